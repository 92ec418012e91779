"""Dynamics: overdamped motion, each step a relaxation."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from vertax._base.announce import announce_compilations
from vertax._base.checkpoints import Checkpoint
from vertax._base.checks import as_key, as_times, check_integer, describe
from vertax._base.memory_maps import warn_of_memory_maps
from vertax._base.tracing import is_concrete, traced
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._long_run import evolve_by_frames
from vertax.dynamics._material import Material
from vertax.dynamics._step_control import StepControl
from vertax.dynamics._time_integration import evolve_at_once
from vertax.energies import AbstractEnergy
from vertax.energies._units import cell_size
from vertax.mesh import AbstractBoundary, Tissue
from vertax.relax._relaxation import Relaxation
from vertax.relax._response import AbstractResponse


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
    - `drive`: in place of a key, that of an [`Evolved`][vertax.dynamics.Evolved] which is to go on.
    - `substeps`: steps from one frame to the next.
    - `control`: in place of `substeps`, [`StepControl`][vertax.dynamics.StepControl]: as many steps as a
        tolerance of their error asks for.
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
    control: StepControl | None
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
        control: StepControl | None = None,
        order: int = 1,
        boundary: Callable[[Float[Array, ""]], AbstractBoundary] | None = None,
        pins: Callable[[Float[Array, ""]], Float[Array, "vertices 2"]] | None = None,
        relaxation: Relaxation | None = None,
    ):
        if not isinstance(dissipation, AbstractDissipation):
            raise TypeError(
                "Argument `dissipation` must be one of vertax.dissipations, e.g. SubstrateFriction(1.0), "
                f"but is {describe(dissipation)}."
            )
        if not isinstance(activity, AbstractActivity | None):
            raise TypeError(
                "Argument `activity` must be one of vertax.activities, e.g. ThermalNoise(0.01), but is "
                f"{describe(activity)}."
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
                f"Argument `relaxation` must be a vertax.Relaxation, but is {describe(relaxation)}."
            )
        for name, function in (("boundary", boundary), ("pins", pins)):
            if function is not None and not callable(function):
                raise TypeError(
                    f"Argument `{name}` must be a function of time, but is {describe(function)}. For one "
                    "that stays, leave it out."
                )
        check_integer("substeps", substeps, at_least=1)
        if order not in (1, 2):
            raise ValueError(f"Argument `order` must be 1 or 2, but is {order!r}.")
        if order == 2 and not isinstance(dissipation, AbstractViscosity):
            raise ValueError(
                "Argument `order` can be 2 only for a dissipation that is half a sum of squares, an "
                f"AbstractViscosity, which {type(dissipation).__name__} is not."
            )
        if not isinstance(control, StepControl | None):
            raise TypeError(
                "Argument `control` must be a vertax.dynamics.StepControl, e.g. StepControl(1e-3), but is "
                f"{describe(control)}."
            )
        if control is not None and (substeps != 1 or activity is not None):
            wrong = "`substeps`" if activity is None else "`activity`"
            raise ValueError(
                f"Argument `control` does not go with {wrong}: "
                + (
                    "it says itself how many steps there are."
                    if activity is None
                    else "random numbers must not depend on which steps are refused. Take `substeps`."
                )
            )
        self.dissipation, self.control = dissipation, control
        self.times = as_times(times)
        self.substeps, self.order = substeps, order
        self.boundary, self.pins = boundary, pins

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy],
        *,
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
        progress: bool = False,
        checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    ) -> Evolved:
        """Let a tissue move.

        **Arguments:** as [`evolve`][vertax.evolve].

        **Returns:** what happened, [`Evolved`][vertax.dynamics.Evolved].

        **Raises:** as [`evolve`][vertax.evolve].
        """
        adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
        response = self
        if isinstance(energy, Material):
            response, energy = self.of(energy), energy.energy
        response.relaxation.check(tissue, energy, adjoint)
        response._check(tissue)
        response._check_drive(tissue)
        warn_of_memory_maps()
        given = (*traced((tissue, energy), tissue.vertices.dtype), response.traced(), adjoint)
        with announce_compilations(f"the evolution of {tissue.n_cells} cells"):
            if progress or checkpoint is not None:
                evolved = evolve_by_frames(*given, checkpoint, progress=progress, throw=throw)
            else:
                evolved = evolve_at_once(*given)
        return evolved.checked() if throw else evolved

    def check_compatible(
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
    def supports_warm_start(self) -> bool:
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
        new = (*traced((self.dissipation, self.activity, self.control)), self.relaxation.traced())
        parts = lambda e: (e.dissipation, e.activity, e.control, e.relaxation)
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
        """Refuse pins without pinned vertices, and a dissipation that resists no motion of some vertices."""
        if self.pins is not None:
            if tissue.pinned is None:
                raise ValueError(
                    "Argument `pins` says where pinned vertices are, but the tissue has none: name them, "
                    "vertax.Tissue(..., pinned=mask)."
                )
            shape = jax.eval_shape(self.pins, self.times[0]).shape
            if shape != tissue.vertices.shape:
                raise ValueError(
                    "Argument `pins` must return one position for each vertex, shape "
                    f"{tissue.vertices.shape}, but its result has the shape {shape}."
                )
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
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
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
    - `progress`: show a progress bar (only on a terminal).
    - `checkpoint`: a file, or a [`Checkpoint`][vertax.Checkpoint], to write down the frames so far, and to go
        on from if it is there, to the same bits as if it had not stopped. With either of these two each frame
        is a call of its own of a compiled function, which is no part of a larger one.
    - `settings`: those of [`Evolution`][vertax.Evolution], whose convenient form this is: `activity`, `key`,
        `drive`, `substeps`, `control`, `order`, `boundary`, `pins`, `relaxation`.

    **Returns:** an [`Evolved`][vertax.dynamics.Evolved]: `tissue` at the end, and `frames`.

    **Raises:**

    - `TypeError` for arguments of the wrong kind.
    - `ValueError` for times that do not increase, a dissipation that leaves vertices without any
        resistance, which are named, or a checkpoint that is broken or of another movement.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step did not converge, or cells overlap.
    """
    evolution = Evolution(dissipation, times, **settings)
    return evolution(
        tissue, energy, adjoint=adjoint, throw=throw, progress=progress, checkpoint=checkpoint
    )


@eqx.filter_jit
def _resistance(tissue: Tissue, dissipation: AbstractDissipation) -> Float[Array, " vertices"]:
    """How much each vertex is held back if all move in different directions."""
    size = 1e-3 * cell_size(tissue)
    angles = 2.4 * jnp.arange(tissue.n_vertices, dtype=tissue.vertices.dtype)
    away = size * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    moved = lambda vertices: dissipation(tissue.with_vertices(vertices), tissue, 1.0)
    return jnp.sum(jax.grad(moved)(tissue.vertices + away) ** 2, axis=-1)
