"""All experiments by name, found in their folder."""

from __future__ import annotations

import ast
import difflib
import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vertax.runs._errors import ConfigError

if TYPE_CHECKING:  # `vertax list` does without what configurations are made of
    from vertax.runs._config import ExperimentConfig

_PACKAGE = "vertax.experiments"


class Experiment(NamedTuple):
    """One experiment: a package that has a configuration `Config` and a function `run`.

    `run(config, folder, *, progress)` writes its results to the [`RunFolder`][vertax.runs.RunFolder] and
    returns its metrics.
    """

    name: str
    summary: str
    """The first line of the docstring of the package."""

    @property
    def config(self) -> type[ExperimentConfig]:
        """What configures it: the `Config` of the package, and the name of its folder as `experiment`."""
        from vertax.runs._config import named

        return named(self._package.Config, self.name)

    @property
    def run(self) -> Callable[..., Mapping[str, Any]]:
        """What runs it."""
        return self._package.run

    @property
    def _package(self) -> Any:
        return importlib.import_module(f"{_PACKAGE}.{self.name}")


def _found() -> dict[str, Experiment]:
    # Their docstrings are read and nothing is imported: lists and help come at once.
    places = map(Path, importlib.import_module(_PACKAGE).__path__)
    experiments: dict[str, Experiment] = {}
    for source in sorted(file for place in places for file in place.glob("*/__init__.py")):
        name = source.parent.name
        if not name.startswith("_"):
            text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
            experiments[name] = Experiment(name, text.partition("\n")[0])
    return experiments


EXPERIMENTS: dict[str, Experiment] = _found()


def find_experiment(name: Any) -> Experiment:
    """The experiment of a name.

    **Arguments:**

    - `name`: as in the key `experiment` of a configuration.

    **Returns:** the experiment.

    **Raises:**

    - `ConfigError` with the nearest name if there is none of this name.
    """
    if isinstance(name, str) and name in EXPERIMENTS:
        return EXPERIMENTS[name]
    near = difflib.get_close_matches(str(name), EXPERIMENTS, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(EXPERIMENTS)}."
    raise ConfigError(f"There is no experiment {name!r}; {hint}")
