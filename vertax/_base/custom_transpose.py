"""Linear functions that bring their own transpose."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.core
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Several = tuple[Array, ...]


def linear_with_transpose(
    name: str, there: Callable[..., Several], back: Callable[..., Several]
) -> Callable[..., Several]:
    """The first of two functions that are each other's transpose, as JAX is to know it.

    The transpose of a look at an array, `x[indices]`, is a scatter to JAX, which takes twice as long on a CPU
    and adds up in any order on a GPU. Where it can be a look as well, here is how to say so. (And what comes
    apart need not be put together for it.)

    **Arguments:**

    - `name`: what it is called in a program.
    - `there`: a function of several arrays, in which it is linear, and of other arguments, in which it is not
        differentiated; it returns several arrays.
    - `back`: its transpose: of the cotangents, and of the same others.
    """
    one, other = Primitive(name), Primitive(f"{name}_transposed")
    _define(one, there, other)
    _define(other, back, one)
    return lambda parts, *others: tuple(one.bind(*parts, *others, number=len(parts)))


def _define(primitive: Primitive, function: Callable[..., Several], transposed: Primitive) -> None:
    primitive.multiple_results = True

    def flat(*operands: Any, number: int) -> list[Array]:
        return list(function(operands[:number], *operands[number:]))

    def outcome(*operands: Any, number: int) -> list[jax.core.ShapedArray]:
        out = jax.eval_shape(functools.partial(flat, number=number), *operands)
        return [jax.core.ShapedArray(x.shape, x.dtype) for x in out]

    def jvp(primals: Any, tangents: Any, number: int) -> tuple[Any, Any]:
        # (JAX does not ask where all tangents are zero.)
        parts = map(ad.instantiate_zeros, tangents[:number])
        changes = primitive.bind(*parts, *primals[number:], number=number)
        return primitive.bind(*primals, number=number), changes

    def transpose(cotangents: Any, *operands: Any, number: int) -> list[Any]:
        parts, others = operands[:number], operands[number:]
        if all(type(part) is ad.Zero for part in cotangents):
            back = [ad.Zero(part.aval) for part in parts]
        else:
            cotangents = [ad.instantiate_zeros(part) for part in cotangents]
            back = transposed.bind(*cotangents, *others, number=len(cotangents))
        # (A part that is known is one that was filled up with zeros.)
        unknown = [ad.is_undefined_primal(part) for part in parts]
        wanted = [x if is_unknown else None for x, is_unknown in zip(back, unknown, strict=True)]
        return [*wanted, *(None for _ in others)]

    def batched(operands: Any, axes: Any, number: int) -> tuple[list[Array], list[int]]:
        out = jax.vmap(functools.partial(flat, number=number), in_axes=axes)(*operands)
        return out, [0] * len(out)

    primitive.def_impl(jax.jit(flat, static_argnames="number"))
    primitive.def_abstract_eval(outcome)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(flat, multiple_results=True))
