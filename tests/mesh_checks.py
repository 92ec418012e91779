"""What every tissue must be, checked by NumPy alone: nothing of vertax but its arrays is used."""

import numpy as np

# Points of an arc, where its crossings with others are sought: few at first, and many if those cross.
_POINTS = (24, 1000)


def check_tissue(tissue, rtol=1e-9):
    """Check connectivity, Euler characteristic, areas and that cells are simple polygons."""
    m = tissue.topology
    twin, cell, frame = (np.asarray(x) for x in (m.twin, m.cell, m.frame))
    edge, half_edge = np.asarray(m.edge), np.asarray(m.half_edge)
    n = tissue.n_cells
    h = np.arange(twin.size)
    assert (twin[twin] == h).all(), "twin is no involution"
    assert (twin != h).all()
    assert (edge[twin] == edge).all()
    assert (edge[half_edge] == np.arange(half_edge.size)).all()
    following = np.where(twin % 3 == 0, twin + 2, twin - 1)
    faces = _faces(following)
    labels = [{int(cell[h]) for h in face} for face in faces]
    assert all(len(label) == 1 for label in labels), "a face of several cells"
    number = np.array([label.pop() for label in labels])
    real = number < n + m.exterior
    assert len(set(number[real].tolist())) == real.sum(), "a cell in several pieces"
    spare = int(np.sum(~real))
    assert all(len(faces[i]) == 2 for i in np.flatnonzero(~real))
    n_vertices = len({v // 3 for i in np.flatnonzero(real) for v in faces[i]})
    n_edges = len({int(edge[k]) for i in np.flatnonzero(real) for k in faces[i]})
    assert n_vertices + 2 * (spare // 3) == twin.size // 3
    assert n_vertices - n_edges + real.sum() == (2 if m.exterior else 0), "Euler characteristic"
    living = np.zeros(n, bool)
    living[number[real & (number < n)]] = True
    assert (living == np.asarray(tissue.alive)).all()

    positions = np.repeat(np.asarray(tissue.vertices, float), 3, axis=0)
    assert np.isfinite(positions).all()
    if not m.exterior:
        positions = positions + frame @ np.asarray(tissue.boundary.lattice, float)
    angles = _angles(tissue, twin, cell, edge, half_edge)
    areas, outside = np.zeros(n), 0.0
    for face, label in zip(faces, number, strict=True):
        if label > n or (label == n and not m.exterior):
            continue
        parts = (positions, following, angles, face)
        area, _ = _outline(*parts, 1)
        crossing = all(_crossing(_outline(*parts, n_points)[1]) for n_points in _POINTS)
        assert not crossing, f"face {label} crosses itself"
        if label == n:
            outside = -area
        else:
            assert area > 0, f"cell {label} is inside out"
            areas[label] = area
    total = outside if m.exterior else np.linalg.det(np.asarray(tissue.boundary.lattice, float))
    size = np.sqrt(np.mean(areas[living]))
    far = 1 + np.abs(positions).max() / size
    np.testing.assert_allclose(areas, tissue.areas, rtol=rtol, atol=rtol * far * size**2)
    assert abs(areas.sum() - total) <= rtol * far * total, "cells do not fill the tissue"


def _faces(following):
    seen, faces = np.zeros(following.size, bool), []
    for start in range(following.size):
        if seen[start]:
            continue
        face, h = [], start
        while not seen[h]:
            seen[h] = True
            face.append(h)
            h = int(following[h])
        assert h == start
        faces.append(face)
    return faces


def _angles(tissue, twin, cell, edge, half_edge):
    """The angle of each half-edge, positive where it bulges to its right."""
    if tissue.angles is None:
        return np.zeros(twin.size)
    angle = np.asarray(tissue.angles, float)
    largest, width = 0.98 * np.pi, 0.02 * np.pi
    beyond = np.maximum(np.abs(angle) - largest, 0)
    bounded = largest + width * beyond / np.hypot(width, beyond)
    angle = np.where(beyond > 0, np.sign(angle) * bounded, angle)
    if not tissue.inner_arcs:
        outer = (cell[half_edge] == tissue.n_cells) | (cell[twin[half_edge]] == tissue.n_cells)
        angle = np.where(outer, angle, 0)
    forward = half_edge[edge] == np.arange(twin.size)
    return np.where(forward, angle[edge], -angle[edge])


def _outline(positions, following, angles, face, n_points):
    """The area of a face by triangles and segments of circles, and points around it."""
    area, points = 0.0, []
    for h in face:
        # (Of a cell in a periodic box all corners are in one frame.)
        start, end = positions[h], positions[following[h]]
        chord, a = end - start, angles[h]
        length = np.linalg.norm(chord)
        origin = positions[face[0]]
        p, q = start - origin, end - origin
        area += 0.5 * (p[0] * q[1] - p[1] * q[0])
        # The sector of a circle without its triangle; or the first terms of that in the angle.
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
    """Whether two sides of a polygon that are no neighbours cross."""
    p, q = points, np.roll(points, -1, axis=0)
    n = len(p)
    d = q - p
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    one = cross(d[:, None], p[None] - p[:, None])  # where other sides begin, seen from each
    two = cross(d[:, None], q[None] - p[:, None])
    scale = 1e-9 * np.abs(d).max() ** 2
    splits = (np.minimum(one, two) < -scale) & (np.maximum(one, two) > scale)
    crosses = splits & splits.T
    i, j = np.nonzero(crosses)
    apart = np.minimum((i - j) % n, (j - i) % n) > 1
    return bool(apart.any())
