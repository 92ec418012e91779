"""Tensions and pressures of a segmented tissue, with their errors, from the balance of forces alone."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from vertax._base.checks import check_number, named
from vertax.inference._balance import Equations, equations
from vertax.inference._mask import read_mask
from vertax.inference._seen import correlation_length, fit_arcs, seen
from vertax.inference._solve import Balance, solve
from vertax.initialise import Segmentation, from_labels
from vertax.io import (
    Foam,
    cell_table,
    edge_table,
    read_surface_evolver,
    write_csv,
    write_geojson,
    write_vtk,
)
from vertax.mesh import Tissue

# From this standard deviation on, relative to the mean, a tension is not determined.
_UNKNOWN = 0.3
# A tissue given as such is known to this share of a cell diameter; and the points that stand for an edge.
_EXACT, _POINTS = 0.002, 12
_EVOLVER = (".dmp", ".fe")


class InferredTensions(eqx.Module):
    """Relative tensions and pressures of a tissue, with their standard deviations.

    A shape tells them but for two numbers: tensions are relative to their mean, and pressures are differences
    from their mean, in units of the mean tension over the unit of length of the tissue.
    """

    tissue: Tissue
    """The tissue as it was seen, each edge an arc."""
    tensions: Float[np.ndarray, " edges"]
    """Tension of each edge; NaN where no balance tells it."""
    tension_deviations: Float[np.ndarray, " edges"]
    """Their standard deviations."""
    determined: Bool[np.ndarray, " edges"]
    """Whether the tension is told by the shape. It is not for edges on the outline, for those without an end
    where three cells meet, for edges so short that their direction is noise, and where the standard deviation
    is above 0.3."""
    pressures: Float[np.ndarray, " cells"]
    """Pressure of each cell less the mean; NaN where no balance tells it."""
    pressure_deviations: Float[np.ndarray, " cells"]
    """Their standard deviations."""
    pressures_determined: Bool[np.ndarray, " cells"]
    """Whether the pressure is told by the shape: it has a number, and an edge of known tension."""
    stresses: Float[np.ndarray, "cells 2 2"]
    """Stress of each cell, tension positive: half the tension of its edges, less its pressure. NaN for cells
    with an edge that is not determined."""
    labels: Int[np.ndarray, " cells"]
    """Label of each cell in the mask, or its number."""
    noise: float
    """Standard deviation of the position of an edge, in units of length."""
    correlation: float
    """How far along an edge this noise is alike, in units of length."""
    model_errors: tuple[float, float]
    """By how much, in radians, angles at junctions and angles of arcs of the length of a cell differ from
    those of a balance, beyond the noise."""
    pixel_size: float | None
    """Length of a pixel side, if the tissue comes from an image."""

    @property
    def doubts(self) -> list[str]:
        """What speaks against believing the result; empty if nothing does."""
        found = []
        asked = np.isfinite(self.tensions)
        share = np.mean(self.determined[asked]) if asked.any() else 0.0
        if share < 0.5:
            found.append(
                f"of {asked.sum()} tensions only {share:.0%} are determined: edges are too short for their "
                "pixels, or outlines too rough; take a finer image or a larger tissue"
            )
        junction, arc = self.model_errors
        if junction > 0.1:
            found.append(
                f"angles at junctions are {np.degrees(junction):.0f} degrees from those of a balance: the "
                "tissue moves, or something else than tensions pulls on junctions; tensions that vary over "
                "many cells are then smoothed out"
            )
        if arc > 0.5:
            found.append(
                f"arcs are {np.degrees(arc):.0f} degrees from those that pressures make: pressures are not "
                "to be trusted"
            )
        none = int(np.sum(self.determined & (self.tensions < 1e-6)))
        if none:
            found.append(
                f"{none} tensions are 0, the least there is: there the shape asks for a push"
            )
        return found

    def edge_table(self) -> dict[str, np.ndarray]:
        """The edges as a table, see [`edge_table`][vertax.io.edge_table].

        **Returns:** its columns, and `left_label`, `right_label` (0: the exterior), `tension`,
        `tension_deviation` and `determined`.
        """
        return edge_table(self.tissue, **self._edge_columns)

    def cell_table(self) -> dict[str, np.ndarray]:
        """The cells as a table, see [`cell_table`][vertax.io.cell_table].

        **Returns:** its columns, and `label`, `pressure`, `pressure_deviation`, `determined` and the stress
        as `stress_xx`, `stress_xy` and `stress_yy`.
        """
        return cell_table(self.tissue, **self._cell_columns)

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
        return {
            "left_label": left,
            "right_label": right,
            "tension": self.tensions,
            "tension_deviation": self.tension_deviations,
            "determined": self.determined,
        }

    @property
    def _cell_columns(self) -> dict[str, Any]:
        return {
            "label": self.labels,
            "pressure": self.pressures,
            "pressure_deviation": self.pressure_deviations,
            "determined": self.pressures_determined,
            "stress_xx": self.stresses[:, 0, 0],
            "stress_xy": self.stresses[:, 0, 1],
            "stress_yy": self.stresses[:, 1, 1],
        }


def infer_tensions(
    segmentation_or_mask: Segmentation
    | Foam
    | Tissue
    | Shaped[np.ndarray | Array, "..."]
    | str
    | os.PathLike[str],
    *,
    kind: str = "auto",
    pixel_size: float | None = None,
    background: int | None = None,
    gap_width: float = 3.0,
    noise: float | None = None,
    prior: float | None = None,
) -> InferredTensions:
    r"""Tensions of edges and pressures of cells that keep a tissue in the shape in which it was seen.

    ```python
    found = vx.inference.infer_tensions("NAME_cp_masks.tif")
    found.write("tensions.csv")
    ```

    Where three cells meet, tensions balance, and across every arc they balance the difference of pressures
    (Laplace):

    $$\sum_e \gamma_e\, t_e = 0, \qquad \gamma_e\, \kappa_e = p_\mathrm{left} - p_\mathrm{right}.$$

    Junctions on the outline, where cells beyond it may pull, do not count, so the tissue may have been cut
    out of a larger one. Vertices and arcs are fitted to the pixels; how far pixels are from arcs is the
    noise, which is carried through the balance with all its correlations, and the geometry is adjusted
    within it (total least squares). What is left tells how far the tissue is from a balance at all, which
    enters the standard deviations too.

    **Arguments:**

    - `segmentation_or_mask`: a label image, or an image of outlines, as an array or a file (see
        [`read_mask`][vertax.inference.read_mask]); a dump of Surface Evolver; or a
        [`Segmentation`][vertax.initialise.Segmentation], [`Foam`][vertax.io.Foam] or
        [`Tissue`][vertax.Tissue] with arcs.
    - `kind`: of a mask, `"labels"`, `"outlines"` or `"auto"`.
    - `pixel_size`, `background`, `gap_width`: of a mask, see [`from_labels`][vertax.initialise.from_labels].
    - `noise`: standard deviation of the position of an edge, in units of length; left out, how far pixels are
        from arcs, and a five hundredth of a cell diameter for a tissue without an image.
    - `prior`: standard deviation of relative tensions about 1 before the shape was seen; left out, how much
        those that are known differ.

    **Returns:** the [`InferredTensions`][vertax.inference.InferredTensions]; look at its `doubts`.

    **Raises:**

    - `TypeError` for something else.
    - `ValueError` for a tissue without a place where three of its cells meet, one with straight inner edges,
        one that was mirrored, a `noise` or `prior` that is not positive, and as the readers.
    """
    for name, value in (("noise", noise), ("prior", prior)):
        if value is not None:
            check_number(name, value, above=0)
    source = segmentation_or_mask
    if isinstance(source, str | os.PathLike):
        if Path(source).suffix.lower() in _EVOLVER:
            source = read_surface_evolver(source)
        else:
            source = read_mask(source, kind=kind, background=background)
            background = None
    elif isinstance(source, np.ndarray | Array):
        source = read_mask(source, kind=kind, background=background)
        background = None
    if isinstance(source, np.ndarray):
        source = from_labels(
            source,
            boundary="free",
            pixel_size=pixel_size,
            gap_width=gap_width,
            background=background,
            inner_arcs=True,
        )
    if isinstance(source, Segmentation):
        if source.courses is None:
            raise ValueError(
                "Argument `segmentation_or_mask` must hold the courses of its edges, which "
                "vx.initialise.from_labels finds. Pass its mask, or its tissue."
            )
        copies = len(np.unique(source.labels)) < len(source.labels)
        if copies or (not source.whole.all() and source.tissue.topology.exterior is False):
            raise ValueError(
                "Argument `segmentation_or_mask` must not be mirrored at its border, where no forces "
                "balance. Use vx.initialise.from_labels(mask, boundary='free')."
            )
        start = np.asarray(source.tissue.vertices)[
            np.asarray(source.tissue.topology.edge_vertices)[:, 0]
        ]
        edge = source.courses.edge
        away = source.courses.points - start[edge]
        return _inferred(source.tissue, source.labels, edge, away, noise, prior, source.pixel_size)
    tissue = source.tissue if isinstance(source, Foam) else source
    if not isinstance(tissue, Tissue):
        raise TypeError(
            "Argument `segmentation_or_mask` must be a mask, a file, a Segmentation, a Foam or a Tissue, but "
            f"is {named(segmentation_or_mask)}."
        )
    if not tissue.inner_arcs:
        raise ValueError(
            "Argument `segmentation_or_mask` must be a tissue whose inner edges are arcs, because their "
            "curvature tells pressures; make it with `inner_arcs=True`."
        )
    fractions = jnp.asarray((np.arange(_POINTS) + 0.5) / _POINTS, tissue.vertices.dtype)
    points = np.asarray(tissue.edge_points(jnp.append(0, fractions)), float)
    away = (points[:, 1:] - points[:, :1]).reshape(-1, 2)
    edge = np.repeat(np.arange(tissue.n_edges), _POINTS)
    return _inferred(tissue, np.arange(tissue.n_cells), edge, away, noise, prior, None)


def _inferred(
    tissue: Tissue,
    labels: Int[np.ndarray, " cells"],
    edge: Int[np.ndarray, " points"],
    away: Float[np.ndarray, "points 2"],
    noise: float | None,
    prior: float | None,
    pixel_size: float | None,
) -> InferredTensions:
    geometry = seen(tissue)
    which = equations(geometry)
    if len(which.junctions) == 0:
        raise ValueError(
            "Argument `segmentation_or_mask` must have a place where three of its cells meet, but it has "
            "none: what pulls at its outline is not known. Take a larger tissue."
        )
    used = np.isin(edge, which.edges)
    edge, away = edge[used], away[used]
    exact = pixel_size is None or noise is not None
    if pixel_size is None:
        noise = _EXACT * geometry.size if noise is None else noise
        apart = float(np.mean(np.linalg.norm(geometry.chord, axis=1))) / _POINTS
        arcs = fit_arcs(geometry, edge, away, noise, apart)
    else:
        arcs = fit_arcs(geometry, edge, away, pixel_size, 2 * pixel_size)
        # What a fit leaves of an edge cannot be alike along all of it.
        longest = 0.25 * float(np.mean(np.linalg.norm(geometry.chord[which.edges], axis=1)))
        apart = min(correlation_length(edge, away, arcs.rest), longest)
        arcs = fit_arcs(geometry, edge, away, pixel_size, apart)
        noise = arcs.noise if noise is None else noise
    fitted = geometry.moved(arcs.change)
    balance = solve(fitted, arcs, which, noise=noise, exact=exact, prior=prior)
    return _result(_moved(tissue, arcs.change), which, balance, labels, apart, pixel_size)


def _moved(tissue: Tissue, change: Float[np.ndarray, " geometry"]) -> Tissue:
    """The tissue with the vertices and angles of the fit."""
    n = 2 * tissue.n_vertices
    dtype = tissue.vertices.dtype
    vertices = tissue.vertices + jnp.asarray(change[:n].reshape(-1, 2), dtype)
    angles = tissue.edge_angles + jnp.asarray(change[n : n + tissue.n_edges], dtype)
    return tissue.with_vertices(vertices).with_angles(angles)


def _result(
    tissue: Tissue,
    which: Equations,
    balance: Balance,
    labels: Int[np.ndarray, " cells"],
    apart: float,
    pixel_size: float | None,
) -> InferredTensions:
    n = len(which.edges)
    deviation = np.sqrt(np.diag(balance.covariance)[:n])
    sure = ~balance.loose & (deviation < _UNKNOWN)
    if not sure.any():
        sure = ~balance.loose
    # Relative to the mean of what is known: the mean has an error too.
    scale = float(np.mean(balance.tension[sure])) if sure.any() else 1.0
    values = np.concatenate([balance.tension, balance.pressure]) / scale
    slope = np.eye(len(values))
    if sure.any():
        slope[:, :n] -= np.outer(values, sure / np.sum(sure))
    known = np.isin(np.arange(tissue.n_cells), tissue_cells(which, sure, tissue))
    beside = known[which.cells]
    if beside.any():
        values[n:] -= np.mean(values[n:][beside])
        slope[n:] -= slope[n:][beside].mean(axis=0)
    covariance = slope @ balance.covariance @ slope.T / scale**2
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0))

    def spread(size: int, place: Int[np.ndarray, " some"], of: np.ndarray, fill: Any) -> np.ndarray:
        everywhere = np.full(size, fill)
        everywhere[place] = of
        return everywhere

    nan = float("nan")
    tensions = spread(tissue.n_edges, which.edges, values[:n], nan)
    determined = spread(
        tissue.n_edges, which.edges, ~balance.loose & (deviations[:n] < _UNKNOWN), False
    )
    pressures = spread(tissue.n_cells, which.cells, values[n:], nan)
    return InferredTensions(
        tissue=tissue,
        tensions=tensions,
        tension_deviations=spread(tissue.n_edges, which.edges, deviations[:n], nan),
        determined=determined,
        pressures=pressures,
        pressure_deviations=spread(tissue.n_cells, which.cells, deviations[n:], nan),
        pressures_determined=known,
        stresses=_stresses(tissue, tensions, pressures, determined),
        labels=np.asarray(labels),
        noise=balance.noise,
        correlation=float(apart),
        model_errors=balance.model_errors,
        pixel_size=pixel_size,
    )


def tissue_cells(
    which: Equations, sure: Bool[np.ndarray, " edges"], tissue: Tissue
) -> Int[np.ndarray, " cells"]:
    """Cells beside an edge of known tension."""
    return np.unique(np.asarray(tissue.topology.edge_cells)[which.edges[sure]])


def _stresses(
    tissue: Tissue,
    tensions: Float[np.ndarray, " edges"],
    pressures: Float[np.ndarray, " cells"],
    determined: Bool[np.ndarray, " edges"],
) -> Float[np.ndarray, "cells 2 2"]:
    """Half the tension of its edges, less the pressure, in each cell (Batchelor 1970,
    doi:10.1017/S0022112070000745)."""
    # Along an arc the tangent turns from -α to α: the integral of t t over its length, along and across.
    chord, angle = np.asarray(tissue.edge_vectors, float), np.asarray(tissue.edge_angles, float)
    length = np.asarray(tissue.edge_lengths, float)
    unit = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-300)[:, None]
    aside = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    share = 0.5 * (1 + np.sinc(2 * angle / np.pi))
    outer = lambda x: x[:, :, None] * x[:, None, :]
    fabric = share[:, None, None] * outer(unit) + (1 - share)[:, None, None] * outer(aside)
    known = np.where(determined, tensions, np.nan)
    pulled = 0.5 * (known * length)[:, None, None] * fabric
    total = np.zeros((tissue.n_cells + 1, 2, 2))
    for side in np.asarray(tissue.topology.edge_cells).T:
        np.add.at(total, side, pulled)
    areas = np.asarray(tissue.areas, float)[:, None, None]
    return total[:-1] / areas - pressures[:, None, None] * np.eye(2)
