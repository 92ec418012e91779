"""Which axes of an array are those of cells, edges or vertices, as fields declare it."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax

AXES = ("cells", "edges", "vertices")
"""The names of axes, as in `Float[Array, "cells"]`."""

METADATA = "axis"
"""The key of the metadata of a field: the name of its first axis, or None for none of them."""

_SHAPE = re.compile(r"\[[^\[\]]*,\s*[\"']([^\"']*)[\"']\s*\]")


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What a field declares of the arrays that it holds."""

    owner: type
    field: str
    shapes: tuple[tuple[str, ...], ...] | None
    """The names of axes, for each kind of array that it may hold; None if it declares nothing."""

    def axes(self, ndim: int) -> dict[int, str]:
        """The axes of an array of so many dimensions that are those of cells, edges or vertices.

        **Raises:**

        - `TypeError` if its annotation allows several answers.
        """
        found = [_axes_of(shape, ndim) for shape in self.shapes or ()]
        found = [axes for axes in found if axes is not None]
        distinct = {tuple(axes.items()): axes for axes in found}
        if len(distinct) > 1:
            raise TypeError(
                f"Field `{self.field}` of {self.owner.__name__} must declare one meaning of an array of "
                f"{ndim} dimensions, but its annotation has several. Declare it by "
                f'eqx.field(metadata={{"{METADATA}": "cells"}}).'
            )
        return next(iter(distinct.values()), {})


def declarations(tree: Any, opaque: tuple[type, ...] = ()) -> list[Declaration | None]:
    """For each leaf of a pytree, in order, what the innermost field that holds it declares.

    **Arguments:**

    - `tree`: the pytree.
    - `opaque`: classes whose instances count as leaves.

    **Returns:** the declarations; None for a leaf that no field of a module holds.
    """
    is_leaf = lambda x: isinstance(x, opaque)
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)
    return [_declared(tree, path) for path, _ in leaves]


def _declared(tree: Any, path: tuple[Any, ...]) -> Declaration | None:
    found: Declaration | None = None
    node: Any = tree
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            if isinstance(node, eqx.Module):
                found = declaration_of(type(node), key.name)
            node = getattr(node, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            node = node[key.idx]
        elif isinstance(key, jax.tree_util.DictKey):
            node = node[key.key]
        else:  # a node that says nothing of its children
            break
    return found


@functools.cache
def declaration_of(cls: type, name: str) -> Declaration:
    """What a field of a class declares."""
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
    """The annotation of a field, evaluated if its names are those of the module."""
    if not isinstance(field.type, str):
        return field.type
    for base in cls.__mro__:
        if field.name in inspect.get_annotations(base):
            names = vars(sys.modules[base.__module__]) if base.__module__ in sys.modules else {}
            try:
                return eval(field.type, dict(names))
            except Exception:  # names of a function, or for type checkers only: read as text
                return field.type
    return field.type


def _shapes(annotation: Any) -> Iterator[tuple[str, ...]]:
    """The shapes of all arrays that an annotation names."""
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
    """The axes of cells, edges and vertices of an array; None if it has another number of dimensions."""
    names = [name.rpartition("=")[2] for name in shape]
    many = [i for i, name in enumerate(names) if name == "..." or "*" in name]
    more = ndim - len(names)
    if more < (-1 if many else 0) or (more > 0 and not many):
        return None
    if many:  # stands for any number of axes, of which the name is that of the first
        (at, *_), spread = many, names[many[0]]
        names[at : at + 1] = [spread.replace("*", "")] * min(1, more + 1) + [""] * more
    plain = [name.lstrip("#?*") for name in names]
    return {i: name for i, name in enumerate(plain) if name in AXES}
