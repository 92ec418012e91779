"""The time integration loop, as a part of a compiled function."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.checks import describe
from vertax._base.frame_loop import AbstractSimulation, Frame
from vertax._base.results import RESULTS, finite_record, first_failure, result_of
from vertax._base.tracing import frozen, tree_where
from vertax.adjoints import AbstractAdjoint
from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._incremental_potential import IncrementalPotential, with_flips_of
from vertax.energies import AbstractEnergy
from vertax.mesh import AbstractBoundary, Periodic, Tissue
from vertax.relax import Equilibrium
from vertax.relax._response import with_overlaps

# The coefficient γ of the two-stage SDIRK method of order 2 (Alexander 1977, doi:10.1137/0714068). The method
# is L-stable: fast modes are damped, as by the implicit Euler method.
_GAMMA = 1 - 0.5**0.5


class State(eqx.Module):
    """The state of a time evolution between two steps."""

    tissue: Tissue
    drive: PyTree
    dt: Float[Array, ""]
    """The next time step, with a `PIController`."""
    error: Float[Array, ""]
    """The error of the last step, in units of the tolerance."""
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    result: RESULTS
    """The first failure of a step."""

    def after(self, step: Equilibrium) -> State:
        """The state after one more step."""
        return State(
            step.tissue,
            self.drive,
            self.dt,
            self.error,
            jnp.maximum(self.max_force, frozen(step.max_force)),
            self.num_steps + step.num_steps,
            self.num_t1 + step.num_t1,
            first_failure(self.result, with_overlaps(step.result, _folded(step.tissue.boundary))),
        )


class Motion(AbstractSimulation):
    """The motion of a tissue, as a simulation of frames."""

    name: ClassVar[str] = "movement"
    points: ClassVar[str] = "times"

    energy: Any
    evolution: Any
    """An `Evolution` without its times, key and drive. (Its module imports this one, therefore `Any`.)"""
    adjoint: AbstractAdjoint

    def begin(self, start: tuple[Tissue, Any, Any], points: Array) -> tuple[State, Frame]:
        """The initial state and frame of a tissue, with a random key or a drive; see `Evolution`."""
        tissue, key, drive = start
        evolution, zero_count, zero = self.evolution, jnp.array(0), jnp.zeros((), points.dtype)
        if drive is None and evolution.activity is not None:
            first, rest = jax.random.split(key)
            drive = (evolution.activity.init(tissue, first), rest)
        control = evolution.stepsize_controller
        dt, n_steps = zero, evolution.substeps
        if control is not None:
            dt, n_steps = control.begin(points), control.max_steps
        state = State(tissue, drive, dt, zero + 1, zero, zero_count, zero_count, _successful())
        frame = {
            "frames": tissue,
            "energies": _energy_at(self.energy, points[0])(tissue),
            "transitions": zero_count,
            "results": _successful(),
            "steps": jnp.zeros(n_steps, points.dtype),
            "num_rejected": zero_count,
            "signals": _record(evolution, state),
        }
        return state, frame

    def advance(self, state: State, interval: Array, key: Any) -> tuple[State, Frame]:
        """Integrate over an interval of time."""
        return integrate(state, interval, self.energy, self.evolution, self.adjoint)

    def outcome(self, points: Array, end: State, frames: Frame) -> Evolved:
        """The result of the evolution."""
        return Evolved(
            tissue=end.tissue,
            energy=frames["energies"][-1],
            max_force=end.max_force,
            num_steps=end.num_steps,
            num_t1=end.num_t1,
            result=end.result,
            times=points,
            drive=end.drive,
            **frames,
        )

    def counts(self, state: State) -> dict[str, Array]:
        """The number of T1 transitions so far."""
        return {"t1": state.num_t1}


def integrate(
    state: State, ends: Array, energy: Any, evolution: Any, adjoint: AbstractAdjoint
) -> tuple[State, Frame]:
    """Integrate an `Evolution` over an interval; return the state and the frame at its end."""
    control, may_flip = evolution.stepsize_controller, evolution.relaxation.transitions is not None
    arrays, static = eqx.partition(state, eqx.is_array)
    combined = lambda arrays: eqx.combine(arrays, static)

    def stage(
        state: State,
        before: Tissue,
        active_energy: Any,
        dissipation: AbstractDissipation,
        start: Any,
        end: Any,
        previous_strains: Any,
    ) -> State:
        """Minimise the energy at time `end` plus the dissipation of the motion from `before`."""
        start_of_stage = evolution.placed(state.tissue, end)
        total_energy = _energy_at(energy, end)
        max_driving_force = None
        if active_energy is not None:
            total_energy += active_energy
            max_driving_force = max_force(active_energy, before)
        potential = IncrementalPotential(
            total_energy,
            dissipation,
            before,
            end - start,
            previous_strains,
            may_flip,
            max_driving_force,
        )
        return state.after(
            evolution.relaxation.solve(start_of_stage, potential, adjoint, recompute=True)
        )

    def step(state: State, start: Any, end: Any) -> State:
        before, active_energy, dt = state.tissue, None, end - start
        dissipation = evolution.dissipation
        if evolution.activity is not None:
            inner, key = state.drive
            key, step_key = jax.random.split(key)
            active_energy, inner = evolution.activity.drive(
                inner, before, dissipation, start, dt, step_key
            )
            dissipation = evolution.activity.step_dissipation(inner, before, dissipation)
            state = eqx.tree_at(lambda s: s.drive, state, (inner, key))
            check_order(evolution.order, dissipation)
        parts = (before, active_energy, dissipation)
        if evolution.order == 1:
            return _finished(evolution, before, stage(state, *parts, start, end, None))
        middle = stage(state, *parts, start, start + _GAMMA * dt, None)
        assert isinstance(dissipation, AbstractViscosity)
        base = with_flips_of(before, middle.tissue) if may_flip else before
        previous_strains = dissipation.strains(middle.tissue, base) * (1 - _GAMMA) / _GAMMA
        after = stage(middle, *parts, end - _GAMMA * dt, end, previous_strains)
        return _finished(evolution, before, after)

    def attempt(state: State, start: Any, stop: Any) -> tuple[State, Any, Array]:
        """Try one step: the state after it, its time, and the time step; 0 if the step was rejected."""
        dt, remaining = frozen(state.dt), stop - start
        last = dt >= 0.999 * remaining
        end = jnp.where(last, stop, start + jnp.minimum(dt, remaining))
        middle = start + (end - start) / 2

        def part(now: State, interval: tuple[Array, Array, Array]) -> tuple[State, State]:
            is_full_step, *ends = interval
            after = step(combined(now), *ends)
            arrays = eqx.filter(after, eqx.is_array)
            return tree_where(is_full_step, now, arrays), arrays

        # The full step and the two half steps, in a loop: so the step is compiled once.
        intervals = (
            jnp.array([True, False, False]),
            jnp.stack([start, start, middle]),
            jnp.stack([end, middle, end]),
        )
        now = eqx.filter(state, eqx.is_array)
        now, parts = jax.lax.scan(part, now, intervals)
        halves, full = combined(now), combined(jax.tree.map(lambda x: x[0], parts))
        records = _record(evolution, halves), _record(evolution, full)
        error = control.error(halves.tissue, full.tissue, evolution.order, records)
        # (After an earlier failure steps are accepted by their error alone.)
        failed_before = state.result != RESULTS.successful
        converged = (halves.result == RESULTS.successful) | failed_before
        accepted = converged & (error <= 1)
        next_dt = control.next_step(end - start, error, state.error, converged, evolution.order)
        # A step that was shortened to end at a frame does not shorten the next one.
        next_dt = jnp.where(accepted & last, jnp.maximum(next_dt, dt), next_dt)
        after = tree_where(accepted, halves, state)
        timing = (frozen(next_dt), frozen(jnp.where(accepted, error, state.error)))
        after = eqx.tree_at(lambda s: (s.dt, s.error), after, timing)
        return after, jnp.where(accepted, end, start), jnp.where(accepted, end - start, 0)

    def controlled(arrays: State, ends: Array) -> tuple[State, Array, Array]:
        """Steps of controlled size to the end of a frame, their sizes, and the number of rejected ones."""

        def one(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], tuple]:
            def take_step(carry: tuple[State, Array]) -> tuple[tuple[State, Array], tuple]:
                state, time, dt = attempt(combined(carry[0]), carry[1], ends[1])
                return (eqx.filter(state, eqx.is_array), time), (dt, dt == 0)

            no_step = (jnp.zeros((), ends.dtype), jnp.array(False))
            return jax.lax.cond(carry[1] < ends[1], take_step, lambda c: (c, no_step), carry)

        (arrays, time), (steps, num_rejected) = jax.lax.scan(
            one, (arrays, ends[0]), None, length=control.max_steps
        )
        reached = RESULTS.where(time >= ends[1], RESULTS.successful, RESULTS.max_time_steps_reached)
        result = first_failure(arrays.result, reached)
        arrays = eqx.tree_at(lambda s: s.result, arrays, result)
        # Accepted steps first, in their order.
        steps = steps[jnp.argsort(steps == 0, stable=True)]
        return arrays, steps, num_rejected.sum()

    if control is not None:
        arrays, steps, num_rejected = controlled(arrays, ends)
    else:
        fractions = jnp.linspace(0, 1, evolution.substeps + 1, dtype=ends.dtype)
        times_of_steps = ends[0] + fractions * (ends[1] - ends[0])

        def substep(arrays: State, ends: tuple[Array, Array]) -> tuple[State, None]:
            return eqx.filter(step(combined(arrays), *ends), eqx.is_array), None

        arrays, _ = jax.lax.scan(substep, arrays, (times_of_steps[:-1], times_of_steps[1:]))
        steps, num_rejected = jnp.diff(times_of_steps), jnp.array(0)
    after = combined(arrays)
    frame = {
        "frames": after.tissue,
        "energies": _energy_at(energy, ends[1])(after.tissue),
        "transitions": after.num_t1 - state.num_t1,
        "results": after.result,
        "steps": steps,
        "num_rejected": num_rejected,
        "signals": _record(evolution, after),
    }
    return after, frame


def _energy_at(energy: Any, time: Any) -> AbstractEnergy:
    value = energy if isinstance(energy, AbstractEnergy) else energy(time)
    if not isinstance(value, AbstractEnergy):
        raise TypeError(
            "Argument `energy` must be an energy, or a function of time that returns one, but returned "
            f"{describe(value)}."
        )
    return value


def check_order(order: int, dissipation: AbstractDissipation) -> None:
    """Raise an error for order 2 with a dissipation that is not half a sum of squares."""
    if order == 2 and not isinstance(dissipation, AbstractViscosity):
        raise ValueError(
            "Argument `order` can be 2 only for a dissipation that is half a sum of squares, an "
            f"AbstractViscosity, which {type(dissipation).__name__} is not."
        )


def _record(evolution: Any, state: State) -> PyTree[Array]:
    """The arrays that the activity records, None without an activity."""
    if evolution.activity is None:
        return None
    return evolution.activity.record(state.drive[0], state.tissue)


def _finished(evolution: Any, before: Tissue, after: State) -> State:
    """The state at the end of a step, with the state of the activity."""
    if evolution.activity is None:
        return after
    inner, key = after.drive
    inner = evolution.activity.finish(inner, before, after.tissue)
    after = eqx.tree_at(lambda s: s.drive, after, (inner, key))
    result = first_failure(after.result, finite_record(_record(evolution, after)))
    return eqx.tree_at(lambda s: s.result, after, result)


def max_force(active_energy: AbstractEnergy, tissue: Tissue) -> Float[Array, ""]:
    """The largest force of an active energy on a vertex."""
    forces = jax.grad(lambda x: active_energy(tissue.with_vertices(x)))(tissue.vertices)
    largest = jnp.max(jnp.sum(forces**2, axis=-1))
    return jnp.sqrt(jnp.maximum(largest, jnp.finfo(largest.dtype).tiny))


def _folded(boundary: AbstractBoundary) -> Bool[Array, ""]:
    """Whether the lattice of a box has no positive determinant."""
    return ~(boundary.area > 0) if isinstance(boundary, Periodic) else jnp.array(False)


def _successful() -> RESULTS:
    return result_of(jnp.array(0))
