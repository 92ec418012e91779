"""Tracing and compilation: compiled properties, tests for tracers, numbers that do not recompile."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vertax._base.announce import announced_jit

Tree = TypeVar("Tree", bound=Any)

if TYPE_CHECKING:
    compiled_property = property  # for the types of properties
else:

    class compiled_property(property):
        """A property of an Equinox module that is compiled as one function.

        Outside `jax.jit`, a property of thirty array operations would otherwise compile thirty functions at
        its first use. Inside `jax.jit` the property is inlined.
        """

        def __init__(self, method: Callable[[Any], Any]):
            super().__init__(announced_jit(method, inline=True), doc=method.__doc__)


def is_concrete(value: Any) -> bool:
    """Whether a value is not a tracer of `jax.jit`, `jax.vmap` or `jax.grad`."""
    return not isinstance(value, jax.core.Tracer)


def frozen(tree: Tree) -> Tree:
    """The same values as constants: derivatives through them are 0."""
    # (Concrete arrays are constants already.)
    if all(map(is_concrete, jax.tree.leaves(tree))):
        return tree
    constant = lambda x: x if is_concrete(x) else jax.lax.stop_gradient(x)
    return jax.tree.map(constant, tree)


def closed_over_tracers(function: Any) -> Iterator[str]:
    """Names of the traced variables that a function, or the methods and fields of a module, close over."""
    if isinstance(function, eqx.Module):
        for kind in type(function).__mro__:
            # (Only classes that are defined in a function.)
            if "<locals>" in kind.__qualname__:
                for method in vars(kind).values():
                    yield from closed_over_tracers(
                        inspect.unwrap(getattr(method, "method", method))
                    )
        for field in vars(function).values():
            for leaf in jax.tree.leaves(field, is_leaf=lambda x: isinstance(x, eqx.Module)):
                yield from closed_over_tracers(leaf)
    elif inspect.isfunction(function):
        for name, cell in zip(
            function.__code__.co_freevars, function.__closure__ or (), strict=True
        ):
            with contextlib.suppress(ValueError):  # an empty cell
                if not all(map(is_concrete, jax.tree.leaves(cell.cell_contents))):
                    yield name


def differs_between_devices(array: jax.typing.ArrayLike) -> bool:
    """Whether an array varies over a mesh axis of `jax.shard_map`."""
    kind = jax.typeof(array)
    newer = getattr(getattr(kind, "mat", None), "varying", None)  # since JAX 0.10
    return bool(newer or getattr(kind, "vma", None))


def zeros_of(shapes: Any) -> Any:
    """A pytree with zeros for the arrays of which only shapes are given, as by `jax.eval_shape`."""
    is_shape = lambda x: isinstance(x, jax.ShapeDtypeStruct)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_shape(x) else x, shapes)


def tree_where(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """`jnp.where` for pytrees, with the dtypes of `old`; leaves that are not arrays are those of `new`."""

    def pick(x: Any, y: Any) -> Any:
        if not eqx.is_array(x):
            return x
        chosen = jnp.where(condition, x, y)
        return (
            chosen if chosen.dtype == y.dtype else chosen.astype(y.dtype)
        )  # (Keys have no `astype`.)

    return jax.tree.map(pick, new, old)


def traced(tree: Tree, dtype: Any = None, *, integers: bool = False) -> Tree:
    """Replace Python floats (and integers) by arrays, and weakly typed arrays by strongly typed ones.

    `equinox.filter_jit` compiles a function again for another Python number and for another weak type of an
    array. `jnp.full(n, 3.7)` is weakly typed; the result of a computation usually is not.

    **Arguments:**

    - `tree`: the pytree.
    - `dtype`: dtype of floats and weakly typed arrays, usually that of the tissue. By default floats become
        weakly typed arrays and weakly typed arrays stay.
    - `integers`: convert Python integers too.
    """

    def convert(x: Any) -> Any:
        if isinstance(x, float):
            return jnp.asarray(x, dtype)
        if integers and isinstance(x, int) and not isinstance(x, bool):
            return jnp.asarray(x, None if dtype is None else jnp.result_type(int))
        # (Random keys have no `weak_type`.)
        if dtype is not None and isinstance(x, jax.Array) and getattr(x, "weak_type", False):
            strong = dtype if jnp.issubdtype(x.dtype, jnp.floating) else x.dtype
            return jax.lax.convert_element_type(x, strong)
        return x

    return jax.tree.map(convert, tree)
