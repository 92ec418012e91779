"""A class of energies in place of an instance is rejected by every public function, with the remedy."""

# pyright: reportArgumentType=false

import jax.numpy as jnp
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.energies import LineTension, ShapeFactorEnergy
from vertax.growth import GrowAndDivide, grow

TISSUE = random_tissue(9, 1)
ENERGY = ShapeFactorEnergy(3.7)
FRICTION = vx.dissipations.SubstrateFriction(1.0)
COST = vx.costs.VertexDistance(TISSUE)
ENTRIES = {
    "equilibrate": lambda e: vx.equilibrate(TISSUE, e),
    "record": lambda e: vx.relax.record_relaxation(TISSUE, e),
    "evolve": lambda e: vx.evolve(TISSUE, e, FRICTION, [0.0, 1.0]),
    "material": lambda e: vx.dynamics.Material(e, FRICTION),
    "problem": lambda e: vx.InverseProblem(TISSUE, e, COST),
    "evaluation": lambda e: vx.InverseProblem(TISSUE, ENERGY, COST)(e),
    "stress": lambda e: vx.mechanics.stress(TISSUE, e),
    "velocities": lambda e: vx.mechanics.velocities(TISSUE, e, FRICTION),
    "external": lambda e: vx.External(vx.external.SurfaceEvolver())(TISSUE, e),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_class_of_energies_is_rejected(without_type_checks, name):
    message = (
        r"`energy` must be an energy, .* but is the class ShapeFactorEnergy\. "
        r"Pass an instance, ShapeFactorEnergy\(target_shape_factor\)"
    )
    with pytest.raises(TypeError, match=message):
        ENTRIES[name](ShapeFactorEnergy)


def test_sum_with_a_class_is_rejected(without_type_checks):
    with pytest.raises(TypeError, match=r"the class LineTension\. Pass an instance, LineTension\("):
        _ = ENERGY + LineTension  # pyright: ignore[reportOperatorIssue]


def test_growth_rejects_a_class_of_energies(without_type_checks):
    roomy = TISSUE.with_capacity(12)
    with pytest.raises(TypeError, match=r"Pass such a function, e\.g\. lambda cells: ShapeFactor"):
        grow(roomy, ShapeFactorEnergy, GrowAndDivide(0.1, 1.5), jnp.array([0.0, 1.0]), key=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cost": lambda t, e: 0.0}, r"`cost` must be a cost, .* Make a function of tissue and en"),
        ({"cost": vx.costs.VertexDistance}, r"the class VertexDistance\. Pass an instance, Vert"),
        ({"tissue": TISSUE.vertices}, "`tissue` must be a vertax.Tissue, but is an array"),
        ({"energy": 3.7}, r"`energy` must be an energy, .* but is 3\.7"),
        ({"response": vx.Relaxation}, r"`response` must be .* Pass an instance, Relaxation\(\)"),
        ({"adjoint": "implicit"}, "`adjoint` must be an adjoint, .* but is 'implicit'"),
    ],
)
def test_inverse_problem_rejects_arguments_of_another_type(without_type_checks, changes, message):
    with pytest.raises(TypeError, match=message):
        vx.InverseProblem(**({"tissue": TISSUE, "energy": ENERGY, "cost": COST} | changes))
