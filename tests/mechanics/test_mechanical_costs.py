"""Costs of stress, moduli and modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue, shape_factors

import vertax as vx
from vertax import costs, mechanics
from vertax.energies import AreaElasticity, PerimeterElasticity

N = 16
PRECISE = eqx.tree_at(lambda r: r.tolerance, FIXED_TOPOLOGY, 1e-11, is_leaf=lambda x: x is None)


def elastic(p0):
    return AreaElasticity(jnp.array(1.5), jnp.array(1.0)) + PerimeterElasticity(jnp.array(1.2), p0)


p0 = shape_factors(N, 3.6, 0.05)
tissue = random_tissue(N, 1)
direction = np.cos(np.arange(N))
CHEAP = [
    costs.Stress(jnp.array([[0.1, 0.02], [0.02, -0.1]])),
    costs.CellStress(jnp.zeros((2, 2)), cells=jnp.array([1, 4, 7])),
]
MODULI = [
    costs.ShearModulus(0.2),
    costs.BulkModulus(2.0),
    costs.Anisotropy(0.3),
]


def test_stress_costs_are_squared_differences():
    e = elastic(p0)
    stress, cells = mechanics.stress(tissue, e), mechanics.cell_stress(tissue, e)
    values = [cost(tissue, e) for cost in CHEAP]
    chosen = np.asarray(cells)[[1, 4, 7]]
    np.testing.assert_allclose(values[0], 0.5 * np.sum((stress - CHEAP[0].target) ** 2))
    np.testing.assert_allclose(values[1], 0.5 * np.sum(chosen**2) / 3)
    with pytest.raises(ValueError, match="one for each selected cell"):
        costs.CellStress(jnp.zeros((3, 2, 2)))(tissue, e)


@pytest.mark.slow
def test_residuals_of_moduli():
    e = elastic(p0)
    rest = PRECISE(tissue, e).tissue
    y = [mechanics.youngs_modulus(rest, e, angle=a) for a in (0.0, np.pi / 2)]
    expected = [
        mechanics.shear_modulus(rest, e) - 0.2,
        mechanics.bulk_modulus(rest, e) - 2.0,
        (y[0] - y[1]) / (y[0] + y[1]) - 0.3,
    ]
    for cost, residual in zip(MODULI, expected, strict=True):
        np.testing.assert_allclose(cost.residuals(rest, e)[0], residual, rtol=1e-9)
    gap = costs.SpectralGap(0.1)(rest, e)
    np.testing.assert_allclose(gap, 0.5 * (mechanics.spectrum(rest, e)[2] - 0.1) ** 2, rtol=1e-6)


def hypergradient_against_differences(cost, rtol, **options):
    problem = vx.InverseProblem(
        tissue=tissue, energy=elastic(p0), cost=cost, response=PRECISE, **options
    )
    evaluate = eqx.filter_jit(lambda e: problem.value_and_gradient(e, throw=False))
    evaluation, h = evaluate(elastic(p0)), 1e-3
    at = lambda s: float(evaluate(elastic(p0 + s * h * direction)).cost)
    expected = (8 * (at(1) - at(-1)) - at(2) + at(-2)) / (12 * h)
    slope = np.sum(evaluation.gradient.terms[1].target_perimeter * direction)
    np.testing.assert_allclose(slope, expected, rtol=rtol)
    assert evaluation.outcome.converged


@pytest.mark.slow
def test_hypergradient_of_stresses():
    hypergradient_against_differences(CHEAP[0] + 0.5 * CHEAP[1], 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [*MODULI, costs.SpectralGap(0.1)], ids=lambda c: type(c).__name__)
def test_hypergradient_of_moduli_and_modes(cost):
    hypergradient_against_differences(cost, 1e-5)


@pytest.mark.slow
def test_hypergradient_of_a_modulus_by_equilibrium_propagation():
    hypergradient_against_differences(MODULI[0], 1e-3, adjoint=vx.EquilibriumPropagation())


@pytest.mark.slow
def test_a_shear_modulus_is_designed():
    problem = vx.InverseProblem(
        tissue=tissue, energy=elastic(p0), cost=costs.ShearModulus(0.3), response=FIXED_TOPOLOGY
    )
    import optax

    fit = vx.fit(problem, optax.adam(1e-2), 40)
    assert mechanics.shear_modulus(fit.tissue, fit.energy) == pytest.approx(0.3, abs=5e-3)
    assert jax.tree.all(jax.tree.map(lambda x: bool(jnp.isfinite(x).all()), fit.energy))
