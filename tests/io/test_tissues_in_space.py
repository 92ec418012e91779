"""Foams and tables with three coordinates."""

import itertools
import json

import jax.numpy as jnp
import numpy as np
import pytest
from curved_helpers import foam_at_rest

import vertax as vx
from vertax.surfaces import HeightMap, SphericalCap
from vertax.tensions import infer_tensions

RADIUS, N_CELLS = 3.0, 14


@pytest.fixture(scope="module")
def cluster():
    """Straight edges, and no cell of two sides."""
    tissues = (vx.initialise.free_voronoi(N_CELLS, key=key, lloyd_steps=3) for key in range(9))
    tissue = next(tissue for tissue in tissues if tissue.neighbour_counts.min() > 2)
    centred = tissue.vertices - tissue.vertices.mean(axis=0)
    return vx.Tissue(centred, tissue.topology, tissue.boundary)


@pytest.fixture(scope="module")
def on_cap(cluster):
    return cluster.with_surface(SphericalCap(RADIUS))


@pytest.fixture(scope="module")
def polygons(on_cap):
    """Points in space and the corners of each cell."""
    m = on_cap.topology
    starts = np.asarray(m.cell)
    faces = [np.flatnonzero(starts == cell) for cell in range(on_cap.n_cells)]
    twin = np.asarray(m.twin)
    following = np.where(twin % 3 == 0, twin + 2, twin - 1)
    cells = []
    for face in faces:
        half_edge, corners = face[0], []
        for _ in face:
            corners.append(int(half_edge) // 3)
            half_edge = following[half_edge]
        cells.append(corners)
    return np.asarray(on_cap.surface.points(on_cap.vertices)), cells


def test_a_map_through_points_reproduces_a_paraboloid():
    x = np.random.default_rng(0).uniform(-3, 5, (40, 2))
    height = lambda x: 0.3 * x[:, 0] ** 2 - 0.2 * x[:, 0] * x[:, 1] + x[:, 1] - 2
    surface = HeightMap.through(np.column_stack([x, height(x)]))
    inner = np.random.default_rng(1).uniform(-2, 4, (20, 2))
    np.testing.assert_allclose(surface.points(jnp.asarray(inner))[:, 2], height(inner), atol=1e-5)


@pytest.mark.thorough
def test_the_error_of_a_map_through_points_decreases_with_their_number():
    errors = []
    for n in (100, 400, 1600):
        x = np.random.default_rng(n).uniform(-1, 1, (n, 2))
        cap = SphericalCap(1.6)
        surface = HeightMap.through(cap.points(jnp.asarray(x)))
        inner = jnp.asarray(np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2)))
        errors.append(np.abs(surface.density(inner) / cap.density(inner) - 1).max())
    assert errors[2] < 0.1 * errors[1] < 0.1 * errors[0]
    assert errors[1] < 1e-3


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 2)), r"shape \(points, 3\)"),
        (np.full((5, 3), np.nan), "NaN"),
        (np.ones((2, 3)), "three points that are not on a line"),
        (np.arange(12.0).reshape(4, 3), "three points that are not on a line"),
    ],
)
def test_points_without_a_map_are_rejected(points, message):
    with pytest.raises(ValueError, match=message):
        HeightMap.through(points)


def test_overhangs_are_rejected():
    t = np.linspace(0, 2 * np.pi, 60)
    s = np.linspace(0, 1, 8)[:, None]
    tube = np.stack(np.broadcast_arrays(np.cos(t), s, np.sin(t)), axis=-1).reshape(-1, 3)
    with pytest.raises(ValueError, match="Overhangs"):
        HeightMap.through(tube)


def test_polygons_in_space_make_a_tissue_on_a_surface(polygons, on_cap):
    points, cells = polygons
    result = vx.initialise.from_polygons(points, cells)
    np.testing.assert_allclose(result.tissue.vertices, on_cap.vertices, atol=1e-12)
    np.testing.assert_allclose(result.tissue.areas, on_cap.areas, rtol=5e-3)
    lengths = np.sort(result.tissue.edge_lengths)  # edges have another order
    np.testing.assert_allclose(lengths, np.sort(on_cap.edge_lengths), rtol=1e-3)
    near = vx.initialise.from_polygons(points, cells, tolerance=1e-4)
    np.testing.assert_allclose(near.tissue.areas, result.tissue.areas, rtol=1e-9)
    flat = vx.initialise.from_polygons(np.column_stack([points[:, :2], 0 * points[:, 0]]), cells)
    assert flat.tissue.surface is None


def test_polygons_in_space_that_have_no_chart_are_rejected(polygons):
    points, cells = polygons
    with pytest.raises(ValueError, match="must have one z"):
        vx.initialise.from_polygons(points, cells, inner_arcs=True)
    turned = points[:, [2, 1, 0]]  # seen along x, the cap covers itself
    with pytest.raises(ValueError, match=r"overlap|cross|share"):
        vx.initialise.from_polygons(turned, cells)


def test_geojson_in_space(polygons, on_cap, tmp_path):
    points, cells = polygons
    rings = [points[[*cell, cell[0]]].tolist() for cell in cells]
    shapes = [{"type": "Polygon", "coordinates": [ring]} for ring in rings]
    features = [{"type": "Feature", "geometry": shape, "properties": {}} for shape in shapes]
    (tmp_path / "cells.geojson").write_text(json.dumps({"features": features}))
    result, _ = vx.io.read_geojson(tmp_path / "cells.geojson")
    np.testing.assert_allclose(result.tissue.areas, on_cap.areas, rtol=5e-3)


def test_tables_of_tyssue_in_space(polygons, on_cap):
    points, cells = polygons
    sides = [
        (a, b, face)
        for face, c in enumerate(cells)
        for a, b in zip(c, np.roll(c, -1), strict=False)
    ]
    srce, trgt, face = np.array(sides).T
    tables = {
        "vert": dict(zip("xyz", points.T, strict=True)),
        "edge": {"srce": srce, "trgt": trgt, "face": face},
    }
    result = vx.io.from_tyssue(tables)
    np.testing.assert_allclose(result.tissue.areas, on_cap.areas, rtol=5e-3)
    with pytest.raises(ValueError, match="must have one z"):
        vx.io.from_tyssue(tables, inner_arcs=True)


@pytest.mark.thorough
def test_edge_tables_in_space(on_cap):
    table = dict(vx.io.edge_table(on_cap))
    for end in ("start", "end"):
        xy = np.column_stack([table[f"{end}_x"], table[f"{end}_y"]])
        table[f"{end}_z"] = np.asarray(on_cap.surface.points(jnp.asarray(xy)))[:, 2]
    again = vx.io.from_edge_table(table)
    np.testing.assert_allclose(again.areas, on_cap.areas, rtol=5e-3)
    straight = infer_tensions(again, edges="straight").tensions
    expected = infer_tensions(on_cap, edges="straight").tensions
    np.testing.assert_allclose(straight, expected, atol=0.05)
    with pytest.raises(ValueError, match="arcs"):
        vx.io.from_edge_table(table | {"angle": 0.1 + 0 * table["angle"]})


@pytest.fixture(scope="module")
def foam(cluster):
    """A foam at rest in the plane, its tensions, and 12 pieces of each edge."""
    return foam_at_rest(cluster)


def evolver_file(rest, tension, to_space):
    """The file of a foam with its points mapped to space."""
    m = rest.topology
    fractions = jnp.linspace(0, 1, 13)[1:-1]
    inner = np.asarray(rest.edge_points(fractions))
    points, edges = list(np.asarray(rest.vertices)), []
    pieces = []
    for edge, (start, end) in enumerate(np.asarray(m.edge_vertices).tolist()):
        numbers = [start, *range(len(points), len(points) + 11), end]
        points += list(inner[edge])
        pieces.append(range(len(edges), len(edges) + 12))
        edges += [(a, b, tension[edge]) for a, b in itertools.pairwise(numbers)]
    twin, edge_of, first = (np.asarray(x) for x in (m.twin, m.edge, m.half_edge))
    following = np.where(twin % 3 == 0, twin + 2, twin - 1)
    faces = []
    for cell in range(rest.n_cells):
        start = half_edge = int(np.flatnonzero(np.asarray(m.cell) == cell)[0])
        loop: list[int] = []
        while not loop or half_edge != start:
            chain = [piece + 1 for piece in pieces[edge_of[half_edge]]]
            forward = first[edge_of[half_edge]] == half_edge
            loop += chain if forward else [-piece for piece in reversed(chain)]
            half_edge = int(following[half_edge])
        faces.append(loop)
    places = to_space(np.array(points))
    rows = lambda values: [f"{i} " + " ".join(map(str, v)) for i, v in enumerate(values, 1)]
    dimension = f"SPACE_DIMENSION {places.shape[1]}\nSTRING\n"
    lines = [*rows(places.tolist()), "edges"]
    lines += rows([(a + 1, b + 1, "density", t) for a, b, t in edges])
    lines += ["faces", *rows(faces), "bodies", *rows([(k + 1,) for k in range(len(faces))])]
    return dimension + "vertices\n" + "\n".join(lines) + "\nread\n"


def stereographic(x):
    """The map of the plane to a sphere, which keeps angles and circles."""
    squared = np.sum(x**2, axis=1, keepdims=True) / (4 * RADIUS**2)
    return np.concatenate([x, RADIUS * (1 - squared)], axis=1) / (1 + squared)


@pytest.mark.thorough
def test_tensions_of_a_foam_on_a_cap(foam, tmp_path):
    rest, tension = foam
    path = tmp_path / "cap.fe"
    path.write_text(evolver_file(rest, tension, stereographic))
    read = vx.io.read_surface_evolver(path)
    assert read.surface is not None
    exact = SphericalCap(RADIUS)
    place = read.tissue.vertices
    np.testing.assert_allclose(read.surface.points(place), exact.points(place), atol=1e-3)
    density = exact.density(read.tissue.centroids)
    np.testing.assert_allclose(read.target_areas, read.tissue.areas * density, rtol=0.05)

    def error(result, source):
        true = np.asarray(source.tensions)[result.determined]
        inferred = result.tensions[result.determined]
        return np.sqrt(np.mean((inferred / inferred.mean() / (true / true.mean()) - 1) ** 2))

    lifted = infer_tensions(path)
    assert lifted.curved is not None
    np.testing.assert_allclose(lifted.curved.areas, read.target_areas, rtol=0.01)
    (tmp_path / "plane.fe").write_text(evolver_file(rest, tension, lambda x: x))
    plane = vx.io.read_surface_evolver(tmp_path / "plane.fe")
    assert plane.surface is None
    (tmp_path / "view.fe").write_text(
        evolver_file(rest, tension, lambda x: stereographic(x)[:, :2])
    )
    view = vx.io.read_surface_evolver(tmp_path / "view.fe")
    planar, projected = (error(infer_tensions(source), source) for source in (plane, view))
    assert error(lifted, read) < planar + 0.01
    assert projected > 3 * error(lifted, read)


@pytest.mark.thorough
def test_files_of_foams_in_space(foam, tmp_path):
    path, (rest, tension) = tmp_path / "foam.fe", foam
    level = evolver_file(rest, tension, lambda x: np.column_stack([x, np.full(len(x), 2.0)]))
    path.write_text(level)
    assert vx.io.read_surface_evolver(path).surface is None
    # Without a dimension, the space of Surface Evolver has three.
    curved = evolver_file(rest, tension, stereographic)
    path.write_text(curved.replace("SPACE_DIMENSION 3\n", ""))
    assert vx.io.read_surface_evolver(path).surface is not None
    rolled = lambda x: np.column_stack([np.sin(2 * x[:, 0]), x[:, 1], np.cos(2 * x[:, 0])])
    path.write_text(evolver_file(rest, tension, rolled))
    with pytest.raises(ValueError, match=r"foam.fe is not a foam without overhangs"):
        vx.io.read_surface_evolver(path)
    path.write_text(curved.replace("SPACE_DIMENSION 3", "SPACE_DIMENSION 4"))
    with pytest.raises(ValueError, match="4 dimensions"):
        vx.io.read_surface_evolver(path)
