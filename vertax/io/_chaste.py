"""Result files of Chaste: `results.viznodes`, `results.vizelements` and others of a folder."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Shaped

from vertax._base.atomic import atomic_write
from vertax.io._geojson import checked_drawing
from vertax.mesh import Tissue, Trajectory
from vertax.mesh._curved import check_planar

_NODES, _ELEMENTS, _OUTER = "results.viznodes", "results.vizelements", "results.vizboundarynodes"
# Of each cell: value, place in the mesh, x, y. The names of cells, and two sources of their types.
_NAMES, _LABELS, _TYPES = "loggedcell.dat", "results.vizlabels", "results.vizcelltypes"


class _Line(NamedTuple):
    """A line of a file: the numbers at one time."""

    place: str
    time: float
    values: Float[np.ndarray, " values"]

    def refuse(self, fact: str, remedy: str) -> NoReturn:
        raise ValueError(f"{self.place} {fact}. {remedy}")

    def integers(self) -> Int[np.ndarray, " values"]:
        whole = self.values.astype(int)
        if not np.array_equal(whole, self.values) or (whole < 0).any():
            self.refuse("must hold integers from 0, but does not", "Write the file again.")
        return whole


def read_chaste(folder: Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """The corners of all cells at all times, as a table.

    Its columns are `frame`, `time`, `cell`, `x`, `y`, and, if they are in the files, `type`, `centroid_x` and
    `centroid_y`.

    Nodes are joined by their numbers, so cells that touch have the same coordinates, to the last bit. Cells
    have the numbers of `loggedcell.dat`, or else their places in a line: these change if a cell dies.
    """
    folders = _results(folder)
    if len(folders) != 1:
        raise ValueError(
            f"{folder} must hold the results of one run of Chaste, but has several: "
            f"{', '.join(each.name for each in folders)}. Choose one of these folders."
        )
    (folder,) = folders
    missing = [name for name in (_NODES, _ELEMENTS) if not (folder / name).is_file()]
    if missing:
        raise ValueError(
            f"{folder} must hold {_NODES} and {_ELEMENTS}, but has no {missing[0]}. Copy it from the "
            "folder `results_from_time_…` of the run."
        )
    optional = (_OUTER, _NAMES, _LABELS, _TYPES)
    files = {name: _lines(folder / name) for name in (_NODES, _ELEMENTS)}
    files |= {name: _lines(folder / name) for name in optional if (folder / name).is_file()}
    n_lines = {name: len(lines) for name, lines in files.items()}
    n_frames = min(n_lines.values())
    if n_frames < max(n_lines.values()):
        warnings.warn(
            f"Files of {folder} have different numbers of lines, as those of a run that goes on: {n_lines}. "
            f"The first {n_frames} times are read.",
            stacklevel=4,
        )
    frames = [_frame(k, {name: lines[k] for name, lines in files.items()}) for k in range(n_frames)]
    if not frames:
        raise ValueError(f"{folder} must hold the lines of at least one time, but has none.")
    return {name: np.concatenate([frame[name] for frame in frames]) for name in frames[0]}


def _results(folder: Path) -> list[Path]:
    """The folder itself, or those of its parts that hold results."""
    if any((folder / name).is_file() for name in (_NODES, _ELEMENTS)):
        return [folder]
    return sorted(path for path in folder.glob("results_from_time_*") if (path / _NODES).is_file())


def _lines(path: Path) -> list[_Line]:
    try:
        *texts, rest = path.read_text(encoding="utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} must be a text file of Chaste, but is not. Write it again."
        ) from error
    if rest.strip():
        warnings.warn(
            f"The last line of {path}, number {len(texts) + 1}, has no end: it is left out.",
            stacklevel=5,
        )
    lines: list[_Line] = []
    for number, text in enumerate(texts, 1):
        if not text.strip():
            continue
        place = f"Line {number} of {path}"
        try:
            values = np.array(text.split(), float)
        except ValueError as error:
            raise ValueError(f"{place} must hold numbers, but does not: {error}.") from error
        line = _Line(place, float(values[0]), values[1:])
        if not np.isfinite(values).all():
            line.refuse("must hold finite numbers, but does not", "Delete it and the lines below.")
        if lines and not line.time > lines[-1].time:
            line.refuse(
                f"must be later than the line above, but has the time {line.time:g}",
                "Delete one of them.",
            )
        lines.append(line)
    return lines


def _frame(number: int, lines: dict[str, _Line]) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """The rows of one time."""
    nodes, elements = lines[_NODES], lines[_ELEMENTS]
    for line in lines.values():
        if line.time != nodes.time:
            line.refuse(
                f"must have the time {nodes.time:g} of {_NODES}, but has {line.time:g}",
                "Take the files of one run.",
            )
    if len(nodes.values) % 2:
        nodes.refuse("must hold two coordinates of each node, but their number is odd", _AGAIN)
    points = nodes.values.reshape(-1, 2)
    cells = _corners(elements, len(points))
    if _OUTER in lines:
        _columns(lines[_OUTER], len(points), 1, "node")
    of_cell: dict[str, np.ndarray] = {"cell": np.arange(len(cells))}
    for name, column in ((_NAMES, "cell"), (_TYPES, "type"), (_LABELS, "type")):
        if name not in lines:
            continue
        table = _columns(lines[name], len(cells), 1 if name == _TYPES else 4, "cell")
        of_cell[column] = table[:, 0].astype(int)
        if name != _TYPES:
            of_cell |= {"centroid_x": table[:, 2], "centroid_y": table[:, 3]}
    row = np.concatenate(cells)
    owner = np.repeat(np.arange(len(cells)), [len(cell) for cell in cells])
    rows = {name: values[owner] for name, values in of_cell.items()}
    frame = {"frame": np.full(len(row), number), "time": np.full(len(row), nodes.time)}
    return frame | rows | {"x": points[row, 0], "y": points[row, 1]}


def _corners(line: _Line, n_nodes: int) -> list[Int[np.ndarray, " _"]]:
    """The nodes of each cell: their number, then the nodes."""
    values, cells, k = line.integers(), [], 0
    while k < len(values):
        end = k + 1 + int(values[k])
        if end > len(values) or end - k < 4:
            line.refuse(
                f"must have three nodes or more after the number of them, but has {values[k]} as this number "
                f"of cell {len(cells)} and {len(values) - k - 1} further numbers",
                _AGAIN,
            )
        cells.append(values[k + 1 : end])
        k = end
    for number, cell in enumerate(cells):
        if cell.max() >= n_nodes:
            line.refuse(
                f"must name nodes below {n_nodes}, the number of nodes in {_NODES} at this time, but cell "
                f"{number} has node {cell.max()}",
                "Write both files in one run, after ReMesh(), which renumbers nodes.",
            )
    if not cells:
        line.refuse("must have a cell, but has none", "Delete this time in all files.")
    return cells


def _columns(line: _Line, n: int, width: int, what: str) -> Float[np.ndarray, "rows columns"]:
    if len(line.values) != n * width:
        line.refuse(
            f"must have {width} number{'s' * (width > 1)} for each of {n} {what}s, but has "
            f"{len(line.values)}",
            f"Take the files of one run, or remove {line.place.rpartition('/')[2]}.",
        )
    return line.values.reshape(n, width)


_AGAIN = "Write the file again, or delete this time in all files."


def write_chaste(
    folder: str | os.PathLike[str],
    trajectory: Trajectory,
    *,
    types: ArrayLike | Sequence[int] | None = None,
    points_per_arc: int = 24,
) -> None:
    """Write a trajectory as result files of Chaste, for its visualiser and programs that read them.

    The files are `results.viznodes`, `.vizelements`, `.vizcelltypes`, `.vizboundarynodes` and
    `loggedcell.dat` (numbers and centroids of cells); [`read_table`][vertax.io.read_table] reads them. Chaste
    continues from the last frame: `last.node` and `last.cell` are its mesh for `VertexMeshReader`. Times are
    the values `time` of the trajectory, if it has them, or else the numbers of the frames. Vertices of a
    periodic tissue are in the box.

    ```python
    movie = vx.evolve(tissue, energy, friction, times)
    vx.io.write_chaste("run", movie.trajectory)
    ```

    **Arguments:**

    - `folder`: it is made if there is none; files of the same names are replaced.
    - `trajectory`: with at least one frame.
    - `types`: an integer for each cell, by default 0.
    - `points_per_arc`: number of straight sides of an arc.

    **Raises:**

    - `ValueError` if there is no frame, for another number of types, a tissue on a surface, and as
        [`write_vtk`][vertax.io.write_vtk].
    - `OSError` if a file cannot be written.
    """
    if len(trajectory) == 0:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    n_cells = trajectory[0].n_cells
    of_cell = np.zeros(n_cells, int) if types is None else np.asarray(types)
    if of_cell.shape != (n_cells,) or of_cell.dtype.kind not in "iu":
        raise ValueError(
            f"Argument `types` must hold an integer for each of {n_cells} cells, but has shape "
            f"{of_cell.shape} and type {of_cell.dtype}."
        )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    times = trajectory.values.get("time", np.arange(len(trajectory)))
    texts: dict[str, list[str]] = {}
    mesh: _Mesh | None = None
    for time, tissue in zip(times, trajectory, strict=True):
        mesh = _mesh(tissue, points_per_arc)
        columns = {
            _NODES: mesh.points.ravel(),
            _ELEMENTS: np.concatenate([[len(cell), *cell] for cell in mesh.cells]),
            _TYPES: of_cell[mesh.numbers],
            _OUTER: mesh.outer,
        }
        for name, values in columns.items():
            texts.setdefault(name, []).append(" ".join([f"{time}\t", *map(str, values.tolist())]))
        places = zip(mesh.numbers, mesh.centroids.tolist(), strict=True)
        cells = (f"{number} {k} {x} {y}" for k, (number, (x, y)) in enumerate(places))
        texts.setdefault(_NAMES, []).append(" ".join([f"{time}\t", *cells]))
    assert mesh is not None
    rows = zip(mesh.points.tolist(), mesh.outer.tolist(), strict=True)
    texts["last.node"] = [
        f"{len(mesh.points)} 2 0 1",
        *(f"{k} {x} {y} {outer}" for k, ((x, y), outer) in enumerate(rows)),
    ]
    texts["last.cell"] = [
        f"{len(mesh.cells)} 0",
        *(f"{k} {len(c)} {' '.join(map(str, c.tolist()))}" for k, c in enumerate(mesh.cells)),
    ]
    for name, lines in texts.items():
        with atomic_write(folder / name) as file:
            file.write("\n".join([*lines, ""]))


class _Mesh(NamedTuple):
    """A tissue as polygons with common nodes."""

    points: Float[np.ndarray, "nodes 2"]
    outer: Int[np.ndarray, " nodes"]
    cells: list[Int[np.ndarray, " _"]]
    numbers: Int[np.ndarray, " cells"]
    centroids: Float[np.ndarray, "cells 2"]


def _mesh(tissue: Tissue, points_per_arc: int) -> _Mesh:
    check_planar("Files of Chaste", tissue)
    drawing = checked_drawing(tissue, points_per_arc)
    m = tissue.topology
    points, on_outline = np.asarray(tissue.vertices, float), np.asarray(m.on_outline)
    if drawing.lattice is not None:
        points = points - np.floor(points @ np.linalg.inv(drawing.lattice)) @ drawing.lattice
    outer = np.zeros(len(points), int)
    outer[np.asarray(m.edge_vertices)[on_outline]] = 1
    # The nodes of each half-edge before its target: those inside an arc follow the vertices.
    curved = drawing.alive_edges & (np.asarray(tissue.edge_angles) != 0)
    inside = drawing.lines[drawing.half_edge[curved], 1:-1]
    n = inside.shape[1]
    of_edge = len(points) + (np.cumsum(curved) - 1)[:, None] * n + np.arange(n)
    source = np.arange(m.n_half_edges)[:, None] // 3
    forward = drawing.half_edge[drawing.edge] == np.arange(m.n_half_edges)
    between = np.where(forward[:, None], of_edge[drawing.edge], of_edge[drawing.edge][:, ::-1])
    nodes = [
        np.append(start, inner if is_curved else inner[:0])
        for start, inner, is_curved in zip(source, between, curved[drawing.edge], strict=True)
    ]
    numbers = np.flatnonzero(drawing.alive)
    cells = []
    first = dict(zip(*np.unique(drawing.cell, return_index=True), strict=True))
    for number in numbers:
        loop = [first[number]]
        while drawing.following[loop[-1]] != loop[0]:
            loop.append(drawing.following[loop[-1]])
        cells.append(np.concatenate([nodes[half_edge] for half_edge in loop]))
    points = np.concatenate([points, inside.reshape(-1, 2)])
    outer = np.append(outer, np.repeat(on_outline[curved].astype(int), n))
    used = np.unique(np.concatenate(cells))
    cells = [np.searchsorted(used, cell) for cell in cells]
    return _Mesh(points[used], outer[used], cells, numbers, drawing.centroids[numbers])
