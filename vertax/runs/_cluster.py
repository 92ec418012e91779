"""Workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax

import vertax
from vertax._base.extras import requires_extra
from vertax.runs._config import ConfigError

_TIMEOUT = 10


@contextlib.contextmanager
def cluster(scheduler: str) -> Iterator[Executor]:
    """The executor of a Dask cluster.

    **Arguments:**

    - `scheduler`: the address of its scheduler, such as `"tcp://10.0.0.1:8786"`, or its scheduler file.

    **Raises:**

    - `ConfigError` if no scheduler answers within ten seconds, it has no worker, or a worker has another
        version of vertax, JAX or Python.
    """
    with requires_extra("cluster", "--scheduler"):
        import distributed
    name = "scheduler_file" if Path(scheduler).is_file() else "address"
    where: dict[str, Any] = {name: scheduler}
    try:
        client = distributed.Client(**where, timeout=_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"No Dask scheduler answers at {scheduler} within {_TIMEOUT} seconds ({error}). Start one by "
            "`dask scheduler`, or correct the address after --scheduler."
        ) from None
    with client:
        expected: str = _versions()
        workers: Any = client.run(_versions)
        if not workers:
            raise ConfigError(
                f"The scheduler at {scheduler} has no workers. Start one by `dask worker {scheduler}`."
            )
        for worker, versions in workers.items():
            if versions != expected:
                raise ConfigError(
                    f"The worker {worker} has {versions}, but this process has {expected}. Install the same "
                    "versions in both."
                )
        yield client.get_executor()


def _versions() -> str:
    python = ".".join(platform.python_version_tuple()[:2])
    return f"vertax {vertax.__version__}, JAX {jax.__version__} and Python {python}"
