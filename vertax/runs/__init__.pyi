from ._config import (
    ExperimentConfig as ExperimentConfig,
    Section as Section,
    allowed as allowed,
    apply_overrides as apply_overrides,
    fields as fields,
    template as template,
    validate as validate,
)
from ._errors import (
    ConfigError as ConfigError,
    RunFolderError as RunFolderError,
    UnfinishedRunError as UnfinishedRunError,
)
from ._folder import RunFolder as RunFolder
from ._load import load_config as load_config
from ._pool import fit_side_by_side as fit_side_by_side, scan as scan, side_by_side as side_by_side
from ._registry import (
    EXPERIMENTS as EXPERIMENTS,
    Experiment as Experiment,
    find_experiment as find_experiment,
)
from ._sections import (
    Fitting as Fitting,
    Gradient as Gradient,
    ImageFile as ImageFile,
    MicrographModel as MicrographModel,
    Microscope as Microscope,
    Preparation as Preparation,
    Relaxation as Relaxation,
    Segmenter as Segmenter,
    ShapeFactors as ShapeFactors,
    TensionRange as TensionRange,
    TissueSection as TissueSection,
    file_name as file_name,
    read_micrograph as read_micrograph,
    replicate_keys as replicate_keys,
    spread_of as spread_of,
)
from ._summary import summary as summary
from ._sweep import (
    SweepRun as SweepRun,
    parse_grid as parse_grid,
    sweep as sweep,
    sweep_runs as sweep_runs,
    sweep_table as sweep_table,
)
from ._tables import (
    fit_metrics as fit_metrics,
    histories as histories,
    history_columns as history_columns,
    joined as joined,
)
from ._versions import installed_version as installed_version
