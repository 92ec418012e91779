"""Response to oscillation, and recoil after a cut."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, hexagon_index, random_tissue, shape_factors

import vertax as vx
from vertax import mechanics
from vertax.dissipations import PerimeterViscosity, SubstrateFriction
from vertax.energies import AreaElasticity, PerimeterElasticity, ShapeFactorEnergy

pytestmark = pytest.mark.thorough

C = hexagon_index()
OMEGAS = jnp.array([0.0, 0.3, 2.0, 1e7])


def elastic(p0):
    return AreaElasticity(jnp.array(1.0), jnp.array(1.0)) + PerimeterElasticity(jnp.array(1.0), p0)


@pytest.fixture(scope="module")
def lattice():
    return vx.initialise.hexagonal(4, 4, softening=0.0)


FRICTION = SubstrateFriction(jnp.array(0.7)) + PerimeterViscosity(jnp.array(0.0))


def test_plateaus_of_the_hexagonal_lattice(lattice):
    # Tong et al. 2022: with energies ½ K_P (P - P0)² and P0 = 0 these are 2√3 and 3√3 K_P.
    modulus = mechanics.complex_modulus(lattice, elastic(jnp.array(0.0)), FRICTION, OMEGAS)
    assert float(modulus[0].real) == pytest.approx(2 * np.sqrt(3), rel=1e-9)
    assert float(modulus[-1].real) == pytest.approx(3 * np.sqrt(3), rel=1e-6)
    assert (np.diff(modulus.real) > 0).all()
    assert (modulus.imag[1:] > 0).all()
    # One relaxation time: a standard linear solid.
    g0, g1 = 2 * np.sqrt(3), 3 * np.sqrt(3)
    tau = np.asarray(modulus.imag / ((g1 - modulus.real) * OMEGAS))[1:3]
    np.testing.assert_allclose(tau, tau[0], rtol=1e-6)
    np.testing.assert_allclose(
        modulus[1:3],
        g0 + (g1 - g0) * (1j * OMEGAS[1:3] * tau) / (1 + 1j * OMEGAS[1:3] * tau),
        rtol=1e-6,
    )


@pytest.mark.slow
def test_perimeter_viscosity_against_a_dense_solution(lattice):
    # A disordered configuration, so that nothing vanishes by symmetry.
    tissue = random_tissue(16, 3)
    energy = elastic(jnp.array(3.0))
    viscosity = SubstrateFriction(jnp.array(0.7)) + PerimeterViscosity(jnp.array(0.4))
    modulus = mechanics.complex_modulus(tissue, energy, viscosity, OMEGAS, angle=0.0)

    strain = jnp.array([[0.0, 0.5], [0.5, 0.0]])

    def displaced(z):
        gradient = jnp.eye(2) + z[0] * strain + 0.5 * z[0] ** 2 * strain @ strain
        return mechanics.deformed(
            tissue.with_vertices(tissue.vertices + z[1:].reshape(-1, 2)), gradient
        )

    zero = jnp.zeros(65)
    stiff = np.asarray(jax.jit(jax.hessian(lambda z: energy(displaced(z))))(zero))
    viscous = np.asarray(jax.jit(jax.hessian(lambda z: viscosity(displaced(z), tissue, 1.0)))(zero))
    for omega, value in zip(OMEGAS[1:3], modulus[1:3], strict=True):
        k = stiff + 1j * float(omega) * viscous
        expected = (k[0, 0] - k[0, 1:] @ np.linalg.solve(k[1:, 1:], k[1:, 0])) / 16
        assert complex(value) == pytest.approx(expected, rel=1e-7)


@pytest.mark.thorough
def test_sparse_and_dense_methods_agree():
    # Not at rest, but the tension makes the Hessian positive, and nothing vanishes by symmetry.
    tissue, energy = vx.initialise.hexagonal(6, 6), ShapeFactorEnergy(shape_factors(36, 3.5, 0.02))
    friction = SubstrateFriction(0.7) + PerimeterViscosity(0.4)
    omegas = jnp.array([0.0, 0.3, 2.0, 1e4])
    tensors = [
        mechanics.complex_modulus(tissue, energy, friction, omegas, method="dense"),
        mechanics.complex_modulus(tissue, energy, friction, omegas, method="sparse"),
    ]
    np.testing.assert_allclose(tensors[1], tensors[0], rtol=1e-8)
    sparse_modulus = lambda p: mechanics.complex_modulus(
        tissue, ShapeFactorEnergy(p), friction, 1.0, method="sparse"
    )
    with pytest.raises(TypeError, match='"sparse" only for an AbstractLocalEnergy'):
        jax.jit(sparse_modulus)(3.4)


@pytest.mark.slow
def test_derivatives_against_differences(lattice):
    def loss(p0):
        modulus = mechanics.complex_modulus(lattice, elastic(p0), FRICTION, OMEGAS)
        return jnp.sum(modulus.real) + 2 * jnp.sum(modulus.imag)

    p0, h = jnp.array(2.0), 1e-5
    expected = (loss(p0 + h) - loss(p0 - h)) / (2 * h)
    assert jax.jit(jax.grad(loss))(p0) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.thorough
def test_recoil_against_a_dense_solution():
    n = 12
    energy = ShapeFactorEnergy(shape_factors(n, 3.5, 0.1))
    tissue = random_tissue(n, 1)
    velocity = mechanics.recoil(tissue, energy, SubstrateFriction(2.0), 5)
    grad = jax.grad(lambda x: energy(tissue.with_vertices(x)))(tissue.vertices)
    pull = jax.grad(lambda x: tissue.with_vertices(x).edge_lengths[5])(tissue.vertices)
    tension = mechanics.tensions(tissue, energy)[5]
    np.testing.assert_allclose(velocity, (tension * pull - grad) / 2.0, atol=1e-9)


@pytest.mark.slow
def test_recoil_is_the_initial_velocity_without_the_tension():
    n = 12
    energy = ShapeFactorEnergy(shape_factors(n, 3.5, 0.1))
    tissue = FIXED_TOPOLOGY(random_tissue(n, 1), energy).tissue
    friction = SubstrateFriction(2.0) + PerimeterViscosity(0.3)
    velocity = mechanics.recoil(tissue, energy, friction, 5)
    # Only the four vertices near the cut move much, and its ends move apart.
    first, last = np.asarray(velocity)[tissue.topology.edge_vertices[5]]
    assert np.sum((last - first) * tissue.edge_vectors[5]) > 0
    tension = jnp.zeros(tissue.n_edges).at[5].set(-mechanics.tensions(tissue, energy)[5])
    cut = energy + vx.energies.LineTension(tension)
    movie = vx.evolve(
        tissue,
        cut,
        friction,
        [0.0, 1e-5],
        relaxation=eqx.tree_at(
            lambda r: r.tolerance, FIXED_TOPOLOGY, 1e-9, is_leaf=lambda x: x is None
        ),
    )
    moved = np.asarray(movie.tissue.vertices - tissue.vertices) / 1e-5
    np.testing.assert_allclose(moved, velocity, atol=2e-3 * np.abs(velocity).max())


def test_modulus_at_an_energy_maximum_is_nan():
    tissue = random_tissue(9, 1)
    # The energy decreases in all directions, and the viscosity of perimeters damps only some.
    energy = PerimeterElasticity(jnp.array(1.0), jnp.zeros(9))
    energy = eqx.tree_at(lambda e: e.stiffness, energy, jnp.array(-1.0))
    modulus = mechanics.complex_modulus(tissue, energy, PerimeterViscosity(1.0), jnp.ones(1))
    assert np.isnan(modulus).all()


def test_invalid_arguments_raise(lattice):
    with pytest.raises(ValueError, match="at least 0"):
        mechanics.complex_modulus(lattice, elastic(jnp.array(3.0)), FRICTION, jnp.array([-1.0]))
    with pytest.raises(ValueError, match="one of the 48 edges"):
        mechanics.recoil(lattice, elastic(jnp.array(3.0)), FRICTION, 48)
