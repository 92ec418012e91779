"""Tissues from polygons in GeoJSON files."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Shaped

from vertax.initialise import PolygonTissue
from vertax.initialise._faces import Names
from vertax.initialise._polygons import tissue_from_near_corners
from vertax.io._read_table import properties, read_features


def read_geojson(
    path: str | os.PathLike[str],
    *,
    box: ArrayLike | Sequence[Any] | None = None,
    tolerance: float | None = None,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> tuple[PolygonTissue, dict[str, Shaped[np.ndarray, " cells"]]]:
    """Read a tissue from a GeoJSON file with a polygon for each cell (RFC 7946), or from a list of features.

    ```python
    polygons, table = vx.io.read_geojson("cells.geojson")
    tissue, pressure = polygons.tissue, table["pressure"]
    ```

    The corners of the polygons make a tissue as in [`from_polygons`][vertax.initialise.from_polygons], on a
    surface if they have different z.

    [`write_geojson`][vertax.io.write_geojson] draws an arc as a chain of straight pieces, so an arc read from
    polygons has the area of that chain. For exactly the same tissue write the edges too (`edges={}`), and
    read them: `vx.io.from_edge_table(vx.io.read_table("cells-edges.geojson"))`.

    **Arguments:**

    - `path`: the file.
    - `box`: of a periodic tissue, width and height, or two lattice vectors as rows. Polygons must be whole;
        they may stick out of the box.
    - `tolerance`: as of [`from_polygons`][vertax.initialise.from_polygons], by default 10⁻⁶ of the root mean
        cell area. Increase it for rounded coordinates and simplified outlines.
    - `inner_arcs`, `softening`: as of [`from_polygons`][vertax.initialise.from_polygons].

    Features without a geometry, and collections of geometries without exactly one polygon, are left out
    with a warning.

    **Returns:** the [`PolygonTissue`][vertax.initialise.PolygonTissue], with the corners in
    the order of the file as points, and the properties of the features as columns with one row for each cell.

    **Raises:**

    - `OSError` if the file cannot be read.
    - `ValueError`, naming the file and the feature, for features that are no polygons or have holes, and as
        [`from_polygons`][vertax.initialise.from_polygons].
    """
    path = Path(path)
    features = _with_polygons(read_features(path), path)
    rings = [_ring(feature, feature["number"], path) for feature in features]
    corner = np.concatenate(rings)
    cells = np.split(np.arange(len(corner)), np.cumsum([len(ring) for ring in rings])[:-1])
    images = [np.zeros((len(ring), 2), int) for ring in rings]
    names = Names(
        f"The polygons of {path}", _at(corner), lambda cell: f"feature {features[cell]['number']}"
    )
    polygons = tissue_from_near_corners(
        corner,
        cells,
        names,
        tolerance,
        box=box,
        images=None if box is None else images,
        relative_tolerance=1e-6,
        inner_arcs=inner_arcs,
        softening=softening,
    )
    return polygons, properties(features, path)


def _with_polygons(features: list[dict[str, Any]], path: Path) -> list[dict[str, Any]]:
    """The features with a geometry, and the polygon of each collection of geometries that has one."""
    kept, skipped = [], []
    for number, feature in enumerate(features):
        geometry = feature["geometry"]
        if isinstance(geometry, dict) and geometry.get("type") == "GeometryCollection":
            parts = [part for part in geometry.get("geometries") or [] if isinstance(part, dict)]
            polygons = [part for part in parts if str(part.get("type")).endswith("Polygon")]
            geometry = polygons[0] if len(polygons) == 1 else None
        if isinstance(geometry, dict):
            kept.append(feature | {"geometry": geometry, "number": number})
        else:
            skipped.append(number)
    if not kept:
        raise ValueError(f"{path} must hold polygons, but no feature has one.")
    if skipped:
        numbers = ", ".join(map(str, skipped[:10])) + (", …" if len(skipped) > 10 else "")
        warnings.warn(
            f"{path}: features without a polygon, or with several, are left out: {numbers}.",
            stacklevel=3,
        )
    return kept


def _at(points: Float[np.ndarray, "points 3"]) -> Any:
    return lambda point: f"the corner {points[point, :2].tolist()}"


def _ring(feature: dict[str, Any], number: int, path: Path) -> Float[np.ndarray, "corners 3"]:
    """The outline of a polygon, z = 0 where a position has none, without its first corner at the end."""
    geometry = feature["geometry"]
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    if kind == "LineString":
        raise ValueError(
            f"{path} must hold polygons, but feature {number} is a line. Read the edges that vertax "
            "writes by "
            "vx.io.from_edge_table(vx.io.read_table(path))."
        )
    if kind == "MultiPolygon" and isinstance(coordinates, list) and len(coordinates) == 1:
        kind, coordinates = "Polygon", coordinates[0]
    if kind != "Polygon" or not isinstance(coordinates, list):
        raise ValueError(
            f"{path} must hold polygons, but feature {number} is of type {kind}. Remove it, or split it "
            "into one "
            "polygon for each cell."
        )
    if len(coordinates) != 1:
        raise ValueError(
            f"{path} must hold polygons without holes, but feature {number} has {len(coordinates) - 1}. "
            "Give the cells inside it, and divide the cell around them."
        )
    try:
        places = [
            (place[0], place[1], place[2] if len(place) > 2 else 0) for place in coordinates[0]
        ]
        ring = np.array([[float(x) for x in place] for place in places])
    except (TypeError, ValueError, IndexError) as error:
        raise ValueError(
            f"{path}: the coordinates of feature {number} are no pairs of numbers."
        ) from error
    if len(ring) > 1 and np.array_equal(ring[0], ring[-1]):
        ring = ring[:-1]
    if len(ring) < 3 or not np.isfinite(ring).all():
        raise ValueError(
            f"{path} must hold polygons of three corners or more at finite places, but feature {number} "
            "does not. "
            "Remove it."
        )
    return ring
