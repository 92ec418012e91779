"""Removal of a cell."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vertax._base.announce import announced_jit
from vertax._base.model_checks import check_spare
from vertax._base.results import RESULTS, checked
from vertax._base.tracing import tree_where
from vertax.mesh import Tissue
from vertax.transitions._change import Change, unchanged
from vertax.transitions._division import check_cell
from vertax.transitions._edge_frames import EdgeFrames
from vertax.transitions._t1 import has_new_overlaps, overlapping_faces
from vertax.transitions._t2 import can_vanish, vanished

# Lengths of a flipped edge, relative to its length before; the next one is tried if cells overlap.
_LENGTH_FRACTIONS = (0.5, 0.1, 0.02)


def remove(tissue: Tissue, cell: int | Int[Array, ""], *, throw: bool = True) -> Change:
    """Remove a cell at once (extrusion or cell death); its neighbours share its area.

    Its shortest edges flip until it has three sides; then it collapses to a vertex and its slot becomes
    spare. For a cell that shrinks in time before it vanishes, decrease its target area and relax with
    `transitions=T1() + T2()` instead. Works under `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `tissue`: the tissue, which must support spare slots, see
        [`with_capacity`][vertax.Tissue.with_capacity].
    - `cell`: number of the cell.
    - `throw`: raise an error if the cell cannot be removed. If False, look at `result`.

    **Returns:** a [`Change`][vertax.transitions.Change], with the tissue.

    **Raises:**

    - `ValueError` for a cell that does not exist, or a tissue without spare slots.
    - `RuntimeError` (an error of Equinox inside `jax.jit`) if the cell cannot be removed: a neighbour would
        have too few sides, cells would overlap, or a corner is pinned.
    """
    check_spare(tissue)
    check_cell(tissue, cell)
    change = _remove(tissue, jnp.asarray(cell))
    return checked(change, change.result) if throw else change


@announced_jit
def _remove(tissue: Tissue, cell: Int[Array, ""]) -> Change:
    return removed(tissue, cell, jnp.array(True))


def removed(tissue: Tissue, cell: Int[Array, ""], do: Bool[Array, ""]) -> Change:
    """Remove a cell if `do` and if possible."""
    edges = jnp.arange(tissue.n_edges)

    def sides(tissue: Tissue) -> Array:
        return jnp.sum(tissue.topology.cell == cell)

    # In a flip the two cells at the sides of the edge lose a side, and the two at its ends gain one. In a
    # small periodic box these may be the same cell. Only flips by which the cell loses sides are candidates,
    # so that the loop ends: each flip reduces its number of sides, and between two flips each edge is
    # rejected at most once.
    def candidates(frames: EdgeFrames, rejected: Array) -> Array:
        is_cell = frames.cells == cell
        lost = jnp.sum(is_cell[:, :2], axis=-1) - jnp.sum(is_cell[:, 2:], axis=-1)
        return (lost > 0) & frames.can_flip & ~rejected

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        *_, is_unfinished = carry
        return is_unfinished

    def flip(carry: tuple) -> tuple:
        tissue, rejected, _ = carry
        frames = EdgeFrames(tissue)
        can_flip = candidates(frames, rejected)
        edge = jnp.argmin(jnp.where(can_flip, frames.length, jnp.inf))
        which = can_flip & (edges == edge)
        tissue, valid = flipped(tissue, frames, which)
        # After a flip, edges that were rejected are tried again.
        rejected = jnp.where(valid, False, rejected | which)
        return tissue, rejected, (sides(tissue) > 3) & (valid | jnp.any(can_flip & ~which))

    same = unchanged(tissue)
    start = (tissue, jnp.zeros(tissue.n_edges, bool), do & (sides(tissue) > 3))
    reduced, *_ = jax.lax.while_loop(unfinished, flip, start)
    possible = do & can_vanish(reduced)[cell]
    new = vanished(reduced, cell, possible)
    done = possible & ~has_new_overlaps(new, tissue)
    result = RESULTS.where(done, RESULTS.successful, RESULTS.removal_impossible)
    return Change(tree_where(done, new, tissue), same.cells, same.edges, same.vertices, result)


def flipped(
    tissue: Tissue, frames: EdgeFrames, which: Bool[Array, " edges"]
) -> tuple[Tissue, Bool[Array, ""]]:
    """Flip an edge if that causes no overlaps; also return whether it flipped."""
    before = overlapping_faces(tissue.overlaps)
    fractions = jnp.asarray(_LENGTH_FRACTIONS, frames.length.dtype)

    def attempt(k: Int[Array, ""]) -> Tissue:
        placed = frames.place(tissue, which, frames.across, fractions[k] * frames.length)
        return frames.flip(placed, which)

    def next_attempt(carry: tuple) -> tuple:
        k, _ = carry
        return k + 1, jnp.any(overlapping_faces(attempt(k).overlaps) & ~before)

    unfinished = lambda carry: carry[1] & (carry[0] < len(_LENGTH_FRACTIONS))
    attempts, bad = jax.lax.while_loop(unfinished, next_attempt, (jnp.array(0), jnp.array(True)))
    valid = ~bad & jnp.any(which)
    return tree_where(valid, attempt(attempts - 1), tissue), valid
