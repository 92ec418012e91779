"""Division: one cell becomes two."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.checks import as_real, check_whole
from vertax._base.modules import is_concrete
from vertax.mesh import Tissue
from vertax.mesh._arcs import arc_points
from vertax.mesh._sides import cross
from vertax.mesh._surgery import spare_slot, split_cell
from vertax.mesh._topology import take
from vertax.transitions._change import Change, raised_if, unchanged

# The ends of a new edge keep this share of the side they lie on away from its corners.
_MARGIN = 0.05


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
        moments of the area within the corners.
    - `throw`: raise an error if the cell cannot divide. If False, look at `done`.

    **Returns:** a [`Change`][vertax.transitions.Change], with the tissue.

    **Raises:**

    - `ValueError` for an axis that is none, or a cell that is not there.
    - `RuntimeError` (of Equinox inside `jax.jit`) if there is no spare slot left, or if it cannot be cut
        in two along this axis.
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
    change = raised_if(change, full, reason)
    return raised_if(
        change,
        ~change.done,
        "The cell cannot be cut in two there. Try another axis, or throw=False.",
    )


def check_cell(tissue: Tissue, cell: int | Int[Array, ""]) -> None:
    """Refuse what is no cell, or one that is not there, if that can be seen."""
    array = isinstance(cell, jax.Array | np.ndarray) and cell.ndim == 0
    if not (array and jnp.issubdtype(jnp.result_type(cell), jnp.integer)):
        check_whole("cell", cell)
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
    mine = m.cell == cell
    centre, long = _centre_and_axis(sides, mine)
    axis = long if axis is None else axis.astype(sides.dtype)
    axis = axis / jnp.sqrt(jnp.sum(axis**2))
    along = jnp.stack([-axis[1], axis[0]])  # of the cut
    first, last = sides[:, :2] - centre, sides[:, :2] + sides[:, 2:4] - centre
    beside = lambda x: -jnp.sum(axis * x, axis=-1)
    before, after = beside(first), beside(last)
    leaves, enters = mine & (before < 0) & (after >= 0), mine & (before >= 0) & (after < 0)
    share = before / jnp.where(leaves | enters, before - after, 1)
    at = jnp.sum(along * (first + share[:, None] * sides[:, 2:4]), axis=-1)
    # Where the line leaves the cell after the centroid, and where it last came in before.
    out = jnp.argmin(jnp.where(leaves & (at > 0), at, jnp.inf)).astype(m.twin.dtype)
    into = jnp.argmax(jnp.where(enters & (at < at[out]), at, -jnp.inf)).astype(m.twin.dtype)
    slot = spare_slot(m)
    done = do & slot.there & leaves[out] & enters[into] & (at[out] > 0) & (at[into] < at[out])

    both = jnp.stack([out, into])
    cut = take(sides, both)
    share = take(share, both)
    if tissue.arcs is not None:
        share = _where_arcs_meet(cut, centre, axis)
    share = jnp.clip(share, _MARGIN, 1 - _MARGIN)
    points = cut[:, :2] + share[:, None] * cut[:, 2:4]
    if tissue.arcs is not None:
        points = _on_arcs(cut, share)

    # A cell that is its own neighbour may be cut twice at one edge: then it matters what comes first.
    same = take(m.twin, out) == into
    late = same & (share[0] + share[1] > 1)
    second = jnp.where(late, 3 * slot.vertices[0] + 2, into)
    changed = split_cell(m, out, second, slot, done)
    frames = jnp.stack([take(m.frame, out), take(changed.frame, second)])
    points = points - tissue.boundary.translation(frames)
    place = jnp.where(done, jnp.stack(slot.vertices), tissue.n_vertices)
    new = tissue.with_vertices(tissue.vertices.at[place].set(points, mode="drop"))
    new = new.with_topology(changed)

    none = unchanged(tissue)
    daughter = jnp.where(done, slot.cell, tissue.n_cells)
    cells = none.cells.at[daughter].set(cell.astype(none.cells.dtype), mode="drop")
    edge, other = take(m.edge, out), take(m.edge, into)
    drop = lambda e: jnp.where(done, e, tissue.n_edges)
    heirs = jnp.stack([drop(e) for e in slot.edges])
    edges = none.edges.at[heirs].set(jnp.stack([edge, other, edge]), mode="drop")
    vertices = none.vertices.at[place].set(take(m.source, both), mode="drop")
    if tissue.angles is not None:
        # The part that an edge keeps, and that which becomes another edge. What was cut before is shorter.
        early = jnp.where(late, (share[1] - 1 + share[0]) / share[0], share[1] / (1 - share[0]))
        shares = jnp.stack([share[0], jnp.where(same, early, share[1])])
        angles = tissue.angles
        old = jnp.stack([edge, jnp.where(same & ~late, slot.edges[0], other)])
        for k in range(2):
            angle = take(angles, old[k])
            angles = angles.at[drop(slot.edges[k])].set((1 - shares[k]) * angle, mode="drop")
            angles = angles.at[drop(old[k])].set(shares[k] * angle, mode="drop")
        new = new.with_angles(angles.at[drop(slot.edges[2])].set(0, mode="drop"))
    return Change(new, cells, edges, vertices, done)


def _centre_and_axis(
    sides: Float[Array, "halfedges parts"], mine: Bool[Array, " halfedges"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """The centroid of a cell and its long axis, both of the polygon of its corners."""
    # From one of its corners: far from the origin digits would be lost.
    reference = sides[jnp.argmax(mine), :2]
    p = sides[:, :2] - reference
    q = p + sides[:, 2:4]
    swept = jnp.where(mine, cross(p, q), 0)
    area = jnp.sum(swept) / 2
    centre = jnp.sum((p + q) * swept[:, None], axis=0) / (6 * area)
    p, q = p - centre, q - centre
    swept = jnp.where(mine, cross(p, q), 0)
    # Of a triangle from the centroid, but for a factor: the three points half-way along its sides.
    points = jnp.stack([p, q, p + q])
    moment = lambda a, b: jnp.sum(swept * jnp.sum(points[..., a] * points[..., b], axis=0))
    xx, xy, yy = moment(0, 0), moment(0, 1), moment(1, 1)
    angle = 0.5 * jnp.arctan2(2 * xy, xx - yy)
    return reference + centre, jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _on_arcs(sides: Float[Array, "2 parts"], shares: Float[Array, "2"]) -> Float[Array, "2 2"]:
    """Points at some shares of the lengths of two sides."""
    one = lambda side, share: arc_points(side[None, :2], side[None, 2:4], side[4:], share[None])
    return jax.vmap(one)(sides, shares)[:, 0, 0]


def _where_arcs_meet(
    sides: Float[Array, "2 parts"],
    centre: Float[Array, "2"],
    axis: Float[Array, "2"],
) -> Float[Array, "2"]:
    """At which share of their length two sides cross the line across an axis, by bisection."""
    distance = lambda x: jnp.sum(axis * (x - centre), axis=-1)
    before = distance(sides[:, :2]) > 0

    def halve(_: Array, ends: tuple) -> tuple:
        low, high = ends
        middle = 0.5 * (low + high)
        early = (distance(_on_arcs(sides, middle)) > 0) == before
        return jnp.where(early, middle, low), jnp.where(early, high, middle)

    none = jnp.zeros(2, sides.dtype)
    steps = 10 - int(np.log2(jnp.finfo(sides.dtype).eps))
    low, high = jax.lax.fori_loop(0, steps, halve, (none, none + 1))
    # Bisection knows no derivative; a step of Newton's method has the right one.
    found = jax.lax.stop_gradient(0.5 * (low + high))
    at = lambda share: distance(_on_arcs(sides, share))
    value, slope = jax.jvp(at, (found,), (jnp.ones_like(found),))
    return found - value / jax.lax.stop_gradient(slope)
