"""Workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import importlib
import logging
import platform
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax

import vertax
from vertax._base.extras import requires_extra
from vertax._base.processes import LocalProcesses
from vertax.runs._config import ConfigError, read_toml

_TIMEOUT = 10


@contextlib.contextmanager
def chosen_executor(
    workers: int | None, scheduler: str | None, file: Path | None
) -> Iterator[Executor | None]:
    """The executor of `--workers`, `--scheduler` or `--cluster`; None without these options.

    **Arguments:**

    - `workers`: number of local processes.
    - `scheduler`: the address of a Dask scheduler, such as `"tcp://10.0.0.1:8786"`, or its scheduler file.
    - `file`: a TOML file with the keys `class`, such as `"dask_jobqueue.SLURMCluster"`, `workers`, the number
        of workers, and `arguments` of the class. The cluster is closed at the end.

    **Raises:**

    - `ConfigError` for two options, a file that describes no cluster, a scheduler that does not answer within
        ten seconds or has no workers, and a worker with another version of vertax, JAX or Python.
    """
    options = {"--workers": workers, "--scheduler": scheduler, "--cluster": file}
    given = [name for name, value in options.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} exclude each other. Pass one of them.")
    with contextlib.ExitStack() as stack:
        if scheduler is None and file is None:
            yield None if workers is None else stack.enter_context(LocalProcesses(workers))
            return
        with requires_extra("cluster", given[0]):
            import distributed
        # (If the scheduler dies, `map_tasks` raises the error.)
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        where = scheduler if file is None else stack.enter_context(_start(file))
        name = "scheduler_file" if scheduler and Path(scheduler).is_file() else "address"
        place: Any = {name: where, "timeout": _TIMEOUT, "set_as_default": False}
        try:
            client: Any = stack.enter_context(distributed.Client(**place))
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"No Dask scheduler answers at {where} within {_TIMEOUT} seconds ({error}). Start one by "
                "`dask scheduler`, or correct the address after --scheduler."
            ) from None
        if file is not None:
            client.wait_for_workers(1)  # a queue may take hours
        installed = client.run(_versions)
        if not installed:
            raise ConfigError(
                f"The scheduler at {where} has no workers. Start one by `dask worker {where}`."
            )
        for worker, versions in installed.items():
            if versions != (expected := _versions()):
                raise ConfigError(
                    f"The worker {worker} has {versions}, but this process has {expected}. Install the same "
                    "versions in both."
                )
        yield client.get_executor()


def _start(file: Path) -> Any:
    """The Dask cluster that a file describes."""
    content = read_toml(file)
    if unknown := set(content) - {"class", "workers", "arguments"}:
        raise ConfigError(
            f"{file} has no key `{min(unknown)}`; its keys are class, workers, arguments."
        )
    module, _, name = str(content.get("class", "")).rpartition(".")
    try:
        cluster = getattr(importlib.import_module(module), name)(**content.get("arguments", {}))
        if "workers" in content:
            cluster.scale(content["workers"])
        return cluster
    except Exception as error:  # of many types: imports, arguments, and commands of the queue
        raise ConfigError(
            f"The cluster `{module}.{name}` of {file} does not start: {type(error).__name__}: {error}."
        ) from error


def _versions() -> str:
    python = ".".join(platform.python_version_tuple()[:2])
    return f"vertax {vertax.__version__}, JAX {jax.__version__} and Python {python}"
