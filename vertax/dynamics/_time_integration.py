"""Steps in time, one after the other, as a part of a compiled function."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checks import describe
from vertax._base.tracing import tree_where
from vertax.adjoints import AbstractAdjoint
from vertax.adjoints._adjoint import frozen
from vertax.dissipations import AbstractViscosity
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._incremental_potential import Incremental, flipped_as
from vertax.energies import AbstractEnergy
from vertax.mesh import AbstractBoundary, Periodic, Tissue
from vertax.relax import RESULTS, Equilibrium

# Of a method of second order with two stages of this share of a step each (SDIRK: Alexander 1977,
# doi:10.1137/0714068), which damps what is fast as the implicit Euler method does.
_SHARE = 1 - 0.5**0.5


class State(eqx.Module):
    """How far an evolution has come."""

    tissue: Tissue
    drive: PyTree[Array]
    dt: Float[Array, ""]
    """How long the next step is to be, if that is controlled."""
    error: Float[Array, ""]
    """Of the last one, in units of the tolerance."""
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    valid: Bool[Array, ""]
    arrived: Bool[Array, ""]

    def after(self, step: Equilibrium) -> State:
        """What is known when one more step is done."""
        return State(
            step.tissue,
            self.drive,
            self.dt,
            self.error,
            jnp.maximum(self.max_force, frozen(step.max_force)),
            self.num_steps + step.num_steps,
            self.num_t1 + step.num_t1,
            self.valid & step.valid & _right_handed(step.tissue.boundary),
            self.arrived & (step.result == RESULTS.successful),
        )

    @property
    def result(self) -> RESULTS:
        """The outcome of all steps."""
        reached = RESULTS.where(
            self.arrived, RESULTS.successful, RESULTS.nonlinear_max_steps_reached
        )
        return RESULTS.where(jnp.isfinite(self.max_force), reached, RESULTS.nonfinite)


class Frames(NamedTuple):
    """What is known of each time after the first, and with `first` of that too."""

    tissue: PyTree[Array]
    energies: Float[Array, " times"]
    transitions: Int[Array, " times"]
    sound: Bool[Array, " times"]
    steps: Float[Array, "times steps"]
    refused: Int[Array, " times"]


def begin(tissue: Tissue, evolution: Any) -> State:
    """The state that an `Evolution` (whose module imports this one) begins with."""
    times = evolution.times.astype(tissue.vertices.dtype)
    yes, none, zero = jnp.array(True), jnp.array(0), jnp.zeros((), times.dtype)
    drive = evolution.drive
    if drive is None and evolution.activity is not None:
        first, rest = jax.random.split(evolution.key)
        drive = (evolution.activity.init(tissue, first), rest)
    dt = zero if evolution.control is None else evolution.control.begin(times)
    return State(tissue, drive, dt, zero + 1, zero, none, none, yes, yes)


def first_frame(state: State, energy: Any, evolution: Any) -> Frames:
    """The frame of the first time, one row as those that `march` makes."""
    time = evolution.times.astype(state.tissue.vertices.dtype)[0]
    tissue = eqx.filter(state.tissue, eqx.is_array)
    n_steps = evolution.substeps if evolution.control is None else evolution.control.most
    steps = jnp.zeros(n_steps, time.dtype)
    value = _energy_at(energy, time)(state.tissue)
    row = Frames(tissue, value, jnp.array(0), jnp.array(True), steps, jnp.array(0))
    return jax.tree.map(lambda x: x[None], row)


def march(
    state: State, energy: Any, evolution: Any, adjoint: AbstractAdjoint
) -> tuple[State, Frames]:
    """From the first of the times of an `Evolution` to the last."""
    times = evolution.times.astype(state.tissue.vertices.dtype)
    control, flips = evolution.control, evolution.relaxation.transitions is not None

    def stage(
        state: State, before: Tissue, acts: Any, start: Any, end: Any, strained: Any
    ) -> State:
        """A relaxation of the energy at the end, and what the way there from `before` dissipates."""
        there = evolution.placed(state.tissue, end)
        pulls = _energy_at(energy, end)
        pressed = None
        if acts is not None:
            pulls += acts
            forces = jax.grad(lambda x: acts(before.with_vertices(x)))(before.vertices)
            largest = jnp.max(jnp.sum(forces**2, axis=-1))
            pressed = jnp.sqrt(jnp.maximum(largest, jnp.finfo(largest.dtype).tiny))
        potential = Incremental(
            pulls, evolution.dissipation, before, end - start, strained, flips, pressed
        )
        return state.after(evolution.relaxation.solve(there, potential, adjoint, recompute=True))

    def step(state: State, start: Any, end: Any) -> State:
        before, acts, dt = state.tissue, None, end - start
        if evolution.activity is not None:
            inner, key = state.drive
            key, now = jax.random.split(key)
            acts, inner = evolution.activity.drive(
                inner, before, evolution.dissipation, start, dt, now
            )
            state = eqx.tree_at(lambda s: s.drive, state, (inner, key))
        if evolution.order == 1:
            return stage(state, before, acts, start, end, None)
        middle = stage(state, before, acts, start, start + _SHARE * dt, None)
        assert isinstance(evolution.dissipation, AbstractViscosity)
        base = flipped_as(before, middle.tissue) if flips else before
        strained = evolution.dissipation.strains(middle.tissue, base) * (1 - _SHARE) / _SHARE
        return stage(middle, before, acts, end - _SHARE * dt, end, strained)

    def attempt(state: State, start: Any, stop: Any) -> tuple[State, Any, Array]:
        """A step that may be too long: the state after it, where that is, and the length if it was not."""
        dt, left = frozen(state.dt), stop - start
        last = dt >= 0.999 * left
        end = jnp.where(last, stop, start + jnp.minimum(dt, left))
        middle = start + (end - start) / 2

        def part(now: State, marks: tuple[Array, Array, Array]) -> tuple[State, State]:
            whole_step, *ends = marks
            after = step(whole(now), *ends)
            arrays = eqx.filter(after, eqx.is_array)
            return tree_where(whole_step, now, arrays), arrays

        # The whole step and its halves by the code of one: compiling is what takes long.
        marks = (
            jnp.array([True, False, False]),
            jnp.stack([start, start, middle]),
            jnp.stack([end, middle, end]),
        )
        now = eqx.filter(state, eqx.is_array)
        now, parts = jax.lax.scan(part, now, marks)
        fine, coarse = whole(now), whole(jax.tree.map(lambda x: x[0], parts))
        error = control.error(fine.tissue, coarse.tissue, evolution.order)
        # (What was wrong before this step is no reason to refuse it.)
        sound = (fine.arrived & fine.valid) | ~(state.arrived & state.valid)
        accepted = sound & (error <= 1)
        following = control.next_step(end - start, error, state.error, sound, evolution.order)
        # One that a frame cut short says little of how long the next may be.
        following = jnp.where(accepted & last, jnp.maximum(following, dt), following)
        after = tree_where(accepted, fine, state)
        timing = (frozen(following), frozen(jnp.where(accepted, error, state.error)))
        after = eqx.tree_at(lambda s: (s.dt, s.error), after, timing)
        return after, jnp.where(accepted, end, start), jnp.where(accepted, end - start, 0)

    def controlled(arrays: State, ends: tuple[Array, Array]) -> tuple[State, Array, Array]:
        """As many steps as it takes, their lengths, and how many were refused."""

        def one(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], tuple]:
            def go(carry: tuple[State, Array]) -> tuple[tuple[State, Array], tuple]:
                state, time, dt = attempt(whole(carry[0]), carry[1], ends[1])
                return (eqx.filter(state, eqx.is_array), time), (dt, dt == 0)

            none = (jnp.zeros((), times.dtype), jnp.array(False))
            return jax.lax.cond(carry[1] < ends[1], go, lambda c: (c, none), carry)

        (arrays, time), (steps, refused) = jax.lax.scan(
            one, (arrays, ends[0]), None, length=control.most
        )
        arrived = arrays.arrived & (time >= ends[1])
        arrays = eqx.tree_at(lambda s: s.arrived, arrays, arrived)
        # Those that were accepted first, in their order.
        steps = steps[jnp.argsort(steps == 0, stable=True)]
        return arrays, steps, refused.sum()

    def interval(arrays: State, ends: tuple[Array, Array]) -> tuple[State, Frames]:
        before = arrays.num_t1
        if control is not None:
            arrays, steps, refused = controlled(arrays, ends)
        else:
            shares = jnp.linspace(0, 1, evolution.substeps + 1, dtype=times.dtype)
            marks = ends[0] + shares * (ends[1] - ends[0])

            def substep(arrays: State, ends: tuple[Array, Array]) -> tuple[State, None]:
                return eqx.filter(step(whole(arrays), *ends), eqx.is_array), None

            arrays, _ = jax.lax.scan(substep, arrays, (marks[:-1], marks[1:]))
            steps, refused = jnp.diff(marks), jnp.array(0)
        value = _energy_at(energy, ends[1])(whole(arrays).tissue)
        sound = arrays.arrived & arrays.valid
        flips = arrays.num_t1 - before
        return arrays, Frames(arrays.tissue, value, flips, sound, steps, refused)

    arrays, static = eqx.partition(state, eqx.is_array)
    whole = lambda arrays: eqx.combine(arrays, static)
    arrays, frames = jax.lax.scan(interval, arrays, (times[:-1], times[1:]))
    return whole(arrays), frames


def evolved(times: Float[Array, " times"], end: State, frames: Frames) -> Evolved:
    """What happened, of the state at the end and all frames."""
    static = eqx.filter(end.tissue, eqx.is_array, inverse=True)
    return Evolved(
        tissue=end.tissue,
        energy=frames.energies[-1],
        max_force=end.max_force,
        num_steps=end.num_steps,
        num_t1=end.num_t1,
        valid=end.valid,
        result=end.result,
        times=times.astype(end.tissue.vertices.dtype),
        frames=eqx.combine(frames.tissue, static),
        energies=frames.energies,
        transitions=frames.transitions,
        drive=end.drive,
        sound=frames.sound,
        steps=frames.steps,
        refused=frames.refused,
    )


@announced_jit
def evolve_at_once(
    tissue: Tissue, energy: Any, evolution: Any, adjoint: AbstractAdjoint
) -> Evolved:
    """All frames by one compiled function."""
    start = begin(tissue, evolution)
    first = first_frame(start, energy, evolution)
    end, frames = march(start, energy, evolution, adjoint)
    frames = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), first, frames)
    return evolved(evolution.times, end, frames)


def _energy_at(energy: Any, time: Any) -> AbstractEnergy:
    found = energy if isinstance(energy, AbstractEnergy) else energy(time)
    if not isinstance(found, AbstractEnergy):
        raise TypeError(
            "Argument `energy` must be an energy, or a function of time that returns one, but returned "
            f"{describe(found)}."
        )
    return found


def _right_handed(boundary: AbstractBoundary) -> Bool[Array, ""]:
    """Whether a box that depends on time has not folded over."""
    return boundary.area > 0 if isinstance(boundary, Periodic) else jnp.array(True)
