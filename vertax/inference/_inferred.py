"""What was inferred of a tissue from its shape, as arrays and tables."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.io import cell_table, edge_table, write_csv, write_geojson, write_vtk
from vertax.mesh import Tissue


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
    """Label of each cell: in the mask, or the number of its body in a dump of Surface Evolver; of a tissue
    without either, the number of the cell plus 1. The exterior has the label 0."""
    noise: float
    """Standard deviation of the position of an edge, in units of length."""
    correlation: float
    """How far along an edge this noise is alike, in units of length."""
    bending: float
    """By how much edges bend beyond arcs, the standard deviation in radians: what a foam at rest does not."""
    model_errors: tuple[float, float]
    """By how much, in radians, angles at junctions and angles of arcs of the length of a cell differ from
    those of a balance, beyond the noise."""
    pixel_size: float | None
    """Length of a pixel side, if the tissue comes from an image."""
    four_fold: Bool[np.ndarray, " edges"]
    """Whether the edge has length 0: it is shorter than half a pixel of the mask, or half the accuracy of the
    positions. Four cells meet in a point, and which two of them share the edge depends on their numbers."""
    resampled_deviations: Float[np.ndarray, " edges"] | None = None
    """Standard deviations of the tensions by resampling, if that was asked for."""

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
        if share > 0 and np.nanmedian(self.tension_deviations[self.determined]) > 0.15:
            found.append(
                "half of the tensions that are determined have standard deviations above 0.15: strong edges "
                "are told from weak ones, and no more"
            )
        if junction > 0.1:
            found.append(
                f"angles at junctions are {np.degrees(junction):.0f} degrees from those of a balance: the "
                "tissue moves, or something else than tensions pulls on junctions; tensions that vary over "
                "many cells are then smoothed out"
            )
        if self.bending > 0.03:
            found.append(
                f"edges bend by {np.degrees(self.bending):.1f} degrees beyond arcs: the tissue moves, and "
                "its shape is in part that of older tensions; those of now differ more than these, "
                "beyond their standard deviations"
            )
        if arc > 0.5:
            found.append(
                f"arcs are {np.degrees(arc):.0f} degrees from those that pressures make: pressures are not "
                "to be trusted"
            )
        if share > 0 and np.mean(self.tensions[self.determined] < 0.2) > 0.03:
            found.append(
                "many tensions are near 0: where outlines are rough and edges short, the error of each "
                "junction adds up over many cells, and a part of the tissue loses its tension to the "
                "others; take a finer image, or a smaller `prior`"
            )
        none = int(np.sum(self.determined & (self.tensions < 1e-6)))
        if none:
            found.append(
                f"{none} tensions are 0, the least there is: there the shape asks for a push"
            )
        return found

    def edge_table(self) -> dict[str, np.ndarray]:
        """The edges as a table, see [`edge_table`][vertax.io.edge_table].

        **Returns:** its columns, and `left_label`, `right_label` (0: the exterior; -1: no pair of cells, for
        an edge that is four-fold), `four_fold`, `tension`, `tension_deviation` and `determined`.
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
            "left_label": np.where(self.four_fold, -1, left),
            "right_label": np.where(self.four_fold, -1, right),
            "four_fold": self.four_fold,
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
