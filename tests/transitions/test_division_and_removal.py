"""Division and removal of cells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import doublet
from helpers import random_tissue
from hypothesis import given, settings, strategies as st
from jaxtyping import Array, Float, PRNGKeyArray

import vertax as vx
from vertax.transitions import divide, remove
from vertax.transitions._edge_frames import EdgeFrames
from vertax.transitions._removal import flipped, removed


def cluster(**options):
    return vx.initialise.free_voronoi(6, key=1, lloyd_steps=3, **options)


def foam():
    tissue = cluster(inner_arcs=True)
    return tissue.with_angles(0.15 * jnp.cos(1.0 * jnp.arange(tissue.n_edges)))


KINDS = {"periodic": lambda: random_tissue(6, 3, lloyd_steps=3), "free": cluster, "foam": foam}
each_kind = pytest.mark.parametrize(
    "kind", ["periodic", pytest.param("free", marks=pytest.mark.slow), "foam"]
)


def newborn(before, after):
    (cell,) = np.flatnonzero(np.asarray(after.alive & ~before.alive))
    return int(cell)


@pytest.mark.thorough
@each_kind
@settings(max_examples=6, deadline=None)
@given(mother=st.integers(0, 5), angle=st.one_of(st.none(), st.floats(0, 6.2)))
def test_daughters_have_the_area_of_the_mother(kind, mother, angle):
    tissue = KINDS[kind]().with_capacity(8)
    axis = None if angle is None else jnp.array([np.cos(angle), np.sin(angle)])
    change = divide(tissue, mother, axis)
    new = change.tissue
    new.topology.validate()
    assert change.converged
    assert not new.overlaps.any
    daughter = newborn(tissue, new)
    areas = np.asarray(new.areas)
    assert areas[mother] + areas[daughter] == pytest.approx(float(tissue.areas[mother]), abs=1e-13)
    others = np.setdiff1d(np.arange(8), [mother, daughter])
    np.testing.assert_allclose(areas[others], tissue.areas[others], atol=1e-13)
    # Lengths are preserved except for the new edge; arcs are split into arcs of the same circle.
    ends = np.sort(np.asarray(new.topology.edge_cells), axis=1)
    inner = (ends == sorted([mother, daughter])).all(axis=1) & ~np.asarray(
        tissue.topology.alive_edges
    )
    total = new.edge_lengths.sum() - new.edge_lengths[inner].sum()
    assert inner.sum() == 1
    assert total == pytest.approx(float(tissue.edge_lengths.sum()), abs=1e-4)
    if axis is not None:
        apart = new.centroids[daughter] - new.centroids[mother]
        edge = new.edge_vectors[inner][0]
        assert abs(apart @ axis) > 0
        assert abs(edge @ axis) < 0.3 * np.linalg.norm(
            edge
        )  # not exact because of the margin at corners


def test_default_cut_is_perpendicular_to_the_long_axis():
    box = jnp.array([[6.0, 0.0], [0.0, 1.5]])
    tissue = random_tissue(4, 1, lattice=box, lloyd_steps=30).with_capacity(5)
    for mother in range(4):
        new = divide(tissue, mother).tissue
        halves = new.areas[jnp.array([mother, newborn(tissue, new)])]
        assert (halves > 0.3 * tissue.areas[mother]).all()


@pytest.mark.thorough
def test_repeated_divisions_of_a_periodic_cell():
    tissue = random_tissue(1).with_capacity(12)

    @jax.jit
    def grow(tissue):
        def once(i, carry):
            tissue, done = carry
            change = divide(tissue, i // 2, throw=False)
            return change.tissue, done & change.converged

        return jax.lax.fori_loop(0, 11, once, (tissue, jnp.array(True)))

    grown, done = grow(tissue)
    grown.topology.validate()
    assert done
    assert grown.alive.all()
    assert not grown.overlaps.any
    assert grown.areas.sum() == pytest.approx(1)


@pytest.mark.thorough
@pytest.mark.parametrize("inner_arcs", [False, True])
def test_a_doublet_can_divide_along_any_axis(inner_arcs):
    # The corners of its cells are collinear, and a cut may intersect one arc twice.
    tissue = doublet(inner_arcs=inner_arcs).with_angles(jnp.array([1.4, 0.3, 1.6])).with_capacity(3)
    n_sides = set()
    for mother in range(2):
        for angle in [None, *np.linspace(0, np.pi, 9)]:
            axis = None if angle is None else jnp.array([np.cos(angle), np.sin(angle)])
            new = divide(tissue, mother, axis).tissue
            new.topology.validate()
            assert not new.overlaps.any
            areas = new.areas[mother] + new.areas[2]
            assert areas == pytest.approx(float(tissue.areas[mother]), abs=1e-13)
            assert new.areas[1 - mother] == pytest.approx(float(tissue.areas[1 - mother]))
            halves = np.sort(new.areas[jnp.array([mother, 2])])
            assert halves[0] > 0.7 * halves[1]
            n_sides |= {tuple(np.sort(new.neighbour_counts).tolist())}
    assert n_sides == {(3, 3, 3), (2, 2, 4)}


def test_cuts_that_cause_overlaps_are_rejected():
    # In a concave cell the line through the centroid may leave the cell and enter it again.
    tissue = random_tissue(6, 3)
    cell = int(tissue.topology.cell[0])
    half_edges = np.flatnonzero(np.asarray(tissue.topology.cell) == cell)
    rng = np.random.default_rng(0)
    for _ in range(20):
        shift = np.zeros((12, 2))
        shift[half_edges // 3] = 0.35 * rng.normal(size=(half_edges.size, 2))
        bent = tissue.with_vertices(tissue.vertices + shift)
        if bent.overlaps.any:
            continue
        for angle in np.linspace(0, np.pi, 7):
            axis = jnp.array([np.cos(angle), np.sin(angle)])
            change = divide(bent.with_capacity(8), cell, axis, throw=False)
            assert not change.tissue.overlaps.any
            assert change.converged == (change.tissue.alive.sum() == 7)


def test_daughters_inherit_parameters():
    tissue = random_tissue(6, 3).with_capacity(8)
    change = divide(tissue, 2)
    energy = vx.energies.AreaElasticity(1.0, jnp.arange(8.0)) + vx.energies.LineTension(
        jnp.arange(24.0)
    )
    areas, tension = (
        change.inherited(energy).terms[0].target_area,
        change.inherited(energy).terms[1].tension,
    )
    daughter = newborn(tissue, change.tissue)
    assert areas[daughter] == 2
    assert areas[2] == 2
    # Both parts of an edge keep its tension; their cells differ by one daughter only.
    cells = np.sort(np.asarray(change.tissue.topology.edge_cells), axis=1)
    old = np.sort(np.asarray(tissue.topology.edge_cells), axis=1)
    born = np.flatnonzero(
        np.asarray(change.tissue.topology.alive_edges & ~tissue.topology.alive_edges)
    )
    for edge in born:
        origin = int(tension[edge])
        mothers = np.sort(np.where(cells[edge] == daughter, 2, cells[edge]))
        if not np.array_equal(mothers, [2, 2]):
            np.testing.assert_array_equal(mothers, old[origin])


class Network(vx.AbstractEnergy):
    """An energy with weights that have as many rows as there are cells or edges."""

    layer: eqx.nn.Linear
    rows: Float[Array, "hidden"]
    marked: Array = eqx.field(metadata={"axis": None})
    of_knots: Float[Array, "knots edges"]
    of_vertices: Float[Array, "vertices 2"]
    of_pairs: Float[Array, "cells cells"]
    given: np.ndarray = eqx.field(metadata={"axis": "cells"})
    parts: dict[str, Float[Array, "*edges"]]
    text: str = "none"
    key: PRNGKeyArray | None = None

    def __call__(self, tissue):
        return jnp.zeros(())


def network(**fields):
    n, e, v = 8, 24, 16
    return Network(
        layer=eqx.nn.Linear(e, n, key=jax.random.key(0)),
        rows=jnp.arange(1.0 * n),
        marked=jnp.arange(1.0 * e),
        of_knots=jnp.arange(3.0 * e).reshape(3, e),
        of_vertices=jnp.arange(2.0 * v).reshape(v, 2),
        of_pairs=jnp.arange(1.0 * n * n).reshape(n, n),
        given=np.arange(1.0 * n),
        parts={"a": jnp.arange(1.0 * e), "b": jnp.array(3.0)},
        key=jax.random.key(1),
        **fields,
    )


def test_only_declared_axes_are_inherited():
    tissue = random_tissue(6, 3).with_capacity(8)
    change = divide(tissue, 2)
    old = network()
    new = change.inherited(old)
    for same in ("layer", "rows", "marked", "text", "key"):
        assert eqx.tree_equal(getattr(new, same), getattr(old, same)), same
    cells, edges, vertices = map(np.asarray, (change.cells, change.edges, change.vertices))
    assert cells[newborn(tissue, change.tissue)] == 2
    np.testing.assert_array_equal(new.of_knots, old.of_knots[:, edges])
    np.testing.assert_array_equal(new.of_vertices, old.of_vertices[vertices])
    np.testing.assert_array_equal(new.of_pairs, old.of_pairs[np.ix_(cells, cells)])
    np.testing.assert_array_equal(new.given, old.given[cells])
    assert isinstance(new.given, np.ndarray)
    np.testing.assert_array_equal(new.parts["a"], old.parts["a"][edges])
    assert new.parts["b"] == 3
    # A new vertex has the entries of the vertex at the start of the split edge.
    born = np.flatnonzero(change.tissue.topology.alive_vertices & ~tissue.topology.alive_vertices)
    assert (vertices[born] < 12).all()
    np.testing.assert_array_equal(np.delete(vertices, born), np.delete(np.arange(16), born))
    # One random key per cell; and arrays outside of modules.
    keys = {"keys": jax.random.split(jax.random.key(0), 8), "age": jnp.arange(8.0)}
    inherited = change.inherited(keys, axis="cells")
    assert (
        jax.random.key_data(inherited["keys"]) == jax.random.key_data(keys["keys"][cells])
    ).all()
    np.testing.assert_array_equal(inherited["age"], cells)


class Undeclared(vx.AbstractEnergy):
    strength: Array

    def __call__(self, tissue):
        return jnp.sum(self.strength * tissue.perimeters)


def test_undeclared_axes_are_rejected_by_name(without_type_checks):
    change = divide(random_tissue(6, 3).with_capacity(8), 2)
    with pytest.raises(TypeError, match="`strength` of Undeclared must declare"):
        change.inherited(Undeclared(jnp.ones(8)))
    assert change.inherited(Undeclared(jnp.ones(5))).strength.shape == (5,)
    with pytest.raises(TypeError, match='axis="cells"'):
        change.inherited([jnp.ones(8)])
    with pytest.raises(ValueError, match="`logits` of BoundedTension must have one entry"):
        change.inherited(vx.energies.BoundedTension(jnp.full(18, 0.5), 0.0, 1.0))
    with pytest.raises(ValueError, match="`axis` must be one of"):
        change.inherited(Undeclared(jnp.ones(5)), axis="faces")


def test_division_without_a_spare_slot_is_rejected(without_type_checks):
    tissue = random_tissue(6, 3).with_capacity(7)
    full = divide(tissue, 0).tissue
    with pytest.raises(RuntimeError, match="capacity is 7 cells"):
        divide(full, 0)
    with pytest.raises(Exception, match="all cell slots of the tissue are alive"):
        jax.block_until_ready(jax.jit(lambda t: divide(t, 0).tissue.vertices)(full))
    change = divide(full, 0, throw=False)
    assert not change.converged
    assert eqx.tree_equal(change.tissue, full)
    with pytest.raises(ValueError, match="living cell"):
        divide(tissue, 6)
    with pytest.raises(ValueError, match="direction"):
        divide(tissue, 0, jnp.zeros(2))
    with pytest.raises(ValueError, match="with_capacity"):
        remove(random_tissue(6), 0)


@pytest.mark.thorough
@each_kind
def test_neighbours_fill_the_area_of_a_removed_cell(kind):
    tissue = KINDS[kind]().with_capacity(6)
    for cell in range(2):
        change = remove(tissue, cell)
        new = change.tissue
        new.topology.validate()
        assert not new.alive[cell]
        assert new.alive.sum() == 5
        assert not new.overlaps.any
        if kind == "periodic":
            assert new.areas.sum() == pytest.approx(float(tissue.areas.sum()))


@pytest.mark.parametrize(
    "shape",
    [
        (1, 1),
        (1, 3),
        *(pytest.param(s, marks=pytest.mark.thorough) for s in [(2, 1), (1, 2), (3, 1), (2, 2)]),
    ],
)
@pytest.mark.thorough
def test_removal_from_a_small_box_terminates(shape, without_type_checks):
    # A cell that is its own neighbour may gain a side in the flip by which it loses one.
    tissue = vx.initialise.hexagonal(*shape)
    tissue = tissue.with_capacity(tissue.n_cells)
    change = remove(tissue, 0, throw=False)
    if change.converged:
        change.tissue.topology.validate()
        assert not change.tissue.overlaps.any
        assert change.tissue.areas.sum() == pytest.approx(tissue.n_cells)
    else:
        assert eqx.tree_equal(change.tissue, tissue)
        with pytest.raises(RuntimeError, match="cannot be removed"):
            remove(tissue, 0)
    assert change.converged == (shape in [(3, 1), (1, 3)])


@pytest.mark.slow
def test_divide_and_remove_vmap_over_tissues():
    tissues = [random_tissue(6, seed, lloyd_steps=2).with_capacity(7) for seed in (1, 2)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *tissues)
    cells = jnp.array([1, 4])
    changes = eqx.filter_vmap(lambda t, c: divide(t, c, throw=False))(batch, cells)
    gone = eqx.filter_vmap(lambda t, c: remove(t, c, throw=False))(batch, cells)
    for k, tissue in enumerate(tissues):
        for many, one in ((changes, divide(tissue, cells[k])), (gone, remove(tissue, cells[k]))):
            member = jax.tree.map(lambda x, k=k: x[k], many.tissue)
            assert eqx.tree_equal(member.topology, one.tissue.topology)
            np.testing.assert_allclose(member.vertices, one.tissue.vertices, atol=1e-13)


def smoothed(tissue):
    """Move vertices half-way to the mean of their neighbours, unless cells overlap then."""
    m = tissue.topology
    vector = tissue.edge_vectors[m.edge]
    vector = jnp.where(m.forward[:, None], vector, -vector)
    pull = jnp.mean(vector.reshape(-1, 3, 2), axis=1)
    moved = tissue.with_vertices(
        tissue.vertices + 0.5 * jnp.where(m.alive_vertices[:, None], pull, 0)
    )
    return jax.tree.map(lambda a, b: jnp.where(moved.overlaps.any, a, b), tissue, moved)


def is_valid(tissue, box):
    """Invariants of a tissue that can be checked inside `jax.jit`."""
    m = tissue.topology
    h = jnp.arange(m.n_half_edges)
    spare = m.cell == m.spare_label
    conditions = [
        m.twin[m.twin] == h,
        m.twin != h,
        m.edge[m.twin] == m.edge,
        m.edge[m.half_edge] == jnp.arange(m.n_edges),
        m.cell[m.next] == m.cell,
        m.offset[m.twin] == -m.offset,
        (m.next[m.next] == h) | ~spare,
        m.neighbour_counts != 1,
        jnp.sum(m.alive_vertices) == 2 * jnp.sum(m.alive),  # Euler's formula
        jnp.sum(m.alive_edges) == 3 * jnp.sum(m.alive),
        # Cells are simple counter-clockwise polygons that cover the box once.
        ~tissue.overlaps.any,
        jnp.abs(jnp.sum(tissue.areas) - box) < 1e-9 * box,
    ]
    return jnp.all(jnp.stack([jnp.all(c) for c in conditions]))


@eqx.filter_jit
def random_events(tissue, key, n_events):
    """Apply random T1 transitions, divisions and removals; return the number of each."""
    box = jnp.linalg.det(tissue.boundary.lattice)
    select = lambda condition, new, old: jax.tree.map(
        lambda a, b: jnp.where(condition, a, b), new, old
    )

    def event(i, carry):
        tissue, counts, ok = carry
        keys = jax.random.split(jax.random.fold_in(key, i), 4)
        n_alive = jnp.sum(tissue.alive)
        cell = jax.random.categorical(keys[0], jnp.where(tissue.alive, 0.0, -jnp.inf))
        axis = jax.random.normal(keys[1], (2,))

        def t1():
            frames = EdgeFrames(tissue)
            edge = jax.random.categorical(keys[2], jnp.where(frames.can_flip, 0.0, -jnp.inf))
            which = frames.can_flip & (jnp.arange(tissue.n_edges) == edge)
            return flipped(tissue, frames, which)

        def birth():
            change = divide(tissue, cell, axis, throw=False)
            # A cut through a concave cell may cause overlaps.
            valid = change.converged & ~change.tissue.overlaps.any
            return select(valid, change.tissue, tissue), valid

        def death():
            change = removed(tissue, cell, n_alive > 4)
            return change.tissue, change.converged

        kind = jax.random.randint(keys[3], (), 0, 3)
        tissue, done = jax.lax.switch(kind, [t1, birth, death])
        tissue = jax.lax.fori_loop(0, 3, lambda _, t: smoothed(t), tissue)
        return tissue, counts.at[kind].add(done), ok & is_valid(tissue, box)

    start = (tissue, jnp.zeros(3, int), is_valid(tissue, box))
    return jax.lax.fori_loop(0, n_events, event, start)


def run_events(n_events):
    tissue = random_tissue(10, 5, lloyd_steps=3).with_capacity(16)
    tissue, counts, ok = random_events(tissue, jax.random.key(0), n_events)
    assert ok, counts
    tissue.topology.validate()
    return tissue, np.asarray(counts)


@pytest.mark.thorough
def test_random_events_preserve_all_invariants():
    _, counts = run_events(300)
    assert (counts > 20).all()


@pytest.mark.slow
def test_200000_random_events_preserve_all_invariants():
    tissue, counts = run_events(200_000)
    assert counts.sum() > 100_000
    assert (counts > 10_000).all()
    energy = vx.energies.AreaElasticity(1.0, 1.0) + vx.energies.LineTension(0.1)
    force = jax.grad(lambda y: energy(tissue.with_configuration(y)))(tissue.vertices)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12)
