"""Movies of polygons in VTK files: `.vtu` files of unstructured grids, and `.pvd` files that list them."""

from __future__ import annotations

import re
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Int, Shaped

from vertax._base.extras import requires_extra

# Names of the columns: of vertax, and of Chaste.
_COLUMNS = {"cell": ("cell", "Cell IDs"), "type": ("type", "Cell labels", "Legacy Cell types")}


def read_vtk(path: Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """The corners of all cells at all times, through meshio.

    **Returns:** the columns `frame`, `time`, `cell`, `x` and `y`, and `type`, if it is in each file. Elements
    with one number of a cell are joined; without numbers each element is a cell.
    """
    files = [(0.0, path)]
    if path.suffix == ".pvd":
        try:
            sets = ET.parse(path).getroot().findall("Collection/DataSet")
        except ET.ParseError as error:
            _refuse(path, f"its text is broken ({error})", "Write it again.")
        files = sorted(
            (float(each.attrib["timestep"]), path.parent / each.attrib["file"]) for each in sets
        )
    if not files:
        _refuse(path, "it lists no file", "Write it again.")
    frames = [_frame(k, time, file) for k, (time, file) in enumerate(files)]
    columns = [name for name in frames[0] if all(name in frame for frame in frames)]
    return {name: np.concatenate([frame[name] for frame in frames]) for name in columns}


def _refuse(path: Path, fact: str, remedy: str) -> NoReturn:
    raise ValueError(f"{path} must hold polygons in a plane, as XML of VTK, but {fact}. {remedy}")


def _frame(number: int, time: float, path: Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    mesh = _mesh(path)
    blocks = [(b.type, b.data) for b in mesh.cells]
    flat = [kind in ("polygon", "triangle", "quad") for kind, _ in blocks]
    other = {kind for kind, _ in blocks} - {"polygon", "triangle", "quad", "line", "vertex"}
    if other or not any(flat):
        _refuse(path, f"it has {', '.join(other) or 'no polygons'}", "Save the cells as polygons.")
    if np.ptp(mesh.points[:, 2:], axis=0).sum() > 1e-9 * np.ptp(mesh.points):
        _refuse(path, "its points have different z", "Project them onto a plane.")
    polygons = [
        ring for (_, rings), keep in zip(blocks, flat, strict=True) if keep for ring in rings
    ]
    data = {"cell": np.arange(len(polygons))}
    for column, names in _COLUMNS.items():
        for name in names:
            if name in mesh.cell_data:
                parts = [x for x, keep in zip(mesh.cell_data[name], flat, strict=True) if keep]
                data[column] = np.concatenate(parts).astype(int)
    rows: dict[str, list] = {name: [] for name in (*data, "x", "y")}
    for cell, first in zip(*np.unique(data["cell"], return_index=True), strict=True):
        ring = _outline([polygons[k] for k in np.flatnonzero(data["cell"] == cell)])
        for name, values in data.items():
            rows[name] += [values[first]] * len(ring)
        rows["x"] += mesh.points[ring, 0].tolist()
        rows["y"] += mesh.points[ring, 1].tolist()
    n = len(rows["x"])
    columns = {name: np.array(values) for name, values in rows.items()}
    return {"frame": np.full(n, number), "time": np.full(n, time)} | columns


def _mesh(path: Path) -> Any:
    """The grid of a `.vtu` file."""
    with requires_extra("files", "Reading VTK files"):
        import meshio
    text = path.read_bytes()
    if text.count(b"<Piece") > 1:
        _refuse(path, "it has several pieces", "Merge them, with ParaView for example.")
    # VTK 9 writes versions above 1.0, which differ only for other elements; meshio refuses them.
    text = re.sub(rb'version="2\.\d+"', b'version="1.0"', text, count=1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "grid.vtu").write_bytes(text)
            return meshio.vtu.read(Path(folder) / "grid.vtu")
    except Exception as error:  # meshio raises errors of all kinds.
        raise ValueError(
            f"{path} must be a VTK file in XML, but cannot be read ({error or type(error).__name__}). Save "
            "it with ParaView as .vtu, as text or compressed by zlib."
        ) from error


def _outline(polygons: list[Int[np.ndarray, " _"]]) -> Int[np.ndarray, " corners"]:
    """The outline of the polygons of one cell: their sides without those that two of them share."""
    if len(polygons) == 1:
        return polygons[0]
    sides = {
        pair
        for ring in polygons
        for pair in zip(ring.tolist(), np.roll(ring, -1).tolist(), strict=True)
    }
    following = {a: b for a, b in sides if (b, a) not in sides}
    ring = [next(iter(following))]
    while len(ring) < len(following) and following.get(ring[-1], ring[0]) != ring[0]:
        ring.append(following[ring[-1]])
    return np.array(ring)
