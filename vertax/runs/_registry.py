"""The jobs of the package, the experiments of the repository, and their configurations, by name."""

from __future__ import annotations

import ast
import difflib
import functools
import importlib
import os
import pkgutil
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # `vertax list` runs without the libraries that configurations are made of
    from vertax.runs._config import ExperimentConfig

PACKAGE = Path(__file__).parents[1]
_JOBS, _EXPERIMENTS = "vertax.jobs", "experiments"


class Experiment(NamedTuple):
    """A job or an experiment: a module with a configuration class `Config` and a function `run`.

    `run(config, folder, *, progress)` writes its results to the folder and returns its metrics.
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
        from vertax.runs._config import with_name

        return with_name(self._module.Config, self.name)

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


@functools.cache
def all_experiments() -> dict[str, Experiment]:
    """The jobs, and the experiments if the package is part of the repository, by name.

    The docstrings are parsed and no module is imported, because an import takes seconds.
    """
    folders = [(_JOBS, folder) for folder in importlib.import_module(_JOBS).__path__]
    if (PACKAGE.parent / "pyproject.toml").is_file():
        folders.append((_EXPERIMENTS, str(PACKAGE.parent / _EXPERIMENTS)))
    experiments: dict[str, Experiment] = {}
    for package, folder in folders:
        for _, name, _ in pkgutil.iter_modules([folder]):
            if not name.startswith("_"):
                text = (Path(folder) / f"{name}.py").read_text(encoding="utf-8")
                about = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
                experiments[name] = Experiment(name, about, package)
    return experiments


def find_experiment(name: Any) -> Experiment:
    """The job or experiment of a name; a `ConfigError` with the nearest name if there is none."""
    from vertax.runs._config import ConfigError

    experiments = all_experiments()
    if isinstance(name, str) and name in experiments:
        return experiments[name]
    for file in shipped_configurations().values():
        if experiment_of(file) == name:
            raise ConfigError(
                f"The experiment {name!r} is not part of the installed package: it is in the folder "
                "`experiments/` of the repository of vertax. There, run: pip install -e '.[run]' && "
                f"vertax run configs/{file.name}"
            )
    near = difflib.get_close_matches(str(name), experiments, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(experiments)}."
    raise ConfigError(f"There is no experiment {name!r}; {hint}")


def shipped_configurations() -> dict[str, Path]:
    """Configurations by name, from the wheel or from the folder `configs` of the repository."""
    folders = (PACKAGE / "configs", PACKAGE.parent / "configs")
    files = next((sorted(each.glob("*.toml")) for each in folders if each.is_dir()), [])
    return {file.stem: file for file in files}


def experiment_of(file: Path) -> Any:
    """The experiment that a shipped configuration names."""
    return tomllib.loads(file.read_text(encoding="utf-8")).get("experiment")


def summary_of(file: Path) -> str:
    """The first sentence of the comment at the start of a configuration."""
    comment = re.match(r"(#.*\n)*", file.read_text(encoding="utf-8"))
    words = " ".join((comment[0] if comment else "").replace("#", " ").split())
    return re.split(r"[.:](?: |$)", words)[0]


def load_config(
    path: str | os.PathLike[str], overrides: Iterable[str] = ()
) -> tuple[Experiment, Any]:
    """Read and check a configuration file.

    **Arguments:**

    - `path`: a TOML file with the name of a job or an experiment as its key `experiment`; or the name of a
        configuration that comes with vertax, such as `"demo"`; `vertax list` prints them.
    - `overrides`: texts `key=value` that set single keys, such as `"fit.epochs=50"`. A value is written as in
        TOML; any other text is a string.

    **Returns:** the job or experiment and its configuration, an instance of `experiment.config`.
    `experiment.run(config, RunFolder(path))` runs it.

    **Raises:**

    - `ConfigError` if the file is missing or not valid TOML, or for an unknown or ill-typed key.
    """
    from vertax.runs._config import ConfigError, apply_overrides, read_toml, validate

    name, file = os.fspath(path), Path(path)
    shipped = shipped_configurations()
    if not file.is_file():  # a file comes before a configuration of the same name
        file = shipped.get(name, file)
    if not file.exists():
        near = difflib.get_close_matches(file.stem, shipped, n=1, cutoff=0.6)
        hint = f"Did you mean {near[0]}, which comes with vertax?" if near else ""
        hint = hint or "`vertax list` prints those that come with vertax."
        raise ConfigError(f"There is no configuration file {name}. {hint}")
    data = apply_overrides(read_toml(file), overrides)
    if "experiment" not in data:
        raise ConfigError(
            f"In {name}: `experiment` is missing; it names the job or experiment to run, "
            f"one of {', '.join(all_experiments())}."
        )
    experiment = find_experiment(data["experiment"])
    return experiment, validate(experiment.config, data, name)
