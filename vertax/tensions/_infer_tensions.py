"""Tensions and pressures of a segmented tissue, with their errors, from the balance of forces alone."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Shaped

from vertax._base.announce import announce_compilations
from vertax._base.available_memory import check_memory
from vertax._base.blas import one_blas_thread
from vertax._base.checks import check_choice, check_number, describe
from vertax._base.phases import phases, start_phase
from vertax._base.pixels import PixelSize, pixel_length
from vertax.initialise import MaskReport, Segmentation, from_labels
from vertax.initialise._heights import surface_of
from vertax.initialise._report import LEAST_LENGTH
from vertax.io import Foam, pixel_aspect, read_image, read_surface_evolver
from vertax.io._surface_evolver import is_surface_evolver
from vertax.mesh import Tissue, geometry_of
from vertax.surfaces import AbstractSurface
from vertax.tensions._balance import equations
from vertax.tensions._curves import Points, read_courses
from vertax.tensions._edges import solution, vertices_only
from vertax.tensions._inferred import InferredTensions
from vertax.tensions._lift import lifted
from vertax.tensions._mask import labels_and_lines, read_pixels
from vertax.tensions._observed_geometry import observed_geometry
from vertax.tensions._outcome import (
    assembled,
    moved_by_fit,
    outline_errors,
    relative,
    spread,
    with_outline_of_mask,
)

# Noise of a tissue without an image, and of the points of a foam, relative to the cell diameter; and the
# number of points of an edge without a course.
_EXACT, _GRAIN, _POINTS = 0.002, 1e-4, 12
# Initial noise of the vertices of a tissue with straight edges, relative to the cell diameter.
_VERTEX = 0.01
# Bytes of memory: of any tissue, of a pixel and of a cell, measured; labels above the last are counted.
_BASE, _PIXEL, _CELL, _MANY = 4e8, 80, 1.2e5, 10**6


@announce_compilations("measurements of a tissue")
@one_blas_thread()
@phases(5)
def infer_tensions(
    mask: Segmentation | Foam | Tissue | Shaped[np.ndarray | Array, "..."] | str | os.PathLike[str],
    *,
    kind: str = "auto",
    plane: int | None = None,
    pixel_size: PixelSize | None = None,
    height: AbstractSurface
    | Shaped[np.ndarray | Array, "..."]
    | str
    | os.PathLike[str]
    | None = None,
    plane_distance: float = 1.0,
    unknown_height: float | int | None = None,
    background: int | None = None,
    gap_width: float | None = None,
    holes: str = "keep",
    edges: str | None = None,
    noise: float | None = None,
    prior: float | None = None,
) -> InferredTensions:
    r"""Tensions of edges and pressures of cells that balance in the observed shape of a tissue.

    ```python
    inferred = vx.tensions.infer_tensions("NAME_cp_masks.tif")
    inferred.write("tensions.csv")
    ```

    Where three cells meet, tensions balance, and across every arc they balance the difference of pressures
    (Laplace):

    $$\sum_e \gamma_e\, t_e = 0, \qquad \gamma_e\, \kappa_e = p_\mathrm{left} - p_\mathrm{right}.$$

    Junctions on the outline and at holes, where forces from beyond are unknown, have no equation, so the
    tissue may have been cut out of a larger one. Vertices and curves are fitted to the pixels: arcs, and
    their bends towards the ends where the pixels resolve them, because tensions pull along the tangents at
    the ends. The distances of pixels from curves are the noise, which is propagated to the balance with its
    correlations, and the geometry is adjusted within the noise (total least squares). The residual is the
    distance of the tissue from a balance, and enters the standard deviations too.

    The image of a curved tissue is its projection. With `height` the curves that were fitted to the pixels
    are lifted to the surface: tensions balance in the tangent plane of each junction, and $\kappa$ is the
    geodesic curvature of the edge. Areas, lengths, stresses and the load on what is below the tissue are
    those in space, see [`CurvedGeometry`][vertax.tensions.CurvedGeometry].

    **Arguments:**

    - `mask`: a label image, or an image of outlines, as an array or a file (see
        [`read_mask`][vertax.tensions.read_mask]); a dump of Surface Evolver; or a
        [`Segmentation`][vertax.initialise.Segmentation], [`Foam`][vertax.io.Foam] or
        [`Tissue`][vertax.Tissue] with arcs.
    - `kind`: of a mask, `"labels"`, `"outlines"` or `"auto"`.
    - `plane`: of a stack, the plane to take, from 0.
    - `pixel_size`, `background`, `gap_width`, `holes`: of a mask, see
        [`from_labels`][vertax.initialise.from_labels]. Where a TIFF file has pixels that are not square,
        their ratio is taken from it.
    - `height`: of a curved tissue, the image of the height of each pixel of the mask, as an array or a file,
        NaN where it is unknown; or a surface, such as a [`HeightMap`][vertax.surfaces.HeightMap] in the unit
        of length of the tissue. An image is smoothed by a Gaussian of a quarter of the cell diameter, or
        of half of it if its heights are steps of planes.
    - `plane_distance`: height per unit of an image of heights, in the unit of `pixel_size`; without
        `pixel_size`, in pixels.
    - `unknown_height`: value of unknown pixels in an image of heights, such as 0, beside NaN.
    - `edges`: `"arcs"`, curved by pressures; `"straight"`, with the pressures acting on
        vertices (Ishihara & Sugimura 2012, doi:10.1016/j.jtbi.2012.08.017); by default, of a tissue with
        arcs the one of the larger evidence, see `InferredTensions.edges`.
    - `noise`: standard deviation of the position of an edge, in pixels of a mask and otherwise in units of
        length; by default the root mean square distance of pixels (or the points of a foam) from curves,
        0.002 cell diameters for a tissue of arcs, and chosen by the evidence for a tissue with straight
        edges.
    - `prior`: standard deviation of the prior of relative tensions about 1, independent of each other; by
        default chosen by the evidence (marginal likelihood), with a part that is similar in regions. A small
        one makes tensions too uniform.

    **Returns:** the [`InferredTensions`][vertax.tensions.InferredTensions]; read its `warnings`.

    On a terminal the present phase is shown: reading, outlines, geometry, balance, errors.

    **Raises:**

    - `TypeError` for a source of another type.
    - `MemoryError` for a mask that takes more memory than is available.
    - `ValueError` for a tissue without a junction of three cells, `edges="arcs"` for straight inner edges,
        a mirrored tissue, a `noise` or `prior` that is not positive, and as the readers.
    """
    for name, value in (("noise", noise), ("prior", prior), ("plane_distance", plane_distance)):
        if value is not None:
            check_number(name, value, above=0)
    check_choice("edges", edges, ("arcs", "straight", None))
    start_phase("reading")
    source, sized = mask, pixel_size is not None
    if isinstance(source, str | os.PathLike) and is_surface_evolver(Path(source)):
        source = read_surface_evolver(source)
    elif isinstance(source, str | os.PathLike | np.ndarray | Array):
        labels, line_width = labels_and_lines(source, kind, background, plane)
        if pixel_size is None and isinstance(source, str | os.PathLike):
            pixel_size = pixels_of_file(Path(source), labels)
        start_phase("outlines")
        cells = len(np.unique(labels)) if labels.max() > _MANY else int(labels.max())
        check_memory("mask", _BASE + _PIXEL * labels.size + _CELL * cells, "Cut it into parts.")
        source = from_labels(
            labels,
            boundary="free",
            pixel_size=pixel_size,
            gap_width=gap_width,
            holes=holes,
            inner_arcs=True,
        )
        source = _across_lines(source, line_width)
    if isinstance(height, str | os.PathLike):
        height = read_pixels(Path(height), "height", read_image)
    if isinstance(source, Segmentation) and height is not None:
        height = surface_of(source, height, plane_distance, unknown_height, sized=sized)
    if height is not None and not isinstance(height, AbstractSurface):
        raise TypeError(
            "Argument `height` must be a surface for a source without pixels, such as a "
            f"vertax.surfaces.HeightMap, but is {describe(height)}."
        )
    if isinstance(source, Segmentation):
        surface, course = source.tissue.surface, _of_mask(source, noise)
    elif isinstance(source, Foam):
        surface, course = source.surface, _of_foam(source, noise)
    elif isinstance(source, Tissue):
        surface, course = source.surface, _of_tissue(source.with_surface(None), noise)
    else:
        raise TypeError(
            "Argument `mask` must be a mask, a file, a Segmentation, a Foam or a Tissue, but "
            f"is {describe(mask)}. For several masks use vx.tensions.infer_tensions_of_masks."
        )
    surface = surface if height is None else height
    tissue, report = course.tissue, course.report
    if edges == "arcs" and not tissue.inner_arcs:
        raise ValueError(
            "Argument `edges` must not be 'arcs' for a tissue with straight inner edges. Make it with "
            "`inner_arcs=True`, or pass edges='straight'."
        )
    is_hole = course.labels == 0
    geometry = observed_geometry(tissue, is_hole, None if report is None else report.closed)
    which = equations(geometry)
    if len(which.junctions) == 0:
        raise ValueError(
            "Argument `mask` must have a place where three of its cells meet, but it has "
            "none: the forces at its outline are unknown. Take a larger tissue."
        )
    uncertain = np.full(tissue.n_edges, False) if report is None else report.uncertain
    used = np.isin(course.points.edge, which.edges)
    points = Points(*(of[used] for of in course.points))
    start_phase("geometry")
    if len(points.edge):
        options = {"apart": course.apart, "noise": course.noise}
        curves = read_courses(geometry, points, course.grain, **options)
    else:
        curves = vertices_only(geometry, course.noise or course.grain)
    start_phase("balance")
    if surface is not None:
        geometry = geometry._replace(lift=lifted(geometry, curves.change, surface))
    straight = None if edges is None and tissue.inner_arcs else edges != "arcs"
    system, balance = solution(
        geometry,
        curves,
        uncertain,
        straight=straight,
        known_noise=course.noise is not None,
        prior=prior,
    )
    start_phase("errors")
    # Vertices in a mask are corners of pixels, so edges of length 0 differ from all others.
    four_fold = geometry_of(tissue).edge_lengths < 0.5 * course.grain
    which, fitted = system.which, moved_by_fit(tissue, curves.change)
    if report is not None:
        fitted = with_outline_of_mask(fitted, course.points, curves.change, which.edges)
    distance = outline_errors(fitted, course.points, curves.change)
    return assembled(
        fitted,
        (which.edges, which.cells),
        relative(balance, which, curves),
        balance.posterior.covariances,
        four_fold=four_fold,
        surface=surface,
        labels=np.asarray(course.labels),
        noise=float(curves.noise * balance.errors.noise),
        correlation=float(curves.apart),
        bending=curves.bending,
        edges="straight" if which.n_arcs == 0 else "arcs",
        errors={name: float(value) for name, value in balance.errors._asdict().items()},
        pixel_size=course.pixel_size,
        mask_report=report,
        short=spread(tissue.n_edges, which.edges, balance.loose, False),
        outline_errors=distance / pixel_length(course.pixel_size or 1.0),
    )


class _Course(NamedTuple):
    """A tissue, and the points of its edges."""

    tissue: Tissue
    labels: Int[np.ndarray, " cells"]
    points: Points
    grain: float
    """Resolution of a point, a length."""
    apart: float | None
    """Distance along an edge at which the errors of two points are independent; None if it is estimated."""
    noise: float | None
    """Standard deviation of a point, a length; None if it is estimated."""
    pixel_size: PixelSize | None
    report: MaskReport | None = None


def pixels_of_file(file: Path, mask: Int[np.ndarray, "rows columns"]) -> PixelSize | None:
    """Size of the pixels of a file that are not square, for a mean cell area of about 1."""
    aspect = pixel_aspect(file)
    if abs(aspect - 1) < 0.01:
        return None
    width = np.sqrt(len(np.unique(mask[mask > 0])) / (np.count_nonzero(mask > 0) * aspect))
    return (float(aspect * width), float(width))


def _across_lines(source: Segmentation, line_width: float) -> Segmentation:
    """The segmentation, with contacts shorter than 1.5 times the width of the lines marked as uncertain."""
    report = source.report
    if report is None or line_width == 0:
        return source
    chord = np.linalg.norm(geometry_of(source.tissue).edge_vectors, axis=1)
    short = chord < LEAST_LENGTH * line_width * pixel_length(source.pixel_size)
    report = dataclasses.replace(report, uncertain=report.uncertain | short, line_width=line_width)
    return dataclasses.replace(source, report=report)


def _of_mask(source: Segmentation, noise: float | None) -> _Course:
    if source.courses is None:
        raise ValueError(
            "Argument `mask` must hold the courses of its edges, as "
            "vx.initialise.from_labels returns them. Pass its mask, or its tissue."
        )
    cells = source.labels[source.labels > 0]  # several holes have the label 0
    copies = len(np.unique(cells)) < len(cells)
    if copies or (not source.complete.all() and source.tissue.topology.exterior is False):
        raise ValueError(
            "Argument `mask` must not be mirrored at its border, where no forces "
            "balance. Use vx.initialise.from_labels(mask, boundary='free')."
        )
    first = geometry_of(source.tissue).edge_vertices[:, 0]
    # Where a wide gap was closed, the mask does not show the edge.
    edge = source.courses.edge[source.courses.shown]
    course = source.courses.points[source.courses.shown]
    points = Points(edge, course - np.asarray(source.tissue.vertices)[first][edge])
    pixel = pixel_length(source.pixel_size)
    noise = None if noise is None else noise * pixel
    tissue, labels, size = source.tissue, source.labels, source.pixel_size
    if tissue.surface is not None:  # where edges are chords; their courses are in the mask
        straight = np.zeros(tissue.n_edges)
        parts = (tissue.vertices, tissue.topology, tissue.boundary, tissue.softening)
        tissue = Tissue(*parts, angles=straight, inner_arcs=True)
    return _Course(tissue, labels, points, pixel, None, noise, size, source.report)


def _of_foam(source: Foam, noise: float | None) -> _Course:
    tissue = source.tissue
    edge = np.repeat(np.arange(tissue.n_edges), [len(chain) for chain in source.chains])
    away = np.concatenate([chain - chain[0] for chain in source.chains])
    same = edge[1:] == edge[:-1]
    apart = float(np.mean(np.linalg.norm(np.diff(away, axis=0), axis=1)[same]))
    grain = _GRAIN * observed_geometry(tissue).size if noise is None else noise
    return _Course(tissue, source.bodies, Points(edge, away), grain, apart, noise, None)


def _of_tissue(tissue: Tissue, noise: float | None) -> _Course:
    labels = np.flatnonzero(tissue.alive) + 1  # 0 is the label of the exterior
    tissue = tissue.without_spare()
    geometry = observed_geometry(tissue)
    if not tissue.inner_arcs:
        points = Points(np.zeros(0, int), np.zeros((0, 2)))
        return _Course(tissue, labels, points, _VERTEX * geometry.size, None, noise, None)
    fractions = jnp.asarray((np.arange(_POINTS) + 0.5) / _POINTS, tissue.vertices.dtype)
    course = np.asarray(tissue.edge_points(jnp.append(0, fractions)), float)
    edge = np.repeat(np.arange(tissue.n_edges), _POINTS)
    points = Points(edge, (course[:, 1:] - course[:, :1]).reshape(-1, 2))
    noise = _EXACT * geometry.size if noise is None else noise
    apart = float(np.mean(np.linalg.norm(geometry.chord, axis=1))) / _POINTS
    return _Course(tissue, labels, points, noise, apart, noise, None)
