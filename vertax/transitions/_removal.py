"""Removal: a cell goes, and its neighbours close the gap."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vertax._base.tracing import tree_where
from vertax.mesh import Tissue
from vertax.transitions._change import Change, raise_if, unchanged
from vertax.transitions._division import check_cell
from vertax.transitions._edge_frames import EdgeFrames
from vertax.transitions._t1 import has_new_overlaps, overlapping_faces
from vertax.transitions._t2 import can_vanish, vanished

# A flipped edge is at first so long, compared with what it was; and shorter where there is no room.
_SHARES = (0.5, 0.1, 0.02)


def remove(tissue: Tissue, cell: int | Int[Array, ""], *, throw: bool = True) -> Change:
    """Remove a cell at once, as extrusion and death do; its neighbours share what it leaves.

    Its shortest edges flip until it has three sides, and then it becomes a vertex. Its slot is spare then.
    Where a cell is to shrink in time before it goes, let its target area fall and relax with
    `transitions=T1() + T2()` instead. Works under `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `tissue`: the tissue, which must have place for spare slots, see
        [`with_capacity`][vertax.Tissue.with_capacity].
    - `cell`: number of the cell.
    - `throw`: raise an error if the cell cannot go. If False, look at `done`.

    **Returns:** a [`Change`][vertax.transitions.Change], with the tissue.

    **Raises:**

    - `ValueError` for a cell that is not there, or a tissue that has no place for spare slots.
    - `RuntimeError` (of Equinox inside `jax.jit`) if the cell cannot go: a neighbour would be left with too
        few sides, cells would overlap, or it is pinned.
    """
    if not tissue.topology.spare:
        raise ValueError(
            "A cell that goes leaves a spare slot behind, for which the tissue must be ready: pass "
            "tissue.with_capacity(tissue.n_cells)."
        )
    check_cell(tissue, cell)
    change = _remove(tissue, jnp.asarray(cell))
    reason = (
        "The cell cannot be removed: a neighbour would be left with too few sides, cells would overlap, or a "
        "corner is pinned. With throw=False `done` tells."
    )
    return raise_if(change, ~change.done, reason) if throw else change


@eqx.filter_jit
def _remove(tissue: Tissue, cell: Int[Array, ""]) -> Change:
    return removed(tissue, cell, jnp.array(True))


def removed(tissue: Tissue, cell: Int[Array, ""], do: Bool[Array, ""]) -> Change:
    """A cell is gone, if it is to go and can."""
    edges = jnp.arange(tissue.n_edges)

    def sides(tissue: Tissue) -> Array:
        return jnp.sum(tissue.topology.cell == cell)

    # A flip takes the edge from the two cells beside it and gives it to the two at its ends. In a small
    # periodic box these may be the same cell. Only flips that take sides from the cell are candidates, so
    # that the loop ends: each flip lowers the number of sides, and between two flips each edge is refused
    # at most once.
    def candidates(frames: EdgeFrames, refused: Array) -> Array:
        its_own = frames.cells == cell
        lost = jnp.sum(its_own[:, :2], axis=-1) - jnp.sum(its_own[:, 2:], axis=-1)
        return (lost > 0) & frames.can_flip & ~refused

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        *_, more = carry
        return more

    def flip(carry: tuple) -> tuple:
        tissue, refused, _ = carry
        frames = EdgeFrames(tissue)
        may = candidates(frames, refused)
        edge = jnp.argmin(jnp.where(may, frames.length, jnp.inf))
        which = may & (edges == edge)
        tissue, good = flipped(tissue, frames, which)
        # What found no room before may find some now.
        refused = jnp.where(good, False, refused | which)
        return tissue, refused, (sides(tissue) > 3) & (good | jnp.any(may & ~which))

    none = unchanged(tissue)
    nothing = jnp.zeros(tissue.n_edges, bool)
    start = (tissue, nothing, do & (sides(tissue) > 3))
    reduced, *_ = jax.lax.while_loop(unfinished, flip, start)
    go = do & can_vanish(reduced)[cell]
    gone = vanished(reduced, cell, go)
    done = go & ~has_new_overlaps(gone, tissue)
    return Change(tree_where(done, gone, tissue), none.cells, none.edges, none.vertices, done)


def flipped(
    tissue: Tissue, frames: EdgeFrames, which: Bool[Array, " edges"]
) -> tuple[Tissue, Bool[Array, ""]]:
    """The tissue with an edge flipped where there is room for it, and whether it is."""
    before = overlapping_faces(tissue.overlaps)
    shares = jnp.asarray(_SHARES, frames.length.dtype)

    def with_share(k: Int[Array, ""]) -> Tissue:
        placed = frames.place(tissue, which, frames.across, shares[k] * frames.length)
        return frames.flip(placed, which)

    def crowded(carry: tuple) -> tuple:
        k, _ = carry
        return k + 1, jnp.any(overlapping_faces(with_share(k).overlaps) & ~before)

    again = lambda carry: carry[1] & (carry[0] < len(_SHARES))
    tries, bad = jax.lax.while_loop(again, crowded, (jnp.array(0), jnp.array(True)))
    good = ~bad & jnp.any(which)
    return tree_where(good, with_share(tries - 1), tissue), good
