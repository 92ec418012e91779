"""Checks of the fields of a module when it is created."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vertax._base.checks import describe


def check_fields(module: eqx.Module) -> None:
    """Raise an error if a field of a module, or of a nested module, cannot be passed to a compiled function.

    JAX looks up a compiled function by the hash and equality of static fields; arrays have no hash.

    **Raises:**

    - `TypeError`, with the name of the field, for a static value without a hash, such as an array, and for
        a NumPy array that does not contain numbers.
    """
    for field in dataclasses.fields(module):
        if not hasattr(module, field.name):
            continue
        value, what = getattr(module, field.name), f"`{field.name}` of {type(module).__name__}"
        if field.metadata.get("static", False):
            _check_static(what, value)
            continue
        for leaf in jax.tree.leaves(value, is_leaf=lambda x: isinstance(x, eqx.Module)):
            if isinstance(leaf, eqx.Module):
                check_fields(leaf)
            elif isinstance(leaf, np.ndarray) and not _numeric(leaf.dtype):
                raise TypeError(
                    f"Field {what} must hold numbers, but holds {describe(leaf)}. Give text as a tuple: "
                    "tuple(array.tolist())."
                )


def warn_of_outer_products(module: Any, counts: Mapping[str, int], *arguments: Any) -> None:
    """Warn of a field of shape (n, 1) or (1, n) with which a module computes an array of shape (n, n).

    A column times an array of one entry per cell is an outer product, and its sum is a wrong number.

    **Arguments:**

    - `module`: the module, called with the `arguments`; other functions have no fields.
    - `counts`: numbers of cells, edges and vertices by the name of one of them.
    """
    for name, shape in _matrices(module):
        n = max(shape)
        items = [item for item, count in counts.items() if count == n]
        if not items or shape not in ((n, 1), (1, n)):
            continue
        # (The trace takes longer than the rest, but it is rare.)
        try:
            trace, *_ = eqx.filter_make_jaxpr(lambda f, *x: f(*x))(module, *arguments)
        except Exception:  # of a function of time, or of a faulty one, which the computation states
            return
        if f"[{n},{n}]" in str(trace):
            warnings.warn(
                f"Field {name} has the shape {shape}, and its product with an array of one entry per "
                f"{items[0]} has {n} × {n} entries. Give it the shape ({n},): reshape(-1).",
                stacklevel=4,
            )


def _matrices(module: Any) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Names and shapes of the fields of a module, and of nested modules, that are matrices.

    Layers of neural networks are left out: a layer may be as wide as there are cells.
    """
    if not isinstance(module, eqx.Module) or type(module).__module__.startswith("equinox.nn"):
        return
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        for leaf in jax.tree.leaves(value, is_leaf=lambda x: isinstance(x, eqx.Module)):
            yield from _matrices(leaf)
        if isinstance(value, np.ndarray | jax.Array) and value.ndim == 2 and max(value.shape) > 2:
            yield f"`{field.name}` of {type(module).__name__}", value.shape


def _check_static(what: str, value: Any) -> None:
    try:
        hash(value)
    except TypeError as error:
        raise TypeError(
            f"Field {what} must have a hash, because it is static, but holds {describe(value)} ({error}). "
            "For an array leave out static=True (a NumPy array is not fitted); give a list as a tuple."
        ) from error


def _numeric(dtype: np.dtype) -> bool:
    return dtype.kind in "biufc" or bool(jnp.issubdtype(dtype, np.number))
