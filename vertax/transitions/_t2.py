"""T2 transitions: a small cell vanishes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_number
from vertax._base.tracing import tree_where
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._euler_operators import collapse_triangle, merge_cells
from vertax.mesh._tissue import mean_area
from vertax.mesh._topology import clockwise, counter_clockwise, source, take
from vertax.transitions._t1 import has_new_overlaps
from vertax.transitions._transitions import AbstractTransitions


class T2(AbstractTransitions):
    """T2 transitions: a small cell of three sides becomes a vertex.

    A cell vanishes if it is smaller than the threshold, has three sides (on the outline of a tissue with
    arcs also two), and does not want to grow: the energy would be higher if it were twice as long and wide.
    Its neighbours lose a side each; where one would be left with too few, cells would overlap, or a corner is
    pinned, it stays.
    Cells with more sides lose them by T1 transitions first, so use both:

    ```python
    vx.equilibrate(tissue.with_capacity(tissue.n_cells), energy, transitions=vx.T1() + vx.T2())
    ```

    **Arguments:**

    - `threshold`: area below which a cell may vanish, in units of the mean area of a cell.

    **Raises:**

    - `ValueError` for a threshold that is not positive, and in a relaxation for a tissue that has no place
        for spare slots.
    """

    threshold: float | Float[Array, ""] = 1e-2

    def __check_init__(self):
        check_number("threshold", self.threshold, above=0, many=True)

    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        """How often each edge vanished: never yet."""
        if not tissue.topology.spare:
            raise ValueError(
                "T2 transitions leave spare slots behind, for which the tissue must be ready: pass "
                "tissue.with_capacity(tissue.n_cells)."
            )
        return jnp.zeros(tissue.n_edges, jnp.int32)

    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, " edges"],
        length_fraction: Float[Array, " edges"] | float = 1.0,
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        """Let every small cell vanish that may; returns the new tissue and the updated counts.

        `length_fraction` has no effect: a cell that vanishes leaves no new edge.
        """
        limit = self.threshold * mean_area(tissue)

        def candidates(tissue: Tissue, todo: Array) -> Array:
            # (What a large step has turned inside out will be put right by the relaxation.)
            small = (tissue.areas < limit) & (tissue.areas > -_ROUNDING * limit)
            return todo & small & can_vanish(tissue)

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            return jnp.any(carry[-1])

        def vanish(carry: tuple) -> tuple:
            tissue, counts, todo = carry
            cell = jnp.argmin(jnp.where(todo, tissue.areas, jnp.inf)).astype(jnp.int32)
            accepted = energy(_enlarged(tissue, cell)) >= energy(tissue)
            gone = vanished(tissue, cell, accepted)
            # Where there is no room for that, there will be when it is smaller.
            accepted &= ~has_new_overlaps(gone, tissue)
            h = jnp.argmax(tissue.topology.cell == cell)
            edge = jnp.where(accepted, take(tissue.topology.edge, h), tissue.n_edges)
            tissue = tree_where(accepted, gone, tissue)
            todo = candidates(tissue, todo & (jnp.arange(tissue.n_cells) != cell))
            return tissue, counts.at[edge].add(1, mode="drop"), todo

        start = (tissue, counts, candidates(tissue, jnp.ones(tissue.n_cells, bool)))
        tissue, counts, _ = jax.lax.while_loop(unfinished, vanish, start)
        return tissue, counts


_ROUNDING = 1e-2


def can_vanish(tissue: Tissue) -> Bool[Array, " cells"]:
    """Which cells can become a vertex, or a part of an edge, and leave their neighbours enough sides."""
    m = tissue.topology
    sides, least = face_sides(tissue)
    across = take(m.cell, m.twin)
    # A triangle takes a side of each neighbour, two sides take two.
    lost = jnp.where(take(sides, m.cell) == 2, 2, 1)
    times = 1 + sum(_meets_again(m.cell, across, m.twin))
    enough = take(sides, across) - lost * times >= take(least, across)
    enough &= across != m.cell
    if tissue.held is not None:
        enough &= ~take(tissue.held, m.source)
    all_enough = jax.ops.segment_min(enough.astype(m.cell.dtype), m.cell, m.n_faces) > 0
    few = (sides == 3) | (sides == 2)
    return (all_enough & few)[: m.n_cells]


def face_sides(tissue: Tissue) -> tuple[Int[Array, " faces"], Int[Array, " faces"]]:
    """How many sides each face has, and how many it needs at least."""
    m = tissue.topology
    sides = jax.ops.segment_sum(jnp.ones_like(m.cell), m.cell, m.n_faces)
    # Two sides bound a face if one is an arc on the outline; two arcs bound the exterior.
    least = jnp.full(m.n_faces, 3)
    if m.exterior and tissue.angles is not None:
        outer = take(m.on_outline, m.edge).astype(m.cell.dtype)
        arcs = jax.ops.segment_sum(outer, m.cell, m.n_faces)
        least = jnp.where(arcs > 0, 2, 3)
    return sides, least


def _meets_again(cell: Array, across: Array, twin: Array) -> list[Array]:
    """Whether the neighbour at a side is also that at the next one, and at the one before it."""
    following = clockwise(twin)
    previous = take(twin, counter_clockwise(jnp.arange(cell.size, dtype=twin.dtype)))
    return [(take(across, other) == across).astype(cell.dtype) for other in (following, previous)]


def _enlarged(tissue: Tissue, cell: Int[Array, ""]) -> Tissue:
    """The tissue with a cell twice as long and wide."""
    m = tissue.topology
    mine = m.cell == cell
    corners = tissue.corners
    centre = jnp.sum(jnp.where(mine[:, None], corners, 0), axis=0) / jnp.sum(mine)
    step = jnp.where(mine[:, None], corners - centre, 0)
    return tissue.with_vertices(tissue.vertices + jnp.sum(step.reshape(-1, 3, 2), axis=1))


def vanished(tissue: Tissue, cell: Int[Array, ""], do: Bool[Array, ""]) -> Tissue:
    """A cell that can vanish is gone, if it is to."""
    m = tissue.topology
    mine = m.cell == cell
    h = jnp.argmax(mine).astype(m.twin.dtype)
    n_sides = jnp.sum(mine)
    corners = tissue.corners
    centre = jnp.sum(jnp.where(mine[:, None], corners, 0), axis=0) / n_sides
    place = centre - tissue.boundary.translation(take(m.frame, h))
    triangle = do & (n_sides == 3)
    where = jnp.where(triangle, source(h), tissue.n_vertices)
    new = tissue.with_vertices(tissue.vertices.at[where].set(place, mode="drop"))
    changed = collapse_triangle(m, h, triangle)
    if m.exterior and tissue.angles is not None:
        # What has two sides becomes a part of the neighbour inside.
        inner = jnp.where(take(m.cell, take(m.twin, h)) == m.n_cells, clockwise(take(m.twin, h)), h)
        changed = merge_cells(changed, inner, do & (n_sides == 2))
    return new.with_topology(changed)
