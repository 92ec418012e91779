"""Checks of the fields of a module when it is created."""

from __future__ import annotations

import dataclasses
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
