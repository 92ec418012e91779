"""Sequential `jax.vmap` on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, ArrayLike

Result = TypeVar("Result")


def sequential_vmap_on_cpu(function: Callable[..., Result]) -> Callable[..., Result]:
    """Make `jax.vmap` of a function a loop over the batch on a CPU, and a batched program elsewhere.

    A batched `while_loop` runs until its slowest member ends, and a batched `cond` computes both branches. On
    a CPU a loop over the members is faster. Under `jax.vmap` the function is not differentiable: its inputs
    must be constants of the differentiation.

    **Arguments:**

    - `function`: takes pytrees and returns a pytree. It must not close over arrays.

    **Returns:** a function with the same arguments and results.
    """

    def call(*args: Any) -> Result:
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        results: list[Any] = []

        def of_leaves(*leaves: Array) -> list[Array]:
            result = function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))
            outputs, rest = eqx.partition(result, eqx.is_array)
            flat, out_structure = jax.tree.flatten(outputs)
            results.append((out_structure, rest))
            return flat

        # Traced once; the batching rule below evaluates the same jaxpr.
        flat = _mapped(jaxpr_as_fun(jax.make_jaxpr(of_leaves)(*leaves)))(*leaves)
        out_structure, rest = results[-1]
        return eqx.combine(jax.tree.unflatten(out_structure, flat), rest)

    return call


def _mapped(program: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
    """Add the batching rule to a function of arrays."""
    mapped = jax.custom_batching.custom_vmap(lambda *leaves: tuple(program(*leaves)))

    @mapped.def_vmap
    def _(size: int, batched: list[bool], *leaves: ArrayLike) -> tuple[Any, Any]:
        if _platform() == "cpu":
            members = [x for x, is_batched in zip(leaves, batched, strict=True) if is_batched]

            def one(members: list[ArrayLike]) -> Any:
                rest = iter(members)
                # `mapped`, so that a nested `vmap` is a loop too.
                pairs = zip(leaves, batched, strict=True)
                return mapped(*(next(rest) if is_batched else x for x, is_batched in pairs))

            result = jax.lax.map(one, members)
        else:
            axes = tuple(0 if is_batched else None for is_batched in batched)
            result = jax.vmap(program, in_axes=axes, axis_size=size)(*leaves)
            result = tuple(result)
        return result, tuple(True for _ in result)

    return mapped


def _platform() -> str:
    """The platform of JAX's default device."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform
