"""Tables read from files: those of vertax, of tyssue, and of the Bayesian force inference."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import vertax as vx

WINGS = Path(__file__).parents[3] / "shared" / "data" / "wings"
FREE = vx.initialise.free_voronoi(12, key=4, lloyd_steps=2)
FOAM = vx.initialise.free_voronoi(8, key=5, lloyd_steps=2, inner_arcs=True)
FOAM = FOAM.with_angles(
    FOAM.edge_angles + 0.1 * jax.random.normal(jax.random.key(0), (FOAM.n_edges,))
)
PERIODIC = vx.initialise.periodic_voronoi(9, key=6, lattice=np.array([[3.0, 0.0], [1.0, 3.0]]))
BOX = PERIODIC.boundary.lattice


def assert_same(one: vx.Tissue, other: vx.Tissue, atol: float = 0.0) -> None:
    """The same cells, edges, vertices and geometry, but for the first half-edge of each vertex."""
    m, n = one.topology, other.topology
    np.testing.assert_array_equal(m.edge_cells, n.edge_cells)
    np.testing.assert_array_equal(m.edge_vertices, n.edge_vertices)
    np.testing.assert_array_equal(m.neighbour_counts, n.neighbour_counts)
    np.testing.assert_array_equal(one.edge_angles, other.edge_angles)
    assert one.inner_arcs == other.inner_arcs
    np.testing.assert_allclose(one.edge_vectors, other.edge_vectors, rtol=0, atol=atol)
    np.testing.assert_allclose(one.areas, other.areas, rtol=1e-13)
    if atol == 0:
        np.testing.assert_array_equal(one.vertices, other.vertices)


@pytest.mark.parametrize("tissue", [FREE, FOAM], ids=["free", "foam"])
@pytest.mark.parametrize("suffix", ["csv", "geojson"])
def test_edges_of_a_free_tissue_are_read_exactly(tmp_path, tissue, suffix):
    path = tmp_path / f"tissue-edges.{suffix}"
    if suffix == "csv":
        vx.io.write_csv(path, vx.io.edge_table(tissue))
    else:
        vx.io.write_geojson(tmp_path / "tissue.geojson", tissue, edges={})
    table = vx.io.read_table(path)
    for name, column in vx.io.edge_table(tissue).items():
        np.testing.assert_array_equal(table[name], column)
    again = vx.io.from_edge_table(table)
    assert_same(again, tissue)
    for name, column in vx.io.edge_table(again).items():
        # (Lengths depend on the softening, which a table does not hold.)
        np.testing.assert_allclose(table[name], column, rtol=1e-5 if name == "length" else 0)


@pytest.mark.parametrize("n_cells", [1, 2, 9])
def test_edges_of_a_periodic_tissue(tmp_path, n_cells):
    tissue = vx.initialise.periodic_voronoi(n_cells, key=n_cells)
    path = tmp_path / "edges.csv"
    vx.io.write_csv(path, vx.io.edge_table(tissue))
    again = vx.io.from_edge_table(vx.io.read_table(path), box=tissue.boundary.lattice)
    assert_same(again, tissue, atol=1e-14)
    fractions = np.asarray(again.vertices) @ np.linalg.inv(np.asarray(tissue.boundary.lattice))
    assert np.all((fractions >= -1e-12) & (fractions < 1 + 1e-12))


def test_edge_table_omits_spare_slots():
    tissue = PERIODIC.with_capacity(11)
    again = vx.io.from_edge_table(vx.io.edge_table(tissue), box=BOX)
    assert_same(again, PERIODIC, atol=1e-14)


@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=True, allow_infinity=True),
            st.integers(-(2**63), 2**63 - 1),
            st.booleans(),
            st.text("ab ;\t,\"'ä\n", min_size=1),
        ),
        min_size=1,
        max_size=5,
    )
)
@settings(max_examples=30, deadline=None)
def test_columns_are_read_as_they_were_written(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("tables") / "table.csv"
    x, count, flag, label = (list(column) for column in zip(*rows, strict=True))
    table = {
        "x": np.array(x),
        "count": np.array(count),
        "flag": np.array(flag),
        "label": np.array(label),
    }
    vx.io.write_csv(path, table)
    for name, column in vx.io.read_table(path).items():
        np.testing.assert_array_equal(column, table[name])
        assert column.dtype.kind == table[name].dtype.kind


def test_missing_values(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text('"","a","b","c"\n"1",NA,2,x\n"2",1,,\n', encoding="utf-8")  # as R writes it
    table = vx.io.read_table(path)
    np.testing.assert_array_equal(table["a"], [np.nan, 1])
    np.testing.assert_array_equal(table["b"], [2, np.nan])
    np.testing.assert_array_equal(table["c"], ["x", ""])
    path = tmp_path / "table.geojson"
    cells = {"p": np.where(np.arange(12) == 3, np.nan, 0.1), "name": np.array(list("abcdefghijkl"))}
    vx.io.write_geojson(path, FREE, cells=cells)
    table = vx.io.read_table(path)
    np.testing.assert_array_equal(table["p"], cells["p"])
    np.testing.assert_array_equal(table["name"], cells["name"])
    np.testing.assert_array_equal(table["area"], FREE.areas)


@pytest.mark.parametrize(
    "text",
    [
        "x, y ,label\n1.5, 2,a;b\n,3,c\n",
        "x;y;label\n1,5;2;a;b\n;3;c\n".replace("a;b", '"a;b"'),
        "x\ty\tlabel\n1.5\t2\ta;b\n\t3\tc\n",
        'x;y;label\n1.5;2;"a;b"\n;3;c\n',
    ],
)
def test_separators_and_decimal_commas_are_recognised(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    table = vx.io.read_table(path)
    assert list(table) == ["x", "y", "label"]
    np.testing.assert_array_equal(table["x"], [1.5, np.nan])
    np.testing.assert_array_equal(table["y"], [2, 3])
    np.testing.assert_array_equal(table["label"], ["a;b", "c"])


def test_lists_of_features_and_nested_properties_are_read(tmp_path):
    path = tmp_path / "cells.geojson"
    vx.io.write_geojson(path, FREE)
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    for number, feature in enumerate(features):
        feature["properties"] = {
            "id": number,
            "classification": {"name": "a", "colour": [1, 2, 3]},
        }
    polygon = features[3]["geometry"]
    point = {"type": "Point", "coordinates": [0, 0]}
    features[3]["geometry"] = {"type": "GeometryCollection", "geometries": [point, polygon]}
    features.insert(2, {"type": "Feature", "geometry": None, "properties": None})
    path.write_text(json.dumps(features), encoding="utf-8")
    lists = pytest.warns(UserWarning, match=r"hold lists are left out: `classification\.colour`")
    with lists, pytest.warns(UserWarning, match=r"without a polygon, .* are left out: 2\."):
        polygons, table = vx.io.read_geojson(path)
    np.testing.assert_allclose(polygons.tissue.areas, FREE.areas, rtol=1e-2)
    np.testing.assert_array_equal(table["id"], np.arange(FREE.n_cells))
    assert set(table) == {"id", "classification.name"}
    with pytest.warns(UserWarning, match="hold lists"):
        rows = vx.io.read_table(path)
    assert np.isnan(rows["id"][2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("a,a\n1,2\n", "two columns have the same name, `a`"),
        ("x,y,name\n(µm),(µm),\nX,Y,\n1,2,a\n", "row 2 below the names .* delete further rows"),
        ("a,b\n1,2\n3\n", "row 2 has 1 fields, and there are 2 columns"),
    ],
)
def test_broken_tables_are_refused(tmp_path, text, message):
    path = tmp_path / "broken.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=rf"broken.csv is no CSV table: {message}"):
        vx.io.read_table(path)


def test_tables_that_are_no_edges_are_refused():
    table = vx.io.edge_table(FREE)
    missing = {name: column for name, column in table.items() if name != "angle"}
    with pytest.raises(ValueError, match="must have a column `angle`, but its columns are: edge, "):
        vx.io.from_edge_table(missing)
    with pytest.raises(ValueError, match=r"three edges at each vertex, but has [12] at vertex"):
        vx.io.from_edge_table({name: column[1:] for name, column in table.items()})
    with pytest.raises(ValueError, match="`box` must be left out for a free tissue"):
        vx.io.from_edge_table(table, box=(4, 4))
    with pytest.raises(ValueError, match="`box` is needed for a periodic tissue"):
        vx.io.from_edge_table(vx.io.edge_table(PERIODIC))
    for factor, message in (
        (1.5, "`box` must be the box of the table"),
        (0.5, "cover the box once"),
    ):
        with pytest.raises(ValueError, match=message):
            vx.io.from_edge_table(vx.io.edge_table(PERIODIC), box=factor * BOX)
    swapped = table | {"left_cell": table["right_cell"], "right_cell": table["left_cell"]}
    with pytest.raises(ValueError, match=r"-1 only on the right, but row \d+ has -1"):
        vx.io.from_edge_table(swapped)
    wrong = table | {"left_cell": np.roll(table["left_cell"], 1)}
    with pytest.raises(ValueError, match=r"the cells at vertex \d+ contradict each other"):
        vx.io.from_edge_table(wrong)
    with pytest.raises(ValueError, match=r"`left_cell` .* must hold integers"):
        vx.io.from_edge_table(table | {"left_cell": table["left_cell"] + 0.5})


@pytest.mark.parametrize("tissue", [FREE, PERIODIC], ids=["free", "periodic"])
def test_polygons_of_a_geojson_file(tmp_path, tissue):
    path = tmp_path / "cells.geojson"
    names = np.array([f"cell-{number}" for number in range(tissue.n_cells)])
    vx.io.write_geojson(path, tissue, cells={"name": names}, points_per_arc=96)
    box = None if tissue is FREE else BOX
    polygons, table = vx.io.read_geojson(path, box=box)
    np.testing.assert_array_equal(table["name"], names)
    again = polygons.tissue
    assert (again.n_cells, again.n_edges) == (tissue.n_cells, tissue.n_edges)
    np.testing.assert_array_equal(again.neighbour_counts, tissue.neighbour_counts)
    np.testing.assert_allclose(again.areas, tissue.areas, rtol=1e-12 if box is not None else 1e-3)
    np.testing.assert_allclose(np.sort(again.edge_lengths), np.sort(tissue.edge_lengths), rtol=1e-3)


def test_rounded_polygons_of_a_geojson_file_need_a_tolerance(tmp_path):
    path = tmp_path / "cells.geojson"
    vx.io.write_geojson(path, PERIODIC)
    content = json.loads(path.read_text())
    for number, feature in enumerate(content["features"]):
        ring = np.array(feature["geometry"]["coordinates"][0]) + 1e-4 * np.sin(number)
        feature["geometry"]["coordinates"] = [np.round(ring, 4).tolist()]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"polygons of .* Pass `tolerance=0\.0005`"):
        vx.io.read_geojson(path, box=BOX)
    again = vx.io.read_geojson(path, box=BOX, tolerance=5e-4)[0].tissue
    np.testing.assert_array_equal(again.neighbour_counts, PERIODIC.neighbour_counts)
    np.testing.assert_allclose(again.areas, PERIODIC.areas, atol=1e-2)


def test_features_that_are_no_cells_are_refused(tmp_path):
    path = tmp_path / "cells.geojson"
    vx.io.write_geojson(path, FREE, edges={})
    with pytest.raises(ValueError, match=r"feature 0 is a line.*from_edge_table"):
        vx.io.read_geojson(tmp_path / "cells-edges.geojson")
    content = json.loads(path.read_text())

    def refused(message: str, **geometry) -> None:
        features = [content["features"][0] | {"geometry": geometry}, *content["features"][1:]]
        path.write_text(json.dumps({"features": features}), encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            vx.io.read_geojson(path)

    ring = content["features"][0]["geometry"]["coordinates"][0]
    refused("feature 0 has 1", type="Polygon", coordinates=[ring, ring])
    refused("feature 0 is of type Point", type="Point", coordinates=[0, 0])
    refused("feature 0 are no pairs", type="Polygon", coordinates=[["a"]])
    refused("three corners or more", type="Polygon", coordinates=[ring[:2]])
    shifted = [[x + 0.01, y] for x, y in ring]
    refused("polygons of .*cells.geojson must", type="Polygon", coordinates=[shifted])
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match="no list `features`"):
        vx.io.read_geojson(path)


def tyssue_tables(tissue: vx.Tissue, first: int = 0) -> dict[str, dict[str, np.ndarray]]:
    """The tables that tyssue has for a tissue, rows of vertices, edges and faces numbered from `first`."""
    m = tissue.topology
    inside = np.flatnonzero(np.asarray(m.cell) < tissue.n_cells)
    source, target, cell = (np.asarray(x)[inside] for x in (m.source, m.target, m.cell))
    x, y = np.asarray(tissue.vertices).T
    number = lambda n: first + np.arange(n)
    return {
        "vert": {"vert": number(len(x)), "x": x, "y": y, "z": 0 * x},
        "edge": {"edge": number(len(cell)), "srce": source + first, "trgt": target + first}
        | {"face": cell + first, "half_edge": inside},
        "face": {"face": number(tissue.n_cells)},
    }


@pytest.mark.parametrize("first", [0, 7])
def test_tables_of_tyssue(tmp_path, first):
    clusters = (vx.initialise.free_voronoi(12, key=key, lloyd_steps=2) for key in range(9))
    tissue = next(cluster for cluster in clusters if cluster.neighbour_counts.min() > 2)
    tissue = tissue.with_angles(jnp.zeros(tissue.n_edges))
    tables = tyssue_tables(tissue, first)
    polygons = vx.io.from_tyssue(tables)
    np.testing.assert_array_equal(polygons.tissue.vertices, tissue.vertices)
    np.testing.assert_allclose(polygons.tissue.areas, tissue.areas, rtol=1e-12)
    # Each row of the edge table lies between the same two cells.
    rows = np.asarray(tissue.topology.edge)[tables["edge"]["half_edge"]]
    expected = np.sort(np.asarray(tissue.topology.edge_cells)[rows], axis=1)
    actual = np.asarray(polygons.tissue.topology.edge_cells)[polygons.side_edges]
    np.testing.assert_array_equal(np.sort(actual, axis=1), expected)
    paths = {name: tmp_path / f"{name}.csv" for name in tables}
    for name, path in paths.items():
        vx.io.write_csv(path, tables[name])
    from_files = vx.io.from_tyssue(paths)
    np.testing.assert_array_equal(from_files.tissue.vertices, tissue.vertices)
    np.testing.assert_array_equal(from_files.side_edges, polygons.side_edges)


def test_periodic_tables_of_tyssue():
    tissue = vx.initialise.periodic_voronoi(30, key=8, lattice=np.diag([6.0, 5.0]))
    polygons = vx.io.from_tyssue(tyssue_tables(tissue), box=(6, 5))
    np.testing.assert_allclose(polygons.tissue.areas, tissue.areas, rtol=1e-12)


def test_tables_that_are_not_those_of_tyssue_are_refused():
    tables = tyssue_tables(FREE, 7)
    vert, edge = tables["vert"], tables["edge"]

    def refused(message: str, **change) -> None:
        with pytest.raises(ValueError, match=message):
            vx.io.from_tyssue(tables | change)

    with pytest.raises(ValueError, match="tables vert, edge and face, but has no edge"):
        vx.io.from_tyssue({"vert": vert})
    refused("`vert` must have a column `y`", vert={"x": vert["x"]})
    refused(
        "`srce` of table `edge` must hold numbers of rows of table `vert`, but holds 0",
        edge=edge | {"srce": 0 * edge["srce"]},
    )
    refused("face 19 has none", face={"face": np.arange(7, 20)})
    refused(r"those of face \d+ make no closed outline", edge={k: v[1:] for k, v in edge.items()})


@pytest.mark.usefixtures("without_type_checks")
def test_something_else_than_tables_is_refused():
    with pytest.raises(TypeError, match=r"such as sheet.datasets"):
        vx.io.from_tyssue("sheet.hf5")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="`table` must hold columns by name"):
        vx.io.from_edge_table(7)  # pyright: ignore[reportArgumentType]


CLUSTER = """# a comment
### C_NUM 2
### E_NUM 7
### V_NUM 6
J[0] 0.0 0.0
J[1] 10 0
J[2] 20 0 Ext
J[3] 20 -10 Ext
J[4] 10 -10
J[5] 0 -10
E[0] 0 1
E[1] 1 4
E[2] 4 5
E[3] 5 0
E[4] 1 2 Ext
E[5] 3 4 Ext
E[6] 2 3 Ext
C[0] 4 : 0 1 4 5
C[1] 4 : 2 3 4 1 Ext
"""


def test_a_vertex_file(tmp_path):
    path = tmp_path / "wing.dat"
    path.write_text(CLUSTER, encoding="utf-8")
    closed = vx.io.read_force_inference(path, pixel_size=0.5)
    np.testing.assert_allclose(closed.tissue.areas, 25, rtol=1e-12)
    assert not closed.open_cells.any()
    # Without its outer edge cell 1 is open. Its last side is the one from vertex 3 to vertex 2.
    text = CLUSTER.replace("E[6] 2 3 Ext\n", "").replace("E_NUM 7", "E_NUM 6")
    path.write_text(text.replace("2 3 4 1 Ext", "3 4 1 2 Ext"), encoding="utf-8")
    opened = vx.io.read_force_inference(path)
    np.testing.assert_array_equal(opened.open_cells, [False, True])
    assert opened.closing_edges.sum() == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("J[1] 10 0", "J[1] 10", "line 6 cannot be read"),
        ("J[1] 10 0", "J[2] 10 0", "line 6 has the number 2, and 1 comes next"),
        ("V_NUM 6", "V_NUM 7", "V_NUM 7, but it has 6 lines J"),
        ("C[1] 4", "C[1] 5", "cell 1 has 4 corners, and 5 are announced"),
        ("C[0] 4 : 0 1 4 5", "C[0] 4 : 0 4 1 5", r"the side \[0, 4\] of cell 0 is no edge"),
        ("C[1] 4 : 2 3 4 1 Ext", "C[1] 3 : 2 3 4 Ext", r"the edge \[1, 2\] is no side of a cell"),
        (CLUSTER, "", r"no lines J\[0\]"),
    ],
)
def test_a_broken_vertex_file_is_refused(tmp_path, old, new, message):
    path = tmp_path / "wing.dat"
    path.write_text(CLUSTER.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        vx.io.read_force_inference(path)


@pytest.mark.thorough
@pytest.mark.skipif(not WINGS.exists(), reason="the folder shared/data/wings is not there")
def test_wings():
    paths = sorted(WINGS.glob("*.dat"))
    assert len(paths) == 12
    for path in paths:
        header = dict(line.split()[1:] for line in path.read_text().splitlines()[1:10])
        wing = vx.io.read_force_inference(path)
        tissue = wing.tissue
        assert tissue.n_cells == int(header["C_NUM"])
        assert wing.open_cells.sum() == int(header["EX_CNUM"])
        # Each open cell adds one edge, and each four-fold point a vertex and an edge.
        assert tissue.n_vertices == int(header["V_NUM"]) + len(wing.split_points)
        added = int(header["EX_CNUM"]) + len(wing.split_points)
        assert tissue.n_edges == int(header["E_NUM"]) + added
        assert len(wing.removed_points) == 0
        assert not wing.flattened_edges.any()
        outline = np.asarray(tissue.topology.on_outline)
        np.testing.assert_array_equal(outline, wing.closing_edges)
        assert (np.asarray(tissue.areas) > 0).all()


@pytest.mark.skipif(not WINGS.exists(), reason="the folder shared/data/wings is not there")
def test_closed_cells_of_a_wing():
    wing = vx.io.read_force_inference(WINGS / "100309-06.dat", keep_open=False)
    assert wing.tissue.n_cells == 84
    assert not wing.open_cells.any()
    assert not wing.tissue.overlaps.any
