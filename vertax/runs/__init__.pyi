from ._config import (
    ConfigError as ConfigError,
    ExperimentConfig as ExperimentConfig,
    Section as Section,
)
from ._folder import RunFolder as RunFolder
from ._registry import load_config as load_config
from ._sections import (
    Fitting as Fitting,
    Gradient as Gradient,
    ImageFile as ImageFile,
    MicroscopeSection as MicroscopeSection,
    RelaxationSection as RelaxationSection,
    ShapeFactors as ShapeFactors,
    TissueSection as TissueSection,
)
from ._tables import (
    concatenate as concatenate,
    fit_metrics as fit_metrics,
    history_table as history_table,
)
