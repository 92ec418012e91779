"""Cells and edges for other programs: tables, CSV, GeoJSON and VTK."""

import csv
import json
import os
import sys
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from free_helpers import cluster
from helpers import counted_compilations, random_tissue

import vertax as vx
from vertax.io import cell_table, edge_table, write_csv, write_geojson, write_vtk
from vertax.plotting import cell_polygons


def single(tree):
    return jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree)


def made(name):
    boundary, precision = name.split()
    tissue = random_tissue(7) if boundary == "periodic" else cluster(7)
    return tissue if precision == "float64" else single(tissue)


KINDS = [
    *(pytest.param(f"{b} float32", marks=pytest.mark.thorough) for b in ("periodic", "free")),
    *("periodic float64", "free float64"),
]


@pytest.fixture(scope="module", params=KINDS)
def tissue(request):
    return made(request.param)


@pytest.fixture(scope="module")
def periodic():
    return made("periodic float64")


def test_tables_of_similar_tissues_share_compiled_functions():
    names, tissues = [], [cluster(n) for n in (12, 13)]
    cell_table(tissues[0]), edge_table(tissues[0])
    with counted_compilations(names):
        cell_table(tissues[1]), edge_table(tissues[1])
    assert names == []


def area_of(ring):
    x, y = np.asarray(ring, float)[:, :2].T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


def fan_area(ring):
    """The area of a fan of triangles about the first corner of a polygon."""
    corners = np.asarray(ring, float)[:, :2] - ring[0, :2]
    turns = corners[1:-1, 0] * corners[2:, 1] - corners[1:-1, 1] * corners[2:, 0]
    return 0.5 * np.sum(np.abs(turns))


def tolerance(tissue):
    return 1e-12 if tissue.vertices.dtype == jnp.float64 else 1e-4


class TestTables:
    def test_cells(self, tissue):
        table = cell_table(tissue, kind=np.array(list("abcdefg")))
        np.testing.assert_array_equal(table["cell"], np.arange(7))
        np.testing.assert_array_equal(table["area"], tissue.areas)
        np.testing.assert_array_equal(table["shape_factor"], tissue.shape_factors)
        assert table["area"].dtype == tissue.vertices.dtype
        assert "".join(table["kind"]) == "abcdefg"
        outside = {int(c) for pair in tissue.topology.edge_cells for c in pair if 7 in pair}
        assert set(np.flatnonzero(table["on_outline"])) == outside - {7}
        # Shifted by lattice vectors into the box.
        offset = np.stack([table["x"], table["y"]], axis=1) - np.asarray(tissue.centroids)
        if isinstance(tissue.boundary, vx.Periodic):
            inverse = np.linalg.inv(tissue.boundary.lattice)
            offset = offset @ inverse - np.round(offset @ inverse)
            fractions = np.stack([table["x"], table["y"]], axis=1) @ inverse
            assert (fractions > -1e-5).all()
            assert (fractions < 1).all()
        np.testing.assert_allclose(offset, 0, atol=10 * tolerance(tissue))

    def test_edges(self, tissue):
        table = edge_table(tissue, tension=jnp.ones(tissue.n_edges))
        vector = np.stack(
            [table["end_x"] - table["start_x"], table["end_y"] - table["start_y"]], axis=1
        )
        np.testing.assert_allclose(vector, tissue.edge_vectors, atol=10 * tolerance(tissue))
        np.testing.assert_array_equal(table["length"], tissue.edge_lengths)
        np.testing.assert_array_equal(table["right_cell"] == -1, tissue.topology.on_outline)
        assert (table["left_cell"] >= 0).all()
        np.testing.assert_array_equal(table["start_vertex"], tissue.topology.edge_vertices[:, 0])

    def test_invalid_arguments_raise(self, periodic):
        with pytest.raises(ValueError, match=r"a column `area` already.*Choose another"):
            cell_table(periodic, area=np.ones(7))
        with pytest.raises(
            ValueError, match=r"`p0` must have one entry for each cell, shape \(7,\)"
        ):
            cell_table(periodic, p0=np.ones(6))
        with pytest.raises(
            ValueError, match=r"`t` must have one entry for each edge, shape \(21,\)"
        ):
            edge_table(periodic, t=np.ones((21, 2)))
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), periodic)
        for write in (cell_table, edge_table):
            with pytest.raises(ValueError, match="single tissue"):
                write(batch)


class TestCSV:
    def test_csv_round_trip_is_exact(self, tissue, tmp_path):
        table = cell_table(tissue)
        write_csv(tmp_path / "cells.csv", table)
        with open(tmp_path / "cells.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == list(table)
        for name, column in table.items():
            parse = (lambda x: x == "True") if column.dtype == bool else column.dtype.type
            np.testing.assert_array_equal([parse(row[name]) for row in rows], column)

    def test_missing_numbers_and_text(self, tmp_path):
        table = {"x": [0.1, np.nan, np.inf, -np.inf], "word": ["a", "b,c", 'd"', "µm²"]}
        write_csv(tmp_path / "a.csv", table)
        with open(tmp_path / "a.csv", newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        assert [row[0] for row in rows] == ["x", "0.1", "", "Inf", "-Inf"]
        assert [row[1] for row in rows[1:]] == table["word"]

    def test_invalid_arguments_raise(self, tmp_path):
        with pytest.raises(ValueError, match=r"one length, but they have \{'a': 2, 'b': 3\}"):
            write_csv(tmp_path / "a.csv", {"a": [1, 2], "b": [1, 2, 3]})
        with pytest.raises(ValueError, match=r"`a` has shape \(2, 2\)"):
            write_csv(tmp_path / "a.csv", {"a": np.ones((2, 2))})
        assert os.listdir(tmp_path) == []


def strictly(path):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    return json.loads(path.read_text("utf-8"), parse_constant=refuse)


class TestGeoJSON:
    def test_cells_are_closed_rings_with_properties(self, tissue, tmp_path):
        values = np.linspace(0, 1, 7)
        values[3] = np.nan
        path = tmp_path / "cells.geojson"
        write_geojson(
            path, tissue, cells={"pressure": values, "kind": list("abcdefg")}, points_per_arc=400
        )
        assert os.listdir(tmp_path) == [path.name]
        content = strictly(path)
        assert content["type"] == "FeatureCollection"
        assert len(content["features"]) == 7
        for k, feature in enumerate(content["features"]):
            (ring,) = feature["geometry"]["coordinates"]
            assert feature["geometry"]["type"] == "Polygon"
            assert ring[0] == ring[-1]
            # Counter-clockwise, as RFC 7946 requires.
            np.testing.assert_allclose(area_of(ring[:-1]), tissue.areas[k], rtol=1e-4)
            properties = feature["properties"]
            assert properties["cell"] == k
            assert properties["area"] == float(tissue.areas[k])
            assert properties["pressure"] == (None if k == 3 else values[k])
            assert properties["kind"] == "abcdefg"[k]

    def test_straight_cells_are_those_of_pictures(self, periodic, tmp_path):
        write_geojson(tmp_path / "cells.geojson", periodic)
        polygons, counts = cell_polygons(periodic)
        for k, feature in enumerate(strictly(tmp_path / "cells.geojson")["features"]):
            (ring,) = feature["geometry"]["coordinates"]
            np.testing.assert_array_equal(ring[:-1], polygons[k, : counts[k]])

    def test_edges_are_lines(self, tissue, tmp_path):
        tension = np.arange(tissue.n_edges)
        write_geojson(
            tmp_path / "a.geojson", tissue, edges={"tension": tension}, points_per_arc=200
        )
        features = strictly(tmp_path / "a-edges.geojson")["features"]
        assert [f["properties"]["tension"] for f in features] == tension.tolist()
        lengths = [
            np.sum(np.hypot(*np.diff(f["geometry"]["coordinates"], axis=0).T)) for f in features
        ]
        np.testing.assert_allclose(lengths, tissue.edge_lengths, rtol=1e-3, atol=2e-3)

    def test_invalid_arguments_raise(self, periodic, tmp_path):
        path = tmp_path / "a.geojson"
        lost = periodic.with_vertices(periodic.vertices.at[0].set(jnp.nan))
        with pytest.raises(ValueError, match="finite positions"):
            write_geojson(path, lost)
        with pytest.raises(ValueError, match="`points_per_arc` must be at least 1"):
            write_geojson(path, periodic, points_per_arc=0)
        with pytest.raises(ValueError, match="`p0` must have one entry for each cell"):
            write_geojson(path, periodic, cells={"p0": np.ones(3)})
        assert os.listdir(tmp_path) == []


class TestVTK:
    @pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
    def test_cells(self, tissue, tmp_path, suffix):
        path = tmp_path / f"tissue{suffix}"
        write_vtk(path, tissue, cells={"pressure": jnp.arange(7.0)}, points_per_arc=400)
        assert os.listdir(tmp_path) == [path.name]
        mesh = meshio.read(path)
        rings = [mesh.points[ring] for block in mesh.cells for ring in block.data]
        data = {name: np.concatenate(parts) for name, parts in mesh.cell_data.items()}
        cell = data["cell"]
        assert (np.diff(cell) >= 0).all()
        drawn = np.bincount(cell, [fan_area(ring) for ring in rings])
        np.testing.assert_allclose(drawn, tissue.areas, rtol=1e-4)
        np.testing.assert_array_equal(data["pressure"], cell)
        for name, column in cell_table(tissue).items():
            if name not in ("x", "y"):
                np.testing.assert_array_equal(data[name], column[cell])

    def test_edges(self, tissue, tmp_path):
        tension = np.arange(tissue.n_edges)
        write_vtk(tmp_path / "a.vtu", tissue, edges={"tension": tension}, points_per_arc=50)
        mesh = meshio.read(tmp_path / "a-edges.vtu")
        (block,) = mesh.cells
        (shown,) = mesh.cell_data["tension"]
        assert block.type == "line"
        assert set(shown) == set(range(tissue.n_edges))
        first, last = (mesh.points[block.data[:, k]] for k in (0, 1))
        length = np.bincount(shown, np.linalg.norm(last - first, axis=1))
        # Edges across a periodic boundary occur twice.
        times = np.round(length / np.asarray(tissue.edge_lengths))
        assert set(times) <= ({1, 2} if isinstance(tissue.boundary, vx.Periodic) else {1})
        np.testing.assert_allclose(length, times * tissue.edge_lengths, rtol=1e-3, atol=4e-3)

    def test_invalid_arguments_raise(self, periodic, tmp_path):
        with pytest.raises(ValueError, match=r"`path` must end in \.vtu or \.vtk"):
            write_vtk(tmp_path / "a.obj", periodic)
        with pytest.raises(ValueError, match=r"`kind` must hold numbers or booleans.*<U1"):
            write_vtk(tmp_path / "a.vtu", periodic, cells={"kind": list("abcdefg")})
        with pytest.raises(ValueError, match="`t` must have one entry for each edge"):
            write_vtk(tmp_path / "a.vtu", periodic, edges={"t": np.ones(3)})
        assert os.listdir(tmp_path) == []

    def test_meshio_is_optional(self, periodic, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "meshio", None)
        with pytest.raises(ImportError, match=r'needs meshio: pip install -e "\.\[files\]"'):
            write_vtk(tmp_path / "a.vtu", periodic)


def test_missing_values_are_empty_fields(tmp_path):
    path = tmp_path / "table.csv"
    nan = float("nan")
    table = {
        "float": [1.5, nan, np.inf],
        "none": [1.5, None, "text"],
        "masked": np.ma.masked_array([1, 2, 3], [False, True, False]),
        "date": np.array(["2020-01-01", "NaT", "2020-01-02"], "datetime64[D]"),
        "half": np.array([1.5, nan, 2.0], np.float16),
        "brain": jnp.array([1.5, nan, 2.0], jnp.bfloat16),
    }
    vx.io.write_csv(path, table)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines == [
        "float,none,masked,date,half,brain",
        "1.5,1.5,1,2020-01-01,1.5,1.5",
        ",,,,,",
        "Inf,text,3,2020-01-02,2.0,2.0",
    ]


@pytest.mark.parametrize(
    ("table", "error", "message"),
    [
        ([1, 2], TypeError, "`table` must hold columns by name, .* type list"),
        ({"a": [1j]}, TypeError, "Column `a` must hold numbers, booleans or text, but holds"),
        ({"a": [b"x"]}, TypeError, "Column `a` must hold numbers, booleans or text, but holds"),
        ({"a": [{}]}, TypeError, "Column `a` must hold numbers, booleans or text, but holds"),
        ({"a": [[1], [2, 3]]}, ValueError, "Column `a` must hold one entry a row"),
    ],
)
def test_invalid_tables_raise(tmp_path, table, error, message, without_type_checks):
    path = tmp_path / "table.csv"
    with pytest.raises(error, match=message):
        vx.io.write_csv(path, table)
    assert not path.exists()


@pytest.mark.parametrize("read", [vx.io.cell_table, vx.io.edge_table])
def test_tables_are_of_one_tissue(read, without_type_checks):
    tissue = random_tissue(5)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), tissue)
    with pytest.raises(ValueError, match=r"vertax.fitting.member\(tissue, 0\), one by one"):
        read(batch)
    member = jax.tree.map(lambda x: x[0], batch)  # as the message proposes
    np.testing.assert_array_equal(read(member)["on_outline"], read(tissue)["on_outline"])
    with pytest.raises(TypeError, match=r"`tissue` must be a vertax.Tissue, but is None"):
        read(None)
    with pytest.raises(TypeError, match=r"does not work inside jax.jit.*Call it outside"):
        jax.jit(lambda tissue: read(tissue)["on_outline"])(tissue)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"cells": {"a": np.full(5, 1j)}},
            TypeError,
            "Column `a` must hold .* which JSON can store",
        ),
        (
            {"cells": {"a": np.full(5, b"x")}},
            TypeError,
            "Column `a` must hold .* which JSON can store",
        ),
        ({"cells": np.ones(5)}, TypeError, "Columns of the cells must be given by name"),
        ({"edges": [1]}, TypeError, "Columns of the edges must be given by name"),
        ({"points_per_arc": 1.5}, TypeError, "`points_per_arc` must be at least 1"),
    ],
)
def test_columns_that_json_cannot_hold_raise(
    tmp_path, options, error, message, without_type_checks
):
    path = tmp_path / "cells.geojson"
    with pytest.raises(error, match=message):
        vx.io.write_geojson(path, random_tissue(5), **options)
    assert not path.exists()


def test_dates_are_text_in_geojson(tmp_path):
    path = tmp_path / "cells.geojson"
    dates = np.full(5, "2020-01-02", "datetime64[D]")
    vx.io.write_geojson(path, random_tissue(5), cells={"seen": dates})
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    assert [feature["properties"]["seen"] for feature in features] == ["2020-01-02"] * 5


def test_writers_raise_without_a_tissue(tmp_path, without_type_checks):
    with pytest.raises(TypeError, match=r"`content` must be a tissue, .*, but is 'tissue'"):
        vx.save(tmp_path / "tissue.npz", cast(Any, "tissue"))
    with pytest.raises(TypeError, match=r"`tissue` must be .*Tissue, but is 'tissue'"):
        vx.io.to_tables(cast(Any, "tissue"))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda t: None,
            TypeError,
            "`tables` must be vertax.io.Tables or BoundedTables, but is None",
        ),
        (tuple, TypeError, r"type tuple. Write Tables\(vert_table"),
        (lambda t: t._replace(width="a"), TypeError, "`width` must be one real number, but is 'a'"),
        (lambda t: t._replace(width=np.ones(2)), ValueError, "`width` must be one number"),
        (lambda t: t._replace(height=np.nan), ValueError, "`height` must be positive"),
    ],
)
def test_error_names_invalid_tables(change, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        vx.io.from_tables(change(vx.io.to_tables(random_tissue(5))))


@pytest.mark.parametrize(
    "classes", [["a"], vx.energies.LineTension, [vx.energies.LineTension(1.0)]]
)
def test_error_names_invalid_classes(tmp_path, classes, without_type_checks):
    path = tmp_path / "energy.npz"
    vx.save(path, vx.energies.LineTension(1.0))
    with pytest.raises(TypeError, match="`classes` must"):
        vx.load(path, vx.AbstractEnergy, classes=classes)
