r"""Three rules by which the tensions of edges learn, each a direction for the same optimiser.

The gradient by implicit differentiation, the same by equilibrium propagation, and *coupled learning* (Stern,
Hexner, Rocks & Liu 2021, doi:10.1103/PhysRevX.11.021045), a local rule. There a teacher takes hold of the
outputs and pulls them a share $\eta$ of the way to what is asked for,
$\sigma^C = \sigma^F + \eta (\sigma^t - \sigma^F)$, and each parameter compares the free state $F$ with the
clamped one $C$:

$$\dot\theta \propto -\frac1\eta \frac{\partial}{\partial\theta} \big(E_C(X_C, \theta) - E(X_F, \theta)\big),
\qquad E_C = E + \frac k2 \sum_c |\sigma_c - \sigma^C_c|^2$$

at held positions. Stress depends on tensions also directly, so the teacher's own energy counts; it is known
where the chosen cells are, so the rule remains local. For a soft teacher, $k \to 0$, it is equilibrium
propagation; a stiff one pulls against what resists, which turns the direction.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PyTree
from optimistix import LevenbergMarquardt

from vertax import AbstractEnergy, InverseProblem, Tissue
from vertax.costs import CellStress
from vertax.fitting import fit
from vertax.mechanics import cell_stress

# Least squares that need more do not come to an end.
_STEPS = 30


class Teacher(eqx.Module):
    """Who pulls at the chosen cells in coupled learning."""

    stiffness: Float[Array, ""]
    """The stiffness $k$ of the pull."""
    share: Float[Array, ""]
    """How far it goes towards what is asked for, η."""


class _Clamped(AbstractEnergy):
    energy: AbstractEnergy
    teacher: Teacher
    wanted: CellStress

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        # The cost is the mean over the chosen cells.
        number = self.wanted.target.shape[0]
        pull = self.teacher.stiffness * number * self.wanted(tissue, self.energy)
        return self.energy(tissue) + pull


class Lesson(eqx.Module):
    """What one epoch tells."""

    cost: Float[Array, ""]
    direction: PyTree[Array]
    """With respect to the trainable parameters; to go against."""
    tissue: Tissue
    """At rest."""
    converged: Bool[Array, ""]


def by_gradient(problem: InverseProblem, energy: AbstractEnergy, tissue: Tissue) -> Lesson:
    """The gradient of the cost, by the adjoint of the problem."""
    found = problem.value_and_gradient(energy, tissue, throw=False)
    at_rest = found.equilibrium
    return Lesson(found.cost, found.gradient, at_rest.tissue, at_rest.converged)


def by_coupled_learning(
    problem: InverseProblem, energy: AbstractEnergy, tissue: Tissue, teacher: Teacher
) -> Lesson:
    """The contrast of free and clamped state."""
    cost = problem.cost
    assert isinstance(cost, CellStress)
    free = problem.response(tissue, energy, throw=False)
    now = cell_stress(free.tissue, energy)
    chosen = now if cost.cells is None else now[cost.cells]
    wanted = CellStress(chosen + teacher.share * (cost.target - chosen), cost.cells)
    clamped = problem.response(free.tissue, _Clamped(energy, teacher, wanted), throw=False)
    parameters, constants = eqx.partition(energy, problem.trainable)

    def contrast(parameters: PyTree) -> Float[Array, ""]:
        there = eqx.combine(parameters, constants)
        held = _Clamped(there, teacher, wanted)(clamped.tissue)
        return (held - there(free.tissue)) / teacher.share

    direction = jax.grad(contrast)(parameters)
    settled = free.converged & clamped.converged
    return Lesson(cost(free.tissue, energy), direction, free.tissue, settled)


class Course(eqx.Module):
    """How learning went."""

    cost: Float[Array, " epochs"]
    converged: Bool[Array, " epochs"]
    first: PyTree[Array]
    """The direction of the first epoch, where there are directions."""
    energy: AbstractEnergy
    tissue: Tissue


@eqx.filter_jit
def learn(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    epochs: int,
    teacher: Teacher | None,
) -> Course:
    """Let parameters learn.

    **Arguments:**

    - `problem`: the stresses asked for.
    - `optimiser`: what makes steps of directions.
    - `epochs`: number of steps.
    - `teacher`: of coupled learning; without one it is the gradient.

    **Returns:** the course.
    """
    parameters, constants = eqx.partition(problem.energy, problem.trainable)
    arrays, static = eqx.partition(problem.tissue, eqx.is_array)

    def epoch(carry: tuple, _: None) -> tuple[tuple, tuple]:
        parameters, state, arrays = carry
        arguments = problem, eqx.combine(parameters, constants), eqx.combine(arrays, static)
        rule = by_gradient if teacher is None else partial(by_coupled_learning, teacher=teacher)
        lesson = rule(*arguments)
        updates, state = optimiser.update(lesson.direction, state, parameters)
        parameters = eqx.apply_updates(parameters, updates)
        carry = parameters, state, eqx.filter(lesson.tissue, eqx.is_array)
        return carry, (lesson.cost, lesson.converged, lesson.direction)

    start = parameters, optimiser.init(parameters), arrays
    (parameters, _, arrays), known = jax.lax.scan(epoch, start, length=epochs)
    cost, converged, directions = known
    first = jax.tree.map(lambda x: x[0], directions)
    energy, tissue = eqx.combine(parameters, constants), eqx.combine(arrays, static)
    return Course(cost, converged, first, energy, tissue)


def solve(problem: InverseProblem, epochs: int) -> Course:
    """Find the parameters by least squares, which tells what can be learnt at all.

    **Arguments:**

    - `problem`: the stresses asked for.
    - `epochs`: length of the course; it ends after 30 steps or fewer, and stays where it is.

    **Returns:** the course.
    """
    solver = LevenbergMarquardt(rtol=1e-8, atol=1e-10)
    found = fit(problem, solver, min(epochs, _STEPS), progress=False)
    history, left = found.history, epochs - len(found.history.cost)
    cost, converged = (np.pad(x, (0, left), mode="edge") for x in (history.cost, history.converged))
    start = problem.cost(problem.tissue, problem.energy)
    cost = np.concatenate([[float(start)], cost[:-1]])
    return Course(jnp.asarray(cost), jnp.asarray(converged), None, found.energy, found.tissue)
