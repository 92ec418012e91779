"""What makes modules pleasant to use: properties that compile as one, numbers that compile once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vertax._base.announce import announced_jit

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
            super().__init__(announced_jit(method, inline=True), doc=method.__doc__)


def is_concrete(value: Any) -> bool:
    """Whether the numbers of an array can be looked at (outside of `jax.jit` and `jax.grad`)."""
    return not isinstance(value, jax.core.Tracer)


def differs_between_devices(array: jax.typing.ArrayLike) -> bool:
    """Whether `jax.shard_map` keeps track of an array as one that differs from device to device."""
    kind = jax.typeof(array)
    newer = getattr(getattr(kind, "mat", None), "varying", None)  # as of JAX 0.10
    return bool(newer or getattr(kind, "vma", None))


def tree_where(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """`jnp.where` of two pytrees that may hold more than arrays, with the types of the old one."""
    pick = lambda x, y: jnp.where(condition, x, y).astype(y.dtype) if eqx.is_array(x) else x
    return jax.tree.map(pick, new, old)


def traced(tree: Tree, dtype: Any = None, *, integers: bool = False) -> Tree:
    """The same pytree with arrays for its Python floats (and integers), and without weakly typed arrays.

    `equinox.filter_jit` compiles a function again for another Python number and for another type of an
    array. Weak types differ between a number, `jnp.full(n, 3.7)` and the result of a computation.

    **Arguments:**

    - `tree`: the pytree.
    - `dtype`: the floating-point type of floats and of weakly typed arrays, usually that of the tissue. If
        left out, floats become weakly typed arrays, which take the precision of what they are combined with,
        and weakly typed arrays stay.
    - `integers`: convert Python integers too.
    """

    def convert(x: Any) -> Any:
        if isinstance(x, float):
            return jnp.asarray(x, dtype)
        if integers and isinstance(x, int) and not isinstance(x, bool):
            return jnp.asarray(x, None if dtype is None else jnp.result_type(int))
        if dtype is not None and isinstance(x, jax.Array) and x.weak_type:
            strong = dtype if jnp.issubdtype(x.dtype, jnp.floating) else x.dtype
            return jax.lax.convert_element_type(x, strong)
        return x

    return jax.tree.map(convert, tree)
