"""Fits of evolutions: costs of several frames, and materials."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import (
    FIXED_TOPOLOGY,
    LEAST_SQUARES,
    central_difference,
    random_like,
    random_tissue,
    relaxed,
)
from jaxtyping import Array, Float

import vertax as vx
from vertax.costs import Frames, VertexDistance
from vertax.dissipations import SubstrateFriction
from vertax.dynamics import Material
from vertax.energies import LineTension, ShapeFactorEnergy

CELLS = 6
TIMES = (0.0, 0.2, 0.5)


@functools.cache
def movie_problem():
    """An evolution, its true material, and an inverse problem with an initial guess."""
    tissue, energy = relaxed(CELLS, 1, 3.5)
    p0 = energy.target_shape_factor
    truth = Material(ShapeFactorEnergy(p0 + 0.1 * random_like(p0, 3)), SubstrateFriction(2.0))
    evolution = vx.Evolution(SubstrateFriction(1.0), TIMES, relaxation=FIXED_TOPOLOGY)
    movie = evolution(tissue, truth)
    guess = Material(ShapeFactorEnergy(p0), SubstrateFriction(1.0))
    cost = Frames([VertexDistance(frame) for frame in movie.trajectory[1:]])
    return movie, truth, vx.InverseProblem(tissue, guess, cost, response=evolution)


@pytest.mark.slow  # the Jacobian through all steps compiles for most of a minute
def test_energy_and_friction_are_recovered_from_a_movie():
    _, truth, problem = movie_problem()
    fit = vx.fit(problem, LEAST_SQUARES, 30, truth=truth, progress=False)
    assert fit.history.relative_error[-1] < 1e-6
    assert isinstance(fit.energy.dissipation, SubstrateFriction)
    np.testing.assert_allclose(fit.energy.dissipation.coefficient, 2.0, rtol=1e-6)
    # The uncertainty also starts from the first frame.
    errors = vx.uncertainty(problem, fit)
    assert errors.noise < 1e-8
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(errors.deviation))


@pytest.mark.thorough
def test_cost_is_the_sum_over_frames_and_can_be_added_to_others():
    movie, truth, problem = movie_problem()
    centroid = vx.costs.CentroidDistance(movie.tissue)
    mixed = problem.cost + 0.5 * centroid
    other = movie.tissue.with_vertices(movie.tissue.vertices + random_like(movie.tissue.vertices))
    frames = vx.fitting.stack([problem.tissue, other, other])
    each = [VertexDistance(frame)(other, truth) for frame in movie.trajectory[1:]]
    expected = sum(each) + 0.5 * centroid(other, truth)
    np.testing.assert_allclose(mixed(frames, truth), expected)
    np.testing.assert_allclose(0.5 * jnp.sum(mixed.residuals(frames, truth) ** 2), expected)


@pytest.mark.thorough
def test_gradient_matches_finite_differences():
    _, _, problem = movie_problem()
    gradient = eqx.filter_jit(lambda p: p.value_and_gradient(throw=False).gradient)(problem)
    parameters = eqx.filter(problem.energy, eqx.is_inexact_array)
    direction = jax.tree.map(random_like, parameters)
    slope = sum(
        jnp.sum(g * d) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)
    )
    energy_with = lambda parameters: eqx.combine(parameters, problem.energy)
    evaluate = eqx.filter_jit(lambda parameters: problem(energy_with(parameters), throw=False)[0])
    np.testing.assert_allclose(
        slope, central_difference(evaluate, parameters, direction), rtol=1e-6
    )


@pytest.mark.thorough
def test_each_epoch_starts_at_the_first_frame():
    _, _, problem = movie_problem()
    fit = vx.fit(problem, optax.adam(1e-2), 4, progress=False)
    expected = problem(fit.energy)[0]
    np.testing.assert_allclose(fit.cost, expected, rtol=1e-6)


class TestInvalidInput:
    @pytest.mark.thorough
    def test_settings_for_equilibria_are_rejected(self):
        _, _, problem = movie_problem()
        arguments = (problem.tissue, problem.energy, problem.cost)
        with pytest.raises(ValueError, match="`cost` must be a cost of a single tissue"):
            vx.InverseProblem(*arguments)
        for what, wrong in (
            ("`fit_position`", {"fit_position": True}),
            ("`guidance`", {"guidance": 1.0}),
            ("nudge='cost'", {"adjoint": vx.EquilibriumPropagation(nudge="cost")}),
        ):
            with pytest.raises(ValueError, match=f"{what}.* goes with a tissue at rest"):
                vx.InverseProblem(*arguments, response=problem.response, **wrong)  # pyright: ignore[reportArgumentType]

    def test_invalid_costs_of_frames_are_rejected(self, without_type_checks):
        cost = VertexDistance(random_tissue(CELLS))
        with pytest.raises(TypeError, match="entry 1 is"):
            Frames([cost, 1.0])  # pyright: ignore[reportArgumentType]
        for costs in ([], [cost, VertexDistance(random_tissue(CELLS + 1))]):
            with pytest.raises(ValueError, match="at least one cost, and all of one class"):
                Frames(costs)
        movie, truth, _ = movie_problem()
        with pytest.raises(ValueError, match="1 costs must have 2 frames"):
            Frames([VertexDistance(movie.tissue)])(movie.frames, truth)

    def test_invalid_materials_are_rejected(self, without_type_checks):
        with pytest.raises(TypeError, match="`dissipation` must be an AbstractDiss"):
            Material(ShapeFactorEnergy(3.5), 1.0)  # pyright: ignore[reportArgumentType]
        with pytest.raises(TypeError, match="function of time"):
            Material(lambda time: ShapeFactorEnergy(3.5))(random_tissue(CELLS))

    def test_an_energy_in_time_may_have_a_row_of_one_entry_per_edge(self):
        class Schedule(eqx.Module):
            tensions: Float[Array, "knots edges"]

            def __call__(self, time):
                return LineTension(self.tensions[0] * time)

        tissue = random_tissue(CELLS)
        material = Material(Schedule(jnp.ones((1, tissue.n_edges))), SubstrateFriction(1.0))
        cost = vx.costs.VertexDistance(tissue)
        response = vx.Evolution(SubstrateFriction(1.0), [0.0, 0.1])
        problem = vx.InverseProblem(tissue, material, cost, response=response)
        assert problem.energy is material
