"""Compiler options for short interactive work."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import PyTree

OPTIONS: dict[str, bool | int] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""Options of XLA: about half of the compile time, at 1.3 to 1.8 times the run time."""


@functools.cache
def available_options() -> dict[str, bool | int]:
    """Those of `OPTIONS` that this version of XLA has."""

    def exists(name: str, value: bool | int) -> bool:
        options: Any = {name: value}
        try:
            jax.jit(lambda x: x).lower(0.0).compile(compiler_options=options)
        except jax.errors.JaxRuntimeError:
            return False
        return True

    return {name: value for name, value in OPTIONS.items() if exists(name, value)}


class _Setting:
    enabled = False


_setting = _Setting()


def enable_fast_compilation(enabled: bool = True) -> None:
    """Compile with fewer optimisations, on CPUs: for short interactive work.

    Compiling takes about half of the time, and compiled functions take 1.3 to 1.8 times as long
    (`python benchmarks/compilation.py --fast`). It pays for up to a few hundred relaxations of one size. The
    setting holds for functions of vertax that are called outside of `jax.jit`, `jax.vmap` and `jax.grad`,
    from the next call on; both versions of a function are kept. It is no setting of JAX.
    (Figures of JAX 0.10. JAX 0.12 lacks one of the two options of XLA, and gains less.)

    ```python
    import vertax as vx

    vx.enable_fast_compilation()
    ```

    **Arguments:**

    - `enabled`: False to return to full optimisation.
    """
    _setting.enabled = bool(enabled)


def compiles_fast(arguments: PyTree) -> bool:
    """Whether the setting applies to a call: not on other devices, nor while JAX traces a function."""
    if not _setting.enabled or jax.default_backend() != "cpu":
        return False
    # (JAX accepts options for the outermost function only. While it traces, new arrays are tracers.)
    leaves = [jnp.zeros(()), *jax.tree.leaves(arguments)]
    return not any(isinstance(x, jax.core.Tracer) for x in leaves)
