"""Invariants of a tissue, checked in NumPy from its arrays, independently of vertax."""

import numpy as np

# Points per arc in tests for crossings; the second number is used only if the first polygons cross.
_POINTS = (24, 1000)


def check_tissue(tissue, rtol=1e-9):
    """Check connectivity, Euler characteristic, areas and that cells are simple polygons."""
    m = tissue.topology
    twin, cell, frame = (np.asarray(x) for x in (m.twin, m.cell, m.frame))
    edge, half_edge = np.asarray(m.edge), np.asarray(m.half_edge)
    n = tissue.n_cells
    h = np.arange(twin.size)
    assert (twin[twin] == h).all(), "twin is not an involution"
    assert (twin != h).all()
    assert (edge[twin] == edge).all()
    assert (edge[half_edge] == np.arange(half_edge.size)).all()
    following = np.where(twin % 3 == 0, twin + 2, twin - 1)
    faces = _faces(following)
    labels = [{int(cell[h]) for h in face} for face in faces]
    assert all(len(label) == 1 for label in labels), "a face of several cells"
    number = np.array([label.pop() for label in labels])
    used = number < n + m.exterior
    assert len(set(number[used].tolist())) == used.sum(), "a cell with several faces"
    n_spare_faces = int(np.sum(~used))
    assert all(len(faces[i]) == 2 for i in np.flatnonzero(~used))
    n_vertices = len({v // 3 for i in np.flatnonzero(used) for v in faces[i]})
    n_edges = len({int(edge[k]) for i in np.flatnonzero(used) for k in faces[i]})
    assert n_vertices + 2 * (n_spare_faces // 3) == twin.size // 3
    assert n_vertices - n_edges + used.sum() == (2 if m.exterior else 0), "Euler characteristic"
    alive = np.zeros(n, bool)
    alive[number[used & (number < n)]] = True
    assert (alive == np.asarray(tissue.alive)).all()

    positions = np.repeat(np.asarray(tissue.vertices, float), 3, axis=0)
    assert np.isfinite(positions).all()
    if not m.exterior:
        positions = positions + frame @ np.asarray(tissue.boundary.lattice, float)
    angles = _angles(tissue, twin, cell, edge, half_edge)
    areas, tissue_area = np.zeros(n), 0.0
    for face, label in zip(faces, number, strict=True):
        if label > n or (label == n and not m.exterior):
            continue
        parts = (positions, following, angles, face)
        area, _ = _outline(*parts, 1)
        crossing = all(_crossing(_outline(*parts, n_points)[1]) for n_points in _POINTS)
        assert not crossing, f"face {label} crosses itself"
        if label == n:
            tissue_area = -area
        else:
            assert area > 0, f"cell {label} is inside out"
            areas[label] = area
    total = tissue_area if m.exterior else np.linalg.det(np.asarray(tissue.boundary.lattice, float))
    size = np.sqrt(np.mean(areas[alive]))
    distance = 1 + np.abs(positions).max() / size  # from the origin; scales the rounding error
    np.testing.assert_allclose(areas, tissue.areas, rtol=rtol, atol=rtol * distance * size**2)
    assert abs(areas.sum() - total) <= rtol * distance * total, "cells do not fill the tissue"


def _faces(following):
    visited, faces = np.zeros(following.size, bool), []
    for start in range(following.size):
        if visited[start]:
            continue
        face, h = [], start
        while not visited[h]:
            visited[h] = True
            face.append(h)
            h = int(following[h])
        assert h == start
        faces.append(face)
    return faces


def _angles(tissue, twin, cell, edge, half_edge):
    """The angle of each half-edge, positive if it bulges to its right."""
    if tissue.angles is None:
        return np.zeros(twin.size)
    angle = np.asarray(tissue.angles, float)
    largest, width = 0.98 * np.pi, 0.02 * np.pi
    excess = np.maximum(np.abs(angle) - largest, 0)
    bounded = largest + width * excess / np.hypot(width, excess)
    angle = np.where(excess > 0, np.sign(angle) * bounded, angle)
    if not tissue.inner_arcs:
        outer = (cell[half_edge] == tissue.n_cells) | (cell[twin[half_edge]] == tissue.n_cells)
        angle = np.where(outer, angle, 0)
    forward = half_edge[edge] == np.arange(twin.size)
    return np.where(forward, angle[edge], -angle[edge])


def _outline(positions, following, angles, face, n_points):
    """The area of a face from triangles and circular segments, and the points of its outline."""
    area, points = 0.0, []
    for h in face:
        # (All corners of a cell are in one frame.)
        start, end = positions[h], positions[following[h]]
        chord, a = end - start, angles[h]
        length = np.linalg.norm(chord)
        origin = positions[face[0]]
        p, q = start - origin, end - origin
        area += 0.5 * (p[0] * q[1] - p[1] * q[0])
        # The area of the circular segment; for small angles its power series.
        if abs(a) < 0.01:
            area += length**2 * (a / 6 + a**3 / 45)
        else:
            area += (0.5 * length / np.sin(a)) ** 2 * (a - np.sin(a) * np.cos(a))
        if abs(a) < 1e-5:
            points.append(start)
            continue
        radius = length / (2 * np.sin(a))
        left = np.array([-chord[1], chord[0]]) / length
        centre = start + 0.5 * chord + left * radius * np.cos(a)
        turn = 2 * a * np.arange(n_points) / n_points
        arm = start - centre
        x = np.cos(turn) * arm[0] - np.sin(turn) * arm[1]
        y = np.sin(turn) * arm[0] + np.cos(turn) * arm[1]
        points.extend(centre + np.stack([x, y], axis=1))
    return area, np.array(points)


def _crossing(points):
    """Whether two sides of a polygon cross that are not adjacent."""
    p, q = points, np.roll(points, -1, axis=0)
    n = len(p)
    d = q - p
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    # Whether the line of each side separates the ends of each other side.
    start = cross(d[:, None], p[None] - p[:, None])
    end = cross(d[:, None], q[None] - p[:, None])
    scale = 1e-9 * np.abs(d).max() ** 2
    separates = (np.minimum(start, end) < -scale) & (np.maximum(start, end) > scale)
    crosses = separates & separates.T
    i, j = np.nonzero(crosses)
    apart = np.minimum((i - j) % n, (j - i) % n) > 1
    return bool(apart.any())
