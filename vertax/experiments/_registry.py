"""All experiments by name."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

from vertax.experiments import (
    benchmark_adjoints,
    compare_conditions,
    convergent_extension,
    design_mechanics,
    infer_from_microscopy,
    infer_shape_factors,
    infer_tensions,
    inference_across_topologies,
    rigidity_transition,
    salt_and_pepper,
)
from vertax.experiments._config import (
    ConfigError,
    ExperimentConfig,
    apply_overrides,
    read_toml,
    validate,
)
from vertax.experiments._run import RunFolder


class RunFunction(Protocol):
    """Runs an experiment, writes its results to the folder and returns its metrics."""

    def __call__(self, config: Any, folder: RunFolder, *, progress: bool) -> Mapping[str, Any]: ...


class Experiment(NamedTuple):
    """One experiment: what configures it and what runs it."""

    name: str
    config: type[ExperimentConfig]
    run: RunFunction
    summary: str


# One module an experiment, and one entry here.
_ALL = (
    Experiment(
        "infer_shape_factors",
        infer_shape_factors.Config,
        infer_shape_factors.run,
        "Recover hidden target shape factors of a synthetic tissue from its vertices or an image.",
    ),
    Experiment(
        "infer_from_microscopy",
        infer_from_microscopy.Config,
        infer_from_microscopy.run,
        "Infer the target shape factors of the cells in a microscopy image.",
    ),
    Experiment(
        "infer_tensions",
        infer_tensions.Config,
        infer_tensions.run,
        "Infer relative tensions and pressures of a cluster from its segmented image.",
    ),
    Experiment(
        "inference_across_topologies",
        inference_across_topologies.Config,
        inference_across_topologies.run,
        "Recover shape factors where the fit has to lead through T1 transitions.",
    ),
    Experiment(
        "rigidity_transition",
        rigidity_transition.Config,
        rigidity_transition.run,
        "Where tissues turn from solid to fluid as the target shape factor grows.",
    ),
    Experiment(
        "compare_conditions",
        compare_conditions.Config,
        compare_conditions.run,
        "Tell a stiff from a fluid-like epithelium by its microscopy images.",
    ),
    Experiment(
        "benchmark_adjoints",
        benchmark_adjoints.Config,
        benchmark_adjoints.run,
        "Compare automatic and implicit differentiation and equilibrium propagation.",
    ),
    Experiment(
        "design_mechanics",
        design_mechanics.Config,
        design_mechanics.run,
        "Choose target shape factors of cells that give the tissue a mean shape factor.",
    ),
    Experiment(
        "convergent_extension",
        convergent_extension.Config,
        convergent_extension.run,
        "Choose tensions of edges that elongate a cluster of cells.",
    ),
    Experiment(
        "salt_and_pepper",
        salt_and_pepper.Config,
        salt_and_pepper.run,
        "Choose tensions of edges that keep cells of one type apart.",
    ),
)

EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in _ALL}


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


def load_config(
    path: str | os.PathLike[str], overrides: Iterable[str] = ()
) -> tuple[Experiment, Any]:
    """Read and check a configuration file.

    **Arguments:**

    - `path`: a TOML file; its key `experiment` says which experiment it configures.
    - `overrides`: texts `key=value` that set single keys, see
        `apply_overrides`.

    **Returns:** the experiment and its configuration, an instance of `experiment.config`.

    **Raises:**

    - `ConfigError` if the file is missing or no TOML, or for an unknown or ill-typed key.
    """
    data = apply_overrides(read_toml(path), overrides)
    if "experiment" not in data:
        raise ConfigError(
            f"In {os.fspath(path)}: `experiment` is missing; it names the experiment to run, one "
            f"of {', '.join(EXPERIMENTS)}."
        )
    experiment = find_experiment(data["experiment"])
    return experiment, validate(experiment.config, data, os.fspath(path))
