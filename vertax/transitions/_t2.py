"""T2 transitions: extrusion of small cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_number
from vertax._base.half_edges import clockwise, counter_clockwise, source
from vertax._base.indexing import take
from vertax._base.model_checks import check_spare
from vertax._base.tracing import tree_where
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.transitions._euler_operators import collapse_triangle, merge_cells
from vertax.transitions._t1 import has_new_overlaps
from vertax.transitions._transitions import AbstractTransitions


class T2(AbstractTransitions):
    """T2 transitions: a small cell with three sides collapses to a vertex.

    A cell vanishes if its area is below the threshold, it has three sides (two are possible on the outline of
    a tissue with arcs), and the energy would not decrease if the cell were scaled by a factor of two. Each
    neighbour loses a side. The cell stays if a neighbour would have too few sides, cells would overlap, or a
    corner is pinned. Cells with more sides lose them by T1 transitions first, so use both:

    ```python
    vx.equilibrate(tissue.with_capacity(tissue.n_cells), energy, transitions=vx.T1() + vx.T2())
    ```

    **Arguments:**

    - `threshold`: area below which a cell may vanish, in units of the mean area of a cell.

    **Raises:**

    - `ValueError` for a threshold that is not positive, and in a relaxation for a tissue without spare
        slots.
    """

    threshold: float | Float[Array, ""] = 1e-2

    def __check_init__(self):
        check_number("threshold", self.threshold, above=0, many=True)

    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        """Zero counts of transitions for each edge."""
        check_spare(tissue)
        return jnp.zeros(tissue.n_edges, jnp.int32)

    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, " edges"],
        allowed: Bool[Array, " edges"] | bool = True,
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        """Remove every small cell that can vanish; return the new tissue and the updated counts.

        `allowed` has no effect, because a cell stays anyway if cells would overlap.
        """
        limit = self.threshold * tissue.mean_area

        def candidates(tissue: Tissue, remaining: Array) -> Array:
            # (Cells that a large step has turned inside out do not vanish; the relaxation corrects them.)
            small = (tissue.areas < limit) & (tissue.areas > -_ROUNDING * limit)
            return remaining & small & can_vanish(tissue)

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            return jnp.any(carry[-1])

        def vanish(carry: tuple) -> tuple:
            tissue, counts, remaining = carry
            cell = jnp.argmin(jnp.where(remaining, tissue.areas, jnp.inf)).astype(jnp.int32)
            accepted = energy(_enlarged(tissue, cell)) >= energy(tissue)
            new = vanished(tissue, cell, accepted)
            # A cell that is rejected because of overlaps may vanish later, when it is smaller.
            accepted &= ~has_new_overlaps(new, tissue)
            h = jnp.argmax(tissue.topology.cell == cell)
            edge = jnp.where(accepted, take(tissue.topology.edge, h), tissue.n_edges)
            tissue = tree_where(accepted, new, tissue)
            remaining = candidates(tissue, remaining & (jnp.arange(tissue.n_cells) != cell))
            return tissue, counts.at[edge].add(1, mode="drop"), remaining

        start = (tissue, counts, candidates(tissue, jnp.ones(tissue.n_cells, bool)))
        tissue, counts, _ = jax.lax.while_loop(unfinished, vanish, start)
        return tissue, counts


# Rounding may make the area of a small cell negative: cells above -0.01 × the threshold may vanish.
_ROUNDING = 1e-2


def can_vanish(tissue: Tissue) -> Bool[Array, " cells"]:
    """Which cells can collapse to a vertex or to a part of an edge, so that neighbours have enough sides."""
    m = tissue.topology
    sides, required = face_sides(tissue)
    across = take(m.cell, m.twin)
    # A neighbour of a triangle loses one side, a neighbour of a cell with two sides loses two.
    lost = jnp.where(take(sides, m.cell) == 2, 2, 1)
    times = 1 + sum(_meets_again(m.cell, across, m.twin))
    enough = take(sides, across) - lost * times >= take(required, across)
    enough &= across != m.cell
    if tissue.held is not None:
        enough &= ~take(tissue.held, m.source)
    all_enough = jax.ops.segment_min(enough.astype(m.cell.dtype), m.cell, m.n_faces) > 0
    few = (sides == 3) | (sides == 2)
    return (all_enough & few)[: m.n_cells]


def face_sides(tissue: Tissue) -> tuple[Int[Array, " faces"], Int[Array, " faces"]]:
    """The number of sides of each face, and the least number that is valid."""
    m = tissue.topology
    sides = jax.ops.segment_sum(jnp.ones_like(m.cell), m.cell, m.n_faces)
    # A face may have two sides if one of them is an arc on the outline.
    required = jnp.full(m.n_faces, 3)
    if m.exterior and tissue.angles is not None:
        outer = take(m.on_outline, m.edge).astype(m.cell.dtype)
        arcs = jax.ops.segment_sum(outer, m.cell, m.n_faces)
        required = jnp.where(arcs > 0, 2, 3)
    return sides, required


def _meets_again(cell: Array, across: Array, twin: Array) -> list[Array]:
    """Whether the neighbour at a side is also the one at the next side, and at the previous side."""
    following = clockwise(twin)
    previous = take(twin, counter_clockwise(jnp.arange(cell.size, dtype=twin.dtype)))
    return [(take(across, other) == across).astype(cell.dtype) for other in (following, previous)]


def _enlarged(tissue: Tissue, cell: Int[Array, ""]) -> Tissue:
    """The tissue with one cell scaled by a factor of two about its mean corner."""
    m = tissue.topology
    mask = m.cell == cell
    corners = tissue.corners
    centre = jnp.sum(jnp.where(mask[:, None], corners, 0), axis=0) / jnp.sum(mask)
    step = jnp.where(mask[:, None], corners - centre, 0)
    return tissue.with_vertices(tissue.vertices + jnp.sum(step.reshape(-1, 3, 2), axis=1))


def vanished(tissue: Tissue, cell: Int[Array, ""], do: Bool[Array, ""]) -> Tissue:
    """Remove a cell that can vanish, if `do`."""
    m = tissue.topology
    mask = m.cell == cell
    h = jnp.argmax(mask).astype(m.twin.dtype)
    n_sides = jnp.sum(mask)
    corners = tissue.corners
    centre = jnp.sum(jnp.where(mask[:, None], corners, 0), axis=0) / n_sides
    place = centre - tissue.boundary.translation(take(m.frame, h))
    triangle = do & (n_sides == 3)
    where = jnp.where(triangle, source(h), tissue.n_vertices)
    new = tissue.with_vertices(tissue.vertices.at[where].set(place, mode="drop"))
    changed = collapse_triangle(m, h, triangle)
    if m.exterior and tissue.angles is not None:
        # A cell with two sides becomes part of its neighbour that is not the exterior.
        inner = jnp.where(take(m.cell, take(m.twin, h)) == m.n_cells, clockwise(take(m.twin, h)), h)
        changed = merge_cells(changed, inner, do & (n_sides == 2))
    return new.with_topology(changed)
