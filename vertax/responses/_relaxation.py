"""Mechanical equilibrium: relaxation with topology changes, then one differentiable solve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.modules import is_concrete
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.adjoints._adjoint import frozen
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.solvers import AbstractSolver, NewtonCG, Wrapped
from vertax.solvers._patience import AtRest, Relaxation, RelaxationState
from vertax.transitions import T1, AbstractTransitions


class Equilibrium(eqx.Module):
    """A relaxed tissue and how it got there; under `jax.vmap` one entry for each of the batch."""

    tissue: Tissue
    """The relaxed tissue, differentiable with respect to the parameters of the energy."""
    energy: Float[Array, "*batch"]
    """Its energy."""
    max_force: Float[Array, "*batch"]
    r"""Largest component of $|\nabla_X E|$."""
    num_steps: Int[Array, "*batch"]
    """Steps of the minimiser."""
    num_t1: Int[Array, "*batch"]
    """T1 transitions on the way."""
    result: optx.RESULTS
    """Outcome; `optimistix.RESULTS[result]` is its message."""

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the largest force fell below the tolerance."""
        return self.result == optx.RESULTS.successful


def equilibrate(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    solver: optx.AbstractMinimiser[Any, Any, Any] | None = None,
    adjoint: AbstractAdjoint | None = None,
    transitions: AbstractTransitions | None = T1(),
    tolerance: float | Float[Array, ""] | None = None,
    patience: int = 1,
    max_steps: int = 2000,
    throw: bool = True,
) -> Equilibrium:
    r"""Relax a tissue to mechanical equilibrium, $X^* \in \arg\min_X E(X, \theta)$ (paper, Methods).

    The relaxation and its T1 transitions find the final topology and positions; the gradient is that
    of the equilibrium in this topology, by the method that `adjoint` names. Works under `jax.jit`,
    `jax.vmap` (over tissues of one size, and over parameters) and `jax.grad` with respect to the energy
    and the boundary.

    **Arguments:**

    - `tissue`: where the relaxation starts.
    - `energy`: what to minimise.
    - `solver`: a minimiser of `vertax.solvers` or of Optimistix; [`NewtonCG`][vertax.solvers.NewtonCG]
        by default, which reaches true equilibria.
    - `adjoint`: how to differentiate, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
        default.
    - `transitions`: the rule for topology changes, or None to keep the topology.
    - `tolerance`: largest force (component of $\nabla_X E$) that counts as equilibrium; by default
        1e-9 in float64 and 1e-4 in float32.
    - `patience`: number of consecutive steps for which the force must stay below the tolerance.
    - `max_steps`: most steps of the minimiser.
    - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

    **Returns:** an [`Equilibrium`][vertax.Equilibrium].

    **Raises:**

    - `ValueError` for a tolerance, patience or number of steps that is not positive.
    - `TypeError` for an adjoint that is none of `vertax.adjoints`.
    - `RuntimeError` (of Equinox, also inside `jax.jit`) if `throw` and the relaxation did not converge.
    """
    if solver is None:
        solver = NewtonCG()
    if not isinstance(solver, AbstractSolver):
        solver = Wrapped(solver)
    adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
    _check_adjoint(adjoint, solver)
    if tolerance is None:
        tolerance = 1e-9 if tissue.vertices.dtype == jnp.float64 else 1e-4
    if is_concrete(tolerance) and not tolerance > 0:
        raise ValueError(f"Argument `tolerance` must be positive, but is {tolerance}.")
    if patience < 1 or max_steps < 1:
        raise ValueError(
            f"Arguments `patience` and `max_steps` must be at least 1, but are {patience} and {max_steps}."
        )
    return _equilibrate(
        tissue, energy, solver, adjoint, transitions, tolerance, patience, max_steps, throw
    )


@eqx.filter_jit
def _equilibrate(
    tissue: Tissue,
    energy: AbstractEnergy,
    solver: AbstractSolver,
    adjoint: AbstractAdjoint,
    transitions: AbstractTransitions | None,
    tolerance: float | Float[Array, ""],
    patience: int,
    max_steps: int,
    throw: bool,
) -> Equilibrium:
    # Solvers bound their steps in units of the cells, whatever unit of length the user chose.
    scale = jnp.sqrt(jnp.mean(jnp.abs(tissue.areas)))
    tolerance = jnp.asarray(tolerance, tissue.vertices.dtype)
    options = frozen({"length_scale": scale, "tolerance": tolerance})
    relaxation = Relaxation(solver=solver, patience=patience)

    found = _search(
        relaxation, options, transitions, *frozen((tissue, energy)), max_steps=max_steps
    )
    # The second solve starts at rest and takes no step: it is there to be differentiated.
    stiffness = mean_stiffness(found.tissue, frozen(energy))
    stiffness = jnp.where(stiffness > 0, stiffness, 1)
    free = free_motions(found.tissue, frozen(energy), scale, stiffness)
    # What the solver did to the whole (turned it a little, say) depends on its way there: undo that,
    # unless the energy has something to say about where the tissue is.
    settled = _choose(jnp.all(free), found.tissue.settled(frozen(tissue)), found.tissue)
    moved = settled.held_as(_choose(jnp.all(free), tissue, found.tissue))
    springs = jnp.ones_like(moved.drift(settled.configuration)).at[: len(free)].set(free)
    memory = {"stiffness": stiffness, "relaxation": relaxation, "start": found.start}
    solution = optx.minimise(
        _potential,
        AtRest(),
        settled.configuration,
        (moved, energy, stiffness * springs),
        options | memory,
        max_steps=max_steps,
        adjoint=adjoint,
        throw=False,
    )
    final = moved.with_configuration(solution.value)
    equilibrium = Equilibrium(
        tissue=final,
        energy=energy(final),
        max_force=found.max_force,
        num_steps=found.num_steps,
        num_t1=found.num_t1,
        result=found.result,
    )
    if throw:
        equilibrium = found.result.error_if(equilibrium, found.result != optx.RESULTS.successful)
    return equilibrium


def _check_adjoint(adjoint: Any, solver: AbstractSolver) -> None:
    if not isinstance(adjoint, AbstractAdjoint):
        raise TypeError(
            "Argument `adjoint` must be one of vertax.adjoints, e.g. ImplicitDifferentiation(), but is "
            f"{type(adjoint).__name__}."
        )
    if adjoint.unrolls and not solver.unrollable:
        inner = solver.solver if isinstance(solver, Wrapped) else solver
        raise ValueError(
            f"{type(adjoint).__name__} differentiates the steps of the solver, which line searches and "
            f"inner loops do not allow, so it does not go with {type(inner).__name__}. Pass e.g. "
            "solver=vertax.solvers.GradientDescent() or Optax(optax.sgd(1e-2, momentum=0.9)), or "
            "keep the solver and use ImplicitDifferentiation or EquilibriumPropagation."
        )
    if isinstance(adjoint, EquilibriumPropagation) and adjoint.nudge == "cost":
        raise ValueError(
            "EquilibriumPropagation(nudge='cost') needs to know the cost: use it in an InverseProblem, "
            "or nudge='linear' here."
        )


def _choose(condition: Bool[Array, ""], one: Tissue, other: Tissue) -> Tissue:
    """The vertices of one tissue or another; pinned ones are where the first has them."""
    if one.pinned is not None:
        condition = condition | one.pinned[:, None]
    return one.with_vertices(jnp.where(condition, one.vertices, other.vertices))


def free_motions(
    tissue: Tissue, energy: AbstractEnergy, scale: Float[Array, ""], stiffness: Float[Array, ""]
) -> Bool[Array, " modes"]:
    """Which motions of the whole cost nothing: all, unless the energy knows positions."""
    there = tissue.boundary.motions(tissue.vertices, 0.3 * scale)
    energies = jax.vmap(lambda vertices: energy(tissue.with_vertices(vertices)))(there)
    here = energy(tissue)
    rounding = jnp.finfo(here.dtype).eps ** 0.6
    return jnp.abs(energies - here) <= rounding * (jnp.abs(here) + stiffness * scale**2)


def _potential(configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Array]) -> Array:
    """The energy, and a term that pins the motions which cost nothing."""
    # Motions of the whole are zero modes. They make the Hessian singular, and a nudged relaxation would
    # drift along them for ever. A spring to the positions in `tissue` removes them and changes no shape.
    tissue, energy, gauge = args
    drift = tissue.drift(configuration)
    return energy(tissue.with_configuration(configuration)) + 0.5 * jnp.sum(gauge * drift**2)


def mean_stiffness(tissue: Tissue, energy: Callable[[Tissue], Array]) -> Float[Array, ""]:
    """The size of a typical second derivative of an energy, or of any number that a tissue has."""
    # The Rayleigh quotient of a random vector is the mean eigenvalue, near enough.
    y, unravel = ravel_pytree(tissue.configuration)
    slope = jax.grad(lambda x: energy(tissue.with_configuration(unravel(x))))
    probe = jax.random.normal(jax.random.key(0), y.shape, y.dtype)
    _, response = jax.jvp(slope, (y,), (probe,))
    return jnp.abs(jnp.sum(probe * response)) / jnp.sum(probe**2)


class _Found(eqx.Module):
    tissue: Tissue
    start: PyTree[Array]  # the configuration right after the last T1 transition, or the first one
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    result: optx.RESULTS


def _search(
    relaxation: Relaxation,
    options: dict[str, Array],
    transitions: AbstractTransitions | None,
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    max_steps: int,
) -> _Found:
    """Relax with topology changes; not differentiable."""
    no_gauge = jnp.zeros((), tissue.vertices.dtype)
    objective = lambda y, args: (_potential(y, args), None)
    f_struct, tags = jax.ShapeDtypeStruct((), no_gauge.dtype), frozenset()

    def begin(at: Tissue) -> RelaxationState:
        args = (at, energy, no_gauge)
        return relaxation.init(objective, at.configuration, args, options, f_struct, None, tags)

    state = begin(tissue)
    dynamic, static = eqx.partition(state, eqx.is_array)
    counts = jnp.zeros(0, jnp.int32) if transitions is None else transitions.init(tissue)

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        *_, num_steps, finished = carry
        return ~finished & (num_steps < max_steps)

    def iterate(carry: tuple) -> tuple:
        tissue, origin, dynamic, counts, num_steps, _ = carry
        if transitions is None:
            flipped = jnp.array(False)
        else:
            tissue, new_counts = transitions.sweep(tissue, energy, counts)
            flipped = jnp.any(new_counts != counts)
            counts = new_counts
            # What a minimiser remembers of the old topology misleads it in the new one.
            dynamic = jax.lax.cond(
                flipped, lambda: eqx.filter(begin(tissue), eqx.is_array), lambda: dynamic
            )
            origin = jax.tree.map(
                lambda new, old: jnp.where(flipped, new, old), tissue.configuration, origin
            )
        state = eqx.combine(dynamic, static)
        finished = (relaxation.at_rest(state) & ~flipped) | jnp.isnan(state.force)

        def step() -> tuple[PyTree, PyTree]:
            args = (tissue, energy, no_gauge)
            y, new_state, _ = relaxation.step(
                objective, tissue.configuration, args, options, state, tags
            )
            return y, eqx.filter(new_state, eqx.is_array)

        y, dynamic = jax.lax.cond(finished, lambda: (tissue.configuration, dynamic), step)
        return (
            tissue.with_configuration(y),
            origin,
            dynamic,
            counts,
            num_steps + jnp.where(finished, 0, 1),
            finished,
        )

    start = (tissue, tissue.configuration, dynamic, counts, jnp.array(0), jnp.array(False))
    tissue, origin, dynamic, counts, num_steps, _ = jax.lax.while_loop(unfinished, iterate, start)
    state = eqx.combine(dynamic, static)
    result = optx.RESULTS.where(
        relaxation.at_rest(state), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    finite = jnp.isfinite(state.force) & jnp.all(jnp.isfinite(tissue.vertices))
    result = optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)
    return _Found(tissue, origin, state.force, num_steps, jnp.sum(counts), result)
