from ._cache import enable_cache as enable_cache
from ._config import (
    ExperimentConfig as ExperimentConfig,
    Section as Section,
    allowed as allowed,
    apply_overrides as apply_overrides,
    fields as fields,
    template as template,
)
from ._errors import (
    ConfigError as ConfigError,
    RunFolderError as RunFolderError,
    UnfinishedRunError as UnfinishedRunError,
)
from ._folder import RunFolder as RunFolder
from ._load import load_config as load_config
from ._registry import (
    EXPERIMENTS as EXPERIMENTS,
    Experiment as Experiment,
    find_experiment as find_experiment,
)
from ._summary import summary as summary
from ._versions import installed_version as installed_version
