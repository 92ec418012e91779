"""A minimiser of a user in two halves, which a relaxation runs without a restart after transitions."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import random_tissue
from jaxtyping import Array

import vertax as vx
from vertax.energies import ShapeFactorEnergy
from vertax.solvers import AbstractIteration, Progress, Scales


class State(eqx.Module):
    trial: Array
    gradient: Array
    progress: Progress
    num_moves: Array
    """Number of calls of `moved` after a transition."""


class Descent(AbstractIteration[State]):
    """Gradient descent."""

    rate: float = 0.03

    def unevaluated(self, fn: Any, y: Any, args: Any, scales: Scales) -> State:
        infinite = jnp.full((), jnp.inf, y.dtype)
        return State(y, jnp.zeros_like(y), Progress.initial(infinite), jnp.array(0))

    def evaluate(self, fn: Any, y: Any, args: Any, scales: Scales, state: State) -> Any:
        (_, aux), gradient = jax.value_and_grad(fn, has_aux=True)(state.trial, args)
        true = jnp.array(True)
        progress = Progress(true, true, true, optx.max_norm(gradient))
        return state.trial, State(state.trial, gradient, progress, state.num_moves), gradient, aux

    def propose(
        self, model: Any, scales: Scales, state: State, active: Array, preconditioner: Any = None
    ) -> State:
        step = jnp.where(active, self.rate, 0) * state.gradient
        return eqx.tree_at(lambda s: s.trial, state, state.trial - step)

    def moved(
        self, state: State, fraction: Any, flipped: Array, changed: Array, scales: Any
    ) -> State:
        return eqx.tree_at(lambda s: s.num_moves, state, state.num_moves + flipped)

    def progress(self, state: State) -> Progress:
        return state.progress

    def gradient(self, state: State) -> Array:
        return state.gradient


@pytest.mark.thorough
def test_an_iteration_of_a_user_relaxes_a_tissue_and_continues_after_transitions():
    tissue, energy = random_tissue(12, 3), ShapeFactorEnergy(jnp.full(12, 3.7))
    relaxation = vx.Relaxation(Descent(), tolerance=1e-6, max_steps=6000)
    equilibrium = relaxation(tissue, energy)
    assert equilibrium.num_t1 > 0
    search = relaxation.traced().search(tissue, energy)
    state = eqx.filter_jit(search.advance)(search.begin(tissue, energy), energy, 6000)
    assert 0 < state.iteration.num_moves <= state.num_t1
    # The same equilibrium as that of another solver that starts there.
    exact = vx.equilibrate(equilibrium.tissue, energy)
    np.testing.assert_allclose(equilibrium.energy, exact.energy, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
def test_adjoints_use_an_iteration_of_a_user(adjoint):
    tissue = vx.equilibrate(random_tissue(12, 3), ShapeFactorEnergy(jnp.full(12, 3.7))).tissue

    def cost(factor: Array, solver: Any, adjoint: Any) -> Array:
        energy = ShapeFactorEnergy(jnp.full(12, factor))
        settings = {"solver": solver, "adjoint": adjoint, "tolerance": 1e-9, "max_steps": 20_000}
        return jnp.sum(
            vx.equilibrate(tissue, energy, transitions=None, **settings).tissue.areas ** 2
        )

    gradient = jax.grad(cost)(jnp.array(3.7), Descent(), adjoint)
    expected = jax.grad(cost)(jnp.array(3.7), vx.solvers.NewtonCG(), vx.ImplicitDifferentiation())
    np.testing.assert_allclose(gradient, expected, rtol=1e-3)


def test_a_plain_minimisation_ends_at_its_tolerance():
    bowl = lambda y, _: 0.5 * jnp.sum((y - 1.0) ** 2)
    solution = optx.minimise(bowl, Descent(atol=1e-6, rate=0.5), jnp.zeros((3, 2)), max_steps=100)
    np.testing.assert_allclose(solution.value, 1.0, atol=1e-6)
