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

from vertax._misc import is_concrete
from vertax._tissue import Tissue
from vertax._transitions import T1, AbstractTransitions
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.solvers import AbstractSolver, NewtonCG, Wrapped


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
    solver: optx.AbstractMinimiser | None = None,
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
    if adjoint is None:
        adjoint = ImplicitDifferentiation()
    if not isinstance(adjoint, AbstractAdjoint):
        raise TypeError(
            "Argument `adjoint` must be one of vertax.adjoints, e.g. ImplicitDifferentiation(), but is "
            f"{type(adjoint).__name__}."
        )
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
    threshold = jnp.asarray(tolerance, tissue.vertices.dtype)
    # Solvers bound their steps in units of the cells, whatever unit of length the user chose.
    scale = jnp.sqrt(jnp.mean(jnp.abs(tissue.areas)))
    options = {"length_scale": jax.lax.stop_gradient(scale)}
    relaxation = _Relaxation(solver, threshold, patience, options)

    found = _search(
        relaxation,
        transitions,
        *_frozen((tissue, energy)),
        max_steps=max_steps,
    )
    # The second solve starts at rest and takes no step: it is there to be differentiated.
    # What the solver did to the whole (turned it a little, say) depends on its way there: undo that.
    settled = found.tissue.settled(_frozen(tissue))
    moved = settled.held_as(tissue)
    gauge = _gauge_stiffness(settled, _frozen(energy))
    solution = optx.minimise(
        _potential,
        _AtRest(),
        settled.configuration,
        (moved, energy, gauge),
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


def _frozen(tree: PyTree) -> PyTree:
    """The same values, taken for constants by differentiation."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _potential(configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Array]) -> Array:
    """The energy, and a term that pins the motions which cost nothing."""
    # Motions of the whole are zero modes. They make the Hessian singular, and a nudged relaxation would
    # drift along them for ever. A spring to the positions in `tissue` removes them and changes no shape.
    tissue, energy, gauge = args
    drift = tissue.drift(configuration)
    return energy(tissue.with_configuration(configuration)) + 0.5 * gauge * jnp.sum(drift**2)


def _gauge_stiffness(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
    """A stiffness for the zero modes that sits amid those of the other modes, in any units."""
    # The Rayleigh quotient of a random vector is the mean eigenvalue, near enough.
    y, unravel = ravel_pytree(tissue.configuration)
    force = jax.grad(lambda x: energy(tissue.with_configuration(unravel(x))))
    probe = jax.random.normal(jax.random.key(0), y.shape, y.dtype)
    _, response = jax.jvp(force, (y,), (probe,))
    quotient = jnp.abs(jnp.sum(probe * response)) / jnp.sum(probe**2)
    return jnp.where(quotient > 0, quotient, 1)


class _RelaxationState(eqx.Module):
    inner: PyTree
    force: Float[Array, ""]
    n_below: Int[Array, ""]


class _Relaxation(eqx.Module):
    """A solver that is at rest when the largest force has stayed below a tolerance for some steps."""

    solver: AbstractSolver
    tolerance: Float[Array, ""]
    patience: int = eqx.field(static=True)
    options: dict[str, Array]

    def init(self, y: Any, args: Any) -> _RelaxationState:
        f_struct = jax.ShapeDtypeStruct((), self.tolerance.dtype)
        tags = frozenset()
        inner = self.solver.init(_objective, y, args, self.options, f_struct, None, tags)
        return self._judge(inner, jnp.array(0))

    def step(self, y: Any, args: Any, state: _RelaxationState) -> tuple[Any, _RelaxationState]:
        y, inner, _ = self.solver.step(_objective, y, args, self.options, state.inner, frozenset())
        return y, self._judge(inner, state.n_below)

    def at_rest(self, state: _RelaxationState) -> Bool[Array, ""]:
        return state.n_below >= self.patience

    def _judge(self, inner: Any, n_below: Int[Array, ""]) -> _RelaxationState:
        force = optx.max_norm(self.solver.gradient(inner))
        return _RelaxationState(inner, force, jnp.where(force < self.tolerance, n_below + 1, 0))


def _objective(y: PyTree[Array], args: Any) -> tuple[Array, None]:
    return _potential(y, args), None


class _AtRest(optx.AbstractMinimiser):
    """Returns the point it is given, which is known to be a minimum."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = eqx.field(static=True, default=optx.max_norm)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> None:
        return None

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: None, tags: Any
    ) -> tuple[Any, None, Any]:
        return y, None, None

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: None, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return jnp.array(True), optx.RESULTS.successful

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Any,
        options: Any,
        state: None,
        tags: Any,
        result: Any,
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}


class _Found(eqx.Module):
    tissue: Tissue
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    result: optx.RESULTS


def _search(
    relaxation: _Relaxation,
    transitions: AbstractTransitions | None,
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    max_steps: int,
) -> _Found:
    """Relax with topology changes; not differentiable."""
    no_gauge = jnp.zeros((), tissue.vertices.dtype)

    def begin(at: Tissue) -> _RelaxationState:
        return relaxation.init(at.configuration, (at, energy, no_gauge))

    state = begin(tissue)
    dynamic, static = eqx.partition(state, eqx.is_array)
    counts = jnp.zeros(0, jnp.int32) if transitions is None else transitions.init(tissue)

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        *_, num_steps, finished = carry
        return ~finished & (num_steps < max_steps)

    def iterate(carry: tuple) -> tuple:
        tissue, dynamic, counts, num_steps, _ = carry
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
        state = eqx.combine(dynamic, static)
        finished = (relaxation.at_rest(state) & ~flipped) | jnp.isnan(state.force)

        def step() -> tuple[PyTree, PyTree]:
            args = (tissue, energy, no_gauge)
            y, new_state = relaxation.step(tissue.configuration, args, state)
            return y, eqx.filter(new_state, eqx.is_array)

        y, dynamic = jax.lax.cond(finished, lambda: (tissue.configuration, dynamic), step)
        return (
            tissue.with_configuration(y),
            dynamic,
            counts,
            num_steps + jnp.where(finished, 0, 1),
            finished,
        )

    start = (tissue, dynamic, counts, jnp.array(0), jnp.array(False))
    tissue, dynamic, counts, num_steps, _ = jax.lax.while_loop(unfinished, iterate, start)
    state = eqx.combine(dynamic, static)
    result = optx.RESULTS.where(
        relaxation.at_rest(state), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    finite = jnp.isfinite(state.force) & jnp.all(jnp.isfinite(tissue.vertices))
    result = optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)
    return _Found(tissue, state.force, num_steps, jnp.sum(counts), result)
