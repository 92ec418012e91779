"""The derivative of an equilibrium with respect to the start of its relaxation.

If the equilibrium is unique up to rigid motions, it depends on the start only through its centroid, and for a
free tissue its orientation, which the energy does not determine.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from free_helpers import cluster
from helpers import FIXED_TOPOLOGY, central_difference, random_like, random_tissue
from jaxtyping import Array, Float

import vertax as vx
from vertax.dissipations import PerimeterViscosity, SubstrateFriction
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy

PRECISE = dataclasses.replace(FIXED_TOPOLOGY, tolerance=jnp.asarray(1e-13))
SGD = vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))
MOMENTUM = dataclasses.replace(FIXED_TOPOLOGY, solver=SGD, max_steps=jnp.asarray(20_000))
IMPLICIT = vx.ImplicitDifferentiation()
PERIODIC, PERIODIC_ENERGY = random_tissue(8, 2), ShapeFactorEnergy(jnp.linspace(3.5, 3.7, 8))
FREE, FREE_ENERGY = cluster(7, 6), AreaElasticity(10.0, 1.0) + LineTension(jnp.array(0.8))


@eqx.filter_jit
def position_and_slope(vertices, tissue, energy, adjoint, response):
    """A cost linear in the relaxed positions, and its derivative with respect to the start."""

    def position(vertices):
        relaxed = response(tissue.with_vertices(vertices), energy, adjoint=adjoint)
        return jnp.sum(random_like(vertices, 3) * relaxed.tissue.vertices)

    return jax.value_and_grad(position)(vertices)


def check_against_differences(tissue, energy, adjoint=IMPLICIT, response=PRECISE, *, rtol=1e-6):
    """Compare with finite differences along all vertices; return the gradient."""
    at = lambda x: position_and_slope(x, tissue, energy, adjoint, response)
    slope = at(tissue.vertices)[1]
    direction = random_like(tissue.vertices)
    difference = float(central_difference(lambda x: at(x)[0], tissue.vertices, direction))
    product = float(jnp.sum(slope * direction))
    assert product == pytest.approx(difference, rel=rtol, abs=1e-6)
    return slope


def pinned(tissue, *vertices):
    mask = jnp.zeros(tissue.n_vertices, bool).at[jnp.asarray(vertices)].set(True)
    return eqx.tree_at(lambda t: t.pinned, tissue, mask, is_leaf=lambda x: x is None)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("adjoint", "response"),
    [
        pytest.param(IMPLICIT, PRECISE, id="implicit"),
        pytest.param(vx.ImplicitDifferentiation("sensitivity"), PRECISE, id="sensitivity"),
        pytest.param(vx.EquilibriumPropagation(), PRECISE, id="propagation"),
        pytest.param(vx.AutomaticDifferentiation(), MOMENTUM, id="automatic"),
    ],
)
def test_centroid_of_a_periodic_tissue_follows_the_start(adjoint, response):
    slope = check_against_differences(PERIODIC, PERIODIC_ENERGY, adjoint, response, rtol=1e-4)
    # A displacement of one vertex of the start moves the centroid by 1/V of it.
    weight = jnp.sum(random_like(PERIODIC.vertices, 3), axis=0) / PERIODIC.n_vertices
    np.testing.assert_allclose(slope, jnp.broadcast_to(weight, slope.shape), rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("adjoint", [IMPLICIT, vx.EquilibriumPropagation()])
def test_orientation_of_a_free_tissue_follows_the_start(adjoint):
    slope = check_against_differences(FREE, FREE_ENERGY, adjoint)
    # The derivative is not only that of the centroid.
    assert jnp.abs(slope - jnp.mean(slope, axis=0)).max() > 1e-3


@pytest.mark.thorough
def test_forward_mode_follows_the_start():
    direction = random_like(PERIODIC.vertices)
    relax = lambda x: PRECISE(PERIODIC.with_vertices(x), PERIODIC_ENERGY).tissue.vertices
    tangent = jax.jit(lambda x, d: jax.jvp(relax, (x,), (d,))[1])(PERIODIC.vertices, direction)
    expected = jnp.broadcast_to(jnp.mean(direction, axis=0), direction.shape)
    np.testing.assert_allclose(tangent, expected, atol=1e-9)


@pytest.mark.thorough
def test_orientation_of_a_free_tissue_with_one_pin_follows_the_start():
    slope = check_against_differences(pinned(FREE, 0), FREE_ENERGY)
    assert jnp.abs(slope[1:]).max() > 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("tissue", [pinned(PERIODIC, 0, 7), pinned(FREE, 0, 5)])
def test_pinned_vertices_alone_determine_the_position(tissue):
    energy = PERIODIC_ENERGY if tissue.n_cells == 8 else FREE_ENERGY
    slope = check_against_differences(tissue, energy)
    np.testing.assert_array_equal(slope[~tissue.pinned], 0)
    assert jnp.abs(slope[tissue.pinned]).min() > 1e-3


class Trap(vx.AbstractEnergy):
    """Springs of all vertices to the origin, along x and y."""

    stiffness: Float[Array, "2"]

    def __call__(self, tissue):
        return 0.5 * jnp.sum(self.stiffness * tissue.vertices**2)


@pytest.mark.thorough
def test_only_motions_that_the_energy_does_not_determine_follow_the_start():
    trapped = lambda x, y: PERIODIC_ENERGY + Trap(jnp.array([x, y]))
    np.testing.assert_array_equal(check_against_differences(PERIODIC, trapped(0.1, 0.2)), 0)
    slope = position_and_slope(PERIODIC.vertices, PERIODIC, trapped(0.1, 0.0), IMPLICIT, PRECISE)[1]
    at = lambda y: position_and_slope(
        PERIODIC.vertices + y * jnp.array([0.0, 1.0]),
        PERIODIC,
        trapped(0.1, 0.0),
        IMPLICIT,
        PRECISE,
    )
    difference = (at(1e-4)[0] - at(-1e-4)[0]) / 2e-4
    assert jnp.sum(slope[:, 1]) == pytest.approx(float(difference), rel=1e-6)
    np.testing.assert_array_equal(slope[:, 0], 0)


@pytest.mark.thorough
@pytest.mark.parametrize("dissipation", [PerimeterViscosity(0.5), SubstrateFriction(1.0)])
def test_position_after_evolution_follows_the_start(dissipation):
    # Friction depends on the position at the start of each step; viscosity alone does not fix the position.
    tissue, weights = PERIODIC, random_like(PERIODIC.vertices, 3)

    @eqx.filter_jit
    def position(vertices):
        movie = vx.evolve(
            tissue.with_vertices(vertices),
            PERIODIC_ENERGY,
            dissipation,
            jnp.array([0.0, 0.05, 0.1]),
            relaxation=PRECISE,
        )
        return jnp.sum(weights * movie.tissue.vertices)

    shift = jnp.broadcast_to(jnp.array([0.3, -0.7]), weights.shape)
    slope = jnp.sum(jax.grad(position)(tissue.vertices) * shift)
    assert slope == pytest.approx(float(jnp.sum(weights * shift)), rel=1e-6)
