"""Checks of energies, costs and tissues as arguments."""

from __future__ import annotations

import inspect
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.checks import describe
from vertax._base.field_checks import warn_of_outer_products


def check_energy(energy: Any, name: str = "energy") -> None:
    """Raise an error unless an argument is an energy or another function of a tissue.

    **Arguments:**

    - `energy`: the argument.
    - `name`: its name in the message.

    **Raises:**

    - `TypeError` for an object that is not callable, and for a class in place of an instance.
    """
    if callable(energy) and not isinstance(energy, type):
        return
    raise TypeError(
        f"Argument `{name}` must be an energy, e.g. vertax.energies.ShapeFactorEnergy(3.8), but is "
        f"{describe(energy)}.{instance_hint(energy)}"
    )


def real_scalar(value: Any, name: str = "energy") -> Float[Array, ""]:
    """The value of an energy or cost; an error unless it can be differentiated.

    Only its type is checked, which costs nothing in a compiled function.

    **Raises:**

    - `TypeError` for a value that is no floating-point number, or not one number.
    """
    if jnp.issubdtype(getattr(value, "dtype", float), jnp.floating) and jnp.shape(value) == ():
        return value
    what = describe(value)
    if hasattr(value, "dtype"):
        what = f"{value.dtype} of shape {jnp.shape(value)}"
    raise TypeError(
        f"Argument `{name}` must return one floating-point number, but returns {what}. Compute it from "
        "vertices, areas, lengths or other geometry (integers such as numbers of neighbours have no "
        "derivative), sum over cells or edges, and return jnp.asarray(…, float) of a constant."
    )


def warn_of_columns(function: Any, tissue: Any, *arguments: Any) -> None:
    """Warn of a column in an energy or cost that makes a matrix of one entry per cell, edge or vertex."""
    if tissue.vertices.ndim == 2:
        counts = {"cell": tissue.n_cells, "edge": tissue.n_edges, "vertex": tissue.n_vertices}
        warn_of_outer_products(function, counts, tissue, *arguments)


def instance_hint(value: Any) -> str:
    """Remedy for a class in place of an instance: how to make an instance; empty for other values."""
    if not isinstance(value, type):
        return ""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # a class defined in C has no signature
        return f" Pass an instance, {value.__name__}(...)."
    required = [p.name for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    return f" Pass an instance, {value.__name__}({', '.join(required)})."


def check_single(
    tissue: Any, remedy: str = "Map over a batch with equinox.filter_vmap.", name: str = "tissue"
) -> None:
    """Raise a `ValueError` for a batch of tissues as the argument `name`; `remedy` ends the message."""
    if jnp.ndim(tissue.vertices) != 2:
        raise ValueError(
            f"Argument `{name}` must be a single tissue, but its vertices have shape "
            f"{jnp.shape(tissue.vertices)}. {remedy}"
        )


def check_spare(tissue: Any) -> None:
    """Raise a `ValueError` for a tissue that was not made with a capacity."""
    if not tissue.topology.spare:
        raise ValueError(
            "Argument `tissue` must support spare slots, for cells that come and go, but does not. Pass "
            "tissue.with_capacity(tissue.n_cells), or more for cells that divide."
        )


def check_planar(what: str, tissue: Any) -> None:
    """Raise a `ValueError` for a tissue on a surface; `what` names the calculation."""
    surface = getattr(tissue, "surface", None)
    if surface is not None:
        raise ValueError(
            f"Argument `tissue` must be planar for {what}, but lies on a surface "
            f"({type(surface).__name__}). For the tissue in the chart call tissue.with_surface(None)."
        )
