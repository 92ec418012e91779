from ._config import (
    ConfigError as ConfigError,
    ExperimentConfig as ExperimentConfig,
    Section as Section,
    allowed as allowed,
    apply_overrides as apply_overrides,
    fields as fields,
    template as template,
)
from ._folder import (
    RunFolder as RunFolder,
    RunFolderError as RunFolderError,
    UnfinishedRunError as UnfinishedRunError,
    installed_version as installed_version,
)
from ._registry import (
    EXPERIMENTS as EXPERIMENTS,
    Experiment as Experiment,
    find_experiment as find_experiment,
    load_config as load_config,
)
from ._summary import summary as summary
