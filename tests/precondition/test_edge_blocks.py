"""A preconditioner of edges: it is that of the Hessian, and positive whatever the Hessian is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax.precondition._edge_blocks import EdgeBlocks, EdgeInverse, Symmetric
from vertax.relax._objective import objective
from vertax.solvers._solver import value_and_gradient

pytestmark = pytest.mark.thorough


@eqx.filter_jit
def blocks_of(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> EdgeBlocks:
    blocks = EdgeBlocks.of(tissue, energy)
    assert blocks is not None
    return blocks


def foam(n: int = 36, seed: int = 0) -> vx.Tissue:
    return vx.initialise.periodic_voronoi(n, key=seed)


def tense(tissue: vx.Tissue, low: float = 0.2, high: float = 0.6) -> vx.AbstractEnergy:
    tension = jax.random.uniform(jax.random.key(1), (tissue.n_edges,), minval=low, maxval=high)
    return vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.LineTension(tension)


def dense_hessian(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> np.ndarray:
    n = tissue.n_vertices
    at = lambda x: energy(tissue.with_vertices(x))
    return np.asarray(jax.jit(jax.hessian(at))(tissue.vertices)).reshape(2 * n, 2 * n)


def both_ends(blocks: EdgeBlocks | EdgeInverse, edge: int) -> np.ndarray:
    """The block of an edge, four rows."""
    x, y, b = blocks.first, blocks.second, blocks.between
    off = np.array([[b.xx[edge], b.xy[edge]], [b.yx[edge], b.yy[edge]]])
    one, other = (np.array([[s.xx[edge], s.xy[edge]], [s.xy[edge], s.yy[edge]]]) for s in (x, y))
    return np.block([[one, off], [off.T, other]])


class Contractility(vx.AbstractEnergy):
    """One that mixes areas and perimeters, and is no sum of local terms to anybody's knowledge."""

    def __call__(self, tissue):
        ratio = tissue.perimeters**2 / tissue.areas
        return 0.1 * jnp.sum(ratio) + jnp.sum(tissue.edge_lengths**2)


class Friction(vx.AbstractEnergy):
    """An energy of vertices alone."""

    def __call__(self, tissue):
        return 0.5 * 7.0 * jnp.sum(tissue.vertices**2)


@pytest.mark.parametrize("energy", [tense, lambda _: Contractility()], ids=["tension", "mixed"])
def test_blocks_are_those_of_the_hessian_without_pressures(energy):
    tissue = foam()
    blocks = blocks_of(tissue, energy(tissue))
    hessian = dense_hessian(tissue, energy(tissue))
    for edge, (i, j) in enumerate(np.asarray(tissue.topology.edge_vertices)):
        rows = [2 * i, 2 * i + 1, 2 * j, 2 * j + 1]
        missing = hessian[np.ix_(rows, rows)] - both_ends(blocks, edge)
        # A pressure turns what moves: that is the difference of two cells' times a quarter turn.
        turn = 0.5 * (missing[0, 3] - missing[1, 2])
        missing[:2, 2:] -= turn * np.array([[0, 1], [-1, 0]])
        missing[2:, :2] += turn * np.array([[0, 1], [-1, 0]])
        np.testing.assert_allclose(missing, 0, atol=1e-8 * np.abs(hessian).max())


@pytest.mark.thorough
@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    low=st.floats(-2, 1),
    factor=st.floats(2.5, 5.0),
    shift=st.floats(0, 10),
)
def test_the_inverse_is_symmetric_and_positive(seed, low, factor, shift):
    tissue = foam(seed=seed % 7)
    energy = tense(tissue, low, low + 1) + vx.energies.ShapeFactorEnergy(factor)
    yields = _compliance(tissue, energy, jnp.full(tissue.n_vertices, shift))
    a, b = jnp.asarray(np.random.default_rng(seed).normal(size=(2, tissue.n_vertices, 2)))
    np.testing.assert_allclose(jnp.vdot(a, yields(b)), jnp.vdot(b, yields(a)), rtol=1e-9)
    assert jnp.vdot(a, yields(a)) > 0


@eqx.filter_jit
def _compliance(tissue, energy, shift):
    return blocks_of(tissue, energy).approximate_inverse(shift)


def test_the_inverse_is_that_of_each_block():
    tissue = foam()
    blocks = blocks_of(tissue, tense(tissue))
    shift = jnp.linspace(0.1, 2.0, tissue.n_vertices)
    compliance = blocks.approximate_inverse(shift)
    for edge, ends in enumerate(np.asarray(tissue.topology.edge_vertices)):
        more = np.repeat(np.asarray(shift)[ends] + float(blocks.softest), 2)
        expected = np.linalg.inv(both_ends(blocks, edge) + np.diag(more))
        np.testing.assert_allclose(both_ends(compliance, edge), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_an_edge_of_zero_length_keeps_it_finite_and_positive(dtype):
    tissue = foam()
    i, j = tissue.topology.edge_vertices[5]
    onto = tissue.vertices.at[j].add(tissue.edge_vectors[5] * -1)
    tissue = jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        tissue.with_vertices(onto),
    )
    compliance = blocks_of(tissue, tense(tissue)).approximate_inverse()
    for seed in range(5):
        force = np.random.default_rng(seed).normal(size=(tissue.n_vertices, 2))
        moved = compliance(jnp.asarray(force, dtype))
        assert jnp.all(jnp.isfinite(moved))
        assert jnp.vdot(jnp.asarray(force, dtype), moved) > 0
    assert i != j


def test_pinned_vertices_do_not_move():
    held = jnp.arange(foam().n_vertices) % 7 == 0
    tissue = eqx.tree_at(lambda t: t.pinned, foam(), held, is_leaf=lambda x: x is None)
    moved = blocks_of(tissue, tense(tissue)).approximate_inverse()(jnp.ones_like(tissue.vertices))
    assert jnp.all(moved[held] == 0)
    assert jnp.all(jnp.isfinite(moved))
    spare = foam().with_capacity(40)
    moved = blocks_of(spare, tense(spare)).approximate_inverse()(jnp.ones_like(spare.vertices))
    assert jnp.all(jnp.isfinite(moved))
    assert jnp.all(moved[spare.held] == 0)


def test_direct_dependence_on_vertices_counts_by_its_mean():
    tissue = foam()
    energy = tense(tissue)
    without, with_friction = blocks_of(tissue, energy), blocks_of(tissue, energy + Friction())
    np.testing.assert_allclose(with_friction.softest - without.softest, 7.0, rtol=1e-9)


def test_arcs_have_none():
    start = vx.initialise.free_voronoi(30, key=0)
    bent = vx.Tissue(start.vertices, start.topology, vx.Free(), angles=jnp.full(start.n_edges, 0.1))
    assert EdgeBlocks.of(bent, vx.energies.AreaElasticity(1.0, 1.0)) is None


@settings(deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_negative_eigenvalues_are_removed(entries):
    xx, xy, yy = entries
    result = Symmetric(*(jnp.array([x]) for x in entries)).positive
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    expected = (vectors * np.maximum(values, 0)) @ vectors.T
    np.testing.assert_allclose(
        [result.xx[0], result.xy[0], result.yy[0]],
        [expected[0, 0], expected[0, 1], expected[1, 1]],
        atol=1e-9,
    )


@pytest.mark.thorough
def test_contacts_add_their_hessian():
    # Of a corner that comes near a side: three vertices, each with a block on the diagonal.
    tissue = foam(100, seed=2)
    energy = vx.energies.ShapeFactorEnergy(4.3)
    search = vx.Relaxation(contact_range=0.05).search(tissue, energy)
    state = search.advance(search.begin(tissue, energy), energy, 8)
    contacts, tissue = state.contacts, state.tissue
    assert contacts is not None
    assert contacts(tissue) > 0
    hessian = jax.jit(jax.hessian(lambda x: contacts(tissue.with_vertices(x))))(tissue.vertices)
    result = contacts.resistance(tissue)
    several = np.bincount(_vertices_of(contacts, tissue), minlength=tissue.n_vertices)
    checked = 0
    for vertex in np.flatnonzero(several == 1):
        values, vectors = np.linalg.eigh(hessian[vertex, :, vertex])
        block = (vectors * np.maximum(values, 0)) @ vectors.T
        mine = [result.xx[vertex], result.xy[vertex], result.yy[vertex]]
        expected = [block[0, 0], block[0, 1], block[1, 1]]
        np.testing.assert_allclose(mine, expected, atol=1e-8 * float(jnp.abs(hessian).max()))
        checked += np.abs(block).max() > 0
    assert checked > 0
    untouched = several == 0
    assert not jnp.any(jnp.where(untouched, result.xx + result.yy, 0))


def _vertices_of(contacts, tissue) -> np.ndarray:
    corner, side = (np.asarray(x) for x in contacts.sides)
    real = corner != side
    after = np.asarray(tissue.topology.next)[side]
    return np.concatenate([corner[real], side[real], after[real]]) // 3


@pytest.mark.thorough
def test_conjugate_gradients_take_fewer_iterations_under_tensions():
    tissue = foam(200, seed=3)
    energy = tense(tissue)
    relaxed = vx.equilibrate(tissue, energy, tolerance=1e-8, throw=False).tissue
    args = (relaxed, energy, None)
    force = lambda y: value_and_gradient(objective, y, args)[1]
    _, product = jax.linearize(force, relaxed.vertices)
    edges = blocks_of(relaxed, energy).approximate_inverse()

    @eqx.filter_jit
    def steps(preconditioner, rhs):
        def going(carry):
            _, r, *_, k = carry
            return (jnp.linalg.norm(r) > 1e-6 * jnp.linalg.norm(rhs)) & (k < 5000)

        def step(carry):
            x, r, d, rz, k = carry
            hd = product(d) + 1e-4 * d
            alpha = rz / jnp.vdot(d, hd)
            r = r - alpha * hd
            z = preconditioner(r)
            new = jnp.vdot(r, z)
            return x + alpha * d, r, z + new / rz * d, new, k + 1

        z = preconditioner(rhs)
        begin = (0 * rhs, rhs, z, jnp.vdot(rhs, z), jnp.array(0))
        x, *_, k = jax.lax.while_loop(going, step, begin)
        return x, k

    rhs = jnp.asarray(np.random.default_rng(0).normal(size=relaxed.vertices.shape))
    plain, many = steps(lambda r: r, rhs)
    result, few = steps(edges, rhs)
    np.testing.assert_allclose(result, plain, rtol=0, atol=1e-3 * float(jnp.abs(plain).max()))
    assert few < 0.3 * many
