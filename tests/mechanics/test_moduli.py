"""Elastic moduli: closed forms for the hexagonal lattice, finite differences for disordered tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import FIXED_TOPOLOGY, hexagon_index, random_tissue, shape_factors

import vertax as vx
from vertax import mechanics
from vertax.energies import AreaElasticity, PerimeterElasticity, ShapeFactorEnergy

C = hexagon_index()
N = 16
PRECISE = eqx.tree_at(lambda r: r.tolerance, FIXED_TOPOLOGY, 1e-11, is_leaf=lambda x: x is None)


@pytest.fixture(scope="module")
def lattice():
    return vx.initialise.hexagonal(4, 4, softening=0.0)


# One class of energy and one number of cells for all tests, which then share compiled functions.
def elastic(k_a, k_p, p0):
    perimeters = PerimeterElasticity(jnp.array(k_p), jnp.broadcast_to(p0, N))
    return AreaElasticity(jnp.array(k_a), jnp.array(1.0)) + perimeters


@pytest.mark.thorough
@pytest.mark.parametrize("p0", [3.2, 3.6])
def test_moduli_of_the_hexagonal_lattice(lattice, p0):
    k_a, k_p = 2.0, 1.7
    energy = elastic(k_a, k_p, p0)
    scale = k_p * C * (C - p0)
    for angle in (None, 0.0, 0.4):
        modulus = mechanics.shear_modulus(lattice, energy, angle=angle)
        assert modulus == pytest.approx(scale / 4, rel=1e-9)
    affine = mechanics.shear_modulus(lattice, energy, affine=True)
    assert affine == pytest.approx(3 / 8 * scale, rel=1e-9)
    stiffness = k_a + k_p * C * p0 / 4
    assert mechanics.bulk_modulus(lattice, energy) == pytest.approx(stiffness, rel=1e-9)


@pytest.fixture(scope="module")
def disordered():
    energy = elastic(1.5, 1.2, shape_factors(N, 3.6, 0.05))
    return PRECISE(random_tissue(N, 1), energy).tissue, energy


STRAINS = (((1.0, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, 1.0)), ((0.0, 0.5), (0.5, 0.0)))


def exponential(strain):
    values, vectors = np.linalg.eigh(strain)
    return jnp.asarray(vectors @ np.diag(np.exp(values)) @ vectors.T)


def tensor_by_differences(energy_at, stress, area, step):
    """The elastic tensor by fourth-order differences of energies at logarithmic strains."""
    basis = np.array(STRAINS)
    along = lambda v: np.tensordot(v, basis, 1)
    energy_0 = energy_at(np.zeros((2, 2)))

    def curvature(v):
        e = {s: energy_at(s * step * along(v)) for s in (-2, -1, 1, 2)}
        return (16 * (e[1] + e[-1]) - e[2] - e[-2] - 30 * energy_0) / (12 * step**2)

    tensor, unit = np.zeros((3, 3)), np.eye(3)
    for i in range(3):
        tensor[i, i] = curvature(unit[i])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        tensor[i, j] = tensor[j, i] = (
            curvature(unit[i] + unit[j]) - tensor[i, i] - tensor[j, j]
        ) / 2
    voigt = np.array([stress[0, 0], stress[1, 1], stress[0, 1]])
    prestress = np.outer(voigt, [1, 1, 0])
    return tensor / area - (prestress + prestress.T) / 2


@pytest.mark.thorough
def test_moduli_of_a_disordered_tissue_against_relaxed_energies(disordered):
    tissue, energy = disordered

    def energy_at(strain):
        return float(PRECISE(mechanics.deformed(tissue, exponential(strain)), energy).energy)

    stress, area = mechanics.stress(tissue, energy), float(tissue.boundary.area)
    expected = tensor_by_differences(energy_at, stress, area, 2e-3)
    tensor = mechanics.elastic_tensor(tissue, energy)
    np.testing.assert_allclose(tensor, expected, atol=1e-6 * np.abs(expected).max())
    affine = mechanics.shear_modulus(tissue, energy, affine=True)
    assert 0 < mechanics.shear_modulus(tissue, energy) < affine


def test_modulus_equals_the_energy_curvature_under_simple_shear(disordered):
    # Simple shear along x includes a rotation, which adds half the normal stress difference to the curvature.
    tissue, energy = disordered
    stress, h = mechanics.stress(tissue, energy), 2e-3
    at = lambda g: float(
        PRECISE(mechanics.deformed(tissue, jnp.array([[1.0, g], [0.0, 1.0]])), energy).energy
    )
    curvature = (16 * (at(h) + at(-h)) - at(2 * h) - at(-2 * h) - 30 * at(0.0)) / (12 * h**2)
    expected = float(curvature / tissue.boundary.area + (stress[0, 0] - stress[1, 1]) / 2)
    assert mechanics.shear_modulus(tissue, energy, angle=0.0) == pytest.approx(expected, rel=1e-5)


def test_default_shear_modulus_is_the_mean_over_directions(disordered):
    tissue, energy = disordered
    along = [mechanics.shear_modulus(tissue, energy, angle=a) for a in np.pi * np.arange(8) / 8]
    assert mechanics.shear_modulus(tissue, energy) == pytest.approx(np.mean(along))
    assert np.ptp(along) > 1e-3


@pytest.mark.slow
def test_derivatives_of_relaxed_moduli_against_differences(disordered):
    tissue, energy = disordered
    weights = jnp.array([[1.0, 0.3, -0.4], [0.3, -0.8, 0.5], [-0.4, 0.5, 2.0]])

    def moduli(p0):
        changed = elastic(1.5, 1.2, p0)
        rest = PRECISE(tissue, changed, throw=False).tissue
        return jnp.sum(weights * mechanics.elastic_tensor(rest, changed, throw=False))

    p0, direction, h = energy.terms[1].target_perimeter, np.cos(np.arange(N)), 1e-4
    at = lambda s: float(moduli(p0 + s * h * direction))
    expected = (8 * (at(1) - at(-1)) - at(2) + at(-2)) / (12 * h)
    slope = jax.jit(jax.grad(moduli))(p0)
    assert np.sum(slope * direction) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_second_derivatives_of_moduli_against_differences(disordered):
    tissue, energy = disordered

    def modulus(p0):
        changed = elastic(1.5, 1.2, p0)
        return mechanics.shear_modulus(tissue, changed, throw=False)

    p0, direction, h = energy.terms[1].target_perimeter, jnp.cos(jnp.arange(N)), 1e-4
    along = jax.jit(lambda p: jax.jvp(modulus, (p,), (direction,))[1])
    curvature = jax.jit(lambda p: jax.jvp(along, (p,), (direction,))[1])(p0)
    expected = (along(p0 + h * direction) - along(p0 - h * direction)) / (2 * h)
    assert curvature == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.slow
def test_a_fluid_tissue_has_no_shear_modulus():
    energy = ShapeFactorEnergy(jnp.full(N, 4.1))
    tissue = PRECISE(random_tissue(N, 1), energy).tissue
    assert energy(tissue) < 1e-14
    assert abs(mechanics.shear_modulus(tissue, energy)) < 1e-6
    assert mechanics.shear_modulus(tissue, energy, affine=True) > 0.1


@pytest.mark.thorough
def test_coarser_fallback_solve_gives_the_same_modulus(disordered):
    exact = mechanics.shear_modulus(*disordered)
    # In 3 steps the first solve fails, and the fallback runs.
    coarse = mechanics.shear_modulus(*disordered, linear_solver=vx.MINRES(max_steps=3))
    assert coarse != exact
    assert coarse == pytest.approx(float(exact), rel=1e-8)


def test_invalid_arguments_raise(disordered):
    with pytest.raises(ValueError, match="must be periodic"):
        mechanics.shear_modulus(cluster(4, 1), AreaElasticity(1.0, 1.0))
    tissue, energy = disordered
    broken = eqx.tree_at(lambda e: e.terms[0].stiffness, energy, jnp.array(jnp.nan))
    with pytest.raises(RuntimeError, match="linear solve with the Hessian failed"):
        mechanics.elastic_tensor(tissue, broken)
    assert np.isnan(mechanics.elastic_tensor(tissue, broken, throw=False)).any()
