"""Dynamics: overdamped motion, each step a relaxation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree

from vertax._base.checks import as_key, check_whole, increasing, named
from vertax._base.memory_maps import spare_memory_maps
from vertax._base.modules import is_concrete, traced
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.adjoints._adjoint import frozen
from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.energies import AbstractEnergy
from vertax.energies._units import cell_size
from vertax.mesh import AbstractBoundary, Periodic, Tissue
from vertax.responses._evolved import Evolved
from vertax.responses._material import Material
from vertax.responses._relaxation import Relaxation
from vertax.responses._response import AbstractResponse, Equilibrium
from vertax.responses._step import Incremental


class Evolution(AbstractResponse):
    r"""The tissue moves, overdamped: $\partial R / \partial \dot x = - \partial E / \partial x$.

    Each step is a minimising movement: from $x_0$ it goes to where

    $$E(x) + \Delta t\, R\left(\frac{x - x_0}{\Delta t}; x_0\right)$$

    has a minimum. That is the implicit Euler method: stable for every length of a step, and without anything
    that drives it the energy never rises, through transitions either. And a step is a
    [`Relaxation`][vertax.Relaxation], with its solvers, transitions, contacts and adjoints.

    **Arguments:**

    - `dissipation`: what resists the motion, see `vertax.dissipations`.
    - `times`: when there is to be a frame; they increase, and at the first one the tissue is where it
        begins.
    - `activity`: what drives the tissue besides its energy, see `vertax.activities`.
    - `key`: for the random numbers of the activity, a key or a seed. Steps draw from it one after the other.
    - `drive`: in place of a key, that of an [`Evolved`][vertax.responses.Evolved] which is to go on.
    - `substeps`: steps from one frame to the next.
    - `order`: 1, or 2 for two stages a step (an SDIRK method, which is stable for every step, but of which
        the energy may rise). The dissipation must be a sum of squares for that.
    - `boundary`: a function of time that returns the space at that time, such as a box that is sheared; the
        tissue is carried along, and then moves. By default it stays as it is.
    - `pins`: a function of time that returns the positions of all vertices, of which those of pinned ones
        count.
    - `relaxation`: how each step is found.

    **Raises:**

    - `TypeError` for a dissipation, an activity or a relaxation that is none, or functions that are none.
    - `ValueError` for an activity without a key, times that do not increase, substeps or an order that do
        not exist, or a second order of a dissipation that is no sum of squares.
    """

    dissipation: AbstractDissipation
    times: Float[Array, " times"]
    activity: AbstractActivity | None
    key: PRNGKeyArray | None
    drive: PyTree[Array]
    substeps: int = eqx.field(static=True)
    order: int = eqx.field(static=True)
    boundary: Callable[[Float[Array, ""]], AbstractBoundary] | None
    pins: Callable[[Float[Array, ""]], Float[Array, "vertices 2"]] | None
    relaxation: Relaxation

    def __init__(
        self,
        dissipation: AbstractDissipation,
        times: ArrayLike | Sequence[Any],
        *,
        activity: AbstractActivity | None = None,
        key: PRNGKeyArray | int | None = None,
        drive: PyTree[Array] = None,
        substeps: int = 1,
        order: int = 1,
        boundary: Callable[[Float[Array, ""]], AbstractBoundary] | None = None,
        pins: Callable[[Float[Array, ""]], Float[Array, "vertices 2"]] | None = None,
        relaxation: Relaxation | None = None,
    ):
        if not isinstance(dissipation, AbstractDissipation):
            raise TypeError(
                "Argument `dissipation` must be one of vertax.dissipations, e.g. SubstrateFriction(1.0), "
                f"but is {named(dissipation)}."
            )
        if not isinstance(activity, AbstractActivity | None):
            raise TypeError(
                "Argument `activity` must be one of vertax.activities, e.g. ThermalNoise(0.01), but is "
                f"{named(activity)}."
            )
        if activity is not None and key is None and drive is None:
            raise ValueError(
                "Argument `key` is missing: an activity draws random numbers. Pass a seed, e.g. key=0, or "
                "the `drive` of an evolution that is to go on."
            )
        self.activity, self.drive = activity, drive
        self.key = None if key is None else as_key(key)
        self.relaxation = Relaxation() if relaxation is None else relaxation
        if not isinstance(self.relaxation, Relaxation):
            raise TypeError(
                f"Argument `relaxation` must be a vertax.Relaxation, but is {named(relaxation)}."
            )
        for name, function in (("boundary", boundary), ("pins", pins)):
            if function is not None and not callable(function):
                raise TypeError(
                    f"Argument `{name}` must be a function of time, but is {named(function)}. For one that "
                    "stays, leave it out."
                )
        check_whole("substeps", substeps, least=1)
        if order not in (1, 2):
            raise ValueError(f"Argument `order` must be 1 or 2, but is {order!r}.")
        if order == 2 and not isinstance(dissipation, AbstractViscosity):
            raise ValueError(
                "Argument `order` can be 2 only for a dissipation that is half a sum of squares, an "
                f"AbstractViscosity, which {type(dissipation).__name__} is not."
            )
        self.dissipation = dissipation
        self.times = increasing(times)
        self.substeps, self.order = substeps, order
        self.boundary, self.pins = boundary, pins

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy],
        *,
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
    ) -> Evolved:
        """Let a tissue move.

        **Arguments:** as [`evolve`][vertax.evolve].

        **Returns:** what happened, [`Evolved`][vertax.responses.Evolved].

        **Raises:** as [`evolve`][vertax.evolve].
        """
        adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
        response = self
        if isinstance(energy, Material):
            response, energy = self.of(energy), energy.energy
        response.relaxation.check(tissue, energy, adjoint)
        response._check(tissue)
        response._check_drive(tissue)
        spare_memory_maps()
        response = response.traced()
        evolved = _evolve(*traced((tissue, energy)), response, adjoint)
        return evolved.checked() if throw else evolved

    def goes_with(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Refuse what goes with tissues at rest alone.

        **Arguments:** as for every response.

        **Raises:**

        - `ValueError` for a cost that pulls the tissue, and for a position that is fitted.
        """
        by_cost = isinstance(adjoint, EquilibriumPropagation) and adjoint.nudge == "cost"
        for what, wrong in (
            ("`fit_position`", placed),
            ("`guidance`", guided),
            ("EquilibriumPropagation(nudge='cost')", by_cost),
        ):
            if wrong:
                raise ValueError(
                    f"{what} goes with a tissue at rest, but the response is an Evolution. Leave it out."
                )

    @property
    def goes_on(self) -> bool:
        """Each epoch of a fit begins at the first of the times."""
        return False

    def of(self, material: Material) -> Evolution:
        """The same for a material with a dissipation or an activity of its own."""
        dissipation, activity = material.dissipation, material.activity
        parts = {"dissipation": dissipation, "activity": activity}
        own = {name: part for name, part in parts.items() if part is not None}
        return Evolution(
            **({f.name: getattr(self, f.name) for f in dataclasses.fields(self)} | own)
        )

    def traced(self) -> Evolution:
        """The same with its numbers as arrays, of which another one compiles nothing anew."""
        new = (traced(self.dissipation), traced(self.activity), self.relaxation.traced())
        parts = lambda e: (e.dissipation, e.activity, e.relaxation)
        return eqx.tree_at(parts, self, new, is_leaf=lambda x: x is None)

    def finer(self, tolerance: Float[Array, ""]) -> Evolution:
        """The same, each step at rest only where the largest force is below this tolerance too."""
        return eqx.tree_at(lambda e: e.relaxation, self, self.relaxation.finer(tolerance))

    def placed(self, tissue: Tissue, time: Float[Array, ""]) -> Tissue:
        """A tissue carried into the space of a time, with its pinned vertices where they are then."""
        if self.boundary is not None:
            tissue = tissue.carried(self.boundary(time))
        if self.pins is not None and tissue.pinned is not None:
            held = jnp.where(tissue.pinned[:, None], self.pins(time), tissue.vertices)
            tissue = tissue.with_vertices(held)
        return tissue

    def _check_drive(self, tissue: Tissue) -> None:
        """Refuse the drive of another activity, or of another tissue."""
        if self.activity is None or self.drive is None:
            return
        key = jax.eval_shape(lambda: jax.random.key(0))
        own = eqx.filter_eval_shape(self.activity.init, tissue, key)
        kinds = lambda tree: jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), tree)
        whole = isinstance(self.drive, tuple) and len(self.drive) == 2
        if not whole or not eqx.tree_equal(kinds(own), kinds(self.drive[0])):
            raise ValueError(
                "Argument `drive` does not go with this activity and this tissue: it must be that of an "
                "evolution of a tissue of this size with this activity. Pass a key to begin anew."
            )

    def _check(self, tissue: Tissue) -> None:
        """Refuse a dissipation that lets some vertices go without any resistance."""
        if not all(map(is_concrete, jax.tree.leaves((tissue, self.dissipation)))):
            return
        with jax.ensure_compile_time_eval():
            free = np.asarray(_resistance(tissue, self.dissipation)) == 0
        if tissue.held is not None:
            free &= ~np.asarray(tissue.held)
        if free.any():
            which = np.nonzero(free)[0]
            some = ", ".join(map(str, which[:5])) + (", ..." if len(which) > 5 else "")
            raise ValueError(
                f"Argument `dissipation` resists no motion of {len(which)} of {tissue.n_vertices} vertices "
                f"({some}): they would move at once. Add friction there, e.g. "
                "+ vertax.dissipations.SubstrateFriction(0.01)."
            )


def evolve(
    tissue: Tissue,
    energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy],
    dissipation: AbstractDissipation,
    times: ArrayLike | Sequence[Any],
    *,
    adjoint: AbstractAdjoint | None = None,
    throw: bool = True,
    **settings: Any,
) -> Evolved:
    r"""Let a tissue move in time, overdamped: $\partial R / \partial \dot x = - \partial E / \partial x$.

    ```python
    friction = vx.dissipations.SubstrateFriction(1.0)
    movie = vx.evolve(tissue, energy, friction, jnp.linspace(0, 10, 51))
    vx.animate(movie.trajectory, "movie.gif")
    ```

    Works under `jax.jit`, `jax.vmap` and `jax.grad` with respect to the energy, the dissipation, the box
    and where the tissue begins. A gradient takes a linear system for each step, backwards in time, and
    keeps one configuration for each. It tells how the course changes as long as the same transitions happen
    in the same steps.

    **Arguments:**

    - `tissue`: where it begins, at the first of the times.
    - `energy`: its energy, or a function of time that returns one (a function, or an `equinox.Module` to
        differentiate with respect to what it holds).
    - `dissipation`: what resists the motion.
    - `times`: when there is to be a frame; they increase.
    - `adjoint`: how to differentiate each step, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation]
        by default.
    - `throw`: raise an error if a step finds no end. If False, look at `converged`.
    - `settings`: those of [`Evolution`][vertax.Evolution], whose convenient form this is: `activity`, `key`,
        `drive`, `substeps`, `order`, `boundary`, `pins`, `relaxation`.

    **Returns:** an [`Evolved`][vertax.responses.Evolved]: `tissue` at the end, and `frames`.

    **Raises:**

    - `TypeError` for arguments of the wrong kind.
    - `ValueError` for times that do not increase, or a dissipation that leaves vertices without any
        resistance, which are named.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step did not converge, or cells overlap.
    """
    return Evolution(dissipation, times, **settings)(tissue, energy, adjoint=adjoint, throw=throw)


class _State(eqx.Module):
    """How far an evolution has come."""

    tissue: Tissue
    drive: PyTree[Array]
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    valid: Bool[Array, ""]
    arrived: Bool[Array, ""]

    def after(self, step: Equilibrium) -> _State:
        """What is known when one more step is done."""
        return _State(
            step.tissue,
            self.drive,
            jnp.maximum(self.max_force, frozen(step.max_force)),
            self.num_steps + step.num_steps,
            self.num_t1 + step.num_t1,
            self.valid & step.valid & _right_handed(step.tissue.boundary),
            self.arrived & (step.result == optx.RESULTS.successful),
        )

    @property
    def result(self) -> optx.RESULTS:
        """The outcome of all steps."""
        reached = optx.RESULTS.where(
            self.arrived, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
        )
        return optx.RESULTS.where(jnp.isfinite(self.max_force), reached, optx.RESULTS.nonfinite)


# Of a method of second order with two stages of this share of a step each (SDIRK: Alexander 1977,
# doi:10.1137/0714068), which damps what is fast as the implicit Euler method does.
_SHARE = 1 - 0.5**0.5


@eqx.filter_jit
def _evolve(tissue: Tissue, energy: Any, evolution: Evolution, adjoint: AbstractAdjoint) -> Evolved:
    times = evolution.times.astype(tissue.vertices.dtype)

    def energy_at(time: Any) -> AbstractEnergy:
        found = energy if isinstance(energy, AbstractEnergy) else energy(time)
        if not isinstance(found, AbstractEnergy):
            raise TypeError(
                "Argument `energy` must be an energy, or a function of time that returns one, but returned "
                f"{named(found)}."
            )
        return found

    def stage(
        state: _State, before: Tissue, acts: Any, start: Any, end: Any, strained: Any
    ) -> _State:
        """A relaxation of the energy at the end, and what the way there from `before` dissipates."""
        there = evolution.placed(state.tissue, end)
        pulls = energy_at(end) if acts is None else energy_at(end) + acts
        potential = Incremental(pulls, evolution.dissipation, before, end - start, strained)
        return state.after(evolution.relaxation.solve(there, potential, adjoint, thrifty=True))

    def step(state: _State, start: Any, end: Any) -> _State:
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
        strained = evolution.dissipation.strains(middle.tissue, before) * (1 - _SHARE) / _SHARE
        return stage(middle, before, acts, end - _SHARE * dt, end, strained)

    def interval(arrays: _State, ends: tuple[Array, Array]) -> tuple[_State, tuple]:
        shares = jnp.linspace(0, 1, evolution.substeps + 1, dtype=times.dtype)
        marks = ends[0] + shares * (ends[1] - ends[0])

        def substep(arrays: _State, ends: tuple[Array, Array]) -> tuple[_State, None]:
            return eqx.filter(step(whole(arrays), *ends), eqx.is_array), None

        before = arrays.num_t1
        arrays, _ = jax.lax.scan(substep, arrays, (marks[:-1], marks[1:]))
        tissue = whole(arrays).tissue
        sound = arrays.arrived & arrays.valid
        frame = (arrays.tissue, energy_at(ends[1])(tissue), arrays.num_t1 - before, sound)
        return arrays, frame

    yes, none = jnp.array(True), jnp.array(0)
    drive = evolution.drive
    if drive is None and evolution.activity is not None:
        assert evolution.key is not None
        first, rest = jax.random.split(evolution.key)
        drive = (evolution.activity.init(tissue, first), rest)
    begin = _State(tissue, drive, jnp.zeros((), times.dtype), none, none, yes, yes)
    arrays, static = eqx.partition(begin, eqx.is_array)
    whole = lambda arrays: eqx.combine(arrays, static)
    end, (frames, energies, flips, sound) = jax.lax.scan(interval, arrays, (times[:-1], times[1:]))
    join = lambda first, rest: jnp.concatenate([jnp.asarray(first)[None], rest])
    end = whole(end)
    energies = join(energy_at(times[0])(tissue), energies)
    return Evolved(
        tissue=end.tissue,
        energy=energies[-1],
        max_force=end.max_force,
        num_steps=end.num_steps,
        num_t1=end.num_t1,
        valid=end.valid,
        result=end.result,
        times=times,
        frames=eqx.combine(jax.tree.map(join, arrays.tissue, frames), static.tissue),
        energies=energies,
        transitions=join(none, flips),
        drive=end.drive,
        sound=join(yes, sound),
    )


def _right_handed(boundary: AbstractBoundary) -> Bool[Array, ""]:
    """Whether a box that depends on time has not folded over."""
    return boundary.area > 0 if isinstance(boundary, Periodic) else jnp.array(True)


@eqx.filter_jit
def _resistance(tissue: Tissue, dissipation: AbstractDissipation) -> Float[Array, " vertices"]:
    """How much each vertex is held back if all move in different directions."""
    size = 1e-3 * cell_size(tissue)
    angles = 2.4 * jnp.arange(tissue.n_vertices, dtype=tissue.vertices.dtype)
    away = size * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    moved = lambda vertices: dissipation(tissue.with_vertices(vertices), tissue, 1.0)
    return jnp.sum(jax.grad(moved)(tissue.vertices + away) ** 2, axis=-1)
