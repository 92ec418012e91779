"""T1 transitions: an edge flips."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.modules import choose, is_concrete
from vertax._base.sums import total
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.energies._units import cell_size
from vertax.mesh import Tissue
from vertax.mesh._measured import Measured
from vertax.mesh._overlaps import Overlaps, faces_crossed
from vertax.mesh._tissue import Known, mean_area
from vertax.mesh._topology import take
from vertax.transitions._edge_frames import EdgeFrames, suspects
from vertax.transitions._transitions import AbstractTransitions


class T1(AbstractTransitions):
    r"""T1 transitions: short edges flip if that lowers the energy (paper, Methods, "T1 transitions").

    An edge shorter than the threshold is compared in two configurations of the same length: stretched
    along itself, and flipped (the two cells at its ends become neighbours). If the flipped one has the
    lower energy it is taken; otherwise the vertices stay where they are. Edges that a large step has
    turned inside out are candidates too. A sweep tries every candidate once, all that share no cell
    together, shortest first.

    This differs from the paper's rule in two points. An edge that does not flip stays as it is: there it
    is stretched, which raises the energy again and again and never comes to rest. And the order is
    shortest first: with another one, 3 to 5 % of the edges of a sweep may end otherwise where candidates
    are neighbours.

    An edge that flipped before in the same relaxation must also want to grow in its new place, from a
    quarter of that length on: where four cells meet in one point because its tension is too high for
    either configuration, it would otherwise flip to and fro for ever.

    Where a flipped edge would make cells overlap it is made shorter, and if that does not help it does not
    flip. An edge below the threshold that is inside out, and does not flip, is put upright.

    Lengths are those of arcs where edges are arcs; an edge that flips becomes straight, or an arc of
    angle 0.

    A flip that would leave a cell with two sides (with one, if the other is an arc on the outline), or
    an edge with one cell or the exterior on both sides, is refused: so a free tissue stays in one
    piece. Edges at pinned vertices do not flip.

    **Arguments:**

    - `threshold`: length below which an edge may flip, in units of the size of a cell (the root mean
        cell area). Smaller values (5e-3 in the paper) reach the same states in more steps.
    - `max_flips`: how often one edge may flip in a relaxation: a last guard against flipping for ever.

    **Raises:**

    - `ValueError` for a threshold that is not positive, or `max_flips` below 1.
    """

    threshold: float | Float[Array, ""] = 0.02
    max_flips: int | Int[Array, ""] = 20

    def __check_init__(self):
        if is_concrete(self.threshold) and not self.threshold > 0:
            raise ValueError(
                f"Argument `threshold` must be positive, but is {self.threshold}. To switch T1 "
                "transitions off pass `transitions=None`."
            )
        if is_concrete(self.max_flips) and not self.max_flips >= 1:
            raise ValueError(f"Argument `max_flips` must be at least 1, but is {self.max_flips}.")

    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        """How often each edge flipped: never yet."""
        return jnp.zeros(tissue.n_edges, jnp.int32)

    def sweep(
        self, tissue: Tissue, energy: AbstractEnergy, counts: Int[Array, " edges"]
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        """Try every candidate once; returns the new tissue and the updated counts."""
        threshold = self.threshold * cell_size(tissue)
        n_rows = _number_of_rows(tissue)

        # Rounds of candidates that share no cell, until all were tried: one that is refused must not
        # keep its neighbours from being tried. `todo` are all suspects at first, and candidates after the
        # first round; it loses at least one of them a round. Mostly there is none, and no second round.
        # (So many at once as are looked at together: others wait.)
        def unfinished(carry: tuple) -> Bool[Array, ""]:
            *_, todo = carry
            return jnp.any(todo)

        def one_round(carry: tuple) -> tuple:
            tissue, counts, todo = carry
            edges = jnp.nonzero(todo, size=n_rows, fill_value=0)[0].astype(
                tissue.topology.edge.dtype
            )
            there = jnp.arange(n_rows) < jnp.sum(todo)
            corner = EdgeFrames(tissue, edges)
            short = corner.length < threshold
            may_flip = there & corner.can_flip & (take(counts, edges) < self.max_flips)
            may_flip &= short | corner.inside_out
            may_turn = there & corner.inside_out & short & corner.free
            candidates = may_flip | may_turn
            chosen = _independent(candidates, corner, tissue.n_cells)

            def flip_where_it_helps() -> tuple[Tissue, Array]:
                length = jnp.maximum(corner.length, threshold)
                shares = jnp.array([1, 1, 0.5, 0.25], length.dtype)
                known = tissue.measured()

                def laid(
                    which: Bool[Array, " rows"],
                    flips: Bool[Array, ""],
                    direction: Float[Array, "rows 2"],
                    length: Float[Array, " rows"],
                ) -> tuple[Tissue, Known]:
                    there = corner.place(tissue, which, direction, length)
                    there = corner.flip(there, which & flips)
                    if tissue.n_cells < _FEW_CELLS:
                        return there, there.measured()
                    return there, corner.measures(tissue, known, which, flips, direction, length)

                def trial(k: Int[Array, ""], which: Bool[Array, " rows"]) -> Tissue:
                    # Stretched, flipped, and flipped with a half and a quarter of the length.
                    direction = jnp.where(k > 0, corner.across, corner.along)
                    chord = length / jnp.where(k > 0, 1, corner.stretch)
                    return Measured(*laid(which, k > 0, direction, shares[k] * chord))

                again = chosen & (take(counts, edges) > 0)
                n_trials = jnp.where(jnp.any(again), 4, 2)
                costs = _judge(energy, chosen, corner, trial, n_trials)
                stretched, flipped, shorter, shortest = costs
                better = (flipped < stretched) & (~again | (shorter < shortest))
                accepted = chosen & may_flip & better

                # Where there is no room for the new edge it is made shorter; then it is refused. If there
                # seems to be none, a turn without any flip shows what overlaps already.
                def crowded(carry: tuple) -> Bool[Array, ""]:
                    i, accepted, *_, blamed = carry
                    return jnp.any(blamed) | ((i == 0) & jnp.any(accepted))

                def make_room(carry: tuple) -> tuple:
                    i, accepted, share, before, crossed, last, _ = carry
                    flip = accepted & (i != 1)
                    yes = jnp.array(True)
                    placed, measures = laid(flip, yes, corner.across, share * length)
                    faces = _crowded_faces(placed, measures.areas, corner, accepted)
                    before = jnp.where(i == 1, faces, before)
                    crossed = jnp.where(i == 1, crossed, faces)
                    blamed = accepted & jnp.any(take(crossed & ~before, corner.cells), axis=-1)
                    refused = blamed & (i >= _SHORTENED)
                    share = jnp.where(blamed & (i > 0), 0.25 * share, share)
                    placed = choose(i == 1, last, placed)
                    return i + 1, accepted & ~refused, share, before, crossed, placed, blamed

                none = jnp.zeros_like(accepted)
                nowhere = jnp.zeros(tissue.n_cells + 1, bool)
                share = jnp.ones_like(length)
                start = (jnp.array(0), accepted, share, nowhere, nowhere, tissue, none)
                _, accepted, *_, placed, _ = jax.lax.while_loop(crowded, make_room, start)
                # What is inside out and stays so little that nobody would notice is put right.
                back = chosen & ~accepted & may_turn
                upright = corner.length / corner.stretch
                upright = corner.place(placed, back, corner.along, upright)
                return upright, counts.at[edges].add(accepted)

            tissue, counts = jax.lax.cond(
                jnp.any(candidates), flip_where_it_helps, lambda: (tissue, counts)
            )
            waits = candidates & ~chosen
            return tissue, counts, todo.at[edges].min(waits | ~there)

        start = (tissue, counts, suspects(tissue, threshold))
        tissue, counts, _ = jax.lax.while_loop(unfinished, one_round, start)
        return tissue, counts


# So many edges are looked at together at least, and this share of all.
_FEWEST, _SHARE = 512, 1 / 32
# In smaller tissues the ends of an edge may be neighbours of its neighbours.
_FEW_CELLS = 16
_SHORTENED = 3


def overlapping_faces(overlaps: Overlaps) -> Bool[Array, " faces"]:
    """Which faces overlap, the exterior last."""
    return jnp.append(overlaps.cells, overlaps.exterior)


def has_new_overlaps(new: Tissue, before: Tissue) -> Bool[Array, ""]:
    """Whether faces overlap after a change that did not before, or cells have no area but rounding errors."""
    crossed = overlapping_faces(new.overlaps) & ~overlapping_faces(before.overlaps)
    # (A cell of two sides has none if its arc is straight.)
    least = 1e3 * jnp.finfo(before.vertices.dtype).eps * mean_area(before)
    flat = new.alive & (new.areas <= least) & ~(before.alive & (before.areas <= least))
    return jnp.any(crossed) | jnp.any(flat)


def _number_of_rows(tissue: Tissue) -> int:
    return min(tissue.n_edges, max(_FEWEST, int(_SHARE * tissue.n_edges)))


def _crowded_faces(
    placed: Tissue,
    areas: Float[Array, " cells"],
    corner: EdgeFrames,
    which: Bool[Array, " rows"],
) -> Bool[Array, " faces"]:
    """The faces that overlap themselves with what the marked edges have moved, the exterior last."""
    m = placed.topology
    ends = jnp.stack([corner.start, corner.end], axis=-1)
    moved = (3 * ends[:, :, None] + jnp.arange(3, dtype=ends.dtype)).reshape(-1, 6)
    moved = jnp.concatenate([moved, take(m.twin, moved)], axis=-1)
    # In pieces: mostly there are few.
    count, n = jnp.sum(which), len(which)
    size = min(n, max(64, n // 16))
    order = jnp.nonzero(which, size=n + -n % size, fill_value=0)[0]

    def piece(i: Int[Array, ""], faces: Bool[Array, " faces"]) -> Bool[Array, " faces"]:
        rows = jax.lax.dynamic_slice_in_dim(order, i * size, size)
        there = i * size + jnp.arange(size) < count
        here = take(moved, rows).reshape(-1)
        return faces | faces_crossed(m, placed.sides_of, here, jnp.repeat(there, 12))

    none = jnp.zeros(m.n_faces, bool)
    faces = jax.lax.fori_loop(0, (count + size - 1) // size, piece, none)
    outside = faces[m.n_cells] if m.exterior else jnp.array(False)
    touched = jnp.zeros(m.n_cells, bool).at[corner.cells].max(which[:, None], mode="drop")
    return jnp.append(faces[: m.n_cells] | (touched & ~(areas > 0)), outside)


def _independent(
    candidates: Bool[Array, " rows"], corner: EdgeFrames, n_cells: int
) -> Bool[Array, " rows"]:
    """The candidates that are the shortest of all candidates at each of their four cells."""
    # Two of them share no cell, hence no vertex and no neighbouring edge, so their flips commute. (An
    # edge lies between two faces, so sharing the exterior alone is no harm.)
    cells = corner.cells
    number = jnp.arange(len(candidates), dtype=cells.dtype)

    def least(values: Array, among: Bool[Array, " rows"]) -> Bool[Array, " rows"]:
        """Those among some that have the least value at each of their cells."""
        most = (
            jnp.inf if jnp.issubdtype(values.dtype, jnp.floating) else jnp.iinfo(values.dtype).max
        )
        values = jnp.where(among, values, most)[:, None]
        best = jnp.full(n_cells, most, values.dtype).at[cells].min(values, mode="drop")
        first = best.at[cells].get(mode="fill", fill_value=0) == values
        return among & jnp.all(first | (cells == n_cells), axis=-1)

    # (Of those of one length the first.)
    return least(number, least(corner.length, candidates))


# The tissue with the marked edges changed in a way that has a number.
_Trial = Callable[[Int[Array, ""], Bool[Array, " rows"]], Tissue]


def _judge(
    energy: AbstractEnergy,
    chosen: Bool[Array, " rows"],
    corner: EdgeFrames,
    trial: _Trial,
    n_trials: Int[Array, ""],
) -> Float[Array, "4 rows"]:
    """What the first trials of each chosen edge cost."""
    costs = jnp.zeros((4, chosen.size), corner.length.dtype)
    if isinstance(energy, AbstractLocalEnergy):
        all_at_once = lambda k, costs: costs.at[k].set(
            _local_costs(energy, trial(k, chosen), corner)
        )
        return jax.lax.fori_loop(0, n_trials, all_at_once, costs)

    # Any other: one edge after the other. (As they share no cell, the rest may stay as it is.)
    edges = jnp.arange(chosen.size)
    order = jnp.argsort(jnp.where(chosen, corner.length, jnp.inf))

    def one(i: Int[Array, ""], costs: Float[Array, "4 rows"]) -> Float[Array, "4 rows"]:
        edge, k = order[i // n_trials], i % n_trials
        return costs.at[k, edge].set(energy(trial(k, edges == edge)))

    return jax.lax.fori_loop(0, n_trials * jnp.sum(chosen), one, costs)


def _local_costs(
    energy: AbstractLocalEnergy, tissue: Tissue, corner: EdgeFrames
) -> Float[Array, " rows"]:
    """The energy of the cells and edges around each edge."""
    # In a very small tissue one cell can be two of the four: count it once.
    cells = corner.cells
    repeated = [jnp.zeros(cells.shape[0], bool)]
    for k in range(1, 4):
        repeated.append(jnp.any(cells[:, :k] == cells[:, k : k + 1], axis=-1))
    by_cell = energy.cell_terms(tissue).at[cells].get(mode="fill", fill_value=0)
    # (The exterior has no energy.)
    by_cell = jnp.where(jnp.stack(repeated, axis=-1), 0, by_cell)
    by_edge = take(energy.edge_terms(tissue), corner.edges)
    return total(terms[:, k] for terms in (by_cell, by_edge) for k in range(terms.shape[1]))
