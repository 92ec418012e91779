"""Cells and edges as GeoJSON, for geopandas, sf and QGIS."""

from __future__ import annotations

import datetime
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vertax._base.atomic import atomic_write
from vertax._base.checks import check_integer, describe
from vertax._base.model_checks import check_planar
from vertax.io._data_tables import Column, cell_columns, check_writable, edge_columns
from vertax.mesh import Drawing, Tissue


def write_geojson(
    path: str | os.PathLike[str],
    tissue: Tissue,
    *,
    cells: Mapping[str, Column] | None = None,
    edges: Mapping[str, Column] | None = None,
    points_per_arc: int = 24,
) -> None:
    """Write the cells of a tissue as polygons to a GeoJSON file (RFC 7946).

    A `FeatureCollection` with one `Polygon` for each cell. Its properties are the columns of
    [`cell_table`][vertax.io.cell_table]. Periodic cells are drawn in one piece, as in pictures.
    Coordinates are in the tissue's units of length, not longitude and latitude. The JSON is strict: a
    property that is not finite is null. The file is written atomically. See
    [`read_geojson`][vertax.io.read_geojson] and [`read_table`][vertax.io.read_table].

    ```python
    vx.io.write_geojson("cells.geojson", tissue, cells={"pressure": pressure})
    ```

    **Arguments:**

    - `path`: the file.
    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `cells`: more properties of the cells by name, one entry for each cell.
    - `edges`: properties of the edges. If given (an empty `{}` too), the edges are written as `LineString`,
        with the columns of [`edge_table`][vertax.io.edge_table], to a second file:
        `cells-edges.geojson` next to `cells.geojson`.
    - `points_per_arc`: number of straight pieces of an arc.

    **Raises:**

    - `ValueError` for a batch of tissues, a tissue on a surface, positions that are not finite,
        `points_per_arc` below 1, and as [`cell_table`][vertax.io.cell_table].
    """
    check_planar("GeoJSON (write_vtk writes three coordinates)", tissue)
    drawing = checked_drawing(tissue, points_per_arc)
    if not np.isfinite(drawing.lines[drawing.cell < drawing.n_cells]).all():
        raise ValueError(
            "Argument `tissue` must have finite positions: JSON has no NaN and no infinity."
        )
    polygons, counts = drawing.polygons()
    # The last point of a ring repeats the first.
    rings = [
        [[*polygon[:n].tolist(), polygon[0].tolist()]]
        for polygon, n in zip(polygons, counts, strict=True)
        if n > 0
    ]
    files = {
        Path(path): (
            "Polygon",
            rings,
            cell_columns(tissue, drawing, {} if cells is None else cells),
        )
    }
    if edges is not None:
        lines = drawing.lines[drawing.half_edge][drawing.alive_edges].tolist()
        files[edge_path(path)] = ("LineString", lines, edge_columns(tissue, drawing, edges))
    for file_path, (kind, shapes, table) in files.items():
        collection = {"type": "FeatureCollection", "features": _features(kind, shapes, table)}
        with atomic_write(file_path) as file:
            json.dump(collection, file, allow_nan=False)
            file.write("\n")


def checked_drawing(tissue: Tissue, points_per_arc: int) -> Drawing:
    """The geometry of one tissue, for files; checks the arguments."""
    check_writable(tissue)
    check_integer("points_per_arc", points_per_arc, at_least=1)
    return Drawing(tissue, points_per_arc)


def edge_path(path: str | os.PathLike[str]) -> Path:
    """The path of the edges, from that of the cells: `cells-edges.geojson`."""
    path = Path(path)
    return path.with_name(f"{path.stem}-edges{path.suffix}")


def _features(kind: str, shapes: list[Any], table: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    columns = [[_strict(name, x) for x in column.tolist()] for name, column in table.items()]
    return [
        {
            "type": "Feature",
            "geometry": {"type": kind, "coordinates": shape},
            "properties": dict(zip(table, row, strict=True)),
        }
        for shape, *row in zip(shapes, *columns, strict=True)
    ]


def _strict(name: str, value: Any) -> Any:
    if isinstance(value, datetime.date):
        return value.isoformat()
    if not (value is None or isinstance(value, str | bool | int | float)):
        raise TypeError(
            f"Column `{name}` must hold numbers, booleans or text, which JSON can store, but holds "
            f"{describe(value)}."
        )
    return None if isinstance(value, float) and not math.isfinite(value) else value
