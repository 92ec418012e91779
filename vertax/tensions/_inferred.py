"""Tensions and pressures inferred from the shape of a tissue, as arrays and tables."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from vertax._base.pixels import PixelSize, pixel_sides
from vertax.initialise import MaskReport
from vertax.io import cell_table, edge_table, write_csv, write_geojson, write_vtk
from vertax.mesh import Tissue, geometry_of
from vertax.tensions._columns import with_pixels
from vertax.tensions._mean_stress import MeanStress
from vertax.tensions._pixel_aspect import pixel_aspect_warning

# Cells with a larger error of the area (vertices that moved far give area to a neighbour), or distance of the
# outline from arcs over the root of the area, are named.
_AREA_ERROR, _OUTLINE_ERROR = 0.05, 0.1
# Number of places that a warning names.
_PLACES = 5
# Smallest number of stray regions of a mask that was resized. (There are also more than cells.)
_STRAY = 20


class MotionFit(eqx.Module):
    """How well tensions explain the motion of a cluster, see [`EdgeMotion`][vertax.tensions.EdgeMotion]."""

    mobility: float
    """Velocity of a point over the force on it, in units of the mean tension."""
    misfit: Float[np.ndarray, " intervals"]
    """Root mean square distance, across edges, of the points at the end of each interval from their predicted
    positions."""
    moved: Float[np.ndarray, " intervals"]
    """Root mean square displacement of the points in each interval, across edges."""


class CurvedGeometry(eqx.Module):
    """The geometry of a tissue on a curved surface, in space."""

    tissue: Tissue
    """The tissue on its surface, each edge a chord."""
    areas: Float[np.ndarray, " cells"]
    """Areas of the cells, with their arcs."""
    perimeters: Float[np.ndarray, " cells"]
    """Perimeters of the cells."""
    slopes: Float[np.ndarray, " cells"]
    """Slope of the surface at each cell: rise over run."""
    lengths: Float[np.ndarray, " edges"]
    """Lengths of the edges."""
    normal_loads: Float[np.ndarray, " vertices"]
    r"""Force of the tensions along the normal at each vertex, half of $\gamma \int \kappa_n\,dl$ of its
    edges, in mean tensions; positive in the direction of increasing heights. What is below the tissue bears
    it. NaN beside a tension without an equation."""


class InferredTensions(eqx.Module):
    """Relative tensions and pressures of a tissue, with their standard deviations.

    A shape determines them except for two numbers. The unit of tensions, and of pressures and stresses times
    the unit of length, is the mean tension of all edges that have an equation: the mean of `tensions` that
    are not NaN is 1. Pressures are differences from the mean of all cells that have an equation.
    """

    tissue: Tissue
    """The observed tissue, each edge an arc."""
    tensions: Float[np.ndarray, " edges"]
    """Tension of each edge; NaN where no equation contains it."""
    tension_deviations: Float[np.ndarray, " edges"]
    """Their standard deviations. Those of arcs include an error of the contrast of all tensions."""
    determined: Bool[np.ndarray, " edges"]
    """Whether the shape determines the tension. It does not for edges of the outline or of a hole, edges
    without an end where three cells meet, edges too short for a direction, contacts that the mask does not
    show, and where the standard deviation without the error of the contrast is above 0.3."""
    pressures: Float[np.ndarray, " cells"]
    """Pressure of each cell less the mean; NaN where no equation contains it."""
    pressure_deviations: Float[np.ndarray, " cells"]
    """Their standard deviations."""
    pressures_determined: Bool[np.ndarray, " cells"]
    """Whether the shape determines the pressure: the cell has an edge of determined tension."""
    stresses: Float[np.ndarray, "cells 2 2"]
    """Stress of each cell, tension positive: half the tension of its edges, less its pressure. NaN for cells
    with an edge that is not determined."""
    labels: Int[np.ndarray, " cells"]
    """Label of each cell: in the mask (0 for a hole, which is no cell), or the number of its body in a dump
    of Surface Evolver; of a tissue without either, the number of the cell plus 1. The exterior has the label
    0."""
    noise: float
    """Standard deviation of the position of an edge, in units of length."""
    correlation: float
    """Correlation length of this noise along an edge, in units of length."""
    bending: float
    """Standard deviation of the bends of edges beyond arcs, in radians; 0 for a foam at rest."""
    edges: str
    """`"arcs"`, `"straight"`, or `"points"` of `EdgeMotion`: how edges were described."""
    errors: dict[str, float]
    """Standard deviations chosen by the evidence: `junction`, of the directions at junctions beyond noise
    (radians); `arc`, of arcs of the length of a cell (radians; 0 for straight edges); `noise`, relative to
    that of the points; and of the priors: `tension`, independent; `region`, similar in regions; `pressure`,
    in mean tensions over a cell diameter (1 for arcs). Empty for `EdgeMotion`."""
    mean_stress: MeanStress
    """Mean stress of the tissue and its anisotropy, with standard deviations."""
    pixel_size: PixelSize | None
    """Length of a pixel side, if the tissue comes from an image; (height, width) if pixels are not square."""
    four_fold: Bool[np.ndarray, " edges"]
    """Whether the edge has length 0: it is shorter than half a pixel of the mask, or half the accuracy of the
    positions. Four cells meet in a point, and which two of them share the edge depends on their numbers."""
    short: Bool[np.ndarray, " edges"] | None = None
    """Whether the edge is too short for a direction, or may be between other cells."""
    mask_report: MaskReport | None = None
    """What became of each label of the mask, and which contacts the mask shows."""

    outline_errors: Float[np.ndarray, " cells"] | None = None
    """Root mean square distance of the outline of each cell in the mask from its arcs, in pixels."""
    motion: MotionFit | None = None
    """The fit of `EdgeMotion`."""
    curved: CurvedGeometry | None = None
    """The geometry in space of a tissue on a surface, `height`; `tissue` is its image."""

    @property
    def area_errors(self) -> Float[np.ndarray, " cells"]:
        """Area of each cell over the area of its pixels, less 1; NaN for a tissue without a mask."""
        if self.mask_report is None or self.pixel_size is None:
            return np.full(self.tissue.n_cells, np.nan)
        pixels = self.mask_report.cell_pixels * np.prod(pixel_sides(self.pixel_size))
        return geometry_of(self.tissue).areas / pixels - 1

    @property
    def reasons(self) -> Shaped[np.ndarray, " edges"]:
        """Why each tension is not determined; empty if it is."""
        short = np.zeros(len(self.determined), bool) if self.short is None else self.short
        faces = np.append(self.labels > 0, False)[np.asarray(self.tissue.topology.edge_cells)]
        cases = [(~np.all(faces, axis=1), "outline or hole"), (self.four_fold, "four cells meet")]
        if self.mask_report is not None:
            cases.append((self.mask_report.closed, "contact not shown"))
            cases.append((self.mask_report.uncertain, "contact uncertain"))
        junction = "no junction of three cells" if self.motion is None else "no junction that moves"
        cases.append((np.isnan(self.tensions), junction))
        cases += [
            (short, "too short for a direction"),
            (~self.determined, "standard deviation above 0.3"),
        ]
        conditions, names = zip(
            *[(case & ~self.determined, name) for case, name in cases], strict=True
        )
        return np.select(conditions, names, "")

    @property
    def pressure_reasons(self) -> Shaped[np.ndarray, " cells"]:
        """Why each pressure is not determined; empty if it is."""
        cases = [self.pressures_determined, self.labels == 0, np.isnan(self.pressures)]
        return np.select(cases, ["", "hole", "no junction of three cells"], "no determined tension")

    @property
    def reason_counts(self) -> dict[str, int]:
        """Number of tensions of each of the `reasons`, and of those that are determined."""
        names, counts = np.unique(self.reasons, return_counts=True)
        named = zip(names.tolist(), counts.tolist(), strict=True)
        return {name or "determined": count for name, count in named}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to distrust parts of the result, as sentences; empty if there are none."""
        warnings = [] if self.mask_report is None else mask_warnings(self.mask_report, self)
        if self.pixel_size is not None:
            aspect = pixel_aspect_warning(self.tissue, self.labels == 0, self.pixel_size)
            warnings += [] if aspect is None else [aspect]
        unknowns = np.isfinite(self.tensions)
        share = np.mean(self.determined[unknowns]) if unknowns.any() else 0.0
        if share < 0.5:
            warnings.append(
                f"of {unknowns.sum()} tensions only {share:.0%} are determined: edges are too short for "
                "their pixels, or outlines too rough; take a finer image or a larger tissue. The unit, the "
                "mean of all, is uncertain "
                f"({', '.join(f'{count} {name}' for name, count in self.reason_counts.items())})"
            )
        junction, arc = self.errors.get("junction", 0.0), self.errors.get("arc", 0.0)
        if share > 0 and np.nanmedian(self.tension_deviations[self.determined]) > 0.15:
            warnings.append(
                "half of the tensions that are determined have standard deviations above 0.15: only "
                "strong and weak edges can be distinguished"
            )
        if junction > 0.1:
            warnings.append(
                f"angles at junctions are {np.degrees(junction):.0f} degrees from those of a balance: the "
                "tissue moves, or other forces than tensions act on junctions; variations of tension over "
                "many cells are then smoothed out"
            )
        if self.bending > 0.03:
            warnings.append(
                f"edges bend by {np.degrees(self.bending):.1f} degrees beyond arcs: the tissue moves, and "
                "its shape is in part that of earlier tensions; the present ones differ more from each other "
                "than the inferred ones"
            )
        if arc > 0.5:
            warnings.append(
                f"arcs are {np.degrees(arc):.0f} degrees from those that pressures cause: pressures are not "
                "reliable"
            )
        if share > 0 and np.mean(self.tensions[self.determined] < 0.2) > 0.03:
            warnings.append(
                "many tensions are near 0: where outlines are rough and edges short, the error of each "
                "junction adds up over many cells, and a part of the tissue loses its tension to the "
                "others; take a finer image, or a smaller `prior`"
            )
        zero = int(np.sum(self.determined & (self.tensions < 1e-6)))
        if zero:
            warnings.append(
                f"{zero} tensions are 0, the smallest allowed: the shape requires a push there"
            )
        return tuple(warnings)

    def edge_table(self) -> dict[str, np.ndarray]:
        """The edges as a table, see [`edge_table`][vertax.io.edge_table].

        **Returns:** its columns, and `left_label`, `right_label` (0: the exterior or a hole; -1: no pair of
        cells, for an edge that is four-fold), `four_fold`, `tension`, `tension_deviation`, `determined` and
        `reason` (see `reasons`); for a mask also `shown`, the share of the edge along which the mask shows
        the contact, `contact_closed`, where that is less than a half, and `contact_uncertain`, for an edge
        across a gap so wide that other cells may touch there; and in pixels, from the top left corner of the
        image, `start_column`, `start_row`, `end_column`, `end_row` and `length_pixels`.
        """
        table = edge_table(self.tissue, **self._edge_columns) | {"reason": self.reasons}
        return with_pixels(table, self.pixel_size)

    def cell_table(self) -> dict[str, np.ndarray]:
        """The cells as a table, see [`cell_table`][vertax.io.cell_table].

        **Returns:** its columns, and `label`, `pressure`, `pressure_deviation`, `determined`, `reason` (see
        `pressure_reasons`) and the stress as `stress_xx`, `stress_xy` and `stress_yy`; for a mask also
        `hole`, `pixels`, `area_error` (the area of the cell over that of its pixels, less 1),
        `outline_error` (in pixels, see `outline_errors`), and in pixels, from the top left corner of the
        image, `column`, `row` and `area_pixels`.
        """
        table = cell_table(self.tissue, **self._cell_columns) | {"reason": self.pressure_reasons}
        return with_pixels(table, self.pixel_size)

    def write(self, path: str | os.PathLike[str]) -> list[Path]:
        """Write cells and edges to two files: `NAME.csv` and `NAME-edges.csv`, and so on.

        **Arguments:**

        - `path`: the file of the cells: `.csv`, `.geojson`, or `.vtu` and `.vtk` for ParaView.

        **Returns:** the two files.

        **Raises:**

        - `ValueError` for another ending, and as the writers of [`vertax.io`](../reference/io.md).
        """
        path = Path(path)
        other = path.with_name(f"{path.stem}-edges{path.suffix}")
        if path.suffix == ".csv":
            write_csv(path, self.cell_table())
            write_csv(other, self.edge_table())
        elif path.suffix in (".geojson", ".json"):
            write_geojson(path, self.tissue, cells=self._cell_columns, edges=self._edge_columns)
        elif path.suffix in (".vtu", ".vtk"):
            write_vtk(path, self.tissue, cells=self._cell_columns, edges=self._edge_columns)
        else:
            raise ValueError(
                "Argument `path` must end in .csv, .geojson, .vtu or .vtk, but is "
                f"{os.fspath(path)!r}."
            )
        return [path, other]

    @property
    def _edge_columns(self) -> dict[str, Any]:
        left, right = np.append(self.labels, 0)[np.asarray(self.tissue.topology.edge_cells)].T
        report = self.mask_report
        contact = {}
        if report is not None:
            contact = {
                "shown": report.shown,
                "contact_closed": report.closed,
                "contact_uncertain": report.uncertain,
            }
        return {
            "left_label": np.where(self.four_fold, -1, left),
            "right_label": np.where(self.four_fold, -1, right),
            "four_fold": self.four_fold,
            "tension": self.tensions,
            "tension_deviation": self.tension_deviations,
            "determined": self.determined,
            **contact,
            **({} if self.curved is None else {"length_in_space": self.curved.lengths}),
        }

    @property
    def _cell_columns(self) -> dict[str, Any]:
        mask = {}
        if self.mask_report is not None:
            mask = {
                "hole": self.labels == 0,
                "pixels": self.mask_report.cell_pixels,
                "area_error": self.area_errors,
                "outline_error": self.outline_errors,
            }
        return {
            "label": self.labels,
            "pressure": self.pressures,
            "pressure_deviation": self.pressure_deviations,
            "determined": self.pressures_determined,
            "stress_xx": self.stresses[:, 0, 0],
            "stress_xy": self.stresses[:, 0, 1],
            "stress_yy": self.stresses[:, 1, 1],
            **mask,
            **self._curved_columns,
        }

    @property
    def _curved_columns(self) -> dict[str, np.ndarray]:
        curved = self.curved
        if curved is None:
            return {}
        m = self.tissue.topology
        # Three cells share the load of a vertex.
        load = np.zeros(self.tissue.n_cells + 1)
        np.add.at(load, np.asarray(m.cell), np.repeat(curved.normal_loads / 3, 3))
        return {
            "area_in_space": curved.areas,
            "perimeter_in_space": curved.perimeters,
            "slope": curved.slopes,
            "normal_load": load[:-1],
        }


def mask_warnings(report: MaskReport, result: InferredTensions) -> list[str]:
    """The changes of a mask as sentences, with places.

    **Arguments:**

    - `report`: the report on the mask.
    - `result`: the tensions.

    **Returns:** a sentence for each kind of change.
    """
    groups = {
        "hole": "the mask has holes, which are no cells: the tensions at their sides are not determined",
        "closed hole": "the mask has holes that were closed: contacts across them are not determined",
        "new cell": "labels are in several pieces as large as cells, which became cells with new labels (do "
        "the numbers start again after 255 or 65535?)",
        "left out": "labelled pixels belong to no cell",
        "absorbed": "labels are no cells",
    }
    warnings = []
    for kind, text in groups.items():
        # Single pixels off a cell are of no consequence.
        least = 0.03 * np.median(report.pixels) if kind == "left out" else 0
        changes = [str(change) for change in report.of_kind(kind) if change.pixels > least]
        if changes:
            warnings.append(f"{text}: {_listed(changes, '; ')}")
    stray = len(report.of_kind("piece", "absorbed", "left out"))
    if stray > max(_STRAY, len(report.cell_pixels)):
        warnings.append(
            f"{stray} stray regions were joined to cells or left out, as in a mask that was resized with "
            "interpolation: its outlines are wrong; resize masks with order 0 (nearest neighbour)"
        )
    closed = report.closed & np.isfinite(report.shown) & ~result.four_fold
    closed &= np.all(
        np.append(result.labels, 0)[np.asarray(result.tissue.topology.edge_cells)] > 0, axis=1
    )
    if closed.any():
        warnings.append(
            f"{closed.sum()} contacts are not shown by the mask, because gaps or holes wider than "
            f"{report.gap_width:g} pixels were closed; their tensions are not determined"
        )
    outline = result.outline_errors
    distance = np.zeros(0) if outline is None else outline / np.sqrt(report.cell_pixels)
    far = "are more than 10 % of the root of their area from arcs"
    for errors, limit, subject, fact, sign in (
        (
            result.area_errors,
            _AREA_ERROR,
            "areas",
            "differ by more than 5 % from those of their pixels",
            "+",
        ),
        (distance, _OUTLINE_ERROR, "outlines", far, ""),
    ):
        off = np.flatnonzero((np.abs(errors) > limit) & (result.labels[: len(errors)] > 0))
        worst = off[np.argsort(-np.abs(errors[off]))]
        cells = [f"label {result.labels[k]} ({errors[k]:{sign}.0%})" for k in worst]
        if cells:
            warnings.append(f"the {subject} of {len(cells)} cells {fact}: {_listed(cells, ', ')}")
    return warnings


def _listed(places: list[str], separator: str) -> str:
    """The first places, and the number of the others."""
    first, more = separator.join(places[:_PLACES]), len(places) - _PLACES
    return first + (f"{separator}and {more} more" if more > 0 else "")
