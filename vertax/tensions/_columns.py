"""Columns of the tables of tensions: positions in pixels, units and meanings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vertax._base.pixels import PixelSize, pixel_length, pixel_sides

_Y = "y points down: it grows with the row of the image"
# Unit and meaning of columns; L is the unit of length.
_COLUMNS = {
    "frame": ("", "name of the file, or number of the frame from 0"),
    "cell": ("", "number of the cell in its frame, from 0"),
    "label": ("", "label in the mask; 0: a hole, or no label"),
    "x": ("L", "centroid, from the left border of the image"),
    "y": ("L", f"centroid, from the top border of the image; {_Y}"),
    "column": ("pixel", "centroid, from the left border; the middle of the first pixel is at 0.5"),
    "row": ("pixel", "centroid, from the top border; the middle of the first pixel is at 0.5"),
    "area": ("L^2", "area of the cell"),
    "area_pixels": ("pixel", "area of the cell"),
    "perimeter": ("L", "perimeter"),
    "shape_factor": ("1", "perimeter over the root of the area"),
    "sides": ("", "number of edges"),
    "on_outline": ("", "whether it borders on the exterior"),
    "area_in_space": ("L^2", "area of the cell on its surface"),
    "perimeter_in_space": ("L", "perimeter on the surface"),
    "length_in_space": ("L", "length of the edge on the surface"),
    "slope": ("1", "slope of the surface at the cell: rise over run"),
    "normal_load": (
        "mean tension",
        "force of the tensions along the normal, a third of that of each corner",
    ),
    "pressure": ("mean tension / L", "pressure less the mean; empty: no equation contains it"),
    "pressure_deviation": ("mean tension / L", "standard deviation of the pressure"),
    "determined": ("", "whether the shape determines the tension or pressure"),
    "reason": ("", "why it is not determined; empty if it is"),
    "stress_xx": ("mean tension / L", "stress, tension positive"),
    "stress_xy": ("mean tension / L", f"stress; {_Y}"),
    "stress_yy": ("mean tension / L", "stress"),
    "hole": ("", "whether the face is a hole, which is no cell"),
    "pixels": ("pixel", "number of pixels, after the changes of the mask"),
    "area_error": ("1", "area over that of the pixels, less 1"),
    "outline_error": ("pixel", "root mean square distance of the outline from its arcs"),
    "edge": ("", "number of the edge in its frame, from 0"),
    "left_cell": ("", "cell on the left; -1: the exterior"),
    "right_cell": ("", "cell on the right; -1: the exterior"),
    "start_vertex": ("", "first vertex"),
    "end_vertex": ("", "last vertex"),
    "start_x": ("L", "first vertex"),
    "start_y": ("L", f"first vertex; {_Y}"),
    "end_x": ("L", "last vertex"),
    "end_y": ("L", f"last vertex; {_Y}"),
    "start_column": ("pixel", "first vertex, from the left border"),
    "start_row": ("pixel", "first vertex, from the top border"),
    "end_column": ("pixel", "last vertex, from the left border"),
    "end_row": ("pixel", "last vertex, from the top border"),
    "length": ("L", "length of the arc"),
    "length_pixels": ("pixel", "length of the arc over the root of the area of a pixel"),
    "angle": ("radian", "angle between chord and tangents; 0 for a straight edge"),
    "left_label": ("", "label on the left; 0: exterior or hole; -1: four cells meet"),
    "right_label": ("", "label on the right; 0: exterior or hole; -1: four cells meet"),
    "four_fold": ("", "whether the edge has length 0, where four cells meet"),
    "tension": ("mean tension", "tension; empty: no equation contains it"),
    "tension_deviation": ("mean tension", "standard deviation of the tension"),
    "shown": ("1", "share of the edge along which the mask shows the contact"),
    "contact_closed": ("", "whether the mask does not show half of the contact"),
    "contact_uncertain": ("", "whether other cells may touch here, across a gap"),
    "kind": ("", "kind of change of the mask"),
    "into": ("", "label of the cell that has the pixels in the tissue; 0: none"),
    "n_cells": ("", "number of cells"),
    "n_determined": ("", "number of tensions that the shape determines"),
    "noise_pixels": ("pixel", "standard deviation of the position of an edge"),
    "pixel_height": ("L", "height of a pixel"),
    "pixel_width": ("L", "width of a pixel"),
    "warnings": ("", "reasons against the result"),
    "error": ("", "message of the error; empty for a result"),
}


def column_descriptions(
    tables: Mapping[str, Mapping[str, Any]], length: str
) -> dict[str, np.ndarray]:
    """Unit and meaning of each column of some tables.

    **Arguments:**

    - `tables`: the tables by name.
    - `length`: the unit of length.

    **Returns:** a table with the columns `table`, `column`, `unit` and `meaning`.
    """
    rows = [
        (table, name, _COLUMNS[name][0].replace("L", f"({length})"), _COLUMNS[name][1])
        for table, columns in tables.items()
        for name in columns
    ]
    columns = map(np.array, zip(*rows, strict=True))
    return dict(zip(("table", "column", "unit", "meaning"), columns, strict=True))


def with_pixels(
    table: dict[str, np.ndarray], pixel_size: PixelSize | None
) -> dict[str, np.ndarray]:
    """A table of cells or edges with positions, lengths and areas in pixels, if it comes from an image."""
    if pixel_size is None:
        return table
    width, height = pixel_sides(pixel_size)
    side = pixel_length(pixel_size)
    scales = {
        "x": ("column", width),
        "y": ("row", height),
        "area": ("area_pixels", side**2),
        "start_x": ("start_column", width),
        "start_y": ("start_row", height),
        "end_x": ("end_column", width),
        "end_y": ("end_row", height),
        "length": ("length_pixels", side),
    }
    new = {name: table[old] / scale for old, (name, scale) in scales.items() if old in table}
    return table | new
