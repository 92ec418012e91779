"""Tissues from label images (segmentation masks)."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from vertax._base.checks import check_concrete, check_number
from vertax.initialise._cracks import Mesh, crack_graph
from vertax.initialise._mask_arguments import check_options, checked_mask
from vertax.initialise._overlap_repair import repair_overlaps
from vertax.initialise._repairs import (
    fill_gaps,
    join_pieces,
    largest_cluster,
    listed,
    mesh_or_repairs,
    untangle,
    with_exterior,
)
from vertax.mesh import Free, Periodic, Tissue, Topology
from vertax.mesh._arcs import angle_of_area
from vertax.mesh._geometry import geometry_of


class Courses(eqx.Module):
    """Where the edges of a tissue run in a label image."""

    edge: Int[np.ndarray, " points"]
    """The edge of each point; edges in ascending order, the points of each from its first vertex on."""
    points: Float[np.ndarray, "points 2"]
    """Middles of the sides between two pixels of different cells, in the tissue's unit of length."""


class Segmentation(eqx.Module):
    """A tissue made from a label image, and how its cells relate to the image.

    A pixel in row r and column c covers [c, c + 1] × [r, r + 1] times `pixel_size`: x grows with
    the column, y with the *row*, so draw it with the y axis pointing down to see the image upright.
    """

    tissue: Tissue
    """The tissue. The original image has its corner at the origin."""
    labels: Int[np.ndarray, " cells"]
    """Label in the given mask of each cell; a mirrored cell carries the label of its original."""
    whole: Bool[np.ndarray, " cells"]
    """True for the one copy of each label in the original image, if it does not touch its border.

    A periodic mask has no border: all its cells are whole.
    """
    absorbed: Int[np.ndarray, " absorbed"]
    """Labels that no cell stands for, because a trivalent mesh cannot hold them, ascending."""
    inflated: Int[np.ndarray, " inflated"]
    """Labels of cells whose corners were moved, because their polygon had next to no area."""
    pixel_size: float
    """Length of a pixel side, in the tissue's unit of length."""
    image_shape: tuple[int, int] = eqx.field(static=True)
    """Rows and columns of the given mask."""
    background: int | None = eqx.field(static=True, default=None)
    """The positive label in the mask that was taken for the background, if there is one."""
    courses: Courses | None = None
    """Where the edges run, pixel by pixel."""


def from_labels(
    mask: Shaped[np.ndarray | Array, " *shape"],
    *,
    boundary: str = "mirrored",
    pixel_size: float | None = None,
    gap_width: float = 3.0,
    background: int | None = None,
    softening: float | None = None,
    inner_arcs: bool = False,
) -> Segmentation:
    """Tissue with the cells and neighbours of a label image (paper, "Mesh initialization").

    Vertices are the pixel corners where three cells meet; the edges between them are straight, and
    all neighbourhoods are those of the image. Where four cells meet in one corner it becomes two
    vertices at the same place: of the two opposite pairs, the one with the smallest label touches
    along an edge of length 0.

    Not every label image is a trivalent mesh. First it is repaired:

    - pixels with label 0 or less, and of the background, are gaps, and go to the nearest label (where 0 may
        be a cell, because there are negative labels too, `background=0` says that it is none). One label all
        along the border of the image, which so surrounds all others, is the background;
    - of a label in several pieces the largest stays (pixels hang together by their sides, not by
        their corners); each other piece goes to the neighbour with the longest common interface;
    - a label inside another (alone or in a group) goes to the one around it;
    - a label with only two sides goes to the neighbour with the longest common interface. In a
        mirrored image this happens to small cells at the border, which gain no side by being
        mirrored.

    The last two steps are repeated until nothing is left to do. `absorbed` tells which labels are
    gone.

    In a free tissue the pixels without a label are the exterior, but for lines between cells, narrow
    bays and holes. The largest cluster of cells stays. Each piece of its outline between two
    junctions becomes an arc, which keeps the area of its cell; a cell on the outline may have two
    sides.

    A cell so concave that the polygon of its vertices has less than a hundredth of its area in the
    image, or is inside out, is inflated a little by moving its vertices; `inflated` tells which.

    **Arguments:**

    - `mask`: a label for each pixel, integers of shape (rows, columns).
    - `boundary`: how the mask becomes periodic. `"mirrored"` mirrors it about its right and bottom
        border into a box of twice the width and height, as in the paper; cells at the border merge
        with their mirror image. `"periodic"` takes a mask that wraps around already. `"free"` makes
        a free cluster in an exterior, with arcs; what lies beyond the image is exterior too.
    - `pixel_size`: length of a pixel side; by default such that the mean cell area is 1.
    - `gap_width`: how wide lines between cells may be, in pixels, not to be taken for a part of the
        exterior of a free tissue.
    - `background`: a positive label that stands for no cell, where cells touch the border of the image too;
        otherwise it is found. 0: negative labels are no cells, and 0 is none either.
    - `softening`: passed on to [`Tissue`][vertax.Tissue].
    - `inner_arcs`: make every edge an arc, with the area that its cells have over its chord in the image,
        and not only those on the outline of a free tissue. Of edges a few pixels long, the angle is
        noise.

    **Returns:** a [`Segmentation`][vertax.initialise.Segmentation]. Cells of the original image
    come first, in the order of their labels, then the mirrored ones.

    **Raises:**

    - `ValueError` for a mask that is not a 2-D array of integers, or is empty, holds fewer than two
        labels, or has a cell that reaches around the (mirrored) image or around all other cells;
        for a mask whose label 0 may be that of a cell, because it has negative ones too; for an unknown
        `boundary`, a `pixel_size` that is not positive, a `gap_width` that is negative or
        larger than the image, or a `background` that no pixel has.
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`.
    """
    check_concrete("from_labels", mask, pixel_size)
    check_options(boundary, pixel_size)
    check_number("gap_width", gap_width, at_least=0)
    values, image, background = checked_mask(mask, background)
    if boundary == "free":
        if gap_width > max(image.shape):
            raise ValueError(
                "Argument `gap_width` must be at most as many pixels as the image has, "
                f"{max(image.shape)}, but is {gap_width}."
            )
        segmentation = _free_from_labels(
            values, image, pixel_size, gap_width, softening, inner_arcs
        )
        return dataclasses.replace(segmentation, background=background)
    periodic = boundary == "periodic"
    image = fill_gaps(image, periodic)
    image = join_pieces(image, periodic)

    n = len(values)
    while True:
        cells = image if periodic else _mirror(image, n)
        mesh = mesh_or_repairs(crack_graph(cells), values)
        if isinstance(mesh, Mesh):
            break
        image = mesh[image]

    label = mesh.cells % n
    size = np.array(cells.shape[::-1], float)
    pixels = np.bincount(cells.ravel(), minlength=4 * n)[mesh.cells]
    bulge = np.bincount(mesh.cell, mesh.bulge, len(label)) if inner_arcs else 0.0 * pixels
    vertices, moved = untangle(mesh, size, pixels, bulge)
    if vertices is None:
        raise _no_polygons(values[label[moved]])
    if pixel_size is None:
        pixel_size = float(np.sqrt(len(label) / size.prod()))
    dtype = jnp.result_type(float)
    tissue = Tissue(
        jnp.asarray(vertices * pixel_size, dtype),
        Topology(mesh.twin, mesh.cell, mesh.frame),
        Periodic(jnp.asarray(np.diag(size * pixel_size), dtype)),
        softening,
    )
    if inner_arcs:
        curved = np.full(len(mesh.cell), True)
        tissue = _with_arcs(tissue, mesh, curved, pixel_size, inner_arcs=True)
    whole = np.ones(len(label), bool)
    if not periodic:
        top_bottom, left_right = _touching(image, n)
        whole = (mesh.cells < n) & ~(top_bottom | left_right)[label]
    return Segmentation(
        tissue=repair_overlaps(tissue),
        labels=values[label],
        whole=whole,
        absorbed=np.setdiff1d(values, values[label]),
        inflated=np.unique(values[label[moved]]),
        pixel_size=float(pixel_size),
        image_shape=(int(image.shape[0]), int(image.shape[1])),
        background=background,
        courses=_courses(tissue.topology, mesh, 0, pixel_size),
    )


def _free_from_labels(
    values: Int[np.ndarray, " labels"],
    image: Int[np.ndarray, "rows columns"],
    pixel_size: float | None,
    gap_width: float,
    softening: float | None,
    inner_arcs: bool,
) -> Segmentation:
    """The part of `from_labels` for a free cluster."""
    exterior = len(values)
    rows, columns = image.shape
    image, margin = with_exterior(image, exterior, gap_width)
    image = join_pieces(image, periodic=False)
    while True:
        image = largest_cluster(image, exterior)
        mesh = mesh_or_repairs(crack_graph(image), np.append(values, 0), exterior)
        if isinstance(mesh, Mesh):
            break
        image = mesh[image]

    label = mesh.cells[:-1]
    n_cells = len(label)
    left, right = mesh.cell, mesh.cell[mesh.twin]
    curved = np.full(len(left), True) if inner_arcs else (left == n_cells) | (right == n_cells)
    pixels = np.bincount(image.ravel(), minlength=exterior + 1)[mesh.cells]
    bulge = np.bincount(left, np.where(curved, mesh.bulge, 0.0), n_cells + 1)
    pixels[-1] = 0  # the exterior is no cell, and has no area
    bulge[-1] = np.inf
    size = np.array(image.shape[::-1], float)
    vertices, moved = untangle(mesh, size, pixels, bulge)
    moved = moved[:-1]
    if vertices is None:
        raise _no_polygons(values[label[moved]])
    topology = Topology(mesh.twin, mesh.cell, mesh.frame, exterior=True)
    if pixel_size is None:
        pixel_size = float(np.sqrt(n_cells / pixels.sum()))
    dtype = jnp.result_type(float)
    corners = jnp.asarray((vertices - margin) * pixel_size, dtype)
    straight = Tissue(corners, topology, Free(), softening)
    home = image[margin : margin + rows, margin : margin + columns]
    top_bottom, left_right = _touching(home, exterior + 1)
    return Segmentation(
        tissue=repair_overlaps(
            _with_arcs(straight, mesh, curved, pixel_size, inner_arcs=inner_arcs)
        ),
        labels=values[label],
        whole=~(top_bottom | left_right)[label],
        absorbed=np.setdiff1d(values, values[label]),
        inflated=np.unique(values[label[moved]]),
        pixel_size=float(pixel_size),
        image_shape=(rows, columns),
        courses=_courses(topology, mesh, margin, pixel_size),
    )


def _courses(topology: Topology, mesh: Mesh, margin: int, pixel_size: float) -> Courses:
    """Where the edges run in their own direction."""
    edge, half_edge = np.asarray(topology.edge), np.asarray(topology.half_edge)
    mine = half_edge[edge[mesh.course]] == mesh.course
    course = mesh.course[mine]
    order = np.argsort(edge[course], kind="stable")
    points = mesh.vertices[course // 3] + mesh.away[mine] - margin
    return Courses(edge[course][order], points[order] * pixel_size)


def _with_arcs(
    straight: Tissue,
    mesh: Mesh,
    curved: Bool[np.ndarray, " halfedges"],
    pixel_size: float,
    *,
    inner_arcs: bool,
) -> Tissue:
    """The tissue with arcs that bound the areas which edges bound in the image."""
    half_edge = np.asarray(straight.topology.half_edge)
    chord = np.linalg.norm(geometry_of(straight).edge_vectors, axis=1) / pixel_size
    angles = np.where(curved[half_edge], angle_of_area(mesh.bulge[half_edge], chord), 0.0)
    return Tissue(
        straight.vertices,
        straight.topology,
        straight.boundary,
        straight.softening,
        angles=jnp.asarray(angles, straight.vertices.dtype),
        inner_arcs=inner_arcs,
    )


def _no_polygons(labels: Int[np.ndarray, " labels"]) -> ValueError:
    return ValueError(
        "Argument `mask` must hold cells that polygons can stand for, but no polygons of positive "
        f"area were found around the labels {listed(labels)}. Smooth their outlines or merge them "
        "with a neighbour."
    )


def _touching(
    image: Int[np.ndarray, "rows columns"], n: int
) -> tuple[Bool[np.ndarray, " labels"], Bool[np.ndarray, " labels"]]:
    """Which labels touch the top or bottom border, and which the left or right."""
    top_bottom, left_right = np.zeros(n, bool), np.zeros(n, bool)
    top_bottom[image[[0, -1]]] = True
    left_right[image[:, [0, -1]]] = True
    return top_bottom, left_right


def _mirror(image: Int[np.ndarray, "rows columns"], n: int) -> np.ndarray:
    """The image and its three mirror images, with cell number `label + n * copy`.

    A label that touches a border is one cell with its mirror image there: both carry the number of
    the copy on the side of the original.
    """
    top_bottom, left_right = _touching(image, n)
    label = np.arange(n, dtype=np.int32)

    def quadrant(row: int, column: int) -> np.ndarray:
        copy = 2 * np.where(top_bottom, 0, row) + np.where(left_right, 0, column)
        return label + n * copy.astype(np.int32)

    flipped = image[:, ::-1]
    upper = np.hstack([quadrant(0, 0)[image], quadrant(0, 1)[flipped]])
    lower = np.hstack([quadrant(1, 0)[image], quadrant(1, 1)[flipped]])
    return np.vstack([upper, lower[::-1]])
