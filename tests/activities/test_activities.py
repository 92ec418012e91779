"""Thermal noise, self-propulsion and fluctuating tensions."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import FIXED_TOPOLOGY, central_difference, dense_hessian, relaxed

import vertax as vx
from vertax.activities import FluctuatingTensions, Push, SelfPropulsion, ThermalNoise
from vertax.activities._tensions import TensionState
from vertax.dissipations import PerimeterViscosity, SubstrateFriction
from vertax.energies import ShapeFactorEnergy

FRICTION = SubstrateFriction(2.0)
CELLS = 12
KEY = jax.random.key(0)


@functools.cache
def solid():
    tissue, energy = relaxed(CELLS, 1, 3.5)
    return FIXED_TOPOLOGY(tissue, energy).tissue, energy


def evolve(
    activity,
    times,
    dissipation: vx.AbstractDissipation = FRICTION,
    key: int | None = 0,
    **settings,
):
    tissue, energy = solid()
    return vx.evolve(
        settings.pop("tissue", tissue),
        energy,
        dissipation,
        times,
        activity=activity,
        key=key,
        relaxation=FIXED_TOPOLOGY,
        **settings,
    )


class TestThermalNoise:
    @pytest.mark.thorough
    def test_force_covariance_matches_the_dissipation(self):
        # The covariance of the forces is 2 T / dt times the matrix of the dissipation; both are compared as
        # quadratic forms along random directions.
        tissue, _ = solid()
        dissipation = SubstrateFriction(0.7) + PerimeterViscosity(0.3)
        dt, temperature = 0.1, 0.02
        matrix = jax.hessian(
            lambda x: dissipation(tissue.with_vertices(x.reshape(-1, 2)), tissue, 1.0)
        )(tissue.vertices.ravel())
        directions = np.random.default_rng(0).normal(size=(5, 48))

        @jax.jit
        def forces(keys):
            draw = lambda key: ThermalNoise(temperature).drive(
                None, tissue, dissipation, jnp.array(0.0), jnp.array(dt), key
            )[0]
            return jax.vmap(lambda key: draw(key).force.ravel())(keys)

        work = np.asarray(forces(jax.random.split(KEY, 4000))) @ directions.T
        expected = 2 * temperature / dt * np.einsum("ki,ij,kj->k", directions, matrix, directions)
        np.testing.assert_allclose((work**2).mean(axis=0), expected, rtol=0.08)
        np.testing.assert_allclose(work.mean(axis=0) / np.sqrt(expected), 0, atol=0.06)

    @pytest.mark.thorough
    def test_modes_satisfy_equipartition(self):
        # With implicit Euler steps λ <q²> = T / (1 + λ dt / 2 ζ) for each mode.
        tissue, energy = solid()
        temperature, dt, friction = 1e-6, 0.4, 2.0
        values, modes = np.linalg.eigh(dense_hessian(tissue, energy))
        values, modes = values[2:], modes[:, 2:]
        movie = evolve(ThermalNoise(temperature), dt * jnp.arange(1500))
        displacement = np.asarray(movie.frames.vertices - tissue.vertices)[200:]
        amplitudes = displacement.reshape(len(displacement), -1) @ modes
        energies = values * (amplitudes**2).mean(axis=0) * (1 + values * dt / (2 * friction))
        # Stiff modes decorrelate faster: weight each mode by its rate of independent samples.
        weights = 1 - np.exp(-values * dt / friction)
        assert np.average(energies, weights=weights) == pytest.approx(temperature, rel=0.03)
        slow, fast = values < np.median(values), values > np.median(values)
        assert energies[fast].mean() == pytest.approx(temperature, rel=0.04)
        assert energies[slow].mean() == pytest.approx(temperature, rel=0.15)

    @pytest.mark.thorough
    def test_noise_is_reproducible_and_can_be_continued(self):
        times = 0.1 * jnp.arange(9)
        full = evolve(ThermalNoise(1e-4), times)
        repeated = evolve(ThermalNoise(1e-4), times)
        np.testing.assert_array_equal(full.frames.vertices, repeated.frames.vertices)
        other = evolve(ThermalNoise(1e-4), times, key=1)
        assert jnp.abs(other.tissue.vertices - full.tissue.vertices).max() > 1e-3
        first_half = evolve(ThermalNoise(1e-4), times[:5])
        second_half = evolve(
            ThermalNoise(1e-4),
            times[4:],
            key=None,
            drive=first_half.drive,
            tissue=first_half.tissue,
        )
        np.testing.assert_allclose(
            second_half.frames.vertices, full.frames.vertices[4:], atol=1e-13
        )

    @pytest.mark.thorough
    def test_temperature_gradient_matches_finite_differences(self):
        weights = np.random.default_rng(0).normal(size=(24, 2))

        @eqx.filter_jit
        def cost(temperature):
            return jnp.sum(
                weights * evolve(ThermalNoise(temperature), [0.0, 0.2, 0.4]).tissue.vertices
            )

        slope = eqx.filter_jit(jax.grad(cost))(jnp.array(1e-3))
        difference = central_difference(cost, jnp.array(1e-3), jnp.array(1.0), 1e-6)
        np.testing.assert_allclose(slope, difference, rtol=1e-6)

    def test_invalid_arguments_are_rejected(self, without_type_checks):
        class NotASumOfSquares(vx.AbstractDissipation):
            def __call__(self, tissue, before, dt):
                return jnp.sum((tissue.vertices - before.vertices) ** 2) / dt

        with pytest.raises(ValueError, match="`temperature` must be at least 0"):
            ThermalNoise(-1.0)
        with pytest.raises(ValueError, match="AbstractViscosity"):
            evolve(ThermalNoise(1.0), [0.0, 1.0], NotASumOfSquares())
        with pytest.raises(ValueError, match="`key` is missing"):
            evolve(ThermalNoise(1.0), [0.0, 1.0], key=None)
        with pytest.raises(TypeError, match="`activity`"):
            evolve(1.0, [0.0, 1.0])


class TestSelfPropulsion:
    @pytest.mark.parametrize(
        "make",
        [lambda: cluster(9, 2), pytest.param(lambda: solid()[0], marks=pytest.mark.thorough)],
    )
    def test_vertex_forces_sum_to_cell_forces(self, make):
        tissue = make()
        activity = SelfPropulsion(jnp.linspace(0.1, 1.0, tissue.n_cells), 0.0)
        state = activity.init(tissue, KEY)
        angles = state.angles
        push, after = activity.drive(state, tissue, FRICTION, jnp.array(0.0), jnp.array(0.1), KEY)
        assert isinstance(push, Push)
        np.testing.assert_array_equal(after.angles, angles)
        direction = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
        total = jnp.sum(activity.force[:, None] * direction, axis=0)
        np.testing.assert_allclose(push.force.sum(axis=0), total, atol=1e-12)

    def test_direction_autocorrelation_decays_exponentially(self):
        # <cos(θ(t) - θ(0))> = exp(-D_r t).
        diffusion, dt, n = 0.8, 0.05, 40
        activity = SelfPropulsion(1.0, diffusion)
        tissue = solid()[0]

        @jax.jit
        def walk(key):
            first, rest = jax.random.split(key)

            def step(state, key):
                _, state = activity.drive(
                    state, tissue, FRICTION, jnp.array(0.0), jnp.array(dt), key
                )
                return state, state.angles

            state = activity.init(tissue, first)
            _, angles = jax.lax.scan(step, state, jax.random.split(rest, n))
            return jnp.concatenate([state.angles[None], angles])

        angles = np.asarray(jax.vmap(walk)(jax.random.split(KEY, 200)))
        correlation = np.cos(angles - angles[:, :1]).mean(axis=(0, 2))
        np.testing.assert_allclose(
            correlation, np.exp(-diffusion * dt * np.arange(n + 1)), atol=0.04
        )

    @pytest.mark.thorough
    def test_centroid_velocity_is_total_force_over_friction(self):
        tissue = cluster(9, 2)
        energy = ShapeFactorEnergy(jnp.full(9, 3.4))
        activity = SelfPropulsion(0.3, 0.5)
        movie = vx.evolve(
            tissue,
            energy,
            FRICTION,
            [0.0, 0.1],
            activity=activity,
            key=3,
            relaxation=FIXED_TOPOLOGY,
        )
        angles = movie.drive[0].angles
        force = 0.3 * np.stack([np.cos(angles), np.sin(angles)], axis=-1).sum(axis=0)
        displacement = movie.tissue.vertices.mean(axis=0) - tissue.vertices.mean(axis=0)
        np.testing.assert_allclose(displacement, 0.1 * force / (2.0 * tissue.n_vertices), atol=1e-9)

    def test_directions_align_with_velocity(self):
        tissue = solid()[0]
        activity = SelfPropulsion(0.1, 0.0, alignment=5.0)
        before = tissue.with_vertices(tissue.vertices - jnp.array([0.0, 0.01]))
        state = activity.init(tissue, KEY)
        for _ in range(40):
            state = activity.finish(state, before, tissue)
            _, state = activity.drive(state, tissue, FRICTION, jnp.array(0.0), jnp.array(0.05), KEY)
        np.testing.assert_allclose(jnp.sin(state.angles), 1, atol=0.05)

    def test_invalid_arguments_are_rejected(self):
        with pytest.raises(ValueError, match="`force`"):
            SelfPropulsion(-1.0)
        with pytest.raises(ValueError, match="one for each cell"):
            evolve(SelfPropulsion(jnp.ones(5)), [0.0, 1.0])


def test_tension_autocorrelation_decays_exponentially():
    tissue = solid()[0]
    activity = FluctuatingTensions(0.2, persistence=0.5)

    @jax.jit
    def pair(key):
        first, second = jax.random.split(key)
        state = activity.init(tissue, first)
        tensions, after = activity.drive(
            state, tissue, FRICTION, jnp.array(0.0), jnp.array(0.3), second
        )
        return state.relative, after.relative, tensions.tension

    before, after, tension = map(np.asarray, jax.vmap(pair)(jax.random.split(KEY, 600)))
    np.testing.assert_allclose(tension, 0.2 * after)
    assert after.std() == pytest.approx(1, rel=0.02)
    assert (before * after).mean() == pytest.approx(np.exp(-0.3 / 0.5), abs=0.02)
    with pytest.raises(ValueError, match="`persistence` must be positive"):
        FluctuatingTensions(0.1, 0.0)


def test_tensions_have_the_right_variance_for_short_steps_in_float32():
    # 1 - exp(-dt / τ)² rounds to 0 for this step.
    short = jnp.asarray(2e-8, jnp.float32)
    activity = FluctuatingTensions(jnp.float32(1.0), jnp.float32(1.0))
    start = TensionState(jnp.zeros(500, jnp.float32))
    _, state = activity.drive(start, solid()[0], FRICTION, 0 * short, short, KEY)
    assert state.relative.dtype == jnp.float32
    assert np.std(state.relative) == pytest.approx(np.sqrt(2 * 2e-8), rel=0.1)


@pytest.mark.thorough
def test_custom_activity_can_be_added():
    class Wind(vx.AbstractActivity):
        force: float

        def drive(self, state, tissue, dissipation, time, dt, key):
            return Push(jnp.full_like(tissue.vertices, self.force)), state

    tissue = solid()[0]
    movie = evolve(Wind(0.4) + FluctuatingTensions(0.0, 1.0), [0.0, 0.5, 1.0])
    # All vertices drift with the velocity force / friction.
    np.testing.assert_allclose(movie.tissue.vertices - tissue.vertices, 0.2, atol=1e-8)
    assert movie.drive[0][1].relative.shape == (36,)
    with pytest.raises(TypeError):
        _ = Wind(1.0) + 1  # pyright: ignore[reportOperatorIssue]
