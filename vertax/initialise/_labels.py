"""Tissues from label images (segmentation masks)."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from vertax._base.checks import check_choice, check_concrete, check_number
from vertax._base.pixels import PixelSize, as_pixel_size, pixel_sides
from vertax.initialise._cracks import Mesh, crack_graph
from vertax.initialise._gaps import (
    EXTERIOR,
    GAP,
    default_gap_width,
    fill_gaps,
    largest_cluster,
    line_width,
    nearest_outside,
    with_exterior,
)
from vertax.initialise._heights import surface_of
from vertax.initialise._mask_arguments import check_options, checked_mask
from vertax.initialise._overlap_repair import repair_overlaps
from vertax.initialise._pieces import join_pieces, numbered, without_specks
from vertax.initialise._repairs import listed, mesh_or_repairs, untangle
from vertax.initialise._report import MaskReport, Repaired, contacts_of, report_on
from vertax.mesh import Free, Periodic, Tissue, Topology, angle_of_area, geometry_of
from vertax.surfaces import AbstractSurface

_HOLES = ("keep", "close")


class Courses(eqx.Module):
    """Points of the edges of a tissue in a label image."""

    edge: Int[np.ndarray, " points"]
    """The edge of each point; edges in ascending order, the points of each from its first vertex on."""
    points: Float[np.ndarray, "points 2"]
    """Middles of the sides between two pixels of different cells, in the tissue's unit of length."""
    shown: Bool[np.ndarray, " points"]
    """Whether the mask shows the contact at this point: the labels touch, or the gap between them is not
    wider than `gap_width`."""


class Segmentation(eqx.Module):
    """A tissue made from a label image, and how its cells relate to the image.

    A pixel in row r and column c covers [c, c + 1] × [r, r + 1] times its width and height: x grows with
    the column, y with the *row*, so draw it with the y axis pointing down to see the image upright.
    """

    tissue: Tissue
    """The tissue. The original image has its corner at the origin."""
    labels: Int[np.ndarray, " cells"]
    """Label of each cell: its label in the mask, where a mirrored cell carries the label of its original; a
    new one for a second piece of a label; 0 for a hole, which is a face of the tissue without a cell."""
    complete: Bool[np.ndarray, " cells"]
    """True for the one copy of each label in the original image, if it does not touch its border.

    A periodic mask has no border: all its cells are whole. Holes are not.
    """
    absorbed: Int[np.ndarray, " absorbed"]
    """Labels without a cell, ascending; `report` says what became of each."""
    inflated: Int[np.ndarray, " inflated"]
    """Labels of cells with corners that were moved, because their polygon had nearly no area."""
    pixel_size: PixelSize
    """Length of a pixel side, in the tissue's unit of length; (height, width) if pixels are not square."""
    image_shape: tuple[int, int] = eqx.field(static=True)
    """Rows and columns of the given mask."""
    background: int | None = eqx.field(static=True, default=None)
    """The positive label in the mask that was taken for the background, or for lines between cells."""
    courses: Courses | None = None
    """The points of the edges, pixel by pixel."""
    report: MaskReport | None = None
    """What became of each label, and which contacts the mask shows."""


def from_labels(
    mask: Shaped[np.ndarray | Array, " *shape"],
    *,
    boundary: str = "mirrored",
    pixel_size: PixelSize | None = None,
    gap_width: float | None = None,
    background: int | None = None,
    holes: str = "keep",
    softening: float | None = None,
    inner_arcs: bool = False,
    height: AbstractSurface | Shaped[np.ndarray | Array, "..."] | None = None,
    plane_distance: float = 1.0,
    unknown_height: float | int | None = None,
) -> Segmentation:
    """Tissue with the cells and neighbours of a label image (paper, "Mesh initialization").

    Vertices are the pixel corners where three cells meet; the edges between them are straight, and
    all neighbourhoods are those of the image. Where four cells meet in one corner it becomes two
    vertices at the same place: of the two opposite pairs, the one with the smallest label touches
    along an edge of length 0.

    Not every label image is a trivalent mesh. First it is repaired:

    - pixels with label 0 or less, and of the background, are gaps, and go to the nearest label (where 0 may
        be a cell, because there are negative labels too, `background=0` states that it is none). One label
        all along the border of the image, which so surrounds all others, is the background. A label of lines
        thinner than 0.3 cells between all cells is a gap too;
    - of a label in several pieces the largest stays (pixels are connected by their sides, not by
        their corners). Every other piece of at least a quarter of the median cell (and 25 pixels) becomes a
        cell with a new label; a smaller one goes to the neighbour with the longest common interface;
    - a label inside another (alone or in a group) goes to the one around it;
    - a label with only two sides goes to the neighbour with the longest common interface. In a
        mirrored image this happens to small cells at the border, which gain no side by being
        mirrored.

    The last two steps are repeated until nothing is left to do. The field `report` lists every change with
    its place, and for each edge the share of its length along which the mask shows the contact.

    In a free tissue the pixels without a label are the exterior, except lines between cells and narrow bays.
    A hole, deeper than one and a half lines, stays a face of the tissue with the label 0, and so does a piece
    of a label between 0.03 and 0.25 median cells. Labels smaller than 0.03 median cells that do not touch the
    border of the image are no cells. The largest cluster of cells stays. Each piece of its outline between
    two junctions becomes an arc, which keeps the area of its cell; a cell on the outline may have two sides.

    A cell so concave that the polygon of its vertices has less than a hundredth of its area in the
    image, or is inside out, is inflated a little by moving its vertices; `inflated` lists these cells.

    **Arguments:**

    - `mask`: a label for each pixel, integers of shape (rows, columns).
    - `boundary`: how the mask becomes periodic. `"mirrored"` mirrors it about its right and bottom
        border into a box of twice the width and height, as in the paper; cells at the border merge
        with their mirror image. `"periodic"` takes a mask that wraps around already. `"free"` makes
        a free cluster in an exterior, with arcs; what lies beyond the image is exterior too.
    - `pixel_size`: length of a pixel side, or (height, width) of pixels that are not square; by default they
        are, and such that the mean cell area is 1.
    - `gap_width`: largest width of a line between two cells in contact, in the shorter side of a pixel. By
        default the width of the lines in the mask (0.9 quantile over all pairs of neighbours) plus 1, and at
        least 3.
    - `background`: a positive label that stands for no cell, where cells touch the border of the image too;
        otherwise it is found. 0: negative labels are no cells, and 0 is none either.
    - `holes`: `"keep"` leaves holes of a free tissue as faces; `"close"` gives them to the cells next to
        them, as is done in a mirrored or periodic one.
    - `softening`: passed on to [`Tissue`][vertax.Tissue].
    - `inner_arcs`: make every edge an arc, with the area that its cells have over its chord in the image,
        and not only those on the outline of a free tissue. Of edges a few pixels long, the angle is
        noise.
    - `height`: of a curved tissue, the height of each pixel of the mask, NaN where it is unknown; or a
        surface in the unit of length of the tissue. The mask is the projection of the tissue, which gets the
        [`HeightMap`][vertax.surfaces.HeightMap] as its surface, mirrored or periodic as the mask is, and
        straight edges on its outline too. An image is smoothed by a Gaussian of a quarter of the cell
        diameter, or of half of it if its heights are steps of planes.
    - `plane_distance`: height per unit of an image of heights, in the unit of `pixel_size`; without
        `pixel_size`, in pixels.
    - `unknown_height`: value of unknown pixels in an image of heights, such as 0, beside NaN.

    **Returns:** a [`Segmentation`][vertax.initialise.Segmentation]. Cells of the original image
    come first, in the order of their labels, then the mirrored ones.

    **Raises:**

    - `ValueError` for a mask that is not a 2-D array of integers, or is empty, holds fewer than two
        labels, is a picture, or has a cell that reaches around the (mirrored) image or around all other
        cells; for a mask with a label 0 that may be that of a cell, because it has negative ones too; for an
        unknown `boundary` or `holes`, a `pixel_size` that is not positive, a `gap_width` that is negative or
        larger than the image, or a `background` that no pixel has; for heights of another shape than the
        mask, and `inner_arcs` with `height`.
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`.
    """
    check_concrete("from_labels", mask, pixel_size)
    check_options(boundary, pixel_size)
    check_choice("holes", holes, _HOLES)
    if gap_width is not None:
        check_number("gap_width", gap_width, at_least=0)
    values, image, background = checked_mask(mask, background)
    if gap_width is not None and boundary == "free" and gap_width > max(image.shape):
        raise ValueError(
            "Argument `gap_width` must be at most as many pixels as the image has, "
            f"{max(image.shape)}, but is {gap_width}."
        )
    if height is not None and inner_arcs:
        raise ValueError(
            "Argument `inner_arcs` must be False with `height`: edges on a surface are straight chords. For "
            "tensions of curved edges pass the mask and its heights to vx.tensions.infer_tensions."
        )
    sides = pixel_sides(1.0 if pixel_size is None else pixel_size)
    sized, arcs = pixel_size is not None, inner_arcs if height is None else None
    keep_holes = holes == "keep" and boundary == "free"
    options = _Options(boundary, sides, sized, gap_width, keep_holes, softening, arcs, background)
    result = _segmentation(values, image, options)
    if height is None:
        return result
    surface = surface_of(result, height, plane_distance, unknown_height, sized=sized)
    return dataclasses.replace(result, tissue=result.tissue.with_surface(surface))


class _Options(NamedTuple):
    """Arguments of `from_labels`."""

    boundary: str
    sides: Float[np.ndarray, " xy"]
    """Width and height of a pixel, or their ratio."""
    sized: bool
    """Whether `sides` are lengths."""
    gap_width: float | None
    keep_holes: bool
    """Whether holes are faces of a free tissue."""
    softening: float | None
    inner_arcs: bool | None
    """None for a tissue without any arc."""
    background: int | None

    @property
    def spacing(self) -> tuple[float, float]:
        """Height and width of a pixel, in the shorter of both."""
        width, height = (self.sides / self.sides.min()).tolist()
        return height, width

    def lengths(self, mean_area: float) -> Float[np.ndarray, " xy"]:
        """Width and height of a pixel, from the mean area of cells in pixels."""
        if self.sized:
            return self.sides
        return self.sides / np.sqrt(mean_area * np.prod(self.sides))


class _Faces(NamedTuple):
    """The faces of a tissue in an image."""

    mesh: Mesh
    """Their mesh; the number of a copy in a mirrored image is that of its original plus that of all faces."""
    cells: Int[np.ndarray, "box_rows box_columns"]
    """The number of each pixel: the image in its margin, or with its mirror images."""
    margin: int
    """Width of the exterior around the given image, in pixels."""
    names: Int[np.ndarray, " faces"]
    """The label of each face, 0 for holes and the exterior."""
    parent: Int[np.ndarray, " faces"]
    """The index of its label in the mask; GAP for holes and the exterior."""
    exterior: int | None
    widths: tuple[float, float]
    """Largest width of gaps that were closed, and the width of lines as measured."""


def _faces_of(
    values: Int[np.ndarray, " labels"],
    given: Int[np.ndarray, "rows columns"],
    options: _Options,
) -> _Faces:
    """The image without gaps, with labels in one piece, repaired until there is a mesh of its faces."""
    free, periodic = options.boundary == "free", options.boundary == "periodic"
    spacing, n_values = options.spacing, len(values)
    measured, apart = line_width(given, spacing)
    gap_width = default_gap_width(measured) if options.gap_width is None else options.gap_width
    if free:
        image, outside = without_specks(given, spacing)
        image, margin = with_exterior(image, gap_width, spacing, keep_holes=options.keep_holes)
        image = np.where(np.pad(outside, margin), EXTERIOR, image)
    else:
        image, margin = fill_gaps(given, periodic=periodic, spacing=spacing), 0
    image, parents = join_pieces(image, n_values, periodic, keep_holes=options.keep_holes)
    n_labels, exterior, remedy = n_values + len(parents), None, ""
    # New labels come after the largest one.
    names = np.append(values, values[-1] + 1 + np.arange(len(parents)))
    if free:
        image, exterior = numbered(image, n_labels)
        names = np.append(names, np.zeros(exterior - n_labels + 1, int))
        if apart > gap_width:
            remedy = (
                f"Neighbouring labels are {apart:.0f} pixels apart (median), and only gaps of at most "
                f"{gap_width:g} pixels were closed: pass gap_width={np.ceil(apart) + 1:.0f}."
            )
    n = len(names)
    parent = np.concatenate([np.arange(n_values), parents, np.full(n - n_labels, GAP)])
    holes, arcs = np.arange(n_labels, n - free), options.inner_arcs is not None
    while True:
        if exterior is not None:
            image = largest_cluster(image, exterior)
        cells = _mirror(image, n) if options.boundary == "mirrored" else image
        mesh = mesh_or_repairs(crack_graph(cells), names, exterior, remedy, arcs=arcs)
        if isinstance(mesh, Mesh):
            widths = gap_width, measured
            return _Faces(mesh, cells, margin, names, parent, exterior, widths)
        # A hole with fewer than three sides is shared out among the cells next to it.
        lost = holes[mesh[holes] != holes]
        mesh[lost] = lost
        image = mesh[image]
        if len(lost):
            image = fill_gaps(np.where(np.isin(image, lost), GAP, image), spacing=spacing)


def _segmentation(
    values: Int[np.ndarray, " labels"],
    given: Int[np.ndarray, "rows columns"],
    options: _Options,
) -> Segmentation:
    """The tissue without overlaps, the points of its edges, and the report on the mask."""
    faces = _faces_of(values, given, options)
    mesh, names, margin, free = faces.mesh, faces.names, faces.margin, faces.exterior is not None
    n, n_cells = len(names), len(mesh.cells) - free
    label = mesh.cells[:n_cells] % n
    curved = (mesh.cell == n_cells) | (mesh.cell[mesh.twin] == n_cells)
    if options.inner_arcs is not False:
        curved = np.full(len(curved), options.inner_arcs is True)
    pixels = np.bincount(faces.cells.ravel(), minlength=4 * n)[mesh.cells]
    bulge = np.bincount(mesh.cell, np.where(curved, mesh.bulge, 0.0), len(mesh.cells))
    if free:
        pixels[-1], bulge[-1] = 0, np.inf  # the exterior is no cell, and has no area
    size = np.array(faces.cells.shape[::-1], float)
    vertices, moved = untangle(mesh, size, pixels, bulge)
    moved, pixels = moved[:n_cells], pixels[:n_cells]
    if vertices is None:
        raise ValueError(
            "Argument `mask` must hold cells that polygons can stand for, but no polygons of positive "
            f"area were found around the labels {listed(names[label[moved]])}. Smooth their outlines or "
            "merge them with a neighbour."
        )
    lengths = options.lengths(float(np.mean(pixels[names[label] > 0])))
    dtype = jnp.result_type(float)
    tissue = Tissue(
        jnp.asarray((vertices - margin) * lengths, dtype),
        Topology(mesh.twin, mesh.cell, mesh.frame, exterior=free),
        Free() if free else Periodic(jnp.asarray(np.diag(size * lengths), dtype)),
        options.softening,
    )
    if curved.any():
        tissue = _with_arcs(tissue, mesh, curved, lengths, inner_arcs=options.inner_arcs is True)

    rows, columns = given.shape
    home = faces.cells[margin : margin + rows, margin : margin + columns] % n
    complete = (mesh.cells[:n_cells] < n) & (names[label] > 0)
    periodic = options.boundary == "periodic"
    if not periodic:
        complete &= ~np.logical_or(*_touching(home, n))[label]
    # Pixels of a face other than the one of their label.
    depth, _ = nearest_outside(faces.parent[home] != given, options.spacing, periodic=periodic)
    # A free tissue has a margin of unchanged pixels; the box of the others repeats itself.
    box, room = depth, 2 * margin
    if options.boundary == "mirrored":
        box = np.pad(depth, [(0, rows), (0, columns)], mode="symmetric")
    box = np.pad(box, room)
    depth_at = lambda row, column: box[(row + room) % box.shape[0], (column + room) % box.shape[1]]
    edge, points = _courses(tissue.topology, mesh, margin)
    chord = np.linalg.norm(geometry_of(tissue).edge_vectors, axis=1) / lengths.min()
    shown, uncertain, point_shown = contacts_of(edge, points, chord, depth_at, faces.widths[0])
    repaired = Repaired(values, given, home, names, faces.exterior, label)
    return Segmentation(
        tissue=repair_overlaps(tissue, bend_back=True),
        labels=names[label],
        complete=complete,
        absorbed=np.setdiff1d(values, names[label]),
        inflated=np.unique(names[label[moved]]),
        pixel_size=as_pixel_size(lengths),
        image_shape=(rows, columns),
        background=options.background,
        courses=Courses(edge, points * lengths, point_shown),
        report=report_on(repaired, (shown, uncertain), depth, faces.widths, pixels),
    )


def _courses(
    topology: Topology, mesh: Mesh, margin: int
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, "points 2"]]:
    """The points of the edges in their own direction, in pixels: the edge of each, and its position."""
    edge, half_edge = np.asarray(topology.edge), np.asarray(topology.half_edge)
    mine = half_edge[edge[mesh.course]] == mesh.course
    course = mesh.course[mine]
    order = np.argsort(edge[course], kind="stable")
    points = mesh.vertices[course // 3] + mesh.away[mine] - margin
    return edge[course][order], points[order]


def _with_arcs(
    straight: Tissue,
    mesh: Mesh,
    curved: Bool[np.ndarray, " halfedges"],
    lengths: Float[np.ndarray, " xy"],
    *,
    inner_arcs: bool,
) -> Tissue:
    """The tissue with arcs that bound the areas which edges bound in the image."""
    half_edge = np.asarray(straight.topology.half_edge)
    chord = np.linalg.norm(geometry_of(straight).edge_vectors, axis=1)
    area = mesh.bulge[half_edge] * np.prod(lengths)
    angles = np.where(curved[half_edge], angle_of_area(area, chord), 0.0)
    return Tissue(
        straight.vertices,
        straight.topology,
        straight.boundary,
        straight.softening,
        angles=jnp.asarray(angles, straight.vertices.dtype),
        inner_arcs=inner_arcs,
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
    rows, columns = image.shape
    mirrored = np.pad(image, [(0, rows), (0, columns)], mode="symmetric")
    below, beside = np.arange(2 * rows)[:, None] >= rows, np.arange(2 * columns) >= columns
    copy = 2 * (below & ~top_bottom[mirrored]) + (beside & ~left_right[mirrored])
    return mirrored + n * copy.astype(np.int32)
