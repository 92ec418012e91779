"""Linear functions with a custom transpose."""

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
    name: str, function: Callable[..., Several], transposed: Callable[..., Several]
) -> Callable[..., Several]:
    """A linear function with a given transpose; the transpose of the transpose is the function again.

    JAX transposes a gather, `x[indices]`, to a scatter-add, which takes twice as long on a CPU and adds in
    undefined order on a GPU. Use this if the transpose can be written as a gather too. (Several arrays as
    input and output avoid a concatenation in the transpose.)

    **Arguments:**

    - `name`: name of the primitive in a jaxpr.
    - `function`: takes a tuple of arrays, in which it is linear, and other arguments, which are constants of
        the differentiation; returns a tuple of arrays.
    - `transposed`: its transpose; takes the cotangents and the same other arguments.
    """
    forward, backward = Primitive(name), Primitive(f"{name}_transposed")
    _define(forward, function, backward)
    _define(backward, transposed, forward)
    return lambda parts, *others: tuple(forward.bind(*parts, *others, number=len(parts)))


def _define(primitive: Primitive, function: Callable[..., Several], transposed: Primitive) -> None:
    primitive.multiple_results = True

    def flat(*operands: Any, number: int) -> list[Array]:
        return list(function(operands[:number], *operands[number:]))

    def abstract_eval(*operands: Any, number: int) -> list[jax.core.ShapedArray]:
        out = jax.eval_shape(functools.partial(flat, number=number), *operands)
        return [jax.core.ShapedArray(x.shape, x.dtype) for x in out]

    def jvp(primals: Any, tangents: Any, number: int) -> tuple[Any, Any]:
        # (JAX does not call this if all tangents are symbolic zeros.)
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
        # (A defined primal is an instantiated zero; it has no cotangent.)
        undefined = [ad.is_undefined_primal(part) for part in parts]
        gradients = [
            x if is_undefined else None for x, is_undefined in zip(back, undefined, strict=True)
        ]
        return [*gradients, *(None for _ in others)]

    def batched(operands: Any, axes: Any, number: int) -> tuple[list[Array], list[int]]:
        out = jax.vmap(functools.partial(flat, number=number), in_axes=axes)(*operands)
        return out, [0] * len(out)

    primitive.def_impl(jax.jit(flat, static_argnames="number"))
    primitive.def_abstract_eval(abstract_eval)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(flat, multiple_results=True))
