"""T1 transitions: an edge flips."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.modules import choose, is_concrete
from vertax._base.sums import total
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.energies._units import cell_size
from vertax.mesh import Tissue
from vertax.mesh._arcs import length_factor
from vertax.mesh._overlaps import Overlaps, find_overlaps
from vertax.mesh._sides import cross, dot
from vertax.mesh._topology import edge_neighbourhood, flip_edges, source, take
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

        def may(corner: EdgeFrames, counts: Int[Array, " edges"]) -> tuple[Array, Array]:
            """Which edges may flip, and which may turn upright."""
            short = corner.length < threshold
            flip = corner.can_flip & (counts < self.max_flips) & (short | corner.inside_out)
            return flip, corner.inside_out & short & corner.free

        # Rounds of candidates that share no cell, until all were tried: one that is refused must not
        # keep its neighbours from being tried. `todo` are all edges at first, and candidates after the
        # first round; it loses at least one of them a round. Mostly there is none, and no second round.
        def unfinished(carry: tuple) -> Bool[Array, ""]:
            *_, todo = carry
            return jnp.any(todo)

        def one_round(carry: tuple) -> tuple:
            tissue, counts, todo = carry
            corner = EdgeFrames(tissue)
            may_flip, may_turn = may(corner, counts)
            todo &= may_flip | may_turn

            def flip_where_it_helps() -> tuple[Tissue, Array, Array]:
                chosen = _independent(todo, corner, tissue.n_cells)
                length = jnp.maximum(corner.length, threshold)
                shares = jnp.array([1, 1, 0.5, 0.25], length.dtype)

                def trial(k: Int[Array, ""], which: Bool[Array, " edges"]) -> Tissue:
                    # Stretched, flipped, and flipped with a half and a quarter of the length.
                    direction = jnp.where(k > 0, corner.across, corner.along)
                    chord = length / jnp.where(k > 0, 1, corner.stretch)
                    turned = _flipped(tissue, which & (k > 0))
                    return corner.place(turned, which, direction, shares[k] * chord)

                again = chosen & (counts > 0)
                n_trials = jnp.where(jnp.any(again), 4, 2)
                costs = _judge(energy, chosen, corner, trial, n_trials)
                stretched, flipped, short, shorter = costs
                accepted = chosen & may_flip & (flipped < stretched) & (~again | (short < shorter))

                # Where there is no room for the new edge it is made shorter; then it is refused. If there
                # seems to be none, a turn without any flip shows what overlaps already.
                def crowded(carry: tuple) -> Bool[Array, ""]:
                    i, accepted, *_, blamed = carry
                    return jnp.any(blamed) | ((i == 0) & jnp.any(accepted))

                def make_room(carry: tuple) -> tuple:
                    i, accepted, share, before, crossed, last, _ = carry
                    flip = accepted & (i != 1)
                    placed = _flipped(
                        corner.place(tissue, flip, corner.across, share * length), flip
                    )
                    touched = jnp.zeros(placed.topology.n_faces, bool)
                    touched = touched.at[corner.cells].max(accepted[:, None])
                    faces = overlapping_faces(
                        find_overlaps(placed.topology, placed.sides, placed.areas, touched)
                    )
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
                return upright, counts + accepted, todo & ~chosen

            return jax.lax.cond(jnp.any(todo), flip_where_it_helps, lambda: (tissue, counts, todo))

        start = (tissue, counts, jnp.ones(tissue.n_edges, bool))
        tissue, counts, _ = jax.lax.while_loop(unfinished, one_round, start)
        return tissue, counts


_SHORTENED = 3


def overlapping_faces(overlaps: Overlaps) -> Bool[Array, " faces"]:
    """Which faces overlap, the exterior last."""
    return jnp.append(overlaps.cells, overlaps.exterior)


class EdgeFrames(eqx.Module):
    """The surroundings of every edge: its cells, its length and the directions a T1 places it in."""

    start: Int[Array, " edges"]
    end: Int[Array, " edges"]
    cells: Int[Array, "edges 4"]  # left, right, at the start, at the end
    edges: Int[Array, "edges 5"]  # the edge itself and its four neighbours
    vector: Float[Array, "edges 2"]
    stretch: Float[Array, " edges"]  # length over distance of the ends
    length: Float[Array, " edges"]
    along: Float[Array, "edges 2"]
    across: Float[Array, "edges 2"]
    inside_out: Bool[Array, " edges"]
    free: Bool[Array, " edges"]  # neither end is pinned
    can_flip: Bool[Array, " edges"]

    def __init__(self, tissue: Tissue):
        m = tissue.topology
        h = m.half_edge
        t, a, b, c, d = edge_neighbourhood(m)
        self.start, self.end = source(h), source(t)
        self.cells = take(m.cell, jnp.stack([h, t, a, c], axis=-1))
        self.edges = take(m.edge, jnp.stack([h, a, b, c, d], axis=-1))
        forward = tissue.edge_vectors
        self.vector = forward
        chord = jnp.sqrt(dot(forward, forward))
        self.stretch = jnp.ones_like(chord)
        leaving = _outward(tissue)
        if tissue.angles is not None:
            self.stretch = length_factor(tissue.edge_angles)
            first, last = (take(tangent, m.edge) for tangent in tissue.edge_tangents)
            leaving = jnp.where(m.forward[:, None], first, -last)
        self.length = chord * self.stretch
        axis = edge_axes(tissue)
        upright = dot(axis, forward) >= 0
        direction = jnp.where((chord > 0)[:, None], forward, axis)
        direction = jnp.where(upright[:, None], direction, -direction)
        norm = jnp.sqrt(dot(direction, direction))[:, None]
        self.along = direction / jnp.where(norm > 0, norm, 1)
        # A flipped half-edge has turned clockwise, see `flip_edges`.
        self.across = jnp.stack([self.along[:, 1], -self.along[:, 0]], axis=-1)
        # Three directions are in counter-clockwise order if at least two of their consecutive cross
        # products are positive. An edge that passed through length 0 spoils that order at both ends.
        u = leaving.reshape(-1, 3, 2)
        v = jnp.roll(u, -1, axis=1)
        disordered = jnp.sum(cross(u, v) < 0, axis=1) >= 2
        self.inside_out = take(disordered, self.start) & take(disordered, self.end) & ~upright
        left, right, at_start, at_end = (self.cells[:, k] for k in range(4))
        spare = jnp.min(_spare_sides(tissue), axis=-1)
        losses = jnp.where(left == right, 2, 1)
        self.can_flip = (spare >= losses) & (at_start != at_end) & (self.start != self.end)
        self.free = jnp.ones_like(upright)
        if tissue.held is not None:
            self.free = ~take(tissue.held, self.start) & ~take(tissue.held, self.end)
        self.can_flip &= self.free

    def place(
        self,
        tissue: Tissue,
        which: Bool[Array, " edges"],
        direction: Float[Array, "edges 2"],
        length: Float[Array, " edges"],
    ) -> Tissue:
        """Lay the marked edges in a direction, about their midpoint, with a given length."""
        half = 0.5 * (direction * length[:, None] - self.vector)
        half = jnp.where(which[:, None], half, 0)
        edge = tissue.topology.edge
        starts = take(self.start, edge) == source(jnp.arange(edge.size, dtype=edge.dtype))
        shifts = jnp.where(starts[:, None], -1, 1) * take(half, edge)
        # (Written out, as below: sums along short axes take several times as long.)
        first, second, third = shifts[::3], shifts[1::3], shifts[2::3]
        return tissue.with_vertices(tissue.vertices + first + second + third)


def edge_axes(tissue: Tissue) -> Float[Array, "edges 2"]:
    """Which way each edge ought to point, of no special length, as the far ends of its neighbours show.

    A short edge's own vector may have shrunk to nothing or turned around; it has no influence here.
    """
    _, a, b, c, d = edge_neighbourhood(tissue.topology)
    outward = _outward(tissue)
    ahead = take(outward, c) + take(outward, d)
    behind = take(outward, a) + take(outward, b)
    return ahead - behind + 2 * tissue.edge_vectors


def _outward(tissue: Tissue) -> Float[Array, "half_edges 2"]:
    """Half-edge vectors: an edge's own vector or its opposite."""
    m = tissue.topology
    outward = take(tissue.edge_vectors, m.edge)
    return jnp.where(m.forward[:, None], outward, -outward)


def _spare_sides(tissue: Tissue) -> Int[Array, "edges 2"]:
    """How many sides more than it needs the cell left, and right, of each edge has without its arc."""
    m = tissue.topology
    face_sums = lambda values: jax.ops.segment_sum(values, m.cell, m.n_faces)
    sides = take(face_sums(jnp.ones_like(m.cell)), m.edge_cells)
    if not m.exterior or tissue.angles is None:
        return sides - 3
    # Two sides bound a cell if one is an arc on the outline, other than the edge that leaves; two arcs
    # bound the exterior.
    arcs = take(face_sums(take(m.on_outline, m.edge).astype(m.cell.dtype)), m.edge_cells)
    return sides - jnp.where(arcs > m.on_outline[:, None], 2, 3)


def _flipped(tissue: Tissue, which: Bool[Array, " edges"]) -> Tissue:
    return straightened(tissue, which).with_topology(flip_edges(tissue.topology, which))


def straightened(tissue: Tissue, which: Bool[Array, " edges"]) -> Tissue:
    if tissue.angles is None:
        return tissue
    return tissue.with_angles(jnp.where(which, 0, tissue.angles))


def _independent(
    candidates: Bool[Array, " edges"], corner: EdgeFrames, n_cells: int
) -> Bool[Array, " edges"]:
    """The candidates that are the shortest of all candidates at each of their four cells."""
    # Two of them share no cell, hence no vertex and no neighbouring edge, so their flips commute. (An
    # edge lies between two faces, so sharing the exterior alone is no harm.)
    cells = corner.cells
    number = jnp.arange(len(candidates), dtype=cells.dtype)

    def least(values: Array, among: Bool[Array, " edges"]) -> Bool[Array, " edges"]:
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
_Trial = Callable[[Int[Array, ""], Bool[Array, " edges"]], Tissue]


def _judge(
    energy: AbstractEnergy,
    chosen: Bool[Array, " edges"],
    corner: EdgeFrames,
    trial: _Trial,
    n_trials: Int[Array, ""],
) -> Float[Array, "4 edges"]:
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

    def one(i: Int[Array, ""], costs: Float[Array, "4 edges"]) -> Float[Array, "4 edges"]:
        edge, k = order[i // n_trials], i % n_trials
        return costs.at[k, edge].set(energy(trial(k, edges == edge)))

    return jax.lax.fori_loop(0, n_trials * jnp.sum(chosen), one, costs)


def _local_costs(
    energy: AbstractLocalEnergy, tissue: Tissue, corner: EdgeFrames
) -> Float[Array, " edges"]:
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
