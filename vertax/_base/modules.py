"""What makes modules pleasant to use: properties that compile as one, numbers that compile once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool

Tree = TypeVar("Tree", bound=Any)

if TYPE_CHECKING:
    compiled_property = property  # so that type checkers see the type of each property
else:

    class compiled_property(property):
        """A property of an Equinox module that is compiled as one function.

        Outside `jax.jit` a property of thirty array operations would otherwise compile thirty functions
        when it is first used; inside, it is inlined.
        """

        def __init__(self, method: Callable[[Any], Any]):
            super().__init__(eqx.filter_jit(method, inline=True), doc=method.__doc__)


def is_concrete(value: Any) -> bool:
    """Whether the numbers of an array can be looked at (outside of `jax.jit` and `jax.grad`)."""
    return not isinstance(value, jax.core.Tracer)


def differs_between_devices(array: jax.typing.ArrayLike) -> bool:
    """Whether `jax.shard_map` keeps track of an array as one that differs from device to device."""
    kind = jax.typeof(array)
    newer = getattr(getattr(kind, "mat", None), "varying", None)  # as of JAX 0.10
    return bool(newer or getattr(kind, "vma", None))


def choose(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """`jnp.where` of two pytrees that may hold more than arrays, with the types of the old one."""
    pick = lambda x, y: jnp.where(condition, x, y).astype(y.dtype) if eqx.is_array(x) else x
    return jax.tree.map(pick, new, old)


def traced(tree: Tree, *, integers: bool = False) -> Tree:
    """The same pytree with its Python floats (and integers) as arrays.

    `equinox.filter_jit` takes numbers that are no arrays for a part of the program, and compiles another
    one for each. These arrays keep the precision of what they are combined with, as Python numbers do.
    """

    def convert(x: Any) -> Any:
        if isinstance(x, float) or (integers and isinstance(x, int) and not isinstance(x, bool)):
            return jnp.asarray(x)
        return x

    return jax.tree.map(convert, tree)
