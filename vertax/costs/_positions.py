"""Distances between the vertices, edges or cells of two tissues."""

from __future__ import annotations

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_choice, check_integer, describe
from vertax._base.indexing import take
from vertax._base.model_checks import check_single
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue

Matching = Literal["number", "cells"]


class VertexDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of vertices to those of a target tissue (paper, "v2v" cost).

    $$C = \frac{1}{2N}\sum_{i=1}^{N} \|x_i - x_{\mathrm{target},i}\|^2$$

    over the $N$ vertices, in units of length squared, with the minimum image in a periodic box.

    With `match="number"` vertices are matched by index: tissue and target should have the same topology,
    because T1 transitions permute the positions of vertices. With `match="cells"` a vertex is matched with
    the target vertex where the same three cells meet in the same cyclic order. A vertex with no match, or
    (in small periodic tissues) with several, contributes 0.

    **Arguments:**

    - `target`: the target tissue, with the same number of vertices.
    - `match`: match vertices by `"number"` (their index) or by the three `"cells"` that meet there.

    **Raises:**

    - `ValueError` if the numbers of vertices (for `"cells"` also of cells) differ, or for an unknown `match`.
    """

    target: Tissue
    match: Matching = eqx.field(static=True, default="number")

    def __check_init__(self):
        check_target("VertexDistance", self.target)
        check_choice("match", self.match, get_args(Matching))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""$(x_i - x_{\mathrm{target},i}) / \sqrt N$."""
        check_equal(type(self).__name__, tissue, self.target, "vertices", same_boundary=True)
        target_vertices = self.target.vertices
        if self.match == "cells":
            check_equal(type(self).__name__, tissue, self.target, "cells")
            counterpart, matched = matching_vertices(tissue, self.target)
            target_vertices = jnp.where(
                matched[:, None], take(target_vertices, counterpart), tissue.vertices
            )
        displacement = tissue.boundary.shortest(tissue.vertices - target_vertices)
        return _root_of_mean(displacement, tissue.topology.alive_vertices, tissue)

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which coordinates are those of a vertex that exists and has a match."""
        compared = tissue.topology.alive_vertices
        if self.match == "cells":
            compared &= matching_vertices(tissue, self.target)[1]
        return jnp.repeat(compared, 2)


class EdgeDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of the edges, arcs included, to those of a target tissue.

    $$C = \frac{1}{2L}\sum_e \ell_{\mathrm{target},e}
      \int_0^1 \|x_e(s) - x_{\mathrm{target},e}(s)\|^2\,\mathrm ds$$

    at the relative arc length $s$ along each edge, with the total length $L$ of the edges of the target; in
    units of length squared, with the minimum image in a periodic box. Unlike
    [`VertexDistance`][vertax.costs.VertexDistance] it depends on the curvature of arcs, and its weights are
    the edge lengths: short edges, with poorly measured directions and angles, have small weights. Edges are
    matched by index, so tissue and target should have the same topology.

    **Arguments:**

    - `target`: the target tissue, with the same number of edges.
    - `points_per_edge`: points of the midpoint rule on each edge.

    **Raises:**

    - `ValueError` if the numbers of edges differ, or for fewer than two points.
    """

    target: Tissue
    points_per_edge: int = eqx.field(static=True, default=5)

    def __check_init__(self):
        check_target("EdgeDistance", self.target)
        check_integer("points_per_edge", self.points_per_edge, at_least=2)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Displacements of points on edges, times the square roots of their quadrature weights."""
        check_equal(type(self).__name__, tissue, self.target, "edges", same_boundary=True)
        fractions = (jnp.arange(self.points_per_edge) + 0.5) / self.points_per_edge
        fractions = fractions.astype(tissue.vertices.dtype)
        target_vertices = self.target.edge_points(fractions)
        displacement = tissue.boundary.shortest(tissue.edge_points(fractions) - target_vertices)
        lengths = self.target.edge_lengths
        share = lengths / (jnp.sum(lengths) * self.points_per_edge)
        return (jnp.sqrt(share)[:, None, None] * displacement).ravel()

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which coordinates are those of an edge that exists in the target."""
        return jnp.repeat(self.target.topology.alive_edges, 2 * self.points_per_edge)


class CentroidDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of the centroids of cells to those of a target tissue.

    $$C = \frac{1}{2N}\sum_{c=1}^{N} \|\bar x_c - \bar x_{\mathrm{target},c}\|^2$$

    over the $N$ cells, in units of length squared, with the minimum image in a periodic box. T1 transitions
    preserve the cells and their indices, so this distance can compare tissues of different topology.

    **Arguments:**

    - `target`: the target tissue, with the same number of cells.

    **Raises:**

    - `ValueError` if the numbers of cells differ.
    """

    target: Tissue

    def __check_init__(self):
        check_target("CentroidDistance", self.target)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""$(\bar x_c - \bar x_{\mathrm{target},c}) / \sqrt N$."""
        check_equal(type(self).__name__, tissue, self.target, "cells", same_boundary=True)
        displacement = tissue.boundary.shortest(tissue.centroids - self.target.centroids)
        return _root_of_mean(displacement, tissue.alive & self.target.alive, tissue)

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which coordinates are those of a cell that exists in the tissue and in the target."""
        return jnp.repeat(tissue.alive & self.target.alive, 2)


def _root_of_mean(
    displacement: Float[Array, "n 2"], living: Bool[Array, " n"], tissue: Tissue
) -> Float[Array, " residuals"]:
    """Displacements over the square root of the number of living rows; 0 in spare slots."""
    if not tissue.topology.spare:
        return displacement.ravel() / jnp.sqrt(1.0 * len(displacement))
    return jnp.where(living[:, None], displacement, 0).ravel() / jnp.sqrt(1.0 * jnp.sum(living))


def matching_vertices(
    tissue: Tissue, target: Tissue
) -> tuple[Int[Array, " vertices"], Bool[Array, " vertices"]]:
    """Match vertices of two tissues where the same three cells meet in the same cyclic order.

    **Arguments:**

    - `tissue`, `target`: the tissues, with equal numbers of vertices and cells.

    **Returns:** for each vertex of the tissue the index of its match in the target, and whether there is
    exactly one match.
    """
    n = tissue.n_vertices
    keys = jnp.concatenate([_meeting_cells(tissue), _meeting_cells(target)])
    order = jnp.lexsort(keys.T[::-1])
    # After sorting, equal keys are adjacent. A match is exactly two equal keys, one from each tissue.
    sorted_keys = take(keys, order)
    same = jnp.all(sorted_keys[1:] == sorted_keys[:-1], axis=-1)
    padding = jnp.zeros(1, bool)
    matches = same & ~jnp.concatenate([padding, same[:-1]]) & ~jnp.concatenate([same[1:], padding])
    first, second = jnp.sort(jnp.stack([order[:-1], order[1:]]), axis=0)
    matches &= (first < n) & (second >= n)
    # Rows that are not a pair write to an index out of range, which is dropped.
    slot = jnp.where(matches, first, n)
    counterpart = jnp.zeros(n, order.dtype).at[slot].set(second - n, mode="drop")
    matched = jnp.zeros(n, bool).at[slot].set(True, mode="drop")
    return counterpart, matched


def _meeting_cells(tissue: Tissue) -> Int[Array, "vertices 3"]:
    """The cells at each vertex in counter-clockwise order, starting with the smallest index."""
    cells = tissue.topology.cell.reshape(-1, 3)
    rotations = jnp.stack([jnp.roll(cells, -k, axis=1) for k in range(3)], axis=1)
    first = jnp.argmin(cells, axis=1)
    return jnp.take_along_axis(rotations, first[:, None, None], axis=1)[:, 0]


def check_target(caller: str, target: Tissue) -> None:
    """Raise a `TypeError` unless a target is a tissue."""
    if not isinstance(target, Tissue):
        raise TypeError(f"The target of {caller} must be a Tissue, but is {describe(target)}.")


def check_equal(
    caller: str, tissue: Tissue, target: Tissue, name: str, *, same_boundary: bool = False
) -> None:
    """Raise an error unless tissue and target have equal numbers of cells, edges or vertices.

    **Arguments:**

    - `caller`: the class or function that compares them, for messages.
    - `tissue`, `target`: the tissues.
    - `name`: `"cells"`, `"edges"` or `"vertices"`.
    - `same_boundary`: whether the boundaries must also be of one class.

    **Raises:**

    - `TypeError` if the target is not a tissue.
    - `ValueError` for different numbers or boundaries, or a batch.
    """
    check_target(caller, target)
    for argument, each in {"tissue": tissue, "target": target}.items():
        check_single(each, "Map over a batch with equinox.filter_vmap, costs included.", argument)
    ours, theirs = (type(t.boundary).__name__ for t in (tissue, target))
    if same_boundary and ours != theirs:
        raise ValueError(
            f"The target of {caller} must have the boundary of the tissue, {ours}, but has {theirs}."
        )
    ours, theirs = (getattr(t, f"n_{name}") for t in (tissue, target))
    if ours != theirs:
        raise ValueError(
            f"The target of {caller} must have {ours} {name}, as the tissue has, but has {theirs}."
        )
