"""Reactions: the rates of change of concentrations, written by the user."""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.checks import as_real, check_instance, describe
from vertax._base.field_checks import check_fields
from vertax.mesh import Tissue


class CellGeometry(NamedTuple):
    """The geometry of the cells at the start of a time step.

    Spare slots hold the values of a living cell, so that reactions are finite there.
    """

    areas: Float[Array, " cells"]
    """Area of each cell."""
    perimeters: Float[Array, " cells"]
    """Perimeter of each cell."""
    neighbour_counts: Int[Array, " cells"]
    """Number of sides of each cell."""
    centroids: Float[Array, "cells 2"]
    """Centroid of each cell."""

    @property
    def shape_factors(self) -> Float[Array, " cells"]:
        r"""Observed shape factor $P/\sqrt{A}$ of each cell."""
        return self.perimeters / jnp.sqrt(self.areas)


class AbstractReaction(eqx.Module):
    r"""The reaction $f$ in $\dot c = f(c, s, t)$, in each cell.

    Subclass it, put the rates into fields and write `__call__`:

    ```python
    class Decay(vx.signals.AbstractReaction):
        rate: float

        def __call__(self, concentrations, cells, time):
            return -self.rate * concentrations
    ```

    For a reaction that depends on other properties of the cells, such as their stress, override `sense`,
    which is called once in each time step.
    """

    def __check_init__(self):
        check_fields(self)

    def sense(self, tissue: Tissue) -> Any:
        """The argument `cells` of the reaction; by default a [`CellGeometry`][vertax.signals.CellGeometry].

        **Arguments:**

        - `tissue`: the tissue at the start of the time step.
        """
        measured = tissue.measured()
        geometry = CellGeometry(
            measured.areas, measured.perimeters, tissue.neighbour_counts, tissue.centroids
        )
        if not tissue.topology.spare:
            return geometry
        return jax.tree.map(lambda x: x[_source_cell(tissue)], geometry)

    @abc.abstractmethod
    def __call__(
        self, concentrations: Float[Array, "species cells"], cells: Any, time: Float[Array, ""]
    ) -> Float[Array, "species cells"]:
        """The rates of change of the concentrations, without exchange and dilution.

        **Arguments:**

        - `concentrations`, shape `(species, cells)`.
        - `cells`: the result of `sense`.
        - `time`: the time.
        """


def _source_cell(tissue: Tissue) -> Int[Array, " cells"]:
    """For each slot a living cell: itself, or the first one for spare slots."""
    return jnp.where(tissue.alive, jnp.arange(tissue.n_cells), jnp.argmax(tissue.alive))


def reaction_rates(
    reaction: AbstractReaction | None,
    concentrations: Float[Array, "species cells"],
    cells: Any,
    time: Float[Array, ""],
    tissue: Tissue,
) -> Float[Array, "species cells"]:
    """The reaction, 0 in spare slots."""
    if reaction is None:
        return jnp.zeros_like(concentrations)
    if not tissue.topology.spare:
        return reaction(concentrations, cells, time)
    # The reaction may have no finite value or derivative at the concentration 0 of spare slots.
    rates = reaction(concentrations[:, _source_cell(tissue)], cells, time)
    return jnp.where(tissue.alive, rates, 0)


def check_rates(reaction: AbstractReaction | None) -> None:
    """Raise an error unless a reaction is an instance with finite rates."""
    if reaction is None:
        return
    expected = "a vertax.signals.AbstractReaction or None"
    remedy = "Write a subclass with the method `__call__`, and pass an instance."
    check_instance("reaction", reaction, AbstractReaction, expected, remedy)
    for path, leaf in jax.tree_util.tree_flatten_with_path(reaction)[0]:
        if isinstance(leaf, float) or eqx.is_inexact_array(leaf):
            as_real(f"reaction{jax.tree_util.keystr(path)}", leaf)


def check_reaction(
    reaction: AbstractReaction | None,
    concentrations: Float[Array, "species cells"],
    tissue: Tissue,
) -> None:
    """Raise an error for a reaction of another shape, or that depends on NumPy; by its traced shape."""
    if reaction is None:
        return
    name, time = type(reaction).__name__, jnp.zeros((), tissue.vertices.dtype)
    call = lambda r, c, tissue, t: r(c, r.sense(tissue), t)
    try:
        rates = eqx.filter_eval_shape(call, reaction, concentrations, tissue, time)
    except jax.errors.TracerArrayConversionError as error:
        raise TypeError(
            f"Reaction `{name}` must use jax.numpy in place of NumPy, which takes no traced arrays. Import "
            "jax.numpy as jnp."
        ) from error
    shape = concentrations.shape
    if getattr(rates, "shape", None) != shape or not jnp.issubdtype(rates.dtype, jnp.floating):
        raise ValueError(
            f"Reaction `{name}` must return one rate for each species and cell, shape {shape}, but returns "
            f"{describe(rates)}. Stack the rates of the species: jnp.stack([...])."
        )
