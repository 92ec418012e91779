"""With `jax_debug_nans` computations without a fault end without an error."""

import jax.numpy as jnp
import numpy as np
import optax
import optimistix
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue

import vertax as vx

CELLS = 6
TISSUE = random_tissue(CELLS)
GUESS = jnp.full(CELLS, 3.7)
ENERGY = vx.energies.ShapeFactorEnergy(GUESS)
UNROLLED = vx.Relaxation(
    vx.solvers.Optax(optax.sgd(1e-2, momentum=0.9)),
    transitions=None,
    contact_range=None,
    tolerance=1e-3,
    max_steps=1000,
)
ADJOINTS = {
    "implicit": (vx.ImplicitDifferentiation(), FIXED_TOPOLOGY),
    "sensitivity": (vx.ImplicitDifferentiation(mode="sensitivity"), FIXED_TOPOLOGY),
    "propagation": (vx.EquilibriumPropagation(), FIXED_TOPOLOGY),
    "unrolling": (vx.AutomaticDifferentiation(throw=False), UNROLLED),
}


@pytest.fixture(scope="module")
def cost():
    truth = vx.energies.ShapeFactorEnergy(GUESS - 0.1)
    return vx.costs.VertexDistance(FIXED_TOPOLOGY(TISSUE, truth).tissue)


class Invalid(vx.AbstractEnergy):
    """A NaN."""

    def __call__(self, tissue):
        return jnp.sqrt(-jnp.sum(tissue.areas))


@pytest.mark.thorough
def test_nan_of_an_energy_is_an_error():
    with pytest.raises(FloatingPointError, match="nan"):
        FIXED_TOPOLOGY(TISSUE, Invalid())


@pytest.mark.parametrize(
    "name",
    [
        "implicit",
        *(
            pytest.param(name, marks=pytest.mark.thorough)
            for name in ADJOINTS
            if name != "implicit"
        ),
    ],
)
def test_gradients_and_fits(name, cost):
    adjoint, response = ADJOINTS[name]
    problem = vx.InverseProblem(TISSUE, ENERGY, cost, response=response, adjoint=adjoint)
    history = vx.fit(problem, optax.adam(1e-2), epochs=2).history
    assert np.isfinite(history.gradient_residual).all()
    assert np.isnan(history.relative_error).all()


@pytest.mark.thorough
def test_least_squares(cost):
    problem = vx.InverseProblem(TISSUE, ENERGY, cost, response=FIXED_TOPOLOGY)
    fit = vx.fit(problem, optimistix.LevenbergMarquardt(1e-6, 1e-6), epochs=2)
    assert fit.history.cost[1] < fit.history.cost[0]
    assert np.isnan(fit.history.gradient_norm).all()


@pytest.mark.thorough
def test_evolution_and_moduli():
    friction = vx.dissipations.SubstrateFriction(1.0)
    times = jnp.array([0.0, 0.1])
    moved = vx.evolve(TISSUE, ENERGY, friction, times, relaxation=FIXED_TOPOLOGY)
    assert jnp.isfinite(moved.tissue.vertices).all()
    rest = FIXED_TOPOLOGY(TISSUE, ENERGY).tissue
    assert jnp.isfinite(vx.mechanics.shear_modulus(rest, ENERGY))
