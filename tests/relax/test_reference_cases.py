"""The paper's tables, and agreement with what the authors' code computed at the same meshes."""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jaxtyping import Array, Float

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy
from vertax.io import BoundedTables, Tables, from_tables, to_tables

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "reference_cases"
needs_data = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="the reference meshes (../shared/data/reference_cases) are not here"
)
STATES = [
    *(
        (case, state)
        for case in ("e1_N20_k0_f64", "e2_N20_k0_d005_f64")
        for state in ("voronoi", "target", "start", "rerelaxed")
    ),
    *(("t1_N20_k2_d01_f64", state) for state in ("before", "after_one_pass", "relaxed")),
]


def assert_same_to_rounding(actual, expected):
    # Both codes work in float64; sums of a few terms agree to a few units in the last place.
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-13)


@pytest.fixture(scope="module")
def load():
    cases = {case: dict(np.load(FOLDER / f"{case}.npz")) for case in {case for case, _ in STATES}}

    def state_of(case, state):
        data = cases[case]
        names = ("vertTable", "heTable", "faceTable")
        vertices, half_edges, faces = (data[f"{state}_{name}"] for name in names)
        box = float(data["width"]), float(data["height"])
        tables = Tables(vertices, half_edges, faces, *box)
        values = {k.removeprefix(state + "_"): v for k, v in data.items() if k.startswith(state)}
        return tables, values, data

    return state_of


@needs_data
@pytest.mark.parametrize(("case", "state"), STATES)
class TestReferenceState:
    def test_geometry(self, load, case, state):
        tables, expected, _ = load(case, state)
        tissue = from_tables(tables, softening=0.0)
        assert_same_to_rounding(geometry(tissue).areas, expected["areas"])
        assert_same_to_rounding(geometry(tissue).perimeters, expected["perimeters"])
        per_row = np.asarray(geometry(tissue).edge_lengths)[tables.edges]
        assert_same_to_rounding(per_row, expected["he_lengths"])

    def test_energy_and_forces(self, load, case, state):
        tables, expected, data = load(case, state)
        tissue = from_tables(tables, softening=0.0)
        energy = paper_energy(case, state, tables, data)
        value, gradient = value_and_gradient(tissue, energy)
        stored = expected["energy_p0_true" if "energy_p0_true" in expected else "energy"]
        np.testing.assert_allclose(value, stored, rtol=1e-12)
        if "gradE" in expected:  # forces cancel: compare with the size of what is summed
            scale = float(data["K_areas"]) if "K_areas" in data else 1.0
            np.testing.assert_allclose(gradient, expected["gradE"], rtol=0, atol=1e-12 * scale)

    def test_tables_come_back(self, load, case, state):
        tables, _, _ = load(case, state)
        again = to_tables(from_tables(tables, softening=0.0))
        # Twins sit side by side in these files, as we write them, so even the rows are the same.
        np.testing.assert_array_equal(again.he_table, tables.he_table)
        np.testing.assert_array_equal(again.vert_table, tables.vert_table)
        assert (again.width, again.height) == (tables.width, tables.height)
        assert again.he_table[again.face_table, 5].tolist() == list(range(len(again.face_table)))


@needs_data
def test_half_edge_rows_map_to_half_edges(load):
    tables, _, _ = load("e1_N20_k0_f64", "target")
    m = from_tables(tables).topology
    columns = (m.previous, m.next, m.twin)
    for column, ours in enumerate(columns):
        rows = tables.he_table[:, column]
        np.testing.assert_array_equal(np.asarray(ours)[tables.half_edges], tables.half_edges[rows])
    for column, ours in ((3, m.source), (4, m.target), (5, m.cell)):
        np.testing.assert_array_equal(
            np.asarray(ours)[tables.half_edges], tables.he_table[:, column]
        )
    np.testing.assert_array_equal(np.asarray(m.offset)[tables.half_edges], tables.he_table[:, 6:])
    np.testing.assert_array_equal(np.asarray(m.edge)[tables.half_edges], tables.edges)


def paper_energy(case, state, tables, data):
    if case.startswith("e2"):
        # The paper sums tension times length over half-edges, so every edge counts twice.
        tension = data["tension_true" if state in ("voronoi", "target") else "tension_start"]
        per_edge = np.zeros(len(tension) // 2)
        np.add.at(per_edge, tables.edges, tension.astype(float))
        return AreaElasticity(float(data["K_areas"]), 1.0) + LineTension(jnp.asarray(per_edge))
    if case.startswith("t1"):
        return ShapeFactorEnergy(jnp.asarray(data["p0"]))
    names = {"voronoi": "p0_true", "target": "p0_true", "start": "p0_start"}
    return ShapeFactorEnergy(jnp.asarray(data[names.get(state, "p0_start")]))


class Geometry(NamedTuple):
    areas: Float[Array, " cells"]
    perimeters: Float[Array, " cells"]
    edge_lengths: Float[Array, " edges"]
    edge_vectors: Float[Array, "edges 2"]


@eqx.filter_jit  # one compilation instead of many small ones
def geometry(tissue):
    return Geometry(*(getattr(tissue, name) for name in Geometry._fields))


@eqx.filter_jit
def value_and_gradient(tissue, energy):
    total = lambda x: energy(tissue.with_configuration(x))
    return jax.value_and_grad(total)(tissue.configuration)


# Tables without reference data.


@pytest.fixture(scope="module")
def tissue():
    return vx.initialise.periodic_voronoi(
        12, key=jax.random.key(3), lattice=np.diag([4.0, 3.0]), softening=0.01
    )


def test_round_trip_of_a_tissue(tissue):
    again = from_tables(to_tables(tissue), softening=0.01)
    np.testing.assert_array_equal(again.vertices, tissue.vertices)
    np.testing.assert_array_equal(geometry(again).edge_vectors, geometry(tissue).edge_vectors)
    np.testing.assert_array_equal(again.topology.edge_cells, tissue.topology.edge_cells)
    np.testing.assert_array_equal(again.topology.edge_vertices, tissue.topology.edge_vertices)
    assert_same_to_rounding(geometry(again).areas, geometry(tissue).areas)
    assert_same_to_rounding(geometry(again).perimeters, geometry(tissue).perimeters)


@pytest.mark.parametrize("n_cells", [1, 2, 3])
def test_round_trip_of_cells_as_large_as_the_box(n_cells):
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(1))
    again = from_tables(to_tables(tissue))
    assert_same_to_rounding(geometry(again).areas, geometry(tissue).areas)
    np.testing.assert_array_equal(geometry(again).edge_vectors, geometry(tissue).edge_vectors)


def test_any_order_of_rows_is_read(tissue):
    tables = to_tables(tissue)
    new = np.random.default_rng(0).permutation(len(tables.he_table))  # row r becomes row new[r]
    he_table = tables.he_table.copy()
    he_table[:, :3] = new[he_table[:, :3]]
    he_table = he_table[np.argsort(new)]
    shuffled = tables._replace(he_table=he_table, face_table=new[tables.face_table])
    again = from_tables(shuffled)
    assert_same_to_rounding(geometry(again).areas, geometry(tissue).areas)
    vectors = np.asarray(geometry(tissue).edge_vectors)[tables.edges]
    other = np.asarray(geometry(again).edge_vectors)[shuffled.edges][new]
    # The first row of a vertex is its first half-edge.
    first = np.unique(he_table[:, 3], return_index=True)[1]
    np.testing.assert_array_equal(shuffled.half_edges[first], 3 * np.arange(tissue.n_vertices))
    # Which of the twins gives the direction may differ, and with it the rounding.
    assert_same_to_rounding(np.abs(other), np.abs(vectors))


def test_vertices_outside_the_box_are_moved_in(tissue):
    boxes = np.random.default_rng(1).integers(-3, 4, (tissue.n_vertices, 2))
    moved = moved_by_boxes(tissue, boxes)
    np.testing.assert_allclose(geometry(moved).areas, geometry(tissue).areas, rtol=1e-11)
    assert np.abs(moved.topology.offset).max() > 1
    tables = to_tables(moved)
    np.testing.assert_allclose(tables.vert_table, tissue.vertices, atol=1e-14)
    np.testing.assert_array_equal(tables.he_table, to_tables(tissue).he_table)


def test_float32_stays_float32(tissue):
    single = jax.tree.map(lambda x: x.astype(np.float32) if eqx.is_inexact_array(x) else x, tissue)
    tables = to_tables(single)
    assert tables.vert_table.dtype == np.float32
    assert from_tables(tables).vertices.dtype == jnp.float32


def test_float64_tables_are_read_without_x64(tissue):
    tables, areas = to_tables(tissue), np.asarray(geometry(tissue).areas)
    with jax.enable_x64(False):
        single = from_tables(tables)
        assert single.vertices.dtype == jnp.float32
        np.testing.assert_allclose(geometry(single).areas, areas, rtol=1e-4)


def test_edges_longer_than_the_box_cannot_be_written(tissue):
    stretched = tissue.with_configuration(tissue.vertices * jnp.array([5.0, 1.0]))
    with pytest.raises(ValueError, match="reach into a neighbouring box at most"):
        to_tables(stretched)


def test_batches_cannot_be_written(tissue):
    with pytest.raises(ValueError, match="must be a single tissue"):
        to_tables(jax.tree.map(lambda x: jnp.stack([x, x]), tissue))


def test_sheared_boxes_cannot_be_written():
    tissue = vx.initialise.hexagonal(3, 3)
    with pytest.raises(ValueError, match="rectangular boxes only"):
        to_tables(tissue)


def test_broken_tables_are_refused_by_name(tissue):
    good = to_tables(tissue)

    def with_he(row, column, value):
        he_table = good.he_table.copy()
        he_table[row, column] = value
        return good._replace(he_table=he_table)

    mirror_x = np.array([1, 1, 1, 1, 1, 1, -1, 1])
    mirrored = good._replace(
        vert_table=good.vert_table * [-1, 1], he_table=good.he_table * mirror_x
    )
    no_wrap = good.he_table.copy()
    no_wrap[:, 6:] = 0
    wrong_frames = good.he_table.copy()
    wrong_frames[[0, 1], 6] += [1, -1]
    rows_of_one_vertex = with_he(0, 3, (good.he_table[0, 3] + 1) % tissue.n_vertices)
    broken = {
        r"vert_table.*shape \(vertices, 2\)": good._replace(vert_table=good.vert_table[:, :1]),
        r"vert_table.*finite": good._replace(vert_table=good.vert_table * np.nan),
        r"he_table.*shape \(half-edges, 8\)": good._replace(he_table=good.he_table[:, :7]),
        r"he_table.*integers": good._replace(he_table=good.he_table.astype(float)),
        r"face_table.*BoundedTables": good._replace(face_table=np.stack([good.face_table] * 2, 1)),
        r"`height` must be positive": good._replace(height=0.0),
        r"three edges.*vertices": rows_of_one_vertex,
        r"`next` must lie in": with_he(5, 1, 10**6),
        r"`twin` must pair": with_he(4, 2, good.he_table[9, 2]),
        r"`previous` must undo": with_he(4, 0, good.he_table[9, 0]),
        r"`target` must be": with_he(4, 4, (good.he_table[4, 4] + 1) % tissue.n_vertices),
        r"`face` must be the same.*\[": with_he(4, 5, (good.he_table[4, 5] + 1) % 12),
        r"twins must have opposite": with_he(4, 6, good.he_table[4, 6] + 1),
        r"add up to zero": good._replace(he_table=wrong_frames),
        r"half-edge of its face": good._replace(face_table=np.roll(good.face_table, 1)),
        r"sum to -1 boxes": mirrored,
        r"sum to 0|sum to -?\d\.\de-\d+ boxes": good._replace(he_table=no_wrap),
    }
    for message, tables in broken.items():
        with pytest.raises(ValueError, match=message):
            from_tables(tables)


def moved_by_boxes(tissue, boxes):
    """The same tissue with its vertices represented by other images."""
    m = tissue.topology
    frame = np.asarray(m.frame) - np.repeat(boxes, 3, axis=0)
    topology = vx.Topology(m.twin, m.cell, frame, m.edge)
    vertices = tissue.vertices + tissue.boundary.translation(jnp.asarray(boxes))
    return vx.Tissue(vertices, topology, tissue.boundary, tissue.softening)


@needs_data
class TestAgainstTheAuthorsResults:
    @pytest.mark.thorough
    def test_hypergradient_at_an_unfinished_relaxation(self, load):
        # The implicit formula with a dense pseudo-inverse, at a state with forces left: the Hessian is
        # singular (translations), and nothing of our relaxation takes part.
        tables, _, data = load("e1_N20_k0_f64", "rerelaxed")
        tissue = from_tables(tables, softening=0.0)

        def force(x, p0):
            energy = vx.energies.ShapeFactorEnergy(p0)
            return jax.grad(lambda y: energy(tissue.with_configuration(y)))(x)

        p0 = jnp.asarray(data["p0_start"])
        hessian = lx.JacobianLinearOperator(
            lambda x, _: force(x, p0), tissue.vertices, tags=lx.symmetric_tag
        )
        pull = jnp.asarray(data["cost_grad_vertices"])
        adjoint = lx.linear_solve(hessian, pull, vx.MINRES()).value
        gradient = -jax.grad(lambda p: jnp.sum(force(tissue.vertices, p) * adjoint))(p0)
        np.testing.assert_allclose(gradient, data["dense_implicit_grad"], rtol=1e-8, atol=1e-13)

    def test_one_pass_of_t1_transitions_changes_the_same_neighbours(self, load):
        before, _, data = load("t1_N20_k2_d01_f64", "before")
        after, _, _ = load("t1_N20_k2_d01_f64", "after_one_pass")
        start, theirs = (from_tables(t, softening=0.0) for t in (before, after))
        energy = vx.energies.ShapeFactorEnergy(jnp.asarray(data["p0"]))
        rule = vx.T1(threshold=float(data["min_dist_T1"]))
        ours, counts = rule.sweep(start, energy, rule.init(start))
        pairs = lambda t: sorted(np.sort(np.asarray(t.topology.edge_cells), axis=1).tolist())
        assert counts.sum() == 3
        assert pairs(ours) == pairs(theirs) != pairs(start)


@needs_data
class TestBoundedReference:
    @pytest.fixture
    def data(self):
        return dict(np.load(FOLDER / "bounded_N20_s1_f64.npz"))

    @pytest.fixture(params=["start", "relaxed"])
    def state(self, request, data):
        prefix = request.param + "_"
        values = {k.removeprefix(prefix): v for k, v in data.items() if k.startswith(prefix)}
        names = ("vertTable", "angTable", "heTable", "faceTable")
        return BoundedTables(*(values[name] for name in names)), values

    def test_geometry(self, state):
        tables, expected = state
        tissue = from_tables(tables, softening=0.0)
        assert_same_to_rounding(tissue.areas, expected["areas"])
        assert_same_to_rounding(tissue.perimeters, expected["perimeters"])
        # The exterior side of an arc has length 0 there.
        pairs = expected["he_any_length"].reshape(-1, 2)
        assert_same_to_rounding(tissue.edge_lengths, pairs.max(axis=1))
        arcs = expected["he_surface_length"].reshape(-1, 2).max(axis=1) > 0
        np.testing.assert_array_equal(tissue.is_arc, arcs)

    def test_energy_and_its_gradients(self, state, data):
        tables, expected = state
        tissue = from_tables(tables, softening=0.0)

        @jax.jit
        @jax.value_and_grad
        def energy(leaves):
            vertices, angles, parameters = leaves
            at = tissue.with_vertices(vertices).with_angles(angles)
            # Theirs has no 1/2.
            area = AreaElasticity(2.0 * float(data["K"]), float(data["target_area"]))
            return (area + LineTension(jax.nn.sigmoid(parameters) + 1))(at)

        parameters = jnp.asarray(data["he_params"])
        value, gradients = energy((tissue.vertices, tissue.angles, parameters))
        np.testing.assert_allclose(value, expected["energy"], rtol=1e-13)
        names = ("gradE_vertices", "gradE_angles", "gradE_he_params")
        for gradient, name in zip(gradients, names, strict=True):
            np.testing.assert_allclose(gradient, expected[name], rtol=0, atol=1e-12)

    def test_tables_come_back(self, state):
        tables, _ = state
        tissue = from_tables(tables, softening=0.0)
        again = to_tables(tissue)
        assert isinstance(again, BoundedTables)
        np.testing.assert_array_equal(again.vert_table, tables.vert_table)
        np.testing.assert_array_equal(again.ang_table, tables.ang_table)
        # We write the cell's side of an arc first, and every exterior side after it.
        inner = (tables.he_table[:, 5] == 0) & (tables.he_table[:, 3] != 0)
        columns = [3, 4, 7]
        np.testing.assert_array_equal(
            again.he_table[inner][:, columns], tables.he_table[inner][:, columns]
        )
        np.testing.assert_array_equal(again.he_table[again.face_table[:, 0], 7], np.arange(20))
        third = to_tables(from_tables(again, softening=0.0))
        for one, other in zip(third, again, strict=True):
            np.testing.assert_array_equal(one, other)


def test_round_trip_of_a_free_tissue():
    tissue = vx.initialise.free_voronoi(9, key=jax.random.key(4), softening=0.01)
    again = from_tables(to_tables(tissue), softening=0.01)
    np.testing.assert_array_equal(again.topology.edge_cells, tissue.topology.edge_cells)
    np.testing.assert_array_equal(again.topology.edge_vertices, tissue.topology.edge_vertices)
    np.testing.assert_array_equal(again.angles, tissue.angles)
    assert_same_to_rounding(again.areas, tissue.areas)


def test_broken_bounded_tables_are_refused_by_name():
    good = to_tables(vx.initialise.free_voronoi(6, key=jax.random.key(1)))
    assert isinstance(good, BoundedTables)

    def with_he(row, column, value):
        he_table = good.he_table.copy()
        he_table[row, column] = value
        return good._replace(he_table=he_table)

    arc = int(np.flatnonzero(good.he_table[:, 5])[0])
    broken = {
        r"vert_table.*finite": good._replace(vert_table=good.vert_table * np.nan),
        r"ang_table.*shape \(edges,\)": good._replace(ang_table=good.ang_table[None]),
        r"face_table.*shape \(rows, 2\)": good._replace(face_table=good.face_table[:, 0]),
        r"`twin` must pair up rows": with_he(0, 2, 5),
        r"vertices must lie in 2": with_he(arc, 5, 99),
        r"a face on one side at least": with_he(arc, 5, 0),
        r"counter-clockwise": good._replace(vert_table=good.vert_table * [1.0, -1.0]),
    }
    for message, tables in broken.items():
        with pytest.raises(ValueError, match=message):
            from_tables(tables)
    curved = vx.initialise.free_voronoi(6, key=jax.random.key(1), inner_arcs=True)
    with pytest.raises(ValueError, match="arcs on the outline only"):
        to_tables(curved)
