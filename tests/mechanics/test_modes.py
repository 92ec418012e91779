"""Modes, densities of states and states of self-stress."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import dense_hessian, random_tissue, shape_factors

import vertax as vx
from vertax import mechanics
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy

N = 12
ENERGY = ShapeFactorEnergy(shape_factors(N, 3.6, 0.1))
# Not relaxed: the tests hold for the Hessian at any configuration.
tissue = random_tissue(N, 1)


def test_dense_modes_are_eigenvectors_of_the_hessian():
    matrix = dense_hessian(tissue, ENERGY)
    expected = np.linalg.eigvalsh(matrix)
    np.testing.assert_allclose(mechanics.spectrum(tissue, ENERGY), expected, atol=1e-10)
    modes = mechanics.modes(tissue, ENERGY, 5)
    np.testing.assert_allclose(modes.values, expected[:5], atol=1e-10)
    vectors = np.asarray(modes.displacements).reshape(5, -1)
    np.testing.assert_allclose(vectors @ matrix, modes.values[:, None] * vectors, atol=1e-9)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(5), atol=1e-9)
    assert ((modes.participation_ratios > 0) & (modes.participation_ratios <= 1 + 1e-12)).all()


@pytest.mark.thorough
def test_sparse_and_dense_hessians_agree():
    from vertax.mechanics._hessian import sparse_hessian
    from vertax.mechanics._landscape import Landscape

    # Large enough that some pairs of vertices share a product.
    large = random_tissue(64, 3)
    energy = ShapeFactorEnergy(shape_factors(64, 3.6, 0.1))
    matrix = sparse_hessian(Landscape(large, energy))
    assert matrix is not None
    np.testing.assert_allclose(matrix.toarray(), dense_hessian(large, energy), atol=1e-10)
    assert matrix.nnz < 0.5 * matrix.toarray().size
    # A spring across the tissue is not local, so there is no sparse Hessian.
    spring = lambda t: energy(t) + jnp.sum((t.vertices[0] - t.vertices[70]) ** 2)
    assert sparse_hessian(Landscape(large, spring)) is None


@pytest.mark.thorough
def test_sparse_hessian_of_a_tissue_with_spare_slots():
    from vertax.mechanics._hessian import sparse_hessian
    from vertax.mechanics._landscape import Landscape

    # The vertices of the slot that a removal leaves lie among the others, and have no cell.
    change = vx.transitions.remove(random_tissue(12, 1).with_capacity(12), 4)
    energy = AreaElasticity(1.0, 1.2)
    matrix = sparse_hessian(Landscape(change.tissue, energy))
    assert matrix is not None
    np.testing.assert_allclose(matrix.toarray(), dense_hessian(change.tissue, energy), atol=1e-10)


@pytest.mark.slow
def test_sparse_and_dense_modes_of_a_relaxed_tissue_agree():
    energy = ShapeFactorEnergy(shape_factors(64, 3.6, 0.1))
    rest = vx.equilibrate(random_tissue(64, 3), energy, contact_range=None).tissue
    dense = mechanics.modes(rest, energy, 8, method="dense")
    sparse = mechanics.modes(rest, energy, 8, method="sparse")
    np.testing.assert_allclose(sparse.values, dense.values, atol=1e-9)
    assert abs(np.sum(sparse.vectors[4] * dense.vectors[4])) == pytest.approx(1, abs=1e-6)
    assert mechanics.zero_modes(rest, energy) == 2


@pytest.mark.slow
def test_sparse_and_dense_modes_with_arcs_and_pins_agree():
    start = cluster(19, 2)
    energy = AreaElasticity(20.0, 1.0) + LineTension(jnp.linspace(0.8, 1.2, start.n_edges))
    free = vx.equilibrate(start, energy, contact_range=None).tissue
    import equinox as eqx

    for pinned in (None, jnp.arange(free.n_vertices) < 3):
        one = eqx.tree_at(lambda t: t.pinned, free, pinned, is_leaf=lambda x: x is None)
        dense = mechanics.modes(one, energy, 6, method="dense")
        sparse = mechanics.modes(one, energy, 6, method="sparse")
        np.testing.assert_allclose(sparse.values, dense.values, atol=1e-8)
        zero = mechanics.zero_modes(one, energy)
        assert zero == (3 if pinned is None else 0)
        n_free = 2 * one.n_vertices - (0 if pinned is None else 6) + int(np.sum(one.is_arc))
        assert mechanics.spectrum(one, energy).size == n_free


@pytest.mark.slow
def test_derivatives_of_eigenvalues_against_differences():
    direction, h = jnp.cos(jnp.arange(N)), 1e-6
    values = jax.jit(lambda p: mechanics.modes(tissue, ShapeFactorEnergy(p), 6).values[2:])
    p0 = ENERGY.target_shape_factor
    expected = (values(p0 + h * direction) - values(p0 - h * direction)) / (2 * h)
    tangent = jax.jit(lambda p: jax.jvp(values, (p,), (direction,))[1])(p0)
    np.testing.assert_allclose(tangent, expected, rtol=1e-5, atol=1e-7)


def test_density_of_states():
    values = jnp.concatenate([jnp.zeros(2), jnp.arange(1.0, 9.0) ** 2])
    frequencies, density = mechanics.density_of_states(values, 4)
    np.testing.assert_allclose(frequencies, [1, 3, 5, 7])
    np.testing.assert_allclose(density, [0.05, 0.1, 0.1, 0.15])
    assert np.sum(density) * 2 == pytest.approx(0.8)


def test_self_stresses_are_in_equilibrium_and_satisfy_the_maxwell_calladine_count():
    self_stress = mechanics.self_stresses(tissue)
    matrix = mechanics.compatibility(tissue)
    np.testing.assert_allclose(self_stress.states @ matrix, 0, atol=1e-9)
    assert self_stress.degrees_of_freedom == 4 * N
    assert self_stress.number == self_stress.zero_modes + 2 * N - 4 * N
    # The areas sum to the area of the box, so equal pressures are a state of self-stress.
    assert self_stress.number == 1
    np.testing.assert_allclose(np.abs(self_stress.states[0, :N]), 1 / np.sqrt(N), atol=1e-9)
    # With the tensions of all edges in place of perimeters there are more constraints.
    edges = mechanics.self_stresses(tissue, ["areas", "edge_lengths"])
    assert edges.number == edges.zero_modes


@pytest.mark.slow
def test_numbers_of_self_stresses_and_zero_modes_of_rigid_and_fluid_tissues():
    # The tensions and pressures of a rigid tissue at rest are one more state.
    for p0, states, zero in ((3.6, 2, 2), (4.1, 1, 2 * N + 1)):
        energy = ShapeFactorEnergy(jnp.full(N, p0))
        rest = vx.equilibrate(tissue, energy, contact_range=None, tolerance=1e-11).tissue
        assert mechanics.self_stresses(rest, tolerance=1e-7).number == states
        assert mechanics.zero_modes(rest, energy, tolerance=1e-7) == zero


def test_invalid_arguments_raise(without_type_checks):
    with pytest.raises(ValueError, match="must be at most"):
        mechanics.modes(tissue, ENERGY, 49)
    with pytest.raises(ValueError, match="must be one of None, 'dense', 'sparse'"):
        mechanics.modes(tissue, ENERGY, 2, method="quick")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match='can be "sparse" only'):
        jax.jit(lambda p: mechanics.modes(tissue, ShapeFactorEnergy(p), 2, method="sparse"))(3.6)
    with pytest.raises(ValueError, match="must name some of"):
        mechanics.self_stresses(tissue, ["volumes"])  # pyright: ignore[reportArgumentType]
