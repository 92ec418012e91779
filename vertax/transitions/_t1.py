"""T1 transitions: an edge flips."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_number
from vertax._base.indexing import take
from vertax._base.reductions import any_of
from vertax._base.sums import total
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.mesh import Overlaps, Tissue
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.transitions._edge_frames import EdgeFrames
from vertax.transitions._transitions import AbstractTransitions


class T1(AbstractTransitions):
    r"""T1 transitions: short edges flip if that lowers the energy (paper, Methods, "T1 transitions").

    An edge shorter than the threshold is compared in two configurations of the same length: stretched
    along itself, and flipped (the two cells at its ends become neighbours). If the flipped one has the
    lower energy it is taken; otherwise the vertices do not move. Edges that a large step has inverted are
    candidates too. A sweep tries every candidate once, shortest first; candidates that share no cell are
    tried together.

    The paper's rule differs in two points. There an edge that does not flip is stretched, which raises the
    energy in every sweep and prevents convergence; here it stays as it is. And the order is shortest first:
    another order changes the result for 3 to 5 % of the edges of a sweep, where candidates are neighbours.

    An edge that has flipped before in the same relaxation flips only if the flipped edge also lowers the
    energy when it grows from a quarter of its length. Otherwise an edge with a tension too high for either
    configuration, where four cells meet in one point, would flip back and forth.

    If a flipped edge makes cells overlap, it does not flip in this step of the relaxation. An inverted edge
    below the threshold that does not flip is turned by half a turn.

    Lengths are those of arcs where edges are arcs; an edge that flips becomes straight, or an arc of
    angle 0.

    A flip that would leave a cell with two sides (with one, if the other is an arc on the outline), or
    an edge with one cell or the exterior on both sides, is refused: a free tissue stays connected. Edges at
    pinned vertices do not flip.

    **Arguments:**

    - `threshold`: length below which an edge may flip, in units of the size of a cell (the root mean
        cell area). Smaller values (5e-3 in the paper) reach the same states in more steps.
    - `max_flips`: most flips of one edge in a relaxation.

    **Raises:**

    - `ValueError` for a threshold that is not positive, or `max_flips` below 1.
    """

    threshold: float | Float[Array, ""] = 0.02
    max_flips: int | Int[Array, ""] = 20

    def __check_init__(self):
        remedy = "To switch T1 transitions off pass `transitions=None`."
        check_number("threshold", self.threshold, above=0, remedy=remedy)
        check_number("max_flips", self.max_flips, at_least=1)

    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        """The number of flips of each edge: 0."""
        return jnp.zeros(tissue.n_edges, jnp.int32)

    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, " edges"],
        allowed: Bool[Array, " edges"] | bool = True,
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        """Try every candidate once; returns the new tissue and the updated counts."""
        threshold = self.threshold * tissue.cell_size

        # Each round tries candidates that share no cell; the others wait for the next round. A round removes
        # at least one edge from `todo`, so the loop ends.
        def unfinished(carry: tuple) -> Bool[Array, ""]:
            return any_of(carry[2])

        def one_round(carry: tuple) -> tuple:
            tissue, counts, todo = carry
            frames = EdgeFrames(tissue)
            short = frames.length < threshold
            may_flip = todo & frames.can_flip & (short | frames.inside_out)
            may_flip &= (counts < self.max_flips) & allowed
            may_turn = todo & frames.inside_out & short & frames.free
            candidates = may_flip | may_turn
            chosen = _independent(candidates, frames, tissue.n_cells)
            size = jnp.maximum(frames.length, threshold)
            costs = jnp.zeros((_N_TRIALS, tissue.n_edges), size.dtype)
            local = isinstance(energy, AbstractLocalEnergy)
            n_trials = _N_TRIALS if local else _N_TRIALS * jnp.sum(chosen)
            order = jnp.argsort(~chosen)

            # The trials; the last pass of the same loop (compiled once) applies the result.
            def trial(i: Int[Array, ""], carry: tuple) -> tuple:
                _, _, costs = carry
                stretched, flipped, shorter = costs
                better = (flipped < stretched) & ((counts == 0) | (flipped < shorter))
                last = i == n_trials
                k = i if local else jax.lax.rem(i, _N_TRIALS)
                tried = chosen
                if not local:
                    edge = order[jnp.minimum(jax.lax.div(i, _N_TRIALS), tissue.n_edges - 1)]
                    tried &= last | (jnp.arange(tissue.n_edges) == edge)
                flips = tried & may_flip & jnp.where(last, better, k > 0)
                turns = tried & ~flips & jnp.where(last, may_turn, k == 0)
                length = jnp.where(k == 2, _SHORTER, 1) * size
                length = jnp.where(last & ~flips, frames.length, length)
                trial_tissue = frames.changed(tissue, flips, turns, length)
                if isinstance(energy, AbstractLocalEnergy):
                    cost = _local_costs(energy, MeasuredTissue(trial_tissue), frames)
                else:
                    cost = jnp.where(tried, energy(MeasuredTissue(trial_tissue)), costs[k])
                costs = jax.lax.select(last, costs, costs.at[k].set(cost))
                return trial_tissue, flips, costs

            n_passes = jnp.where(any_of(candidates), n_trials + 1, 0)
            start = (tissue, jnp.zeros_like(chosen), costs)
            tissue, flips, _ = jax.lax.fori_loop(0, n_passes, trial, start)
            return tissue, counts + flips, candidates & ~chosen

        start = (tissue, counts, jnp.ones(tissue.n_edges, bool))
        tissue, counts, _ = jax.lax.while_loop(unfinished, one_round, start)
        return tissue, counts


_N_TRIALS = 3
"""Trials of an edge: stretched along itself, flipped, and flipped with a fraction of the length."""
_SHORTER = 0.25
"""That fraction."""


def overlapping_faces(overlaps: Overlaps) -> Bool[Array, " faces"]:
    """The faces that overlap, the exterior last."""
    return jnp.append(overlaps.cells, overlaps.exterior)


def has_new_overlaps(new: Tissue, before: Tissue) -> Bool[Array, ""]:
    """Whether a change made faces overlap, or areas of cells vanish."""
    crossed = overlapping_faces(new.overlaps) & ~overlapping_faces(before.overlaps)
    # (A cell of two sides has no area if its arc is straight.)
    least = 1e3 * jnp.finfo(before.vertices.dtype).eps * before.mean_area
    flat = new.alive & (new.areas <= least) & ~(before.alive & (before.areas <= least))
    return jnp.any(crossed) | jnp.any(flat)


def _independent(
    candidates: Bool[Array, " edges"], frames: EdgeFrames, n_cells: int
) -> Bool[Array, " edges"]:
    """The candidates that are the shortest of all candidates at each of their four cells.

    Two of them share no cell, so no vertex and no neighbouring edge, and their flips commute. (They may share
    the exterior: an edge lies between two faces.) Of candidates of equal length the first one counts.
    """
    cells, n_edges = frames.cells, candidates.size

    def least(values: Array, largest: Any, some: Bool[Array, " edges"]) -> Bool[Array, " edges"]:
        """Those of `some` edges with the least value at each of their cells."""
        values = jnp.where(some, values, largest)
        of_cells = jnp.full(n_cells, largest, values.dtype)
        of_cells = of_cells.at[cells].min(values[:, None], mode="drop")
        minima = of_cells.at[cells].get(mode="clip")
        is_least = (minima == values[:, None]) | (cells == n_cells)
        return some & functools.reduce(jnp.logical_and, (is_least[:, k] for k in range(4)))

    shortest = least(frames.length, jnp.inf, candidates)
    return least(jnp.arange(n_edges), n_edges, shortest)


def _local_costs(
    energy: AbstractLocalEnergy, tissue: Tissue, frames: EdgeFrames
) -> Float[Array, " rows"]:
    """The energy of the cells and edges around each edge."""
    # In a very small tissue one cell can be two of the four: count it once.
    cells = frames.cells
    repeated = [jnp.zeros(cells.shape[0], bool)]
    for k in range(1, 4):
        repeated.append(jnp.any(cells[:, :k] == cells[:, k : k + 1], axis=-1))
    by_cell = energy.cell_terms(tissue).at[cells].get(mode="fill", fill_value=0)
    # (The exterior has no energy.)
    by_cell = jnp.where(jnp.stack(repeated, axis=-1), 0, by_cell)
    by_edge = take(energy.edge_terms(tissue), frames.edges)
    return total(terms[:, k] for terms in (by_cell, by_edge) for k in range(terms.shape[1]))
