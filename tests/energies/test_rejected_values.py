"""Values of energies and costs that have no derivative."""

import jax.numpy as jnp
import optax
import pytest
from helpers import random_tissue

import vertax as vx

TISSUE = random_tissue(6)
ENERGY = vx.energies.ShapeFactorEnergy(jnp.array(3.7))
FRICTION = vx.dissipations.SubstrateFriction(1.0)
pytestmark = pytest.mark.usefixtures("without_type_checks")


class Neighbours(vx.AbstractEnergy):
    """An integer."""

    def __call__(self, tissue):
        return jnp.sum(tissue.neighbour_counts)


class Vector(vx.AbstractEnergy):
    """A number for each cell."""

    def __call__(self, tissue):
        return tissue.areas


class IntegerCost(vx.AbstractCost):
    """An integer."""

    def __call__(self, tissue, energy):
        return jnp.sum(tissue.neighbour_counts)


@pytest.mark.parametrize(
    "compute",
    [
        vx.equilibrate,
        lambda tissue, energy: vx.equilibrate(tissue, energy, solver=vx.solvers.FIRE()),
        lambda tissue, energy: vx.evolve(tissue, energy, FRICTION, [0.0, 0.1]),
        vx.mechanics.stress,
        vx.mechanics.pressures,
        vx.mechanics.shear_modulus,
        lambda tissue, energy: vx.mechanics.velocities(tissue, energy, FRICTION),
    ],
)
@pytest.mark.parametrize(
    ("energy", "returned"), [(Neighbours(), "int"), (Vector(), "float64 of shape .6,.")]
)
def test_energies_without_a_derivative_are_rejected(compute, energy, returned):
    message = rf"`energy` must return one floating-point number, but returns {returned}.*have no derivative"
    with pytest.raises(TypeError, match=message):
        compute(TISSUE, energy)


@pytest.mark.thorough
@pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
def test_integer_costs_are_rejected(adjoint):
    problem = vx.InverseProblem(TISSUE, ENERGY, IntegerCost(), adjoint=adjoint)
    with pytest.raises(
        TypeError, match="`cost` must return one floating-point number, but returns int"
    ):
        vx.fit(problem, optax.adam(1e-3), epochs=1)
