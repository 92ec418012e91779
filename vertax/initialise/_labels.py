"""Tissues from label images (segmentation masks)."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from vertax._base.checks import check_concrete, check_number
from vertax._base.pixels import PixelSize, as_pixel_size, pixel_sides
from vertax.initialise._cracks import Mesh, crack_graph
from vertax.initialise._gaps import (
    EXTERIOR,
    GAP,
    default_gap_width,
    distance_within,
    fill_gaps,
    largest_cluster,
    line_width,
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
    if holes not in _HOLES:
        raise ValueError(
            f"Argument `holes` must be one of {', '.join(map(repr, _HOLES))}, but is {holes!r}."
        )
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
    options = _Options(sides, sized, gap_width, holes == "keep", softening, arcs, background)
    if boundary == "free":
        result = _free(values, image, options)
    else:
        result = _closed(values, image, options, periodic=boundary == "periodic")
    if height is None:
        return result
    surface = surface_of(result, height, plane_distance, unknown_height, sized=sized)
    return dataclasses.replace(result, tissue=result.tissue.with_surface(surface))


class _Options(NamedTuple):
    """Arguments of `from_labels`."""

    sides: Float[np.ndarray, " xy"]
    """Width and height of a pixel, or their ratio."""
    sized: bool
    """Whether `sides` are lengths."""
    gap_width: float | None
    keep_holes: bool
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


def _closed(
    values: Int[np.ndarray, " labels"],
    image: Int[np.ndarray, "rows columns"],
    options: _Options,
    *,
    periodic: bool,
) -> Segmentation:
    """The part of `from_labels` for periodic and mirrored tissues."""
    given, spacing = image, options.spacing
    measured, _ = line_width(image, spacing)
    gap_width = default_gap_width(measured) if options.gap_width is None else options.gap_width
    image = fill_gaps(image, periodic=periodic, spacing=spacing)
    image, parents = join_pieces(image, len(values), periodic, keep_holes=False)
    names = _names(values, parents)
    n = len(names)
    while True:
        cells = image if periodic else _mirror(image, n)
        mesh = mesh_or_repairs(crack_graph(cells), names)
        if isinstance(mesh, Mesh):
            break
        image = mesh[image]

    label = mesh.cells % n
    size = np.array(cells.shape[::-1], float)
    pixels = np.bincount(cells.ravel(), minlength=4 * n)[mesh.cells]
    bulge = np.bincount(mesh.cell, mesh.bulge, len(label)) if options.inner_arcs else 0.0 * pixels
    vertices, moved = untangle(mesh, size, pixels, bulge)
    if vertices is None:
        raise _no_polygons(names[label[moved]])
    lengths = options.lengths(size.prod() / len(label))
    dtype = jnp.result_type(float)
    tissue = Tissue(
        jnp.asarray(vertices * lengths, dtype),
        Topology(mesh.twin, mesh.cell, mesh.frame),
        Periodic(jnp.asarray(np.diag(size * lengths), dtype)),
        options.softening,
    )
    if options.inner_arcs:
        curved = np.full(len(mesh.cell), True)
        tissue = _with_arcs(tissue, mesh, curved, lengths, inner_arcs=True)
    uncut = np.ones(len(label), bool)
    if not periodic:
        top_bottom, left_right = _touching(image, n)
        uncut = (mesh.cells < n) & ~(top_bottom | left_right)[label]
    parent = np.append(np.arange(len(values)), parents)
    depth = distance_within(parent[image] != given, spacing, periodic=periodic)
    repaired = Repaired(values, given, image, names, None, np.unique(label))
    return _segmentation(
        tissue,
        mesh,
        repaired,
        depth if periodic else _reflected(depth),
        (gap_width, measured),
        lengths,
        label=label,
        complete=uncut,
        moved=moved,
        pixels=pixels,
        background=options.background,
    )


def _free(
    values: Int[np.ndarray, " labels"],
    image: Int[np.ndarray, "rows columns"],
    options: _Options,
) -> Segmentation:
    """The part of `from_labels` for a free cluster."""
    given, spacing = image, options.spacing
    measured, apart = line_width(image, spacing)
    gap_width = default_gap_width(measured) if options.gap_width is None else options.gap_width
    image, outside = without_specks(image, spacing)
    image, margin = with_exterior(image, gap_width, spacing, keep_holes=options.keep_holes)
    image = np.where(np.pad(outside, margin), EXTERIOR, image)
    image, parents = join_pieces(image, len(values), False, keep_holes=options.keep_holes)
    n_labels = len(values) + len(parents)
    image, exterior = numbered(image, n_labels)
    names = np.append(_names(values, parents), np.zeros(exterior - n_labels + 1, int))
    remedy = ""
    if apart > gap_width:
        remedy = (
            f"Neighbouring labels are {apart:.0f} pixels apart (median), and only gaps of at most "
            f"{gap_width:g} pixels were closed: pass gap_width={np.ceil(apart) + 1:.0f}."
        )
    while True:
        image = largest_cluster(image, exterior)
        arcs = options.inner_arcs is not None
        mesh = mesh_or_repairs(crack_graph(image), names, exterior, remedy, arcs=arcs)
        if isinstance(mesh, Mesh):
            break
        # A hole with fewer than three sides is shared out among the cells next to it.
        lost = np.flatnonzero(mesh[n_labels:exterior] != np.arange(n_labels, exterior)) + n_labels
        mesh[lost] = lost
        image = mesh[image]
        if len(lost):
            image = fill_gaps(np.where(np.isin(image, lost), GAP, image), spacing=spacing)

    label = mesh.cells[:-1]
    n_cells = len(label)
    left, right = mesh.cell, mesh.cell[mesh.twin]
    curved = (left == n_cells) | (right == n_cells)
    if options.inner_arcs is not False:
        curved = np.full(len(left), options.inner_arcs is True)
    pixels = np.bincount(image.ravel(), minlength=exterior + 1)[mesh.cells]
    bulge = np.bincount(left, np.where(curved, mesh.bulge, 0.0), n_cells + 1)
    pixels[-1] = 0  # the exterior is no cell, and has no area
    bulge[-1] = np.inf
    size = np.array(image.shape[::-1], float)
    vertices, moved = untangle(mesh, size, pixels, bulge)
    moved, pixels = moved[:-1], pixels[:-1]
    if vertices is None:
        raise _no_polygons(names[label[moved]])
    topology = Topology(mesh.twin, mesh.cell, mesh.frame, exterior=True)
    lengths = options.lengths(float(np.mean(pixels[names[label] > 0])))
    corners = jnp.asarray((vertices - margin) * lengths, jnp.result_type(float))
    tissue = Tissue(corners, topology, Free(), options.softening)
    if options.inner_arcs is not None:
        tissue = _with_arcs(tissue, mesh, curved, lengths, inner_arcs=options.inner_arcs)
    rows, columns = given.shape
    home = image[margin : margin + rows, margin : margin + columns]
    top_bottom, left_right = _touching(home, exterior + 1)
    # Pixels of a face other than the one of their label; holes and the exterior have none.
    parent = np.concatenate(
        [np.arange(len(values)), parents, np.full(exterior - n_labels + 1, GAP)]
    )
    depth = distance_within(parent[home] != given, spacing, periodic=False)
    repaired = Repaired(values, given, home, names, exterior, label)
    return _segmentation(
        tissue,
        mesh,
        repaired,
        depth,
        (gap_width, measured),
        lengths,
        label=label,
        complete=~(top_bottom | left_right)[label] & (names[label] > 0),
        moved=moved,
        pixels=pixels,
        background=options.background,
        margin=margin,
    )


def _names(
    values: Int[np.ndarray, " labels"], parents: Int[np.ndarray, " new_labels"]
) -> Int[np.ndarray, " all_labels"]:
    """The labels, and new ones after the largest of them."""
    return np.append(values, values[-1] + 1 + np.arange(len(parents)))


def _shape(image: Int[np.ndarray, "rows columns"]) -> tuple[int, int]:
    return int(image.shape[0]), int(image.shape[1])


def _segmentation(
    tissue: Tissue,
    mesh: Mesh,
    repaired: Repaired,
    depth: Float[np.ndarray, "box_rows box_columns"],
    widths: tuple[float, float],
    lengths: Float[np.ndarray, " xy"],
    *,
    label: Int[np.ndarray, " cells"],
    complete: Bool[np.ndarray, " cells"],
    moved: np.ndarray,
    pixels: Int[np.ndarray, " cells"],
    background: int | None,
    margin: int = 0,
) -> Segmentation:
    """The tissue without overlaps, the points of its edges, and the report on the mask."""
    edge, points = _courses(tissue.topology, mesh, margin)
    # A free tissue has a margin of unchanged pixels; the box of the others repeats itself.
    room = 2 * margin
    padded = np.pad(depth, room) if room else depth
    depth_at = lambda row, column: padded[
        (row + room) % padded.shape[0], (column + room) % padded.shape[1]
    ]
    chord = np.linalg.norm(geometry_of(tissue).edge_vectors, axis=1) / lengths.min()
    shown, uncertain, point_shown = contacts_of(edge, points, chord, depth_at, widths[0])
    rows, columns = repaired.given.shape
    report = report_on(repaired, (shown, uncertain), depth[:rows, :columns], widths, pixels)
    names = repaired.names
    return Segmentation(
        tissue=repair_overlaps(tissue, bend_back=True),
        labels=names[label],
        complete=complete,
        absorbed=np.setdiff1d(repaired.values, names[label]),
        inflated=np.unique(names[label[moved]]),
        pixel_size=as_pixel_size(lengths),
        image_shape=_shape(repaired.given),
        background=background,
        courses=Courses(edge, points * lengths, point_shown),
        report=report,
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


def _reflected(image: Shaped[np.ndarray, "rows columns"]) -> np.ndarray:
    """The image and its three mirror images."""
    wide = np.hstack([image, image[:, ::-1]])
    return np.vstack([wide, wide[::-1]])


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
