"""Division of a cell."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.checks import as_real, check_integer, check_shape
from vertax._base.indexing import take
from vertax._base.results import RESULTS, checked
from vertax._base.tracing import is_concrete, tree_where
from vertax.mesh import Tissue, Topology
from vertax.transitions._change import Change, unchanged
from vertax.transitions._cut import Cut, find_cut, points_at
from vertax.transitions._euler_operators import Slot, spare_slot, split_cell
from vertax.transitions._t1 import has_new_overlaps


def divide(
    tissue: Tissue,
    cell: int | Int[Array, ""],
    axis: ArrayLike | None = None,
    *,
    throw: bool = True,
) -> Change:
    r"""Divide a cell by a straight edge through its centroid.

    The new edge is perpendicular to an axis, along which the daughters are next to each other: the long axis
    of the cell (Hertwig's rule), or a given axis. The daughters cover the area of the mother. One keeps the
    number of the mother, the other one uses a spare slot, see [`with_capacity`][vertax.Tissue.with_capacity]:

    ```python
    change = vx.transitions.divide(tissue.with_capacity(50), 3)
    tissue, energy = change.tissue, change.inherited(energy)
    ```

    Works under `jax.jit` and `jax.vmap`. The parts of an arc are arcs of the same circle. The ends of the new
    edge are at least 5 % of the length of a side away from its corners.

    **Arguments:**

    - `tissue`: the tissue, with spare slots.
    - `cell`: number of the cell.
    - `axis`, shape `(2,)`: direction from one daughter to the other; by default the long axis, from the
        second moments of the area.
    - `throw`: raise an error if the cell cannot divide. If False, look at `result`.

    **Returns:** a [`Change`][vertax.transitions.Change], with the tissue.

    **Raises:**

    - `ValueError` for an invalid axis, or a cell that does not exist.
    - `RuntimeError` (an error of Equinox inside `jax.jit`) without a spare slot, or if no cut
        perpendicular to the axis gives two cells without overlaps.
    """
    if axis is not None:
        axis = as_real("axis", axis)
        check_shape("axis", axis, (2,))
        if is_concrete(axis) and not np.any(np.asarray(axis)):
            raise ValueError("Argument `axis` must be a direction, but is zero.")
    check_cell(tissue, cell)
    change = _divide(tissue, jnp.asarray(cell), axis)
    describe = f"The capacity is {tissue.n_cells} cells".format
    return checked(change, change.result, describe) if throw else change


def check_cell(tissue: Tissue, cell: int | Int[Array, ""]) -> None:
    """Raise an error unless `cell` is the number of a living cell; only its type is checked for tracers."""
    is_array = isinstance(cell, jax.Array | np.ndarray) and cell.ndim == 0
    if not (is_array and jnp.issubdtype(jnp.result_type(cell), jnp.integer)):
        check_integer("cell", cell)
    if not is_concrete(cell) or not is_concrete(tissue.topology.cell):
        return
    alive = 0 <= int(cell) < tissue.n_cells and int(cell) in np.asarray(tissue.topology.cell)
    if not alive:
        raise ValueError(f"Argument `cell` must be the number of a living cell, but is {cell}.")


@announced_jit
def _divide(
    tissue: Tissue, cell: Int[Array, ""], axis: Float[Array, "2"] | None, do: bool | Array = True
) -> Change:
    return divided(tissue, cell, axis, jnp.asarray(do))


def divided(
    tissue: Tissue, cell: Int[Array, ""], axis: Float[Array, "2"] | None, do: Bool[Array, ""]
) -> Change:
    """Divide a cell if `do`, if there is a spare slot and if it can be cut."""
    m, sides = tissue.topology, tissue.sides
    cut = find_cut(tissue, m.cell == cell, axis)
    slot = spare_slot(m)
    done = do & slot.available & cut.possible

    out, into = cut.out, cut.into
    both = jnp.stack([out, into])
    points = points_at(take(sides, both), cut.fractions)
    parts = _Parts.of(m, cut, slot)
    changed = split_cell(m, out, parts.second, slot, done)
    frames = jnp.stack([take(m.frame, out), take(changed.frame, parts.second)])
    points = points - tissue.boundary.translation(frames)
    place = jnp.where(done, jnp.stack(slot.vertices), tissue.n_vertices)
    new = tissue.with_vertices(tissue.vertices.at[place].set(points, mode="drop"))
    new = new.with_topology(changed)
    drop = lambda e: jnp.where(done, e, tissue.n_edges)
    if tissue.angles is not None:
        angles = tissue.angles
        for old, new_edge, fraction in zip(parts.edges, slot.edges, parts.fractions, strict=False):
            angle = take(angles, old)
            angles = angles.at[drop(new_edge)].set((1 - fraction) * angle, mode="drop")
            angles = angles.at[drop(old)].set(fraction * angle, mode="drop")
        new = new.with_angles(angles.at[drop(slot.edges[2])].set(0, mode="drop"))
    # (In a concave cell, or near a corner, the new edge may cross other sides.)
    valid = done & ~has_new_overlaps(new, tissue)

    same = unchanged(tissue)
    put = lambda old, where, parent: old.at[jnp.where(valid, where, old.size)].set(
        parent.astype(old.dtype), mode="drop"
    )
    edge, other = take(m.edge, out), take(m.edge, into)
    failure = RESULTS.where(slot.available, RESULTS.division_impossible, RESULTS.capacity_reached)
    result = RESULTS.where(valid, RESULTS.successful, failure)
    return Change(
        tree_where(valid, new, tissue),
        put(same.cells, slot.cell, cell),
        put(same.edges, jnp.stack(slot.edges), jnp.stack([edge, other, edge])),
        put(same.vertices, jnp.stack(slot.vertices), take(m.source, both)),
        result,
    )


class _Parts(NamedTuple):
    """The parts of the edges after the first and the second cut."""

    second: Int[Array, ""]
    """The half-edge of the second cut; a part of the first edge if both cuts are on the same edge."""
    edges: tuple[Int[Array, ""], Int[Array, ""]]
    """The edges that are cut; each keeps the part before the cut."""
    fractions: tuple[Float[Array, ""], Float[Array, ""]]
    """Length of that part, as a fraction of the length before the cut."""

    @classmethod
    def of(cls, m: Topology, cut: Cut, slot: Slot) -> _Parts:
        first, second = cut.fractions
        out, into = cut.out, cut.into
        edge, other, ahead = take(m.edge, out), take(m.edge, into), 3 * slot.vertices[0]
        # If a cell is its own neighbour, both cuts may be on the same edge, on opposite sides: the second cut
        # is on the part before the first cut, or after it.
        opposite = take(m.twin, out) == into
        late = opposite & (first + second > 1)
        before = jnp.where(late, (second - 1 + first) / first, second / (1 - first))
        # An arc may be cut twice on the same side.
        same = out == into
        after = same & (second > first)
        along = jnp.where(after, (second - first) / (1 - first), second / first)
        half_edge = jnp.where(late, ahead + 2, jnp.where(after, ahead, into))
        on_new = (opposite & ~late) | after
        return cls(
            half_edge,
            (edge, jnp.where(on_new, slot.edges[0], other)),
            (first, jnp.where(same, along, jnp.where(opposite, before, second))),
        )
