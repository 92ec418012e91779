"""Vertex files of the Bayesian force inference."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from vertax._base.checks import check_number
from vertax.initialise import PolygonTissue
from vertax.initialise._faces import Names
from vertax.initialise._polygons import tissue_from_corners

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LINES = {
    "J": re.compile(rf"J\[(\d+)\]\s+({_NUMBER})\s+({_NUMBER})\s*(Ext)?"),
    "E": re.compile(r"E\[(\d+)\]\s+(\d+)\s+(\d+)\s*(Ext)?"),
    "C": re.compile(r"C\[(\d+)\]\s+(\d+)\s*:\s*((?:\d+\s*)*)\s*(Ext)?"),
}
_COUNTS = {"J": "V_NUM", "E": "E_NUM", "C": "C_NUM"}


def read_force_inference(
    path: str | os.PathLike[str],
    *,
    pixel_size: float = 1.0,
    keep_open: bool = True,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> PolygonTissue:
    """Read a vertex file of the Bayesian force inference (Ishihara & Sugimura 2012,
    doi:10.1016/j.jtbi.2012.08.017).

    ```python
    tissue = vx.io.read_force_inference("wing.dat").tissue
    ```

    Lines `J[i] x y`, `E[i] v w` and `C[i] n : v1 ... vn` are vertices in pixels, edges, and cells with their
    corners in order; `Ext` marks outer ones. y points up (it is minus the row of the image). Outer cells are
    cut off by the border of the image. Where the file has no edge from the last to the first corner of such a
    cell, the cell is open: see [`from_polygons`][vertax.initialise.from_polygons] for what becomes of it, and
    of points where two or more than three edges meet.

    **Arguments:**

    - `path`: the file.
    - `pixel_size`: length of a pixel side, in the unit of length that the tissue is to have.
    - `keep_open`: keep open cells, closed by a straight side, or leave them out.
    - `inner_arcs`, `softening`: as of [`from_polygons`][vertax.initialise.from_polygons].

    **Returns:** a free [`PolygonTissue`][vertax.initialise.PolygonTissue] with the numbers of cells and
    points in the file.

    **Raises:**

    - `OSError` if the file cannot be read.
    - `ValueError`, naming the file and the line, cell or vertex, for a file of another kind, numbers of
        elements other than in the header, edges that are no side of a cell and sides that are no edge, and as
        [`from_polygons`][vertax.initialise.from_polygons].
    """
    check_number("pixel_size", pixel_size, above=0)
    path = Path(path)
    broken = lambda fact: ValueError(f"{path} is no vertex file of the force inference: {fact}.")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise broken("it is not text") from error
    rows: dict[str, list[re.Match[str]]] = {kind: [] for kind in _LINES}
    for number, line in enumerate(map(str.strip, lines), 1):
        if not line or line.startswith("#"):
            continue
        kind = line[0]
        match = _LINES[kind].fullmatch(line) if kind in _LINES else None
        if match is None:
            raise broken(f"line {number} cannot be read ({line[:40]!r})")
        if int(match[1]) != len(rows[kind]):
            raise broken(
                f"line {number} has the number {match[1]}, and {len(rows[kind])} comes next"
            )
        rows[kind].append(match)
    for kind, name in _COUNTS.items():
        if not rows[kind]:
            raise broken(f"it has no lines {kind}[0] …")
        count = re.search(rf"^#+\s*{name}\s+(\d+)", "\n".join(lines), re.MULTILINE)
        if count is not None and int(count[1]) != len(rows[kind]):
            raise broken(
                f"its header has {name} {count[1]}, but it has {len(rows[kind])} lines {kind}[…]"
            )

    points = pixel_size * np.array([(float(m[2]), float(m[3])) for m in rows["J"]])
    edges = {frozenset((int(m[2]), int(m[3]))) for m in rows["E"]}
    cells, is_open, sides = [], [], set()
    for cell, match in enumerate(rows["C"]):
        corners = [int(word) for word in match[3].split()]
        if len(corners) != int(match[2]):
            raise broken(f"cell {cell} has {len(corners)} corners, and {match[2]} are announced")
        outline = [frozenset(side) for side in zip(corners, corners[1:] + corners[:1], strict=True)]
        is_open.append(match[4] is not None and outline[-1] not in edges)
        outline = outline[:-1] if is_open[-1] else outline
        invalid = next((side for side in outline if side not in edges), None)
        if invalid is not None:
            raise broken(f"the side {sorted(invalid)} of cell {cell} is no edge")
        sides.update(outline)
        cells.append(corners)
    unused = next((side for side in edges if side not in sides), None)
    if unused is not None:
        raise broken(f"the edge {sorted(unused)} is no side of a cell")
    names = Names(f"The cells of {path}", "vertex {}".format, "cell {}".format)
    return tissue_from_corners(
        points,
        cells,
        names,
        box=None,
        open_cells=np.array(is_open),
        keep_open=keep_open,
        inner_arcs=inner_arcs,
        softening=softening,
    )
