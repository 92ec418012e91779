"""Compiler options for short interactive work."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import PyTree

OPTIONS: dict[str, bool | int] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""Options of XLA in JAX 0.10: half of the compile time, at 1.0 to 1.8 times the run time."""


@functools.cache
def has_options() -> bool:
    """Whether this version of XLA has these options: JAX 0.12 has not, and its level alone gains nothing."""
    options: Any = OPTIONS
    try:
        jax.jit(lambda x: x).lower(0.0).compile(compiler_options=options)
    except jax.errors.JaxRuntimeError:
        return False
    return True


class _Setting:
    enabled = False


_setting = _Setting()


def enable_fast_compilation(enabled: bool = True) -> None:
    """Compile with fewer optimisations, on CPUs and with JAX 0.10: for short interactive work.

    Compiling takes about half of the time, and compiled functions take 1.0 to 1.8 times as long
    (`python benchmarks/compilation.py --fast`). It pays for up to a few hundred relaxations of one size. The
    setting holds for functions of vertax that are called outside of `jax.jit`, `jax.vmap` and `jax.grad`,
    from the next call on; both versions of a function are kept. It is no setting of JAX.

    ```python
    import vertax as vx

    vx.enable_fast_compilation()
    ```

    **Arguments:**

    - `enabled`: False to return to full optimisation.

    **Warns:** `UserWarning` if the installed version of JAX has no such options; nothing changes then.
    """
    if enabled and not has_options():
        warnings.warn(
            f"JAX {jax.__version__} has no options for faster compilation: enable_fast_compilation has no "
            "effect. The compilation cache (vertax.enable_compilation_cache) shortens later processes.",
            stacklevel=2,
        )
        enabled = False
    _setting.enabled = bool(enabled)


def compiles_fast(arguments: PyTree) -> bool:
    """Whether the setting applies to a call: not on other devices, nor while JAX traces a function."""
    if not _setting.enabled or jax.default_backend() != "cpu":
        return False
    # (JAX accepts options for the outermost function only. While it traces, new arrays are tracers.)
    leaves = [jnp.zeros(()), *jax.tree.leaves(arguments)]
    return not any(isinstance(x, jax.core.Tracer) for x in leaves)
