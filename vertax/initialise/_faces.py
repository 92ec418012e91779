"""The trivalent mesh of cells that are given by their corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.initialise._pieces import components
from vertax.mesh import Topology


class Sides(NamedTuple):
    """The sides of all cells, one cell after the other, each counter-clockwise.

    Side i leads from its own corner to that of the next side of its cell.
    """

    corner: Int[np.ndarray, " sides"]
    """The point at which each side begins."""
    image: Int[np.ndarray, "sides 2"]
    """Lattice image of that point, in the frame of the cell."""
    cell: Int[np.ndarray, " sides"]
    """The cell, in ascending order."""

    @property
    def following(self) -> Int[np.ndarray, " sides"]:
        """The next side of the cell."""
        first = np.flatnonzero(np.diff(self.cell, prepend=-1))
        last = np.append(first[1:], len(self.cell)) - 1
        following = np.arange(len(self.cell)) + 1
        following[last] = first
        return following


class Names(NamedTuple):
    """How error messages name the input, a point and a cell."""

    subject: str
    point: Callable[[int], str]
    cell: Callable[[int], str]

    def cells(self, cells: Sequence[int] | Int[np.ndarray, " some"]) -> str:
        """At most ten cells, each once."""
        return _listed([self.cell(int(cell)) for cell in np.unique(np.asarray(cells, int))])

    def points(self, points: Sequence[int] | Int[np.ndarray, " some"]) -> str:
        """At most ten points, each once."""
        return _listed([self.point(int(point)) for point in np.unique(np.asarray(points, int))])

    def refuse(self, requirement: str, fact: str, remedy: str) -> NoReturn:
        """Raise the error that all messages have the form of."""
        raise ValueError(f"{self.subject} must {requirement}, but {fact}. {remedy}")


class FaceMesh(NamedTuple):
    """The trivalent mesh of some cells, and where points and sides are in it."""

    topology: Topology
    points: Int[np.ndarray, " vertices"]
    """The point of each vertex, ascending. A point where k > 3 edges meet has k - 2 vertices."""
    half_edge: Int[np.ndarray, " sides"]
    """The half-edge that each side is a part of."""
    rank: Int[np.ndarray, " sides"]
    """Its place among the sides of that half-edge, from 0."""
    degree: Int[np.ndarray, " points"]
    """Number of edges that meet at each point: two at those that are no vertex."""
    start: Int[np.ndarray, " all_sides"]
    """The point at which each side begins; after the sides of the cells come those of the exterior."""
    following: Int[np.ndarray, " all_sides"]
    """The next side of the cell, or of the exterior."""

    def chains(self) -> list[Int[np.ndarray, " _"]]:
        """The sides of each half-edge, in order; none on the exterior, and for edges of length 0."""
        order = np.lexsort((self.rank, self.half_edge))
        count = np.bincount(self.half_edge, minlength=self.topology.n_half_edges)
        return np.split(order, np.cumsum(count)[:-1])


# A side g leaves its point. In its cell a side p = previous(g) arrives there, so the next edge
# counter-clockwise around the point is the twin of p: between them lies the cell of g. This order of the
# edges follows from the cells alone, and holds where curved edges leave in nearly one direction.
def build_faces(
    points: Float[np.ndarray, "points 2"], sides: Sides, names: Names, *, exterior: bool
) -> FaceMesh:
    """Join cells at their common sides.

    Points with two edges lie inside an edge. Where k > 3 edges meet, k - 2 vertices at the same place are
    joined by k - 3 edges of length 0: there the cell of the lowest number (next to the exterior, if that is
    there) touches all the others.

    **Arguments:**

    - `points`: positions, for error messages.
    - `sides`: the sides of the cells.
    - `names`: for error messages.
    - `exterior`: whether sides without a cell on the other side border on the exterior of a free tissue.

    **Returns:** the mesh. Vertices and cells keep the order of points and cells.

    **Raises:**

    - `ValueError` if a side has two cells on one side or more than two in all, or none on the other side in a
        periodic tissue; if cells touch in a point only, enclose a hole, lie apart, or have too few
        neighbours.
    """
    n_sides, n_cells = len(sides.corner), int(sides.cell.max()) + 1
    twin = _twins(sides, names)
    alone = np.flatnonzero(twin < 0)
    if exterior and not alone.size:
        names.refuse(
            "have an outline, where sides belong to one cell",
            "each side belongs to two",
            "Pass `box` for a periodic tissue.",
        )
    if not exterior and alone.size:
        first, last = sides.corner[[alone[0], sides.following[alone[0]]]].tolist()
        names.refuse(
            "fill the periodic box",
            f"the side from {names.point(first)} to {names.point(last)} belongs to "
            f"{names.cell(int(sides.cell[alone[0]]))} only ({len(alone)} such sides)",
            "Add the missing cells, or leave out `box` for a free tissue. Where edges are longer than half "
            "the box, give the `images` of the corners.",
        )
    # The exterior has a side against each of these.
    end = sides.corner[sides.following]
    start = np.concatenate([sides.corner, end[alone]])
    cell = np.concatenate([sides.cell, np.full(len(alone), n_cells)])
    frame = np.concatenate([sides.image, np.zeros((len(alone), 2), int)])
    outer = n_sides + np.arange(len(alone))
    twin[alone] = outer
    twin = np.concatenate([twin, alone])
    following = np.concatenate([sides.following, np.zeros(len(alone), int)])
    n_points = len(points)
    times = np.bincount(start[outer], minlength=n_points)
    if np.any(times > 1):
        _refuse_pinch(int(np.argmax(times > 1)), start, cell, n_cells, names)
    leaving = np.full(n_points, -1)
    leaving[start[outer]] = outer
    following[outer] = leaving[start[twin[outer]]]

    previous = np.argsort(following)
    turned = twin[previous]  # counter-clockwise around the point
    _check_pieces(n_points, start, cell, twin, n_cells, names)
    _check_orbits(points, start, cell, following, turned, n_cells, names)

    degree = np.bincount(start, minlength=n_points)
    if np.any(degree[start] < 2):
        point = int(start[np.argmin(degree[start])])
        names.refuse(
            "have corners in order around each cell",
            f"{names.cells(cell[start == point])} turns back at {names.point(point)}",
            "Leave out this corner.",
        )
    junction = degree >= 3
    begins = np.flatnonzero(junction[start])
    if not begins.size:
        names.refuse(
            "hold cells that meet three at a point, or two and the exterior",
            "there is no such point",
            "A single free cell is no tissue: give its neighbours too.",
        )
    slots, linked = _slots(start, cell, turned, degree, n_cells)
    slot = np.full(len(start), -1)
    slot[slots[~linked]] = np.flatnonzero(~linked)

    # From each junction along the cell on the left to the next junction, all at once, a side at a time.
    owner, rank = np.full(len(start), -1), np.zeros(len(start), int)
    last = begins.copy()
    walking = np.arange(len(begins))
    step = 0
    while walking.size:
        owner[last[walking]], rank[last[walking]] = slot[begins[walking]], step
        arrives = start[following[last[walking]]]
        walking = walking[~junction[arrives]]
        last[walking] = following[last[walking]]
        step += 1
    if np.any(owner < 0):
        names.refuse(
            "hold cells that meet their neighbours at junctions",
            f"{names.cells(cell[owner < 0][:1])} has none on its outline",
            "A cell inside another one, or with the exterior as its only neighbour, cannot be part of a "
            "tissue: leave it out, or divide the cell around it.",
        )
    half_twin = np.empty(len(slots), int)
    half_twin[slot[begins]] = slot[twin[last]]
    links = np.flatnonzero(linked)
    # Links are made in pairs, one after the other, see `_slots`.
    half_twin[links[0::2]], half_twin[links[1::2]] = links[1::2], links[0::2]
    half_cell, half_frame = cell[slots], frame[slots]
    _check_side_counts(half_cell, half_twin, n_cells, names)
    topology = Topology(half_twin, half_cell, half_frame, exterior=exterior)
    return FaceMesh(
        topology, start[slots[::3]], owner[:n_sides], rank[:n_sides], degree, start, following
    )


def _twins(sides: Sides, names: Names) -> Int[np.ndarray, " sides"]:
    """The same side as seen from the other cell, or -1."""
    n = len(sides.corner)
    end = sides.corner[sides.following]
    offset = sides.image[sides.following] - sides.image
    forward = np.column_stack([sides.corner, end, offset])
    backward = np.column_stack([end, sides.corner, -offset])
    # (One number a row, which sorts faster than rows.)
    rows = np.concatenate([forward, backward])
    rows -= rows.min(axis=0)
    number = np.ravel_multi_index(tuple(rows.T), tuple(rows.max(axis=0) + 1))
    unique, code = np.unique(number, return_inverse=True)
    forward_code, backward_code = code[:n], code[n:]
    times = np.bincount(forward_code, minlength=len(unique))
    if np.any(times > 1):
        bad = int(np.argmax(times[forward_code] > 1))
        both = (forward_code == forward_code[bad]) | (backward_code == forward_code[bad])
        cells = sides.cell[both]
        ends = f"{names.point(sides.corner[bad])} to {names.point(end[bad])}"
        if len(cells) > 2:
            names.refuse(
                "have at most two cells at each side",
                f"the side from {ends} belongs to {names.cells(cells)}",
                "Cells overlap there: correct their corners, or leave one of them out.",
            )
        names.refuse(
            "hold cells that do not overlap",
            f"{names.cells(cells)} are on the same side of the line from {ends}",
            "Correct the corners of one of them, or leave it out.",
        )
    place = np.full(len(unique), -1)
    place[forward_code] = np.arange(n)
    return place[backward_code]


def _slots(
    start: Int[np.ndarray, " sides"],
    cell: Int[np.ndarray, " sides"],
    turned: Int[np.ndarray, " sides"],
    degree: Int[np.ndarray, " points"],
    n_cells: int,
) -> tuple[Int[np.ndarray, " halfedges"], Bool[np.ndarray, " halfedges"]]:
    """The side of each half-edge; of half-edges that link vertices at one point, a side with its corner.

    The half-edges that link two vertices come one after the other among those that do.
    """
    n_vertices = np.where(degree >= 3, degree - 2, 0)
    base = 3 * (np.cumsum(n_vertices) - n_vertices)
    slots = np.full(3 * int(n_vertices.sum()), -1)
    linked = np.zeros(len(slots), bool)
    first = np.full(len(degree), -1)
    first[start[::-1]] = np.arange(len(start))[::-1]
    simple = np.flatnonzero(degree == 3)
    side = first[simple]
    for k in range(3):
        slots[base[simple] + k] = side
        side = turned[side]
    # With the edges g_0, ..., g_k-1 counter-clockwise and the corner i between g_i and g_i+1, where corner
    # k - 1 is that of the chosen cell:
    #
    #     first vertex      g_0, g_1, link on         corners 0, 1, k - 1
    #     vertex j          link back, g_j, link on   corners j - 1, j, k - 1
    #     last vertex       link back, g_k-2, g_k-1   corners k - 3, k - 2, k - 1
    for point in np.flatnonzero(degree > 3):
        fan = [int(first[point])]
        while len(fan) < degree[point]:
            fan.append(int(turned[fan[-1]]))
        cells = cell[fan]
        # A cell with two corners here would get a side on itself: it is chosen last.
        priority = cells + n_cells * (np.bincount(cells)[cells] > 1)
        if np.any(cells == n_cells):
            outside = int(np.argmax(cells == n_cells))
            beside = np.zeros(len(fan), bool)
            beside[[outside - 1, (outside + 1) % len(fan)]] = True
            priority[~beside] = 2 * n_cells + 1
        fan = np.roll(fan, -1 - int(np.argmin(priority)))
        k, at = len(fan), int(base[point])
        rows = [(fan[0], fan[1], fan[-1])]
        links = [(False, False, True)]
        for j in range(2, k - 2):
            rows.append((fan[j - 1], fan[j], fan[-1]))
            links.append((True, False, True))
        rows.append((fan[k - 3], fan[k - 2], fan[k - 1]))
        links.append((True, False, False))
        slots[at : at + 3 * (k - 2)] = np.ravel(rows)
        linked[at : at + 3 * (k - 2)] = np.ravel(links)
    return slots, linked


def _refuse_pinch(
    point: int,
    start: Int[np.ndarray, " sides"],
    cell: Int[np.ndarray, " sides"],
    n_cells: int,
    names: Names,
) -> NoReturn:
    cells = cell[(start == point) & (cell < n_cells)]
    names.refuse(
        "hold cells that touch along sides",
        f"{names.cells(cells)} touch in {names.point(point)} only, with the exterior between them",
        "Leave out cells, or add those between them.",
    )


def _check_pieces(
    n_points: int,
    start: Int[np.ndarray, " sides"],
    cell: Int[np.ndarray, " sides"],
    twin: Int[np.ndarray, " sides"],
    n_cells: int,
    names: Names,
) -> None:
    """Refuse cells in several pieces that do not touch."""
    n_pieces, piece = components(n_points, start, start[twin])
    counts = np.bincount(piece[start], minlength=n_pieces)
    if np.count_nonzero(counts) <= 1:
        return
    apart = (piece[start] != np.argmax(counts)) & (cell < n_cells)
    names.refuse(
        "be in one piece",
        f"{names.cells(cell[apart])} have no side in common with the rest",
        "Leave them out, or make a tissue of each piece.",
    )


def _check_orbits(
    points: Float[np.ndarray, "points 2"],
    start: Int[np.ndarray, " sides"],
    cell: Int[np.ndarray, " sides"],
    following: Int[np.ndarray, " sides"],
    turned: Int[np.ndarray, " sides"],
    n_cells: int,
    names: Names,
) -> None:
    """Refuse points that cells surround in several groups, and more than one outline."""
    n_fans, fan = components(len(start), np.arange(len(start)), turned)
    fans_at = np.bincount(start[np.unique(fan, return_index=True)[1]], minlength=len(points))
    if n_fans > np.count_nonzero(fans_at):
        point = int(np.argmax(fans_at > 1))
        names.refuse(
            "surround each point once",
            f"the cells at {names.point(point)}, {names.cells(cell[(start == point) & (cell < n_cells)])}, "
            "do so in separate groups",
            "Cells overlap there: correct their corners.",
        )
    outer = np.flatnonzero(cell == n_cells)
    if not outer.size:
        return
    outline = components(len(start), outer, following[outer])[1]
    extents = {
        int(k): float(np.prod(np.ptp(points[start[outer[outline[outer] == k]]], axis=0)))
        for k in np.unique(outline[outer])
    }
    if len(extents) > 1:
        largest = max(extents, key=lambda k: extents[k])
        hole = start[outer[outline[outer] == min(k for k in extents if k != largest)]]
        names.refuse(
            "enclose no hole",
            f"there is one with the corners {names.points(hole)}",
            "Give the hole as a cell, in whose place it stays.",
        )


def _check_side_counts(
    cell: Int[np.ndarray, " halfedges"],
    twin: Int[np.ndarray, " halfedges"],
    n_cells: int,
    names: Names,
) -> None:
    sides = np.bincount(cell, minlength=n_cells)[:n_cells]
    outside = np.bincount(cell, cell[twin] == n_cells, n_cells + 1)[:n_cells] > 0
    few = np.flatnonzero(sides < np.where(outside, 2, 3))
    if few.size:
        names.refuse(
            "hold cells with three neighbours or more (the exterior is one, and with it two are enough)",
            f"{names.cells(few)} {'has' if len(few) == 1 else 'have'} fewer",
            "Corners where only two edges meet are no junctions. Merge such a cell with a neighbour.",
        )


def _listed(names: list[str]) -> str:
    shown = names[:10]
    if len(names) > 10:
        return f"{', '.join(shown)} and {len(names) - 10} more"
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
