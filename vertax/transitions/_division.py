"""Division: one cell becomes two."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.checks import as_real, check_integer
from vertax._base.tracing import is_concrete, tree_where
from vertax.mesh import Tissue, Topology
from vertax.mesh._euler_operators import Slot, spare_slot, split_cell
from vertax.mesh._topology import take
from vertax.transitions._change import Change, raise_if, unchanged
from vertax.transitions._cut import Cut, find_cut, points_at
from vertax.transitions._t1 import has_new_overlaps


def divide(
    tissue: Tissue,
    cell: int | Int[Array, ""],
    axis: ArrayLike | None = None,
    *,
    throw: bool = True,
) -> Change:
    r"""Divide a cell by a straight edge through its centroid.

    The daughters lie beside each other along an axis, and the new edge is across it: along the long axis of
    the cell by Hertwig's rule, or along one that you give. Together they cover what the mother did. One keeps
    her number, the other one takes a spare slot, see [`with_capacity`][vertax.Tissue.with_capacity]:

    ```python
    change = vx.transitions.divide(tissue.with_capacity(50), 3)
    tissue, energy = change.tissue, change.inherited(energy)
    ```

    Works under `jax.jit` and `jax.vmap`. Where sides are arcs their parts are arcs of the same circle. The
    new edge keeps 5 % of the length of a side away from its corners.

    **Arguments:**

    - `tissue`: the tissue, with spare slots.
    - `cell`: number of the cell.
    - `axis`, shape `(2,)`: direction of one daughter from the other; by default the long axis of the second
        moments of the area.
    - `throw`: raise an error if the cell cannot divide. If False, look at `done`.

    **Returns:** a [`Change`][vertax.transitions.Change], with the tissue.

    **Raises:**

    - `ValueError` for an axis that is none, or a cell that is not there.
    - `RuntimeError` (of Equinox inside `jax.jit`) if there is no spare slot left, or if it cannot be cut
        in two along this axis without overlaps.
    """
    if axis is not None:
        axis = as_real("axis", axis)
        if axis.shape != (2,):
            raise ValueError(f"Argument `axis` must have shape (2,), but has {axis.shape}.")
        if is_concrete(axis) and not np.any(np.asarray(axis)):
            raise ValueError("Argument `axis` must be a direction, but is zero.")
    check_cell(tissue, cell)
    change = _divide(tissue, jnp.asarray(cell), axis)
    if not throw:
        return change
    full = ~jnp.any(~tissue.alive)
    reason = (
        f"The cell cannot divide: the tissue has a capacity of {tissue.n_cells} cells, and all are alive. "
        "Make room with tissue.with_capacity(...) before."
    )
    change = raise_if(change, full, reason)
    return raise_if(
        change,
        ~change.done,
        "The cell cannot be cut in two there. Try another axis, or throw=False.",
    )


def check_cell(tissue: Tissue, cell: int | Int[Array, ""]) -> None:
    """Refuse what is no cell, or one that is not there, if that can be seen."""
    array = isinstance(cell, jax.Array | np.ndarray) and cell.ndim == 0
    if not (array and jnp.issubdtype(jnp.result_type(cell), jnp.integer)):
        check_integer("cell", cell)
    if not is_concrete(cell) or not is_concrete(tissue.topology.cell):
        return
    there = 0 <= int(cell) < tissue.n_cells and int(cell) in np.asarray(tissue.topology.cell)
    if not there:
        raise ValueError(f"Argument `cell` must be the number of a living cell, but is {cell}.")


@eqx.filter_jit
def _divide(
    tissue: Tissue, cell: Int[Array, ""], axis: Float[Array, "2"] | None, do: bool | Array = True
) -> Change:
    return divided(tissue, cell, axis, jnp.asarray(do))


def divided(
    tissue: Tissue, cell: Int[Array, ""], axis: Float[Array, "2"] | None, do: Bool[Array, ""]
) -> Change:
    """Divide a cell, if it is to, there is room and it can be cut."""
    m, sides = tissue.topology, tissue.sides
    cut = find_cut(tissue, m.cell == cell, axis)
    slot = spare_slot(m)
    done = do & slot.available & cut.possible

    out, into = cut.out, cut.into
    both = jnp.stack([out, into])
    points = points_at(take(sides, both), cut.shares)
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
        for kept, more, share in zip(parts.edges, slot.edges, parts.shares, strict=False):
            angle = take(angles, kept)
            angles = angles.at[drop(more)].set((1 - share) * angle, mode="drop")
            angles = angles.at[drop(kept)].set(share * angle, mode="drop")
        new = new.with_angles(angles.at[drop(slot.edges[2])].set(0, mode="drop"))
    # (Through a concave cell, or near a corner, the new edge may cross other sides.)
    good = done & ~has_new_overlaps(new, tissue)

    none = unchanged(tissue)
    put = lambda old, where, parent: old.at[jnp.where(good, where, old.size)].set(
        parent.astype(old.dtype), mode="drop"
    )
    edge, other = take(m.edge, out), take(m.edge, into)
    return Change(
        tree_where(good, new, tissue),
        put(none.cells, slot.cell, cell),
        put(none.edges, jnp.stack(slot.edges), jnp.stack([edge, other, edge])),
        put(none.vertices, jnp.stack(slot.vertices), take(m.source, both)),
        good,
    )


class _Parts(NamedTuple):
    """What becomes of the edges that are cut, the first before the second."""

    second: Int[Array, ""]
    """The half-edge that is cut second; one of the first cut, if both are on one edge."""
    edges: tuple[Int[Array, ""], Int[Array, ""]]
    """The edges that are cut, which keep the part before the cut."""
    shares: tuple[Float[Array, ""], Float[Array, ""]]
    """How long that part is, in units of what is cut."""

    @classmethod
    def of(cls, m: Topology, cut: Cut, slot: Slot) -> _Parts:
        first, share = cut.shares
        out, into = cut.out, cut.into
        edge, other, ahead = take(m.edge, out), take(m.edge, into), 3 * slot.vertices[0]
        # A cell that is its own neighbour may be cut twice at one edge, from either side: the second cut is
        # on the part before the first one, or after it.
        opposite = take(m.twin, out) == into
        late = opposite & (first + share > 1)
        before = jnp.where(late, (share - 1 + first) / first, share / (1 - first))
        # An arc may be cut twice from the same side.
        same = out == into
        after = same & (share > first)
        along = jnp.where(after, (share - first) / (1 - first), share / first)
        second = jnp.where(late, ahead + 2, jnp.where(after, ahead, into))
        on_new = (opposite & ~late) | after
        return cls(
            second,
            (edge, jnp.where(on_new, slot.edges[0], other)),
            (first, jnp.where(same, along, jnp.where(opposite, before, share))),
        )
