import dataclasses
import functools
import io
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import (
    ADAM,
    FIXED_TOPOLOGY,
    LEAST_SQUARES,
    NO_CONTACT,
    central_difference,
    random_like,
    random_tissue,
    relaxed,
)
from jaxtyping import Array, Float, Shaped

import vertax as vx
from vertax.costs import MeshImage, VertexDistance, render
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy
from vertax.fitting import stack

inverse_problem = functools.partial(vx.InverseProblem, response=FIXED_TOPOLOGY)


@eqx.filter_jit
def cost_and_slope(energy, tissue, cost):
    """The cost and the equilibrium, and the gradient, without a fit."""
    problem = inverse_problem(tissue, energy, cost)
    return eqx.filter_value_and_grad(problem, has_aux=True)(energy)


@pytest.fixture(scope="module")
def hidden():
    """A target tissue, its true energy, and the initial energy and tissue of the inference."""
    target, truth = relaxed(10, 1)
    guess = ShapeFactorEnergy(jnp.full(10, 3.7, float))
    return target, truth, guess, NO_CONTACT(target, guess).tissue


def test_shape_factors_are_recovered_from_vertices(hidden):
    target, truth, guess, start = hidden
    problem = vx.InverseProblem(start, guess, VertexDistance(target))
    fit = vx.fit(problem, ADAM, 200, truth=truth, progress=False)
    np.testing.assert_allclose(fit.energy.target_shape_factor, truth.target_shape_factor, rtol=1e-4)
    h = fit.history
    assert h.converged.all()
    assert h.relative_error[-1] < 1e-3 * h.relative_error[0]
    assert h.cost[fit.best_epoch] == h.cost.min() == fit.cost
    assert len(h.cost) == 200
    # The returned cost, energy and tissue are consistent.
    again, equilibrium = problem(fit.energy, fit.tissue)
    assert again == pytest.approx(float(fit.cost), abs=1e-12)
    assert equilibrium.num_steps <= 1


@pytest.mark.thorough
def test_shape_factors_are_recovered_from_an_image_of_a_displaced_tissue(hidden):
    target, truth, guess, start = hidden
    image = render(target, (96, 96), 0.07)
    displaced = start.with_configuration(start.vertices + jnp.array([0.02, -0.03]))
    problem = inverse_problem(displaced, guess, MeshImage(image, 0.07), fit_position=True)
    fit = vx.fit(problem, ADAM, 250, truth=truth, progress=False)
    np.testing.assert_allclose(fit.energy.target_shape_factor, truth.target_shape_factor, rtol=1e-3)
    # If the position is not fitted, the parameters are biased.
    fixed = inverse_problem(displaced, guess, MeshImage(image, 0.07))
    biased = vx.fit(fixed, ADAM, 250, truth=truth, progress=False)
    assert biased.history.relative_error[-1] > 10 * fit.history.relative_error[-1]


@pytest.mark.thorough
def test_gradient_of_inverse_problem_matches_plain_jax(hidden):
    target, _, guess, start = hidden
    cost, adjoint = VertexDistance(target), vx.ImplicitDifferentiation()
    loss = lambda energy: cost(FIXED_TOPOLOGY(start, energy, adjoint=adjoint).tissue, energy)
    plain = jax.grad(loss)(guess)
    _, by_problem = cost_and_slope(guess, start, cost)
    np.testing.assert_allclose(plain.target_shape_factor, by_problem.target_shape_factor, rtol=1e-7)


def test_position_gradient_matches_finite_differences(hidden):
    target, _, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    f = lambda shift: problem(shift=shift)[0]
    shift, direction = jnp.array([0.1, -0.05]), random_like(jnp.zeros(2))
    evaluate = jax.jit(jax.value_and_grad(f))
    slope = jnp.sum(evaluate(shift)[1] * direction)
    difference = central_difference(lambda s: evaluate(s)[0], shift, direction)
    assert slope == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.thorough
def test_only_trainable_leaves_are_fitted(hidden):
    target, _, guess, start = hidden
    energy = guess + LineTension(jnp.full(30, 0.01))
    trainable = jax.tree.map(lambda _: False, energy)
    trainable = eqx.tree_at(lambda e: e.terms[0].target_shape_factor, trainable, True)
    problem = inverse_problem(start, energy, VertexDistance(target), trainable)
    fit = vx.fit(problem, ADAM, 3, progress=False)
    np.testing.assert_array_equal(fit.energy.terms[1].tension, 0.01)
    assert not np.allclose(fit.energy.terms[0].target_shape_factor, 3.7)


@pytest.mark.thorough
def test_custom_energy_is_fitted():
    class Contractility(vx.AbstractEnergy):
        strength: Float[Array, " cells"]

        def __call__(self, tissue):
            return 0.5 * jnp.sum(self.strength * tissue.perimeters**2)

    area = AreaElasticity(20.0, 1.0)
    strength = 0.3 + 0.1 * jax.random.uniform(jax.random.key(3), (10,))
    truth = area + Contractility(strength)
    target = FIXED_TOPOLOGY(random_tissue(10, 4), truth).tissue
    guess = area + Contractility(jnp.full(10, 0.35))
    start = FIXED_TOPOLOGY(target, guess).tissue
    fit = vx.fit(
        inverse_problem(start, guess, VertexDistance(target)),
        ADAM,
        150,
        truth=truth,
        progress=False,
    )
    assert fit.history.relative_error[-1] < 0.1 * fit.history.relative_error[0]
    # Python numbers remain constants in the fitted energy.
    assert isinstance(fit.energy.terms[0].stiffness, float)
    assert len(jax.tree.leaves(eqx.filter(fit.energy, eqx.is_inexact_array))) == 1


@pytest.mark.thorough
def test_optimiser_state_persists_over_epochs(hidden):
    # Compare with three epochs of Adam in a plain loop.
    target, truth, guess, start = hidden
    cost = VertexDistance(target)
    energy, state, tissue = guess, ADAM.init(eqx.filter(guess, eqx.is_inexact_array)), start

    for _ in range(3):
        (_, equilibrium), gradient = cost_and_slope(energy, tissue, cost)
        updates, state = ADAM.update(gradient, state)
        energy, tissue = eqx.apply_updates(energy, updates), equilibrium.tissue
    fit = vx.fit(inverse_problem(start, guess, cost), ADAM, 4, truth=truth, progress=False)
    # The parameters of lowest cost are those of the last epoch, after three updates.
    assert fit.best_epoch == 3
    np.testing.assert_allclose(
        fit.energy.target_shape_factor, energy.target_shape_factor, rtol=1e-9
    )


@pytest.mark.thorough
def test_levenberg_marquardt_converges_in_twelve_steps(hidden):
    target, truth, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    fit = vx.fit(problem, LEAST_SQUARES, 12, truth=truth)
    np.testing.assert_allclose(fit.energy.target_shape_factor, truth.target_shape_factor, rtol=1e-8)
    assert fit.history.converged.all()
    assert len(fit.history.cost) <= 12
    assert fit.history.cost[0] == pytest.approx(float(problem()[0]), rel=1e-6)
    assert fit.cost == fit.history.cost.min()
    again, _ = problem(fit.energy, fit.tissue)
    assert again == pytest.approx(float(fit.cost), abs=1e-15)


@pytest.mark.slow
def test_levenberg_marquardt_fits_an_image_and_the_position(hidden):
    target, truth, guess, start = hidden
    displaced = start.with_configuration(start.vertices + jnp.array([0.02, -0.03]))
    cost = MeshImage(render(target, (64, 64), 0.1), 0.1)
    problem = inverse_problem(displaced, guess, cost, fit_position=True)
    fit = vx.fit(problem, LEAST_SQUARES, 15, truth=truth)
    np.testing.assert_allclose(fit.energy.target_shape_factor, truth.target_shape_factor, rtol=1e-4)


@pytest.mark.slow
def test_levenberg_marquardt_works_with_equilibrium_propagation(hidden):
    target, truth, guess, start = hidden
    adjoint = vx.EquilibriumPropagation()
    problem = inverse_problem(start, guess, VertexDistance(target), adjoint=adjoint)
    fit = vx.fit(problem, LEAST_SQUARES, 12, truth=truth)
    assert fit.history.relative_error[-1] < 1e-6


def test_least_squares_solver_requires_a_sum_of_squares(hidden):
    class Area(vx.AbstractCost):
        def __call__(self, tissue, energy):
            return tissue.areas[0]

    _, _, guess, start = hidden
    with pytest.raises(TypeError, match=r"must be a sum of squares .* Area is not"):
        vx.fit(inverse_problem(start, guess, Area()), LEAST_SQUARES, 3)


@pytest.fixture(scope="module")
def batch(hidden):
    """Three problems with different guesses, single and stacked."""
    target, truth, guess, _ = hidden
    problems = []
    for k in range(3):
        noise = 0.05 * random_like(guess.target_shape_factor, k)
        energy = ShapeFactorEnergy(guess.target_shape_factor + noise)
        start = NO_CONTACT(target, energy).tissue
        problems.append(inverse_problem(start, energy, VertexDistance(target)))
    stacked = stack(problems)
    return problems, stacked, truth, stack([truth] * 3)


@pytest.mark.parametrize(
    "optimiser",
    [
        pytest.param(ADAM, id="adam"),
        pytest.param(LEAST_SQUARES, id="lm", marks=pytest.mark.slow),
    ],
)
@pytest.mark.thorough
def test_batched_fit_matches_single_fits(batch, optimiser):
    problems, stacked, truth, truths = batch
    batched = vx.fit(stacked, optimiser, 8, truth=truths, batched=True, progress=False)
    assert batched.history.cost.shape[1:] == batched.cost.shape == (3,)
    for k, problem in enumerate(problems):
        single = vx.fit(problem, optimiser, 8, truth=truth, progress=False)
        n = len(single.history.cost)
        np.testing.assert_allclose(
            batched.history.relative_error[:n, k],
            single.history.relative_error,
            rtol=1e-5,
            atol=1e-9,
        )
        np.testing.assert_allclose(
            batched.energy.target_shape_factor[k], single.energy.target_shape_factor, rtol=1e-6
        )


@pytest.mark.thorough
def test_failed_member_does_not_affect_other_members(batch):
    _, stacked, _, truths = batch
    broken = eqx.tree_at(
        lambda p: p.cost.target.vertices,
        stacked,
        stacked.cost.target.vertices.at[1].set(jnp.nan),
    )
    fit = vx.fit(broken, ADAM, 30, truth=truths, batched=True, progress=False)
    error = fit.history.relative_error
    assert (error[-1, [0, 2]] < 0.9 * error[0, [0, 2]]).all()
    assert (error[:, 1] == error[0, 1]).all()
    assert list(fit.best_epoch == -1) == [False, True, False]
    assert list(jnp.isfinite(fit.cost)) == [True, False, True]


def test_batch_requires_a_leading_axis(hidden):
    target, _, guess, start = hidden
    with pytest.raises(ValueError, match="leading axis of the same size"):
        vx.fit(
            inverse_problem(start, guess, VertexDistance(target)),
            ADAM,
            3,
            batched=True,
        )


def test_history_records_adjoint_residuals_and_steps(hidden):
    target, truth, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    history = vx.fit(problem, ADAM, 3, truth=truth, progress=False).history
    assert (history.gradient_residual < 1e-9).all()
    assert (history.gradient_steps > 5).all()


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self):
        return True


def test_progress_bar_shows_compilation_until_the_first_epoch(hidden, monkeypatch):
    target, truth, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    shown = []
    watch = lambda *_: shown.append(screen.getvalue())
    vx.fit(problem, ADAM, 2, truth=truth, callback=watch)
    assert "compiling:   0%" in shown[0]
    after = screen.getvalue()[len(shown[0]) :]
    assert "2/2" in after
    assert "compiling" not in after


@pytest.mark.thorough
def test_unconverged_adjoint_ends_the_fit(hidden):
    target, _, guess, start = hidden

    def run(throw):
        solver = vx.MINRES(max_steps=2)
        adjoint = vx.ImplicitDifferentiation(linear_solver=solver, throw=throw)
        problem = inverse_problem(start, guess, VertexDistance(target), adjoint=adjoint)
        return vx.fit(problem, optax.adam(1e-3), 3, progress=False)

    with pytest.raises(vx.FitError, match="epoch 0 cannot be trusted"):
        run(True)
    assert (run(False).history.gradient_residual > 1e-3).all()


@pytest.mark.thorough
def test_protocol_of_the_paper_reduces_the_error(hidden):
    target, truth, guess, start = hidden
    problem = vx.InverseProblem(
        start,
        guess,
        VertexDistance(target),
        response=vx.Relaxation(vx.solvers.GradientDescent(1e-2), vx.T1(5e-3), 1e-3, 10, 1000),
    )
    fit = vx.fit(problem, optax.nadam(1e-3), 60, truth=truth, progress=False)
    assert fit.history.relative_error[-1] < fit.history.relative_error[0]


def test_interrupted_fit_returns_completed_epochs(hidden):
    target, truth, guess, start = hidden

    def interrupt(epoch, _):
        if epoch == 4:
            raise KeyboardInterrupt

    problem = inverse_problem(start, guess, VertexDistance(target))
    fit = vx.fit(problem, ADAM, 100, truth=truth, progress=False, callback=interrupt)
    # Epoch 4 was interrupted and is not recorded.
    assert len(fit.history.cost) == 4
    assert fit.result == vx.RESULTS.interrupted


@pytest.mark.thorough
def test_interrupted_least_squares_fit_returns_completed_epochs(hidden):
    target, truth, guess, start = hidden

    def interrupt(epoch, record):
        if epoch == 3:
            raise KeyboardInterrupt
        return {"cost": record.cost}

    problem = inverse_problem(start, guess, VertexDistance(target))
    fit = vx.fit(problem, LEAST_SQUARES, 12, truth=truth, progress=False, callback=interrupt)
    assert fit.result == vx.RESULTS.interrupted
    np.testing.assert_array_equal(fit.notes["cost"], fit.history.cost)
    assert len(fit.history.cost) == 3
    assert fit.cost < 1e-2 * fit.history.cost[0]


@pytest.mark.thorough
def test_diverging_fit_raises_with_the_fit_so_far(hidden):
    target, _, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    with pytest.raises(vx.FitError, match=r"not finite|broke down") as error:
        vx.fit(problem, optax.sgd(np.inf), 20, progress=False)
    assert error.value.fit is not None
    assert error.value.fit.best_epoch == 0
    assert jnp.isfinite(error.value.fit.tissue.vertices).all()


def test_fit_without_equilibrium_raises(hidden):
    target, truth, guess, _ = hidden
    one_step = dataclasses.replace(FIXED_TOPOLOGY, max_steps=1)
    problem = inverse_problem(
        random_tissue(10, 8), guess, VertexDistance(target), response=one_step
    )
    with pytest.raises(vx.FitError, match="No epoch of the fit reached equilibrium"):
        vx.fit(problem, ADAM, 2, truth=truth, progress=False)


@pytest.mark.thorough
def test_fit_from_a_tissue_with_overlaps_names_them(hidden):
    target, _, guess, start = hidden
    # Pinned, so that no relaxation removes the overlaps.
    mirrored = start.vertices * jnp.array([1.0, -1.0])
    inside_out = vx.Tissue(
        mirrored, start.topology, start.boundary, pinned=np.arange(start.n_vertices) > 0
    )
    response = vx.Relaxation(transitions=None, contact_range=0.0)
    problem = inverse_problem(inside_out, guess, VertexDistance(target), response=response)
    with pytest.raises(vx.FitError, match="tissue of the problem has overlaps: cell 1,"):
        vx.fit(problem, ADAM, 2, progress=False)


@pytest.mark.thorough
def test_error_of_a_fit_names_an_invalid_gradient_and_not_the_relaxation(hidden):
    target, _, guess, start = hidden

    class Root(vx.AbstractCost):
        def __call__(self, tissue, energy):
            return jnp.sum(jnp.sqrt(jnp.abs(energy.target_shape_factor - 3.7)))

    few_steps = vx.ImplicitDifferentiation(linear_solver=vx.MINRES(max_steps=2))
    for cost, adjoint, reason in (
        (VertexDistance(target), few_steps, "gradient of epoch 0 cannot be trusted .*: the linear"),
        (Root(), vx.ImplicitDifferentiation(), "no finite derivative with respect to a parameter"),
    ):
        problem = inverse_problem(start, guess, cost, adjoint=adjoint)
        with pytest.raises(vx.FitError, match=f"^The fit stopped: .*{reason}") as error:
            vx.fit(problem, ADAM, 2, progress=False)
        assert "No epoch" not in str(error.value)


@pytest.mark.thorough
def test_error_of_a_fit_names_parameters_and_forces_that_are_not_finite(hidden):
    target, _, guess, start = hidden

    class Root(vx.AbstractEnergy):
        strength: Float[Array, ""]

        def __call__(self, tissue):
            perimeter = tissue.perimeters[0]
            return self.strength * jnp.sqrt(jnp.abs(perimeter - perimeter)) + guess(tissue)

    fit = lambda energy: vx.fit(
        inverse_problem(start, energy, VertexDistance(target)), ADAM, 2, progress=False
    )
    with pytest.raises(vx.FitError, match=r"the forces are not finite. .* has a derivative"):
        fit(Root(jnp.array(0.1)))
    broken = eqx.tree_at(
        lambda e: e.target_shape_factor, guess, replace_fn=lambda p: p.at[2].set(jnp.nan)
    )
    with pytest.raises(ValueError, match=r"finite parameters, but `target_shape_factor` .* nan"):
        fit(broken)


def test_energy_with_integer_arrays_alone_is_rejected_with_the_remedy(hidden):
    target, _, _, start = hidden

    class Contractility(vx.AbstractEnergy):
        strength: Shaped[Array, " cells"]

        def __call__(self, tissue):
            return jnp.sum(self.strength * tissue.perimeters**2)

    problem = inverse_problem(start, Contractility(jnp.ones(10, int)), VertexDistance(target))
    with pytest.raises(
        ValueError, match=r"`strength` has the type int64\. Convert it: jnp\.asarray"
    ):
        vx.fit(problem, ADAM, 2)


OPTIMISERS = {
    "steps of two epochs": lambda energy: optax.MultiSteps(ADAM, 2),
    "random key": lambda energy: optax.noisy_sgd(1e-2, key=jax.random.key(0)),
    "mask": lambda energy: optax.masked(ADAM, jax.tree.map(lambda _: True, energy)),
    "labels": lambda energy: optax.partition(
        {"a": ADAM, "b": optax.sgd(1e-2)}, lambda _: jax.tree.map(lambda _: "a", energy)
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        "labels",
        *(
            pytest.param(name, marks=pytest.mark.thorough)
            for name in OPTIMISERS
            if name != "labels"
        ),
    ],
)
@pytest.mark.thorough
def test_optimisers_with_keys_masks_and_several_steps(hidden, name, tmp_path):
    target, _, guess, start = hidden
    problem, optimiser = (
        inverse_problem(start, guess, VertexDistance(target)),
        OPTIMISERS[name](guess),
    )
    fit = lambda epochs, optimiser=optimiser, **options: vx.fit(
        problem, optimiser, epochs, progress=False, **options
    )
    complete = fit(4)
    if name == "steps of two epochs":
        np.testing.assert_allclose(complete.history.cost[::2], complete.history.cost[1::2])
        assert complete.history.cost[2] < complete.history.cost[0]
    if name in ("mask", "labels"):
        np.testing.assert_allclose(complete.history.cost, fit(4, ADAM).history.cost, rtol=1e-9)
    fit(2, checkpoint=tmp_path / "fit.npz")
    resumed = fit(4, checkpoint=tmp_path / "fit.npz")
    np.testing.assert_array_equal(resumed.history.cost, complete.history.cost)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: optax.lbfgs(), r"'value_fn'\. A line search .*linesearch=None"),
        (
            lambda energy: optax.partition({"a": ADAM}, jax.tree.map(lambda _: "a", energy)),
            "Give labels as a function",
        ),
        (lambda _: optax.contrib.sam(ADAM, ADAM), "needs parameters, gradient and cost alone"),
    ],
)
def test_optimisers_that_need_more_than_the_gradient_are_rejected(hidden, make, message):
    target, _, guess, start = hidden
    problem = inverse_problem(start, guess, VertexDistance(target))
    with pytest.raises(TypeError, match=rf"`optimiser` must be an Optax optimiser .*{message}"):
        vx.fit(problem, make(guess), 2, progress=False)
    stacked = stack([problem, problem])
    with pytest.raises(TypeError, match=message):
        vx.fit(stacked, make(guess), 2, batched=True, progress=False)


@pytest.mark.thorough
def test_members_without_a_valid_epoch_have_failed(hidden):
    target, _, guess, start = hidden
    one_step = dataclasses.replace(FIXED_TOPOLOGY, max_steps=1)
    problem = lambda start, target: inverse_problem(
        start, guess, VertexDistance(target), response=one_step
    )
    invalid = target.with_vertices(target.vertices * jnp.nan)
    members = [problem(start, target), problem(random_tissue(10, 8), target)]
    batch = stack([*members, problem(start, invalid)])
    noisy = optax.noisy_sgd(1e-4, key=jax.random.key(0))  # (An optimiser with a random key.)
    fit = vx.fit(batch, noisy, 2, batched=True, progress=False)
    np.testing.assert_array_equal(fit.best_epoch < 0, [False, True, True])
    expected = ("successful", "nonlinear_max_steps_reached", "not_finite_cost")
    for k, name in enumerate(expected):
        assert vx.fitting.member(fit.result, k) == getattr(vx.RESULTS, name)


def test_invalid_problems_are_rejected(hidden):
    target, _, guess, start = hidden
    cost = VertexDistance(target)
    with pytest.raises(ValueError, match="nothing to fit"):
        vx.fit(inverse_problem(start, ShapeFactorEnergy(3.7), cost), ADAM, 3)
    with pytest.raises(ValueError, match="`epochs`"):
        vx.fit(inverse_problem(start, guess, cost), ADAM, 0)


@pytest.mark.slow
def test_shape_factors_are_recovered_in_float32(hidden):
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    target, truth, guess, start = jax.tree.map(to32, hidden)
    problem = inverse_problem(start, guess, VertexDistance(target))
    fit = vx.fit(problem, ADAM, 120, truth=truth, progress=False)
    assert fit.energy.target_shape_factor.dtype == jnp.float32
    assert fit.history.relative_error[-1] < 0.1 * fit.history.relative_error[0]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"optimiser": "adam"}, TypeError, r"but is 'adam'. Write optax.adam\(learning_rate\)"),
        ({"optimiser": "best"}, TypeError, r"but is 'best'. Pass an Optax optimiser"),
        ({"optimiser": optax.adam}, TypeError, r"Call it: adam\("),
        ({"optimiser": None}, TypeError, "but is None. Pass an Optax optimiser"),
        (
            {"optimiser": optx.BFGS(rtol=1e-3, atol=1e-3)},
            TypeError,
            "Minimisers relax tissues.*For the parameters pass an Optax",
        ),
        ({"optimiser": vx.solvers.LBFGS()}, TypeError, "Minimisers relax tissues"),
        ({"problem": "problem"}, TypeError, "`problem` must be a vertax.InverseProblem"),
        ({"epochs": 2.5}, TypeError, "`epochs` must be at least 1"),
        ({"epochs": 0}, ValueError, "`epochs` must be at least 1"),
        ({"guidance": 3.0}, TypeError, "`guidance` must be a function of the epoch.*3.0"),
        ({"callback": "print"}, TypeError, "`callback` must be a function"),
    ],
)
def test_arguments_of_wrong_type_are_rejected_with_remedies(
    changes, error, message, without_type_checks
):
    tissue = random_tissue(6)
    energy = ShapeFactorEnergy(jnp.full(6, 3.7))
    given = {
        "problem": vx.InverseProblem(tissue, energy, VertexDistance(tissue)),
        "optimiser": ADAM,
        "epochs": 2,
    }
    with pytest.raises(error, match=message):
        vx.fit(**given | changes)
