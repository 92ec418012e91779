"""Read a configuration file."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from vertax.runs._config import apply_overrides, read_toml, validate
from vertax.runs._errors import ConfigError
from vertax.runs._registry import EXPERIMENTS, Experiment, find_experiment
from vertax.runs._shipped import configuration_file, nearest_configuration


def load_config(
    path: str | os.PathLike[str], overrides: Iterable[str] = ()
) -> tuple[Experiment, Any]:
    """Read and check a configuration file.

    **Arguments:**

    - `path`: a TOML file with the name of a job or an experiment as its key `experiment`; or the name of a
        configuration that comes with vertax, such as `"demo"`; `vertax list` shows them.
    - `overrides`: texts `key=value` that set single keys, see
        `apply_overrides`.

    **Returns:** the job or experiment and its configuration, an instance of `experiment.config`.

    **Raises:**

    - `ConfigError` if the file is missing or no TOML, or for an unknown or ill-typed key.
    """
    file = configuration_file(path)
    if not file.exists():
        raise ConfigError(
            f"There is no configuration file {os.fspath(path)}.{nearest_configuration(path)}"
        )
    data = apply_overrides(read_toml(file), overrides)
    if "experiment" not in data:
        raise ConfigError(
            f"In {os.fspath(path)}: `experiment` is missing; it names the job or experiment to run, "
            f"one of {', '.join(EXPERIMENTS)}."
        )
    experiment = find_experiment(data["experiment"])
    return experiment, validate(experiment.config, data, os.fspath(path))
