"""Adaptive time steps."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    FIXED_TOPOLOGY,
    NO_CONTACT,
    central_difference,
    random_like,
    random_tissue,
    relaxed,
)

import vertax as vx
from vertax.dissipations import SubstrateFriction
from vertax.dynamics import PIController
from vertax.energies import ShapeFactorEnergy

FRICTION = SubstrateFriction(1.0)


@functools.cache
def displaced_tissue():
    """A tissue displaced from rest, and its energy."""
    tissue, energy = relaxed(9, 1, 3.5)
    tissue = FIXED_TOPOLOGY(tissue, energy).tissue
    return tissue.with_vertices(tissue.vertices + 0.02 * random_like(tissue.vertices, 7)), energy


def evolved(order=1, **settings):
    tissue, energy = displaced_tissue()
    return vx.evolve(
        tissue,
        energy,
        FRICTION,
        [0.0, 0.05, 1.0],
        order=order,
        relaxation=FIXED_TOPOLOGY,
        **settings,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("order", [1, 2])
def test_error_scales_with_the_tolerance(order):
    exact = evolved(2, substeps=300).tissue.vertices
    tolerances = np.array([1e-3, 1e-4, 1e-5])
    runs = [
        evolved(order, stepsize_controller=PIController(tolerance, max_steps=200))
        for tolerance in tolerances
    ]
    errors = np.array([jnp.max(jnp.abs(run.tissue.vertices - exact)) for run in runs])
    counts = np.array([(run.steps > 0).sum() for run in runs])
    # The tolerance is for the local error; the global error scales with the power p / (p + 1).
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    # (The order of stiff modes, which are damped but not resolved, is below 2.)
    np.testing.assert_allclose(slope, order / (order + 1), atol=0.2 if order == 1 else 0.3)
    assert (errors < 10 * tolerances ** (order / (order + 1))).all()
    assert (np.diff(counts) > 0).all()
    for run in runs:
        np.testing.assert_allclose(run.steps.sum(axis=1)[1:], jnp.diff(run.times), rtol=1e-9)
        assert (jnp.diff(run.energies) < 0).all() or order == 2
        # Later the motion is slower, and steps are longer.
        steps = np.asarray(run.steps[-1])
        steps = steps[steps > 0]
        assert steps.max() > 3 * run.steps[1, 0]


@pytest.mark.thorough
def test_gradient_at_fixed_step_sizes():
    tissue, energy = displaced_tissue()
    weights = random_like(tissue.vertices, 8)
    # The residual force limits the accuracy of the finite difference.
    precise_relaxation = vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-12)

    @eqx.filter_jit
    def cost(friction, control):
        movie = vx.evolve(
            tissue,
            energy,
            SubstrateFriction(friction),
            [0.0, 0.4],
            relaxation=precise_relaxation,
            stepsize_controller=control,
            throw=False,
        )
        return jnp.sum(weights * movie.tissue.vertices**2), movie.steps[1]

    # With this tolerance a small change of the friction does not change the step sizes.
    control = PIController(1.0, first_step=0.05, max_steps=8)
    friction = jnp.linspace(0.8, 1.2, tissue.n_vertices)
    gradient, steps = jax.grad(cost, has_aux=True)(friction, control)
    assert 1 < (steps > 0).sum() < 8
    direction = random_like(friction)
    np.testing.assert_allclose(
        jnp.sum(gradient * direction),
        central_difference(lambda f: cost(f, control)[0], friction, direction),
        rtol=1e-6,
    )


@pytest.mark.thorough
def test_rejected_steps_do_not_change_the_state():
    tissue, energy = random_tissue(9, 0), ShapeFactorEnergy(jnp.linspace(3.2, 3.6, 9))
    times = [0.0, 0.1, 0.3]
    control = PIController(2e-3, first_step=0.1, max_steps=60)
    run = vx.evolve(
        tissue, energy, FRICTION, times, relaxation=NO_CONTACT, stepsize_controller=control
    )
    assert run.num_rejected.sum() > 0  # the first step is far too long
    assert run.num_t1 == run.transitions.sum() > 0
    assert (jnp.diff(run.energies) < 0).all()
    fixed = vx.evolve(tissue, energy, FRICTION, times, relaxation=NO_CONTACT, substeps=100)
    np.testing.assert_array_equal(run.transitions, fixed.transitions)
    np.testing.assert_allclose(run.energy, fixed.energy, rtol=0.02)


class TestErrors:
    def test_numbers_must_be_positive(self):
        for settings in ({"tolerance": 0.0}, {"first_step": -1.0}, {"max_steps": 0}):
            with pytest.raises(ValueError, match=next(iter(settings))):
                PIController(**settings)  # pyright: ignore[reportArgumentType]

    def test_incompatible_arguments_raise(self, without_type_checks):
        control = PIController()
        with pytest.raises(ValueError, match="does not go with `substeps`"):
            vx.Evolution(FRICTION, [0.0, 1.0], stepsize_controller=control, substeps=2)
        noise = vx.activities.ThermalNoise(0.1)
        with pytest.raises(ValueError, match="does not go with `activity`: random numbers"):
            vx.Evolution(FRICTION, [0.0, 1.0], stepsize_controller=control, activity=noise, key=0)
        with pytest.raises(TypeError, match="`stepsize_controller` must be a"):
            vx.Evolution(FRICTION, [0.0, 1.0], stepsize_controller=0.1)  # pyright: ignore[reportArgumentType]

    @pytest.mark.thorough
    def test_too_few_steps_raise(self):
        with pytest.raises(RuntimeError, match="Raise `max_steps` of the `PIController`"):
            evolved(stepsize_controller=PIController(1e-6, max_steps=3))
