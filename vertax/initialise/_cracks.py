"""From a periodic image of cell numbers to its mesh, by the cracks between its pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax._base.plane import cross
from vertax.initialise._pieces import components
from vertax.initialise._spatial_order import spatial_order

# A *crack* is the side between two pixels of different cells; cracks join at the corners of pixels.
# The whole extraction is exact integer arithmetic on these corners, on the torus. Each corner has
# four slots, counter-clockwise for x = column to the right and y = row downwards, and the pixel on
# the left of slot d is the one between slots d and d + 1:
#
#            NW  |3|  NE         slot 0: +x     left pixel SE
#           --2-- o --0--        slot 1: +y     left pixel SW
#            SW  |1|  SE         slot 2: -x     left pixel NW
#                                slot 3: -y     left pixel NE
#
# As in the mesh, the face on the left goes on one occupied slot clockwise of the twin. Two diagonal
# pixels of one cell are not joined through their corner, so faces are the 4-connected regions.
_STEP = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])

# _TURN[p, e]: first occupied slot clockwise of slot e at a corner with the occupied slots in the bits
# of p.
_OCCUPIED = (np.arange(16)[:, None] >> np.arange(4)) & 1
_CANDIDATES = (np.arange(4)[:, None] - np.arange(1, 5)) % 4
_TURN = np.take_along_axis(
    np.broadcast_to(_CANDIDATES, (16, 4, 4)),
    np.argmax(_OCCUPIED[:, _CANDIDATES], axis=-1)[..., None],
    axis=-1,
)[..., 0]


class CrackGraph(NamedTuple):
    """The cracks of a periodic image of cell numbers.

    Crack `4 * corner + d` leaves `corner` through slot `d`; rows of cracks that are not `present`
    hold no meaning.
    """

    shape: tuple[int, int]
    """Rows and columns of the image."""
    corner: Int[np.ndarray, "corners 2"]
    """Position of each corner, (x, y) in pixel sides."""
    present: Bool[np.ndarray, "corners 4"]
    """Whether there is a crack in each slot."""
    left: Int[np.ndarray, "corners 4"]
    """Cell on the left of each slot."""
    target: Int[np.ndarray, " cracks"]
    """Corner that each crack reaches."""
    twin: Int[np.ndarray, " cracks"]
    """The crack in the opposite direction."""
    following: Int[np.ndarray, " cracks"]
    """The next crack around the cell on the left."""

    def interfaces(self) -> tuple[Int[np.ndarray, " sides"], Int[np.ndarray, " sides"]]:
        """The cells on both sides of every crack, each crack in both directions."""
        cracks = np.flatnonzero(self.present)
        left = self.left.ravel()
        return left[cracks], left[self.twin[cracks]]


class Mesh(NamedTuple):
    """What [`Topology`][vertax.Topology] is made of, and where the vertices are in pixel sides."""

    vertices: Int[np.ndarray, "vertices 2"]
    twin: Int[np.ndarray, " halfedges"]
    following: Int[np.ndarray, " halfedges"]
    """The next half-edge around the cell on the left."""
    cell: Int[np.ndarray, " halfedges"]
    frame: Int[np.ndarray, "halfedges 2"]
    cells: Int[np.ndarray, " cells"]
    """The number that each cell has in the image, ascending."""
    bulge: Float[np.ndarray, " halfedges"]
    """Area between each edge as the pixels have it and its chord, right of the chord, in pixels."""
    course: Int[np.ndarray, " sides"]
    """The half-edge that each side between two pixels of different cells belongs to, from its first to its
    last."""
    away: Float[np.ndarray, "sides 2"]
    """The middle of that side, seen from the vertex that the half-edge leaves, in pixel sides."""


def crack_graph(image: Int[np.ndarray, "rows columns"]) -> CrackGraph:
    """The cracks of an image of cell numbers that is periodic in both directions."""
    rows, columns = image.shape
    right = image != np.roll(image, 1, axis=0)
    down = image != np.roll(image, 1, axis=1)
    slots = (right, down, np.roll(right, 1, axis=1), np.roll(down, 1, axis=0))
    code = np.flatnonzero(slots[0] | slots[1] | slots[2] | slots[3])
    present = np.stack([slot.ravel()[code] for slot in slots], axis=1)
    y, x = np.divmod(code, columns)
    left = np.stack(
        [image[(y - dy) % rows, (x - dx) % columns] for dy, dx in ((0, 0), (0, 1), (1, 1), (1, 0))],
        axis=1,
    )
    reached_x = (x[:, None] + _STEP[:, 0]) % columns
    reached_y = (y[:, None] + _STEP[:, 1]) % rows
    # Where a slot is empty, the corner there need not exist; the clip only keeps the index legal.
    target = np.searchsorted(code, reached_y * columns + reached_x)
    target = np.minimum(target, max(len(code) - 1, 0)).ravel()
    back = np.tile((np.arange(4) + 2) % 4, len(code))
    pattern = present @ np.array([1, 2, 4, 8])
    following = 4 * target + _TURN[pattern[target], back]
    return CrackGraph(
        (rows, columns), np.stack([x, y], 1), present, left, target, 4 * target + back, following
    )


def enclosed_cells(graph: CrackGraph, exterior: int | None = None) -> dict[int, int]:
    """Cells that lie inside another cell, singly or in groups, and the cell that encloses them.

    If there is an `exterior`, its outline is one, and belongs to the tissue.

    **Raises:**

    - `NotADiskError` if no set of cells cuts the torus
        into disks.
    """
    n_corners = len(graph.corner)
    cracks = np.flatnonzero(graph.present)
    n_parts, part = components(n_corners, cracks // 4, graph.target[cracks])
    n_faces, face = components(4 * n_corners, cracks, graph.following[cracks])
    face = face[cracks]
    # A connected graph cuts the torus into disks if and only if vertices - edges + faces is 0, and
    # no two disjoint graphs do. That part is the tissue; the others lie inside its cells.
    part_of_crack = part[cracks // 4]
    first = np.unique(face, return_index=True)[1]
    euler = (
        np.bincount(part, minlength=n_parts)
        - np.bincount(part_of_crack, minlength=n_parts) // 2
        + np.bincount(part_of_crack[first], minlength=n_parts)
    )
    left, right = graph.interfaces()
    is_tissue = euler == 0
    if exterior is not None:
        is_tissue = np.arange(n_parts) == part_of_crack[np.argmax(left == exterior)]
    if not np.any(is_tissue):
        # The outline of a disk makes four left turns in all, that of a hole four right turns, and
        # an outline that goes around the torus none: cells without an outline of the first kind are
        # not disks.
        turn = (graph.following[cracks] % 4 - cracks % 4 + 1) % 4 - 1
        turns = np.bincount(face, turn, minlength=n_faces)
        raise NotADiskError(np.setdiff1d(left, left[turns[face] == 4]))
    if n_parts == 1:
        return {}
    in_tissue = np.isin(left, left[part_of_crack == np.argmax(is_tissue)])
    cells, index = np.unique(np.concatenate([left, right]), return_inverse=True)
    a, b = index[: len(left)], index[len(left) :]
    tissue = np.zeros(len(cells), bool)
    tissue[a[in_tissue]] = True
    inside = ~tissue[a] & ~tissue[b]
    group = components(len(cells), a[inside], b[inside])[1]
    border = ~tissue[a] & tissue[b]
    host = np.zeros(len(cells), int)
    host[group[a[border]]] = cells[b[border]]
    return {int(cells[c]): int(host[group[c]]) for c in np.flatnonzero(~tissue)}


class NotADiskError(Exception):
    """Cells that go around the torus or around all the others."""

    def __init__(self, cells: Int[np.ndarray, " cells"]):
        self.cells = cells


def build_mesh(graph: CrackGraph, priority: Int[np.ndarray, "corners 4"]) -> Mesh:
    """The trivalent mesh of an image of cells that are disks.

    `priority` ranks the cell on the left of each slot: where four different cells meet, the one of
    the lowest rank gets to touch its opposite.
    """
    degree = graph.present.sum(axis=1)
    triple, fourfold = np.flatnonzero(degree == 3), np.flatnonzero(degree == 4)
    slot3 = np.nonzero(graph.present[triple])[1].reshape(-1, 3)  # ascending: counter-clockwise
    cell3 = np.take_along_axis(graph.left[triple], slot3, axis=1)
    # A four-fold corner becomes two vertices u, w joined by an edge of length 0. It separates two
    # opposite cells and lets the two others, p[s] and p[s + 2], touch along it:
    #
    #     u: slots s + 1, s + 2, new edge      with cells p[s + 1], p[s + 2], p[s]
    #     w: slots s + 3, s,     new edge      with cells p[s + 3], p[s],     p[s + 2]
    #
    # If one opposite pair is a single cell, it is that pair which must be kept apart: the cell
    # closes around the corner elsewhere, and would become a ring.
    p, rank = graph.left[fourfold], priority[fourfold]
    s = np.where(np.minimum(rank[:, 0], rank[:, 2]) < np.minimum(rank[:, 1], rank[:, 3]), 0, 1)
    s = np.where(p[:, 0] == p[:, 2], 1, np.where(p[:, 1] == p[:, 3], 0, s))[:, None]
    slot = (s + np.array([[1, 2, 3, 0]])) % 4
    p_slot = np.take_along_axis(p, slot, axis=1)
    cell_u, cell_w = p_slot[:, [0, 1, 3]], p_slot[:, [2, 3, 1]]

    at = np.concatenate([triple, fourfold, fourfold])
    cell = np.concatenate([cell3, cell_u, cell_w])
    crack = np.full((len(at), 3), -1)
    crack[: len(triple)] = 4 * triple[:, None] + slot3
    crack[len(triple) :, :2] = 4 * at[len(triple) :, None] + np.vstack([slot[:, :2], slot[:, 2:]])
    partner = np.arange(len(at))
    u = np.arange(len(triple), len(triple) + len(fourfold))
    partner[u], partner[u + len(u)] = u + len(u), u

    size = np.array(graph.shape[::-1])
    order = spatial_order(graph.corner[at] / size)
    position, cell, crack = graph.corner[at][order], cell[order], crack[order].ravel()
    partner = np.argsort(order)[partner[order]]

    # From each junction along its crack to the next junction: that is the other end of the edge.
    half_edge = np.full(len(graph.target), -1)
    real = crack >= 0
    half_edge[crack[real]] = np.flatnonzero(real)
    every = np.arange(len(graph.target))
    onwards = np.where(degree[graph.target] == 2, graph.following, every)
    step = np.tile(_STEP, (len(graph.corner), 1))
    last, way, swept = _follow(onwards, step)
    # What leads from a crack to the end of its edge: the longest way is that of the first crack.
    steps = _follow(onwards, np.ones_like(step))[1][:, 0]
    ahead = way
    swept += cross(way, _STEP[last % 4])
    way = way + _STEP[last % 4]
    bulge = np.zeros(len(crack))
    bulge[real] = 0.5 * swept[crack[real]]
    twin = 3 * np.repeat(partner, 3) + 2
    displacement = np.zeros((len(crack), 2), int)
    twin[real] = half_edge[graph.twin[last[crack[real]]]]
    displacement[real] = way[crack[real]]
    owner = np.full(len(graph.target), -1)
    owner[last[crack[real]]] = np.flatnonzero(real)
    course = np.where(graph.present.ravel(), owner[last], -1)
    along = np.lexsort((-steps, course))
    along = along[course[along] >= 0]
    course = course[along]
    away = ahead[crack[course]] - ahead[along] + 0.5 * step[along]

    source = np.repeat(position, 3, axis=0)
    offset = (source + displacement - source[twin]) // size
    # Frames add up the offsets along each face, from its first half-edge onwards.
    cells, cell = np.unique(cell.ravel(), return_inverse=True)
    following = 3 * (twin // 3) + (twin + 2) % 3  # one slot clockwise of the twin
    previous = np.empty_like(twin)
    previous[following] = np.arange(len(twin))
    before = offset[previous]
    first = np.unique(cell, return_index=True)[1]
    previous[first] = first
    frame = _follow(previous, before)[1]
    return Mesh(position, twin, following, cell, frame, cells, bulge, course, away)


def _follow(
    pointer: Int[np.ndarray, " nodes"], value: Int[np.ndarray, "nodes 2"]
) -> tuple[Int[np.ndarray, " nodes"], Int[np.ndarray, "nodes 2"], Int[np.ndarray, " nodes"]]:
    """End of every chain of pointers (a node that points to itself), and the sum up to there.

    Also twice the area that the chain of vectors encloses with their sum, on the right of the sum.

    Pointer doubling: as many passes as the longest chain has binary digits. Closed chains have no
    end; theirs means nothing.
    """
    total = np.where((pointer == np.arange(len(pointer)))[:, None], 0, value)
    swept = np.zeros(len(pointer), int)
    for _ in range(len(pointer).bit_length()):
        onwards = pointer[pointer]
        if np.array_equal(onwards, pointer):
            break
        swept = swept + swept[pointer] + cross(total, total[pointer])
        total = total + total[pointer]
        pointer = onwards
    return pointer, total, swept
