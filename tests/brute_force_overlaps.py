"""Overlaps of a tissue by brute force, independently of the library."""

import numpy as np

import vertax as vx


def faces_that_overlap(tissue: vx.Tissue, points: int = 48) -> list[int]:
    """The faces (the exterior last) with an outline that crosses itself or is inside out.

    Arcs are replaced by polygons with `points` corners.
    """
    m = tissue.topology
    following, cell = np.asarray(m.next), np.asarray(m.cell)
    vertices, lattice = np.asarray(tissue.vertices), np.zeros((2, 2))
    if isinstance(tissue.boundary, vx.Periodic):
        lattice = np.asarray(tissue.boundary.lattice)
    start = np.repeat(vertices, 3, axis=0) + np.asarray(m.frame) @ lattice
    angles = np.where(m.forward, 1, -1) * np.asarray(tissue.edge_angles)[np.asarray(m.edge)]
    bad = []
    for face in range(m.n_faces):
        first = h = int(np.flatnonzero(cell == face)[0])
        outline = []
        while True:
            outline.append(side_points(start[h], start[following[h]], angles[h], points))
            h = int(following[h])
            if h == first:
                break
        polygon = np.concatenate(outline)
        x, y = polygon.T
        area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        if (area > 0) == (face == m.n_cells) or _crosses_itself(polygon):
            bad.append(face)
    return bad


def side_points(p: np.ndarray, q: np.ndarray, angle: float, points: int) -> np.ndarray:
    """Points on an arc from p (included) to q (excluded) that bulges to the right of its chord.

    They are closer at the ends: two arcs that touch at a common end may cross next to it.
    """
    if abs(angle) < 1e-9:
        return p[None]
    chord = q - p
    right = np.array([chord[1], -chord[0]])
    centre = 0.5 * (p + q) - right * 0.5 / np.tan(angle)
    turn = angle * (1 - np.cos(np.linspace(0, np.pi, points, endpoint=False)))
    x, y = (p - centre).T
    return centre + np.stack(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=-1
    )


def _crosses_itself(polygon: np.ndarray) -> bool:
    p, u = polygon, np.roll(polygon, -1, axis=0) - polygon
    side = lambda a, b: np.sign(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    w = p[None] - p[:, None]
    ends = side(u[:, None], w) * side(u[:, None], w + u[None])
    crossed = (ends < 0) & (ends.T < 0)
    n = len(p)
    apart = np.abs(np.arange(n)[:, None] - np.arange(n)) % (n - 1) > 1
    return bool(np.any(crossed & apart))
