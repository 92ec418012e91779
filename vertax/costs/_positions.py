"""Distances between the vertices, or the cells, of two tissues."""

from __future__ import annotations

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_integer, describe
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._topology import take

Matching = Literal["number", "cells"]


class VertexDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of vertices to those of a target tissue (paper, "v2v" cost).

    $$C = \frac{1}{2N}\sum_{i=1}^{N} \|x_i - x_{\mathrm{target},i}\|^2$$

    over the $N$ vertices, in units of length squared; across a periodic boundary the shorter way
    counts.

    Compared by number, tissue and target should have one topology: after a T1 between them, numbers
    stand for different places. Compared by cells, a vertex belongs to the one of the target at which
    the same three cells meet in the same order; one that has no counterpart, or (in tiny periodic
    tissues) several, does not count.

    **Arguments:**

    - `target`: the target tissue, with as many vertices.
    - `match`: by `"number"` of the vertices, or by the `"cells"` that meet there.

    **Raises:**

    - `ValueError` if the numbers of vertices, or for `"cells"` those of cells, differ, or for an unknown
        `match`.
    """

    target: Tissue
    match: Matching = eqx.field(static=True, default="number")

    def __check_init__(self):
        check_target("VertexDistance", self.target)
        if self.match not in get_args(Matching):
            raise ValueError(
                f"Argument `match` of VertexDistance must be one of {get_args(Matching)}, but is "
                f"{self.match!r}."
            )

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Displacements from the target over the root of the number of vertices."""
        check_equal(type(self).__name__, tissue, self.target, "vertices", place=True)
        goal = self.target.vertices
        if self.match == "cells":
            check_equal(type(self).__name__, tissue, self.target, "cells")
            counterpart, matched = matching_vertices(tissue, self.target)
            goal = jnp.where(matched[:, None], take(goal, counterpart), tissue.vertices)
        displacement = tissue.boundary.shortest(tissue.vertices - goal)
        return _root_of_mean(displacement, tissue.topology.alive_vertices, tissue)


class EdgeDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of the edges, arcs included, to those of a target tissue.

    $$C = \frac{1}{2L}\sum_e \ell_{\mathrm{target},e}
      \int_0^1 \|x_e(s) - x_{\mathrm{target},e}(s)\|^2\,\mathrm ds$$

    at the same share $s$ of the length of an edge, with the length $L$ of all edges of the target; in
    units of length squared; across a periodic boundary the shorter way counts. Where edges are arcs it
    sees how they bend, which [`VertexDistance`][vertax.costs.VertexDistance] does not; and it weighs what
    is drawn of a tissue, so that a short edge, whose direction and angle are mostly noise, counts little.
    Edges are compared by number, so tissue and target should have one topology.

    **Arguments:**

    - `target`: the target tissue, with as many edges.
    - `points_per_edge`: points of the quadrature (midpoint rule) on each edge.

    **Raises:**

    - `ValueError` if the numbers of edges differ, or for fewer than two points.
    """

    target: Tissue
    points_per_edge: int = eqx.field(static=True, default=5)

    def __check_init__(self):
        check_target("EdgeDistance", self.target)
        check_integer("points_per_edge", self.points_per_edge, at_least=2)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Displacements of points on edges, times the root of the share of length they stand for."""
        check_equal(type(self).__name__, tissue, self.target, "edges", place=True)
        fractions = (jnp.arange(self.points_per_edge) + 0.5) / self.points_per_edge
        fractions = fractions.astype(tissue.vertices.dtype)
        goal = self.target.edge_points(fractions)
        displacement = tissue.boundary.shortest(tissue.edge_points(fractions) - goal)
        lengths = self.target.edge_lengths
        share = lengths / (jnp.sum(lengths) * self.points_per_edge)
        return (jnp.sqrt(share)[:, None, None] * displacement).ravel()


class CentroidDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of the centroids of cells to those of a target tissue.

    $$C = \frac{1}{2N}\sum_{c=1}^{N} \|\bar x_c - \bar x_{\mathrm{target},c}\|^2$$

    over the $N$ cells, in units of length squared; across a periodic boundary the shorter way counts.
    Cells, unlike vertices, are the same on both sides of a T1 transition, so this is the distance to use
    between tissues of different topology.

    **Arguments:**

    - `target`: the target tissue, with as many cells.

    **Raises:**

    - `ValueError` if the numbers of cells differ.
    """

    target: Tissue

    def __check_init__(self):
        check_target("CentroidDistance", self.target)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Displacements from the target over the root of the number of cells."""
        check_equal(type(self).__name__, tissue, self.target, "cells", place=True)
        displacement = tissue.boundary.shortest(tissue.centroids - self.target.centroids)
        return _root_of_mean(displacement, tissue.alive & self.target.alive, tissue)


def _root_of_mean(
    displacement: Float[Array, "n 2"], there: Bool[Array, " n"], tissue: Tissue
) -> Float[Array, " residuals"]:
    """Residuals of which half the sum of squares is the mean square over what there is."""
    if not tissue.topology.spare:
        return displacement.ravel() / jnp.sqrt(1.0 * len(displacement))
    return jnp.where(there[:, None], displacement, 0).ravel() / jnp.sqrt(1.0 * jnp.sum(there))


def matching_vertices(
    tissue: Tissue, target: Tissue
) -> tuple[Int[Array, " vertices"], Bool[Array, " vertices"]]:
    """Which vertices of two tissues join the same three cells in the same order.

    **Arguments:**

    - `tissue`, `target`: the tissues, with equally many vertices and cells.

    **Returns:** for each vertex of the tissue the one of the target, and whether there is exactly one.
    """
    n = tissue.n_vertices
    keys = jnp.concatenate([_meeting_cells(tissue), _meeting_cells(target)])
    order = jnp.lexsort(keys.T[::-1])
    # Equal keys are now side by side; a pair of ours and theirs, and no third, is a match.
    ranked = take(keys, order)
    same = jnp.all(ranked[1:] == ranked[:-1], axis=-1)
    no = jnp.zeros(1, bool)
    pair = same & ~jnp.concatenate([no, same[:-1]]) & ~jnp.concatenate([same[1:], no])
    first, second = jnp.sort(jnp.stack([order[:-1], order[1:]]), axis=0)
    pair &= (first < n) & (second >= n)
    # Rows that are no pair write to a place past the end, which is dropped.
    place = jnp.where(pair, first, n)
    counterpart = jnp.zeros(n, order.dtype).at[place].set(second - n, mode="drop")
    matched = jnp.zeros(n, bool).at[place].set(True, mode="drop")
    return counterpart, matched


def _meeting_cells(tissue: Tissue) -> Int[Array, "vertices 3"]:
    """The cells at each vertex in counter-clockwise order, the one of least number first."""
    cells = tissue.topology.cell.reshape(-1, 3)
    turns = jnp.stack([jnp.roll(cells, -k, axis=1) for k in range(3)], axis=1)
    first = jnp.argmin(cells, axis=1)
    return jnp.take_along_axis(turns, first[:, None, None], axis=1)[:, 0]


def check_target(who: str, target: Tissue) -> None:
    """Refuse a target that is no tissue with a `TypeError`."""
    if not isinstance(target, Tissue):
        raise TypeError(f"The target of {who} must be a Tissue, but is {describe(target)}.")


def check_equal(
    who: str, tissue: Tissue, target: Tissue, name: str, *, place: bool = False
) -> None:
    """Refuse a target with another number of something, or a batch.

    **Arguments:**

    - `who`: what compares them.
    - `tissue`, `target`: the tissues.
    - `name`: what there must be equally many of, e.g. `"cells"`.
    - `place`: whether both must also lie in the same kind of space.

    **Raises:**

    - `TypeError` if the target is no tissue.
    - `ValueError` if there are not equally many.
    """
    check_target(who, target)
    for each in (tissue, target):
        if each.vertices.ndim != 2:
            raise ValueError(
                f"{who} compares a single tissue with a single target, but vertices have shape "
                f"{each.vertices.shape}. Take a batch through equinox.filter_vmap, costs included."
            )
    ours, theirs = (type(t.boundary).__name__ for t in (tissue, target))
    if place and ours != theirs:
        raise ValueError(
            f"The target of {who} must have the boundary of the tissue, {ours}, but has {theirs}."
        )
    ours, theirs = (getattr(t, f"n_{name}") for t in (tissue, target))
    if ours != theirs:
        raise ValueError(
            f"The target of {who} must have {ours} {name}, as the tissue has, but has {theirs}."
        )
