"""The jobs of the package and the experiments of the repository, by name."""

from __future__ import annotations

import ast
import difflib
import importlib
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vertax.runs._errors import ConfigError
from vertax.runs._shipped import REPOSITORY, configuration_of, shipped_configurations

if TYPE_CHECKING:  # `vertax list` runs without the libraries that configurations are made of
    from vertax.runs._config import ExperimentConfig

_JOBS, _EXPERIMENTS = "vertax.jobs", "experiments"


class Experiment(NamedTuple):
    """A job or an experiment: a module with a configuration class `Config` and a function `run`.

    `run(config, folder, *, progress)` writes its results to the [`RunFolder`][vertax.runs.RunFolder] and
    returns its metrics.
    """

    name: str
    """The name of the module, and the value of the key `experiment` of its configurations."""
    summary: str
    """The first line of the docstring of the module."""
    package: str = _JOBS
    """The package of the module: `vertax.jobs`, or `experiments` of the repository."""

    @property
    def config(self) -> type[ExperimentConfig]:
        """The class `Config` of the module; its key `experiment` accepts only the name of the module."""
        from vertax.runs._config import named

        return named(self._module.Config, self.name)

    @property
    def run(self) -> Callable[..., Mapping[str, Any]]:
        """The function `run` of the module."""
        return self._module.run

    @property
    def is_job(self) -> bool:
        """Whether it is part of the package, and not of the repository alone."""
        return self.package == _JOBS

    @property
    def _module(self) -> Any:
        return importlib.import_module(f"{self.package}.{self.name}")


def _folders() -> Iterator[tuple[str, Path]]:
    """The packages of jobs and experiments, each with its folder."""
    yield from ((_JOBS, Path(folder)) for folder in importlib.import_module(_JOBS).__path__)
    if REPOSITORY is not None:
        yield _EXPERIMENTS, REPOSITORY / _EXPERIMENTS


def _all_experiments() -> dict[str, Experiment]:
    # The docstrings are parsed and no module is imported, because an import takes seconds.
    experiments: dict[str, Experiment] = {}
    for package, folder in _folders():
        for _, name, is_package in pkgutil.iter_modules([str(folder)]):
            file = folder / name / "__init__.py" if is_package else folder / f"{name}.py"
            if not name.startswith("_"):
                text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
                experiments[name] = Experiment(name, text.partition("\n")[0], package)
    return experiments


EXPERIMENTS: dict[str, Experiment] = _all_experiments()


def find_experiment(name: Any) -> Experiment:
    """The job or the experiment of a name.

    **Arguments:**

    - `name`: as in the key `experiment` of a configuration.

    **Returns:** the job or experiment.

    **Raises:**

    - `ConfigError` with the nearest name if there is none of this name, or if it is an experiment of the
        repository and vertax runs as an installed package.
    """
    if isinstance(name, str) and name in EXPERIMENTS:
        return EXPERIMENTS[name]
    for file in shipped_configurations().values():
        if configuration_of(file) == name:
            raise ConfigError(
                f"The experiment {name!r} is not part of the installed package: it is in the folder "
                "`experiments/` of the repository of vertax. There, run: pip install -e '.[run]' && "
                f"vertax run configs/{file.name}"
            )
    near = difflib.get_close_matches(str(name), EXPERIMENTS, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(EXPERIMENTS)}."
    raise ConfigError(f"There is no experiment {name!r}; {hint}")
