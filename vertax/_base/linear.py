"""Linear functions that bring their own transpose."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.core
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


def linear_pair(
    name: str, there: Callable[..., Array], back: Callable[..., Array]
) -> Callable[..., Array]:
    """The first of two functions that are each other's transpose, as JAX is to know it.

    The transpose of a look at an array, `x[indices]`, is a scatter to JAX, which takes twice as long on a CPU
    and adds up in any order on a GPU. Where it can be a look as well, here is how to say so.

    **Arguments:**

    - `name`: what it is called in a program.
    - `there`: a function of an array, in which it is linear, and of others, in which it is not
        differentiated.
    - `back`: its transpose: of the cotangent, and of the same others.
    """
    one, other = Primitive(name), Primitive(f"{name}_transposed")
    _define(one, there, other)
    _define(other, back, one)
    return one.bind


def _define(primitive: Primitive, function: Callable[..., Array], transposed: Primitive) -> None:
    def outcome(*operands: Any) -> jax.core.ShapedArray:
        out = jax.eval_shape(function, *operands)
        return jax.core.ShapedArray(out.shape, out.dtype)

    def jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
        value, (tangent, *_) = primitive.bind(*primals), tangents
        if type(tangent) is ad.Zero:
            return value, ad.Zero(jax.typeof(value).to_tangent_aval())
        return value, primitive.bind(tangent, *primals[1:])

    def transpose(cotangent: Any, x: Any, *others: Any) -> list[Any]:
        zero = type(cotangent) is ad.Zero
        result = ad.Zero(x.aval) if zero else transposed.bind(cotangent, *others)
        return [result, *(None for _ in others)]

    def batched(operands: Any, axes: Any) -> tuple[Array, int]:
        return jax.vmap(function, in_axes=axes)(*operands), 0

    primitive.def_impl(jax.jit(function))
    primitive.def_abstract_eval(outcome)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))
