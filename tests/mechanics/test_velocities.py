"""Velocities, and their integration by the solvers of Diffrax."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, central_difference, random_like, random_tissue

import vertax as vx
from vertax.dissipations import PerimeterViscosity, SubstrateFriction
from vertax.energies import ShapeFactorEnergy
from vertax.mechanics import velocities

ENERGY = ShapeFactorEnergy(jnp.linspace(3.5, 3.8, 9))


@pytest.mark.thorough
def test_velocities_balance_forces_and_dissipation():
    tissue = random_tissue(9, 4)
    friction, viscosity = jnp.linspace(0.5, 2, 18), 0.3
    force = -jax.grad(lambda x: ENERGY(tissue.with_vertices(x)))(tissue.vertices)
    plain = velocities(tissue, ENERGY, SubstrateFriction(friction))
    np.testing.assert_allclose(plain, force / friction[:, None], rtol=1e-9, atol=1e-11)
    both = velocities(tissue, ENERGY, SubstrateFriction(friction) + PerimeterViscosity(viscosity))
    slopes = jax.jacobian(lambda x: tissue.with_vertices(x).perimeters)(tissue.vertices)
    slopes = np.asarray(slopes).reshape(9, -1)
    matrix = np.diag(np.repeat(friction, 2)) + viscosity * slopes.T @ slopes
    dense = np.linalg.solve(matrix, np.asarray(force).ravel())
    np.testing.assert_allclose(both.ravel(), dense, rtol=1e-8, atol=1e-10)


@pytest.mark.thorough
def test_pinned_vertices_have_zero_velocity_and_gradients_match_differences():
    free = random_tissue(9, 4)
    tissue = vx.Tissue(
        free.vertices, free.topology, free.boundary, free.softening, pinned=jnp.arange(18) < 2
    )
    weights = random_like(tissue.vertices)

    @eqx.filter_jit
    def work(targets):
        velocity = velocities(
            tissue, ShapeFactorEnergy(targets), SubstrateFriction(2.0), throw=False
        )
        return jnp.sum(weights * velocity), velocity

    targets = ENERGY.target_shape_factor
    gradient, velocity = jax.grad(work, has_aux=True)(targets)
    np.testing.assert_array_equal(velocity[:2], 0)
    direction = random_like(targets, 3)
    slope = central_difference(lambda p: work(p)[0], targets, direction)
    np.testing.assert_allclose(jnp.sum(gradient * direction), slope, rtol=1e-6)


@pytest.mark.thorough
def test_explicit_steps_of_diffrax_converge_to_evolve():
    tissue = FIXED_TOPOLOGY(random_tissue(9, 4), ENERGY).tissue
    start = tissue.with_vertices(tissue.vertices + 0.02 * random_like(tissue.vertices, 7))
    friction = SubstrateFriction(1.5)
    move = lambda t, x, args: velocities(start.with_vertices(x), ENERGY, friction, throw=False)
    explicit = diffrax.diffeqsolve(
        diffrax.ODETerm(move),
        diffrax.Tsit5(),
        0.0,
        0.2,
        0.01,
        start.vertices,
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-10),
    )
    assert explicit.ys is not None
    errors = []
    for substeps in (10, 20):
        implicit = vx.evolve(
            start,
            ENERGY,
            friction,
            [0.0, 0.2],
            order=2,
            substeps=substeps,
            relaxation=FIXED_TOPOLOGY,
        )
        errors.append(float(jnp.max(jnp.abs(implicit.tissue.vertices - explicit.ys[-1]))))
    assert errors[1] < 1e-4
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.35)
