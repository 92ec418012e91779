"""What is recycled of an equilibrium near by: it changes how long a solution takes, and not the solution."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, random_like, random_tissue, shape_factors
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax.costs import VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._recycled_hessian import RecycledHessian

pytestmark = pytest.mark.thorough

N_CELLS = 16
START = random_tissue(N_CELLS)
RELAXATION = vx.Relaxation(tolerance=1e-9)


def energy_of(seed: int) -> ShapeFactorEnergy:
    """Energies that are similar."""
    return ShapeFactorEnergy(3.7 + 0.02 * jax.random.normal(jax.random.key(seed), (N_CELLS,)))


def worked_out(relaxation, tissue, energy) -> RecycledHessian:
    hessian = eqx.filter_jit(relaxation.preconditioner_at)(tissue, energy)
    assert hessian is not None
    return hessian


@pytest.fixture(scope="module")
def at_rest():
    return RELAXATION(START, energy_of(0)).tissue


@pytest.fixture(scope="module")
def recycled(at_rest) -> RecycledHessian:
    return worked_out(RELAXATION, at_rest, energy_of(0))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.floats(-1, 1))
def test_it_is_symmetric_and_positive_whatever_the_hessian(seed, offset):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(12, 12))
    matrix = jnp.asarray(matrix + matrix.T + 5 * offset * np.eye(12))
    place = jnp.asarray(rng.normal(size=(6, 2)))
    product = lambda v: (matrix @ v.ravel()).reshape(v.shape)
    hessian = RecycledHessian.at(product, place, jnp.ones(()))
    shares = jnp.asarray(rng.uniform(0.1, 1, 6))
    for compliance in (
        hessian.approximate_inverse(()),
        hessian.approximate_inverse((), 0.0, shares),
    ):
        yields = lambda f, c=compliance: hessian.apply(c, f, f)
        a, b = jnp.asarray(rng.normal(size=(2, 6, 2)))
        np.testing.assert_allclose(jnp.vdot(a, yields(b)), jnp.vdot(b, yields(a)), rtol=1e-9)
        assert jnp.vdot(a, yields(a)) > 0


def test_at_a_minimum_it_is_the_inverse_hessian(at_rest, recycled):
    slope = jax.grad(lambda v: energy_of(0)(at_rest.with_vertices(v)))
    force = jax.jvp(slope, (at_rest.vertices,), (random_like(at_rest.vertices, 1),))[1]
    moved = recycled.apply(recycled.approximate_inverse(()), force, force)
    back = jax.jvp(slope, (at_rest.vertices,), (moved,))[1]
    np.testing.assert_allclose(back, force, atol=1e-8)


def test_it_is_ready_nearby_and_after_translations(at_rest, recycled):
    assert recycled.near(at_rest.configuration).ready
    translated = at_rest.with_vertices(at_rest.vertices + jnp.array([3.0, -1.0]))
    assert recycled.near(translated.configuration).ready
    elsewhere = at_rest.vertices + 0.1 * random_like(at_rest.vertices, 0)
    assert not recycled.near(at_rest.with_vertices(elsewhere).configuration).ready
    assert not RecycledHessian.unknown(at_rest.configuration).ready


def test_a_nan_hessian_is_not_ready(at_rest):
    nan = at_rest.with_vertices(at_rest.vertices.at[0, 0].set(jnp.nan))
    hessian = worked_out(RELAXATION, nan, energy_of(0))
    assert not hessian.ready
    assert jnp.all(hessian.inverse == 0)


def test_large_tissues_and_other_responses_have_none():
    large = random_tissue(ElasticMedium.min_cells)
    assert RELAXATION.preconditioner_at(large, None) is None
    evolution = vx.Evolution(vx.dissipations.SubstrateFriction(1.0), [0.0, 1.0])
    assert evolution.preconditioner_at(START, None) is None
    assert evolution.with_preconditioner(None) is evolution


def test_wrong_types_and_sizes_are_refused(recycled, without_type_checks):
    with pytest.raises(TypeError, match="`preconditioner` must be a result of `preconditioner_at`"):
        RELAXATION.with_preconditioner("soft")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="has 64 coordinates for 32"):
        RELAXATION.with_preconditioner(recycled)(random_tissue(8), ShapeFactorEnergy(3.7))


@eqx.filter_jit
def _results(relaxation, tissue, energy):
    """Where a tissue comes to rest, a gradient there, and what both have taken."""
    search = relaxation.search(tissue, energy)
    end = search.advance(search.begin(tissue, energy), energy, jnp.asarray(200))
    problem = vx.InverseProblem(tissue, energy, VertexDistance(START), response=relaxation)
    evaluation = problem.value_and_gradient(throw=False)
    rest = evaluation.equilibrium.tissue.vertices
    products = end.iteration.num_products
    return rest, evaluation.gradient, products, evaluation.outcome.num_steps


@pytest.mark.thorough
def test_solutions_are_the_same_with_fewer_products(at_rest, recycled):
    without = RELAXATION.with_preconditioner(RecycledHessian.unknown(at_rest.configuration))
    rest, gradient, products, steps = _results(without, at_rest, energy_of(1))
    plain = eqx.filter_jit(RELAXATION)(at_rest, energy_of(1)).tissue.vertices
    np.testing.assert_allclose(rest, plain, atol=1e-8)
    same, other, fewer_products, fewer_steps = _results(
        RELAXATION.with_preconditioner(recycled), at_rest, energy_of(1)
    )
    np.testing.assert_allclose(same, rest, atol=1e-8)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-6, atol=1e-9)
    assert fewer_products < 0.5 * products
    assert fewer_steps < 0.5 * steps


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["arcs", "pinned", "spare slots", "float32"])
def test_it_works_for_every_kind_of_tissue(kind):
    relaxation = dataclasses.replace(FIXED_TOPOLOGY, tolerance=1e-3 if kind == "float32" else 1e-8)
    tissue = vx.initialise.free_voronoi(8, key=1) if kind == "arcs" else random_tissue(8)
    energy = ShapeFactorEnergy(shape_factors(8, 3.6, 0.02))
    if kind == "arcs":
        energy = AreaElasticity(2.0, 1.0) + LineTension(jnp.full(tissue.n_edges, 0.3))
    elif kind == "pinned":
        mask = jnp.arange(tissue.n_vertices) % 5 == 0
        tissue = eqx.tree_at(lambda t: t.pinned, tissue, mask, is_leaf=lambda x: x is None)
    elif kind == "spare slots":
        tissue = tissue.with_capacity(10)
        energy = ShapeFactorEnergy(shape_factors(10, 3.6, 0.02))
    else:
        single = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
        tissue, energy = jax.tree.map(single, (tissue, energy))
    equilibrium = relaxation(tissue, energy)
    hessian = worked_out(relaxation, equilibrium.tissue, energy)
    stiffer = jax.tree.map(lambda x: 1.01 * x if eqx.is_inexact_array(x) else x, energy)
    plain = relaxation(equilibrium.tissue, stiffer)
    helped = relaxation.with_preconditioner(hessian)(equilibrium.tissue, stiffer)
    assert hessian.ready
    assert hessian.inverse.dtype == tissue.vertices.dtype
    tolerance = 1e-2 if kind == "float32" else 1e-6
    np.testing.assert_allclose(
        helped.tissue.edge_vectors, plain.tissue.edge_vectors, atol=tolerance
    )
