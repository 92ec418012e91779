"""Result files of Chaste: `results.viznodes`, `results.vizelements` and others of a folder."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Shaped

from vertax._base.atomic import atomic_write
from vertax._base.model_checks import check_planar
from vertax.io._geojson import checked_drawing
from vertax.mesh import Tissue, Trajectory

_NODES, _ELEMENTS, _OUTER = "results.viznodes", "results.vizelements", "results.vizboundarynodes"
# Numbers of the cells; two sources of their types, the second one where both are present.
_NAMES, _TYPES, _LABELS = "loggedcell.dat", "results.vizcelltypes", "results.vizlabels"
_FILES = (_NODES, _ELEMENTS, _OUTER, _NAMES, _TYPES, _LABELS)


class _Line(NamedTuple):
    """A line of a file: the numbers at one time."""

    place: str
    time: float
    values: Float[np.ndarray, " values"]

    def require(self, condition: bool | np.bool_, rule: str, fact: str) -> None:
        if not condition:
            raise ValueError(
                f"{self.place} must {rule}, but {fact}. Take the files of one run, or delete this time in "
                "all of them."
            )


def read_chaste(folder: Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """The corners of all cells at all times, as a table.

    Its columns are `frame`, `time`, `cell`, `x`, `y`, and, if they are in the files, `type`, `centroid_x` and
    `centroid_y`. Nodes are joined by their numbers, so cells that touch have the same coordinates. Cells have
    the numbers of `loggedcell.dat`, or else their places in a line, which change if a cell dies.
    """
    if not (folder / _ELEMENTS).is_file():
        parts = sorted(path.parent for path in folder.glob(f"results_from_time_*/{_ELEMENTS}"))
        folder = parts[0] if len(parts) == 1 else folder
    files = {name: _lines(folder / name) for name in _FILES if (folder / name).is_file()}
    if not {_NODES, _ELEMENTS} <= set(files):
        raise ValueError(
            f"{folder} must hold {_NODES} and {_ELEMENTS} of one run of Chaste, but holds: "
            f"{', '.join(sorted(path.name for path in folder.iterdir())[:10]) or 'nothing'}. Choose the "
            "folder `results_from_time_…` of one run."
        )
    n_lines = {name: len(lines) for name, lines in files.items()}
    n_frames = min(n_lines.values())
    if n_frames < max(n_lines.values()):
        warnings.warn(
            f"Files of {folder} have different numbers of lines, as those of a run that goes on: {n_lines}. "
            f"The first {n_frames} times are read.",
            stacklevel=4,
        )
    if not n_frames:
        raise ValueError(
            f"{folder} must hold the lines of at least one time, but has none. Wait for the run, or choose "
            "another folder."
        )
    frames = [_frame(k, {name: lines[k] for name, lines in files.items()}) for k in range(n_frames)]
    return {name: np.concatenate([frame[name] for frame in frames]) for name in frames[0]}


def _lines(path: Path) -> list[_Line]:
    *texts, rest = path.read_bytes().decode(errors="replace").split("\n")
    if rest.strip():
        warnings.warn(
            f"The last line of {path}, number {len(texts) + 1}, has no end: it is left out.",
            stacklevel=5,
        )
    lines: list[_Line] = []
    for number, text in enumerate(texts, 1):
        if not text.strip():
            continue
        try:
            values = np.array(text.split(), float)
        except ValueError:
            values = np.array([np.nan])
        line = _Line(f"Line {number} of {path}", float(values[0]), values[1:])
        line.require(np.isfinite(values).all(), "hold finite numbers", f"is {text[:40]!r}")
        later = not lines or line.time > lines[-1].time
        line.require(later, "be later than the line above", f"has the time {line.time:g}")
        lines.append(line)
    return lines


def _frame(number: int, lines: dict[str, _Line]) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """The rows of one time."""
    nodes, elements = lines[_NODES], lines[_ELEMENTS]
    for line in lines.values():
        rule = f"have the time {nodes.time:g} of {_NODES}"
        line.require(line.time == nodes.time, rule, f"has {line.time:g}")
    n = len(nodes.values)
    nodes.require(n % 2 == 0, "hold two coordinates of each node", f"has {n} numbers")
    points = nodes.values.reshape(-1, 2)
    cells = _corners(elements, len(points))

    def columns(name: str, n: int, width: int, what: str) -> Float[np.ndarray, "rows columns"]:
        line = lines[name]
        rule = f"have {width} number{'s' * (width > 1)} for each of {n} {what}s"
        line.require(len(line.values) == n * width, rule, f"has {len(line.values)}")
        return line.values.reshape(n, width)

    if _OUTER in lines:
        columns(_OUTER, len(points), 1, "node")
    of_cell: dict[str, np.ndarray] = {"cell": np.arange(len(cells))}
    for name, column in ((_NAMES, "cell"), (_TYPES, "type"), (_LABELS, "type")):
        if name in lines:
            # The value, and of all but types the place in the mesh and the centroid.
            table = columns(name, len(cells), 1 if name == _TYPES else 4, "cell")
            of_cell[column] = table[:, 0].astype(int)
            if name != _TYPES:
                of_cell |= {"centroid_x": table[:, 2], "centroid_y": table[:, 3]}
    row = np.concatenate(cells)
    owner = np.repeat(np.arange(len(cells)), [len(cell) for cell in cells])
    frame = {"frame": np.full(len(row), number), "time": np.full(len(row), nodes.time)}
    frame |= {name: values[owner] for name, values in of_cell.items()}
    return frame | {"x": points[row, 0], "y": points[row, 1]}


def _corners(line: _Line, n_nodes: int) -> list[Int[np.ndarray, " _"]]:
    """The nodes of each cell, from the number of them and then the nodes."""
    values, cells, k = line.values.astype(int), [], 0
    integral = np.array_equal(values, line.values)
    line.require(
        integral and len(values) > 0, "hold integers, the nodes of a cell at least", "does not"
    )
    while k < len(values):
        end, name = k + 1 + values[k], f"cell {len(cells)}"
        rule = "have three nodes or more after the number of them"
        rest = f"{name} has {values[k]} as this number, and {len(values) - k - 1} numbers follow"
        line.require(k + 3 < end <= len(values), rule, rest)
        cells.append(values[k + 1 : end])
        largest = int(cells[-1].max())
        rule = f"name nodes below {n_nodes}, their number in {_NODES} at this time"
        inside = cells[-1].min() >= 0 and largest < n_nodes
        line.require(inside, rule, f"{name} has node {largest}")
        k = end
    return cells


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
    for time, tissue in zip(times, trajectory, strict=True):
        points, outer, cells = _mesh(tissue, points_per_arc)
        places = zip(cells, np.asarray(tissue.centroids)[[*cells]].tolist(), strict=True)
        columns = {
            _NODES: points.ravel().tolist(),
            _ELEMENTS: [x for cell in cells.values() for x in (len(cell), *cell)],
            _TYPES: of_cell[[*cells]].tolist(),
            _OUTER: outer.tolist(),
            _NAMES: [x for k, (cell, (x, y)) in enumerate(places) for x in (cell, k, x, y)],
        }
        for name, values in columns.items():
            texts.setdefault(name, []).append(f"{time}\t" + " ".join(map(str, values)))
        rows = enumerate(zip(points.tolist(), outer.tolist(), strict=True))
        texts["last.node"] = [
            f"{len(points)} 2 0 1",
            *(f"{k} {x} {y} {o}" for k, ((x, y), o) in rows),
        ]
        rows = enumerate(cells.values())
        texts["last.cell"] = [
            f"{len(cells)} 0",
            *(f"{k} {len(c)} {' '.join(map(str, c))}" for k, c in rows),
        ]
    for name, lines in texts.items():
        with atomic_write(folder / name) as file:
            file.write("\n".join([*lines, ""]))


def _mesh(
    tissue: Tissue, points_per_arc: int
) -> tuple[Float[np.ndarray, "nodes 2"], Int[np.ndarray, " nodes"], dict[int, list[int]]]:
    """Nodes, whether they are on the outline, and the nodes of each cell by number."""
    check_planar("Files of Chaste", tissue)
    drawing = checked_drawing(tissue, points_per_arc)
    vertices, on_outline = (
        np.asarray(tissue.vertices, float),
        np.asarray(tissue.topology.on_outline),
    )
    if drawing.lattice is not None:
        vertices = vertices - np.floor(vertices @ np.linalg.inv(drawing.lattice)) @ drawing.lattice
    curved = drawing.alive_edges & (np.asarray(tissue.edge_angles) != 0)
    # The nodes inside the arcs follow the vertices.
    inside = drawing.lines[drawing.half_edge[curved], 1:-1]
    n = inside.shape[1]
    first = len(vertices) + n * (np.cumsum(curved) - 1)
    points = np.concatenate([vertices, inside.reshape(-1, 2)])
    outer = np.zeros(len(points), int)
    outer[np.asarray(tissue.topology.edge_vertices)[on_outline & drawing.alive_edges]] = 1
    outer[len(vertices) :] = np.repeat(on_outline[curved], n)
    cells: dict[int, list[int]] = {}
    for cell in np.flatnonzero(drawing.alive).tolist():
        half_edge = start = int(np.argmax(drawing.cell == cell))
        cells[cell] = []
        while not cells[cell] or half_edge != start:
            edge = drawing.edge[half_edge]
            arc = [*range(first[edge], first[edge] + n)] if curved[edge] else []
            forward = drawing.half_edge[edge] == half_edge
            cells[cell] += [half_edge // 3, *(arc if forward else arc[::-1])]
            half_edge = int(drawing.following[half_edge])
    # Spare slots have vertices, which are left out.
    used = np.unique(np.concatenate([*cells.values()]))
    place = dict(zip(used.tolist(), range(len(used)), strict=True))
    return points[used], outer[used], {c: [place[x] for x in nodes] for c, nodes in cells.items()}
