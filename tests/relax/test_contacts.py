"""Cells never overlap on the way to equilibrium, and rest against each other smoothly."""

import functools
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brute_force_overlaps import faces_that_overlap
from free_helpers import cluster
from helpers import fine_difference
from hypothesis import example, given, settings, strategies as st

import vertax as vx
from vertax.relax._contacts import no_contacts

N = 20
relaxed = vx.Relaxation(max_steps=300)


def tissue_of(seed: int) -> vx.Tissue:
    return vx.initialise.periodic_voronoi(n_cells=N, key=seed)


def shape_factors(seed: int, low: float = 3.3, high: float = 4.9) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, N)


def shapes(targets) -> vx.AbstractEnergy:
    return vx.energies.ShapeFactorEnergy(jnp.asarray(targets))


@pytest.mark.thorough
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), low=st.floats(3.0, 4.5), spread=st.floats(0, 0.5))
def test_a_random_tissue_stays_valid(seed, low, spread):
    energy = shapes(shape_factors(seed, low, low + spread + 1e-9))
    equilibrium = relaxed(tissue_of(seed % 100), energy, throw=False)
    assert not equilibrium.tissue.overlaps.any
    assert faces_that_overlap(equilibrium.tissue) == []


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), inner_arcs=st.booleans())
# A bulge meets a flat side, and the arcs of a cell with four sides meet.
@example(seed=11, inner_arcs=True)
def test_a_random_cluster_stays_valid(seed, inner_arcs):
    tissue = cluster(12, seed % 100, inner_arcs=inner_arcs)
    tension = np.random.default_rng(seed).uniform(0.06, 0.6, tissue.n_edges)
    energy = vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.LineTension(jnp.asarray(tension))
    equilibrium = relaxed(tissue, energy, throw=False)
    assert not equilibrium.tissue.overlaps.any
    assert faces_that_overlap(equilibrium.tissue, 200) == []


def crowded_tissues() -> Iterator[vx.Tissue]:
    """A tissue that nearly overlaps, in each copy with another short edge. (A flip of edge 42 overlaps.)"""
    tissue = tissue_of(9)
    directions = jax.random.normal(jax.random.key(1009), tissue.vertices.shape)
    displaced = lambda by: tissue.with_vertices(tissue.vertices + by * directions)
    valid, invalid = 0.0, 1.0
    for _ in range(30):
        middle = (valid + invalid) / 2
        valid, invalid = (valid, middle) if displaced(middle).overlaps.any else (middle, invalid)
    crowded = displaced(valid)
    for (start, end), vector in zip(
        np.asarray(crowded.topology.edge_vertices), np.asarray(crowded.edge_vectors), strict=True
    ):
        # Shorter than the threshold of T1.
        shift = 0.5 * (1 - 0.005 / np.hypot(*vector)) * vector
        short = crowded.with_vertices(crowded.vertices.at[start].add(shift).at[end].add(-shift))
        if not short.overlaps.any:
            yield short


@pytest.mark.thorough
def test_transitions_of_the_initial_tissue_make_no_overlaps():
    """The first flips happen before the first step."""
    energy, flips = shapes(np.full(N, 3.7)), 0
    for tissue in crowded_tissues():
        stepped = vx.Relaxation(max_steps=1)(tissue, energy, throw=False)
        assert not stepped.tissue.overlaps.any
        flips += int(stepped.num_t1)
    assert flips > 5


@pytest.mark.thorough
def test_flips_that_overlap_do_not_shorten_the_step():
    """The edge does not flip: the trial point itself is valid."""
    energy, relaxation, before = shapes(np.full(N, 3.7)), vx.Relaxation(), tissue_of(9)

    @eqx.filter_jit
    def feasible(tissue):
        search = relaxation.search(tissue, energy)
        state = search.begin(tissue, energy)
        start = search.feasibility.start(before, state.contacts, state.counts)
        true, false = jnp.array(True), jnp.array(False)
        return search.feasibility(start, tissue, energy, active=true, guarded=true, first=false)

    ends = [feasible(tissue) for tissue in crowded_tissues()]
    for end in ends:
        np.testing.assert_array_equal(end.fraction, 1)
        assert not end.tissue.overlaps.any
    assert max(int(end.num_attempts) for end in ends) > 1


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(vx.solvers.FIRE(), id="FIRE", marks=pytest.mark.slow),
        pytest.param(vx.solvers.LBFGS(), id="LBFGS", marks=pytest.mark.thorough),
    ],
)
def test_every_solver_avoids_overlaps(solver):
    response = vx.Relaxation(solver, tolerance=1e-6, max_steps=400)
    for seed in range(3):
        equilibrium = response(tissue_of(seed), shapes(np.full(N, 4.5)), throw=False)
        assert faces_that_overlap(equilibrium.tissue) == []


class _Spoiler(vx.transitions.AbstractTransitions):
    """Where anything has moved, a vertex ends up far away."""

    start: jax.Array
    where: jax.Array
    vertex: int

    def init(self, tissue):
        return jnp.zeros(tissue.n_edges, jnp.int32)

    def sweep(self, tissue, energy, counts, allowed=True):
        moved = (tissue.vertices != self.start).any(axis=1)
        far = jnp.where((self.where & moved).any(), 2.0, 0.0)
        return tissue.with_vertices(tissue.vertices.at[self.vertex].add(far)), counts


@pytest.mark.thorough
def test_only_the_neighbourhood_of_an_overlap_is_frozen():
    tissue = vx.initialise.periodic_voronoi(60, key=jax.random.key(2), lloyd_steps=3)
    cells = np.asarray(tissue.topology.cell).reshape(-1, 3)
    # The neighbours of the vertex's cells as well, which would not overlap.
    grown = lambda vertices: np.isin(cells, cells[vertices]).any(axis=1)
    held = grown(grown([7]))
    response = vx.Relaxation(transitions=_Spoiler(tissue.vertices, jnp.asarray(held), 7))
    energy = shapes(np.full(60, 3.6))

    @eqx.filter_jit
    def step(tissue, energy):
        search = response.search(tissue, energy)
        return search.advance(search.begin(tissue, energy), energy, 1)

    state = step(tissue, energy)
    moved = np.asarray((state.tissue.vertices != tissue.vertices).any(axis=1))
    assert not moved[held].any()
    assert moved[~grown(grown(held))].all()
    assert 0.2 < moved.mean() < 0.8
    assert state.iteration.value < energy(tissue)
    # What stays because of others is to be shorter next time as well.
    radii = np.asarray(state.iteration.radii)
    assert radii[~moved].max() < radii[moved].min()


@pytest.mark.thorough
def test_frozen_vertices_are_released():
    """A vertex without an overlap joined the frozen ones again and again."""
    tissue = vx.initialise.periodic_voronoi(1000, key=jax.random.key(1001))
    factors = 3.5 + 0.1 * jax.random.normal(jax.random.key(2001), (1000,))
    response = vx.Relaxation(tolerance=1e-8, max_steps=150)
    assert eqx.filter_jit(response)(tissue, shapes(factors), throw=False).converged


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [294, 711])
def test_radii_of_frozen_vertices_stay_short(seed):
    """Well-predicted steps that lead to overlaps: radii grew again as fast as they had shrunk."""
    # The first one took 212 steps then; the second one never ends if regions only shrink. (The number of
    # steps depends on rounding, and near rest on the flat energy: the median of nearly equal starts.)
    relax = eqx.filter_jit(vx.Relaxation(tolerance=0.01, max_steps=200))
    tissue = vx.initialise.periodic_voronoi(64, key=jax.random.key(seed))
    factors = 4.1 + 0.1 * jax.random.normal(jax.random.key(1 + seed), (64,))
    shift = lambda key: 1e-9 * jax.random.normal(key, tissue.vertices.shape)
    starts = [tissue.with_vertices(tissue.vertices + shift(jax.random.key(i))) for i in range(7)]
    steps = [relax(start, shapes(factors), throw=False).num_steps for start in starts]
    assert np.median(steps) < 100


@pytest.mark.thorough
def test_without_contacts_cells_overlap_and_an_error_is_raised():
    response = vx.Relaxation(contact_range=None)
    energy = shapes(np.full(N, 4.7))
    equilibrium = response(tissue_of(3), energy, throw=False)
    bad = faces_that_overlap(equilibrium.tissue)
    assert bad
    assert equilibrium.result == vx.RESULTS.overlap
    assert not equilibrium.converged
    with pytest.raises(RuntimeError, match=rf"overlap.*contact_range.*cell {bad[0]}\b"):
        response(tissue_of(3), energy)


def test_the_error_names_the_cells_of_an_initial_overlap():
    tissue = tissue_of(2)
    overlapping = tissue.with_vertices(tissue.vertices.at[0].add(2.5))
    with pytest.raises(RuntimeError, match="vertices"):
        vx.equilibrate(overlapping, shapes(np.full(N, 3.7)), max_steps=1)


@pytest.mark.thorough
def test_contacts_do_not_change_a_tissue_without_contacts():
    energy = shapes(np.full(N, 3.6))
    start = vx.equilibrate(tissue_of(2), energy).tissue
    pushed = shapes(np.linspace(3.55, 3.65, N))
    held, free = (vx.Relaxation(contact_range=r)(start, pushed) for r in (0.01, None))
    assert held.num_steps == free.num_steps
    np.testing.assert_allclose(held.tissue.vertices, free.tissue.vertices, rtol=0, atol=1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_an_edge_that_vanishes_along_another_side_has_a_moderate_curvature(offset):
    tissue = tissue_of(0)
    m = tissue.topology
    # The edge from a to b folds back onto the side of the same face that ends at a.
    side = int(m.previous[0])
    along = np.asarray(tissue.sides[side, 2:4])
    away = 1e-7 * (offset * np.array([-along[1], along[0]]) - along)
    b = int(m.next[0]) // 3
    displaced = tissue.with_vertices(tissue.vertices.at[b].add(away - tissue.sides[0, 2:4]))
    one = jnp.asarray(1.0)
    contacts, _ = no_contacts(0.01, one, displaced).updated_pairs(displaced)
    assert [int(m.next[0]), side] in contacts.sides.T.tolist()
    energy_at = lambda x: contacts(displaced.with_vertices(displaced.vertices.at[b].set(x)))
    curvature = jax.hessian(energy_at)(displaced.vertices[b])
    assert np.abs(curvature).max() < 1e5 * contacts.pairs.strength


def test_room_for_contacts_is_a_positive_integer(without_type_checks):
    with pytest.raises(ValueError, match="`max_contacts` must be at least 1, but is 0"):
        vx.Relaxation(max_contacts=0)
    with pytest.raises(TypeError, match=r"`max_contacts` must be at least 1 \(a Python integer\)"):
        vx.Relaxation(max_contacts=2.5)  # pyright: ignore[reportArgumentType]


def test_a_negative_range_is_refused():
    with pytest.raises(ValueError, match="contact_range"):
        vx.Relaxation(contact_range=-0.1)


@functools.cache
def in_contact() -> tuple[vx.Tissue, np.ndarray]:
    """A tissue at rest in which corners press against sides: target shape factors differ much."""
    exerted = eqx.filter_jit(lambda t, e: jax.grad(lambda v: e(t.with_vertices(v)))(t.vertices))
    for seed in range(40, 100):
        targets = shape_factors(seed)
        equilibrium = relaxed(tissue_of(seed), shapes(targets), throw=False)
        # What the energy exerts there and contacts bear.
        if (
            equilibrium.converged
            and np.max(np.abs(exerted(equilibrium.tissue, shapes(targets)))) > 1e-3
        ):
            return equilibrium.tissue, targets
    raise AssertionError("no tissue ends in contact")


@eqx.filter_jit
def cost_and_slope(targets, start, adjoint):
    """A cost of the equilibrium, and its gradient."""

    def cost(targets):
        energy = vx.energies.ShapeFactorEnergy(targets)
        equilibrium = vx.equilibrate(start, energy, adjoint=adjoint, tolerance=1e-11)
        return jnp.sum(jnp.sin(3 * equilibrium.tissue.edge_lengths))

    return jax.value_and_grad(cost)(targets)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("adjoint", "rtol"),
    [
        (vx.ImplicitDifferentiation(), 1e-6),
        # What it propagates is the same; the tests of adjoints have it without contacts.
        pytest.param(vx.EquilibriumPropagation(beta=1e-6), 1e-5, marks=pytest.mark.slow),
    ],
    ids=["implicit", "propagation"],
)
def test_hypergradients_of_a_tissue_in_contact(adjoint, rtol):
    start, targets = in_contact()
    direction = np.random.default_rng(0).normal(size=N)
    # By one program for all adjoints: that of the first, which compiles least.
    at = lambda t: cost_and_slope(t, start, vx.ImplicitDifferentiation())[0]
    expected = fine_difference(at, targets, direction, 3e-5)
    slope = cost_and_slope(jnp.asarray(targets), start, adjoint)[1]
    np.testing.assert_allclose(slope @ direction, expected, rtol=rtol)


@pytest.mark.thorough
def test_contacts_beyond_the_room_are_reported_and_repeated_with_more_room(in_contact_case):
    random, energy = in_contact_case
    narrow = vx.Relaxation(contact_range=0.05, max_contacts=1)
    wide = vx.Relaxation(contact_range=0.05)
    # (From a random tissue, rounding errors decide which equilibrium is reached.)
    tissue = wide(random, jax.tree.map(lambda x: 1.001 * x, energy)).tissue
    repeated = narrow(tissue, energy)
    expected = wide(tissue, energy).tissue.vertices
    np.testing.assert_allclose(repeated.tissue.vertices, expected, atol=1e-8)
    inside = eqx.filter_jit(lambda: narrow(tissue, energy, throw=False))()
    assert inside.result == vx.RESULTS.too_many_contacts
    assert not inside.converged
    with pytest.raises(RuntimeError, match="Raise `max_contacts`"):
        inside.checked()


@pytest.fixture(scope="module")
def in_contact_case() -> tuple[vx.Tissue, vx.AbstractEnergy]:
    """A fluid tissue with a wide barrier: many contacts."""
    factors = 4.3 + 0.3 * jax.random.normal(jax.random.key(1), (64,))
    return vx.initialise.periodic_voronoi(64, key=jax.random.key(40)), shapes(factors)
