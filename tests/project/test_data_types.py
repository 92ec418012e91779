"""Tissues in float32 while 64-bit types are enabled: no result is computed or returned in float64."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import FIXED_TOPOLOGY

import vertax as vx
from vertax import costs, mechanics
from vertax.energies import AreaElasticity, PerimeterElasticity

# Large enough for all parts of the preconditioner.
TISSUE = vx.initialise.hexagonal(13, 12)
FRICTION = vx.dissipations.SubstrateFriction(1.0)


def single(tree):
    """The pytree in single precision."""
    cast = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    return jax.tree.map(cast, tree)


ENERGY = single(AreaElasticity(jnp.ones(TISSUE.n_cells), 1.0)) + PerimeterElasticity(1.0, 3.6)
TARGET = single(TISSUE)


def perimeters(adjoint):
    def cost(energy, tissue):
        return jnp.sum(FIXED_TOPOLOGY(tissue, energy, adjoint=adjoint).tissue.perimeters ** 2)

    return lambda tissue: eqx.filter_value_and_grad(cost)(ENERGY, tissue)


def gradient_of(cost):
    def value(vertices, tissue):
        return cost(tissue.with_vertices(vertices), ENERGY)

    return lambda tissue: eqx.filter_value_and_grad(value)(tissue.vertices, tissue)


def fitted(tissue):
    problem = vx.InverseProblem(tissue, ENERGY, costs.VertexDistance(tissue))
    evaluation = problem.value_and_gradient(ENERGY)
    return evaluation.cost, evaluation.gradient, evaluation.equilibrium


def evolved(**options):
    return lambda tissue: vx.evolve(tissue, ENERGY, FRICTION, [0.0, 0.1], **options)


CASES = {
    "box": lambda t: mechanics.BoxRelaxation()(t, ENERGY),
    "implicit": perimeters(vx.ImplicitDifferentiation()),
    "sensitivity": perimeters(vx.ImplicitDifferentiation(mode="sensitivity")),
    "propagation": perimeters(vx.EquilibriumPropagation()),
    "fit": fitted,
    "first order": evolved(),
    "adaptive": evolved(stepsize_controller=vx.dynamics.PIController()),
    "noise": evolved(activity=vx.activities.ThermalNoise(0.1), key=0),
    "signals": evolved(
        activity=vx.signals.Signals(
            None, [0.1], initial=[1.0], couple=lambda c, tissue: AreaElasticity(1.0, c[0])
        )
    ),
    "modulus": lambda t: mechanics.elastic_tensor(t, ENERGY),
    "modes": lambda t: mechanics.modes(t, ENERGY, 3),
    "structure": gradient_of(costs.IndexAwareStructural(TARGET)),
    "sum": gradient_of(2.0 * costs.MeanShapeFactor(3.9) + costs.VertexDistance(TARGET)),
    "shear": gradient_of(costs.ShearModulus(1.0)),
}


# The others are traced for longer, and use the functions of these.
ALWAYS = ("implicit", "fit", "signals", "modes")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in ALWAYS else pytest.mark.thorough) for name in CASES],
)
def test_results_in_float32_while_64_bit_types_are_enabled(name):
    result = eqx.filter_eval_shape(CASES[name], single(TISSUE))
    leaves = [x for x in jax.tree.leaves(result) if hasattr(x, "dtype")]
    assert {str(x.dtype) for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)} == {"float32"}
