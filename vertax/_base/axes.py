"""Axes of cells, edges and vertices in arrays, as declared by the annotations of fields."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vertax._base.tracing import is_concrete

Tree = TypeVar("Tree", bound=Any)

AXES = ("cells", "edges", "vertices")
"""The names of axes, as in `Float[Array, "cells"]`."""

METADATA = "axis"
"""Metadata key of a field: the name of its first axis (one of `AXES`), or None."""

_SHAPE = re.compile(r"\[[^\[\]]*,\s*[\"']([^\"']*)[\"']\s*\]")


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The axes that a field declares for its arrays."""

    owner: type
    field: str
    shapes: tuple[tuple[str, ...], ...] | None
    """The names of axes of each array type in the annotation; None without a declaration."""

    def axes(self, ndim: int) -> dict[int, str]:
        """The axes of cells, edges and vertices in an array of `ndim` dimensions.

        **Raises:**

        - `TypeError` if the annotation is ambiguous.
        """
        candidates = [_axes_of(shape, ndim) for shape in self.shapes or ()]
        candidates = [axes for axes in candidates if axes is not None]
        distinct = {tuple(axes.items()): axes for axes in candidates}
        if len(distinct) > 1:
            raise TypeError(
                f"Field `{self.field}` of {self.owner.__name__} must declare one meaning of an array of "
                f"{ndim} dimensions, but its annotation has several. Declare it by "
                f'eqx.field(metadata={{"{METADATA}": "cells"}}).'
            )
        return next(iter(distinct.values()), {})


def declarations(tree: Any, opaque: tuple[type, ...] = ()) -> list[Declaration | None]:
    """For each leaf of a pytree, the declaration of the innermost field that contains it.

    **Arguments:**

    - `tree`: the pytree.
    - `opaque`: classes with instances that count as leaves.

    **Returns:** the declarations; None for a leaf outside of modules.
    """
    is_leaf = lambda x: isinstance(x, opaque)
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)
    return [_declaration_at(tree, path) for path, _ in leaves]


def gather(
    tree: Tree,
    parents: Mapping[str, Any],
    sizes: Mapping[str, int],
    *,
    axis: str | None = None,
    opaque: tuple[type, ...] = (),
    strict: tuple[type, ...] = (eqx.Module,),
) -> Tree:
    """Index the arrays of a pytree along their axes of cells, edges and vertices by `parents`.

    **Arguments:**

    - `tree`: the pytree.
    - `parents`: for each name in `AXES`, the old index of each new entry.
    - `sizes`: for each name in `AXES`, the old number of entries.
    - `axis`: the name of the first axis of arrays without a declaration.
    - `opaque`: classes with instances that stay unchanged.
    - `strict`: classes in which an array must be declared if the length of its first axis is one of `sizes`.

    **Raises:**

    - `TypeError` if `axis` is None, for an array outside of modules, and for an undeclared array of one of
        `sizes` in a class of `strict`.
    - `ValueError` for an array of another length than declared.
    """
    is_leaf = lambda x: isinstance(x, opaque)
    leaves, structure = jax.tree.flatten(tree, is_leaf=is_leaf)
    pairs = zip(leaves, declarations(tree, opaque), strict=True)
    return jax.tree.unflatten(
        structure, [_gathered(x, field, parents, sizes, axis, strict) for x, field in pairs]
    )


def _gathered(
    x: Any,
    field: Declaration | None,
    parents: Mapping[str, Any],
    sizes: Mapping[str, int],
    default: str | None,
    strict: tuple[type, ...],
) -> Any:
    if not isinstance(x, jax.Array | np.ndarray) or x.ndim == 0:
        return x
    name = (
        "Argument `tree`" if field is None else f"Field `{field.field}` of {field.owner.__name__}"
    )
    if field is not None and field.shapes is not None:
        axes = field.axes(x.ndim)
    elif default is not None:
        axes = {0: default}
    elif field is None:
        raise TypeError(
            f"{name} must hold its arrays in fields of modules, which declare what has one entry for "
            'each cell, edge or vertex, but holds one outside. Pass axis="cells", "edges" or "vertices".'
        )
    else:
        _check_undeclared(name, x, field, sizes, strict)
        axes = {}
    for at, kind in axes.items():
        if x.shape[at] != sizes[kind]:
            raise ValueError(
                f"{name} must have one entry for each of {sizes[kind]} {kind} along its axis {at}, but its "
                f'shape is {x.shape}. If it has not, declare it: eqx.field(metadata={{"axis": None}}).'
            )
        x = _taken(x, parents[kind], at)
    return x


def _check_undeclared(
    name: str,
    x: Array | np.ndarray,
    field: Declaration,
    sizes: Mapping[str, int],
    strict: tuple[type, ...],
) -> None:
    kinds = {sizes[kind]: kind for kind in reversed(AXES)}
    if issubclass(field.owner, strict) and x.shape[0] in kinds:
        kind = kinds[x.shape[0]]
        raise TypeError(
            f"{name} must declare whether it has one entry for each of the {kind}, of which there are as "
            f'many, but does not. Annotate it, {field.field}: Float[Array, "{kind}"], or '
            'eqx.field(metadata={"axis": None}).'
        )


def _taken(x: Array | np.ndarray, parent: Any, axis: int) -> Array | np.ndarray:
    if is_concrete(x) and is_concrete(parent) and not _is_key(x):
        # NumPy, because JAX would compile this for each size.
        taken = np.take(np.asarray(x), np.asarray(parent), axis)
        return taken if isinstance(x, np.ndarray) else jnp.asarray(taken)
    # (`jnp.take` does not support random keys.)
    return jnp.asarray(x)[(slice(None),) * axis + (parent,)]


def _is_key(x: Array | np.ndarray) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _declaration_at(tree: Any, path: tuple[Any, ...]) -> Declaration | None:
    declaration: Declaration | None = None
    node: Any = tree
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            if isinstance(node, eqx.Module):
                declaration = declaration_of(type(node), key.name)
            node = getattr(node, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            node = node[key.idx]  # pyright: ignore[reportIndexIssue]
        elif isinstance(key, jax.tree_util.DictKey):
            node = node[key.key]  # pyright: ignore[reportIndexIssue]
        else:  # a pytree node without named children
            break
    return declaration


@functools.cache
def declaration_of(cls: type, name: str) -> Declaration:
    """The declaration of a field of a class."""
    (field,) = (f for f in dataclasses.fields(cls) if f.name == name)
    if METADATA in field.metadata:
        axis = field.metadata[METADATA]
        if axis is not None and axis not in AXES:
            raise ValueError(
                f"The metadata `{METADATA}` of field `{name}` of {cls.__name__} must be one of {AXES} or "
                f"None, but is {axis!r}."
            )
        return Declaration(cls, name, () if axis is None else ((f"*{axis}",),))
    shapes = tuple(_shapes(_annotation(cls, field)))
    return Declaration(cls, name, shapes or None)


def _annotation(cls: type, field: dataclasses.Field[Any]) -> Any:
    """The annotation of a field, evaluated in its module if possible."""
    if not isinstance(field.type, str):
        return field.type
    for base in cls.__mro__:
        if field.name in inspect.get_annotations(base):
            names = vars(sys.modules[base.__module__]) if base.__module__ in sys.modules else {}
            try:
                return eval(field.type, dict(names))
            except Exception:  # local names or TYPE_CHECKING imports: parse the text instead
                return field.type
    return field.type


def _shapes(annotation: Any) -> Iterator[tuple[str, ...]]:
    """The shapes of all array types in an annotation."""
    if isinstance(annotation, str):
        yield from (tuple(shape.split()) for shape in _SHAPE.findall(annotation))
    elif isinstance(shape := getattr(annotation, "dim_str", None), str):
        yield tuple(shape.split())
    elif leaf := getattr(annotation, "leaftype", None):  # of a PyTree of jaxtyping
        yield from _shapes(leaf)
    elif not isinstance(annotation, types.EllipsisType):
        for part in typing.get_args(annotation):
            yield from _shapes(part)


def _axes_of(shape: tuple[str, ...], ndim: int) -> dict[int, str] | None:
    """The axes of cells, edges and vertices of an array; None if `ndim` does not match."""
    names = [name.rpartition("=")[2] for name in shape]
    many = [i for i, name in enumerate(names) if name == "..." or "*" in name]
    more = ndim - len(names)
    if more < (-1 if many else 0) or (more > 0 and not many):
        return None
    if many:  # a variadic axis (`*cells` or `...`); its name is that of the first axis
        (at, *_), spread = many, names[many[0]]
        names[at : at + 1] = [spread.replace("*", "")] * min(1, more + 1) + [""] * more
    plain = [name.lstrip("#?*") for name in names]
    return {i: name for i, name in enumerate(plain) if name in AXES}
