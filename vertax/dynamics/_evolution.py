"""Time evolution: overdamped motion by implicit steps, each a relaxation."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from vertax._base.announce import announce_compilations
from vertax._base.checkpoints import Checkpoint
from vertax._base.checks import (
    as_key,
    as_times,
    check_choice,
    check_function,
    check_instance,
    check_integer,
)
from vertax._base.frame_loop import simulate
from vertax._base.memory_maps import warn_of_memory_maps
from vertax._base.tracing import is_concrete, traced
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.dissipations import AbstractDissipation
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._material import Material
from vertax.dynamics._pi_controller import PIController
from vertax.dynamics._time_integration import Motion, check_order
from vertax.energies import AbstractEnergy
from vertax.mesh import AbstractBoundary, Tissue
from vertax.relax import AbstractResponse, Relaxation


class Evolution(AbstractResponse):
    r"""Overdamped motion of a tissue: $\partial R / \partial \dot x = - \partial E / \partial x$.

    Each step minimises the incremental potential (a minimising movement),

    $$x_{n+1} = \arg\min_x\; E(x) + \Delta t\, R\left(\frac{x - x_n}{\Delta t}; x_n\right).$$

    This is the implicit Euler method: stable for every $\Delta t$, and without an activity the energy never
    increases, also through T1 transitions. Each step is a [`Relaxation`][vertax.Relaxation], with its
    solvers, transitions, contacts and adjoints.

    **Arguments:**

    - `dissipation`: the dissipation $R$, see `vertax.dissipations`.
    - `times`: the times of the frames, increasing; the first one is the time of the initial tissue.
    - `activity`: active forces or noise, see `vertax.activities`.
    - `key`: the random key or seed of the activity. Each step uses a new key that is split from it. A
        deterministic activity needs none.
    - `drive`: instead of a key, the field `drive` of an [`Evolved`][vertax.dynamics.Evolved] to continue.
    - `substeps`: steps per frame.
    - `stepsize_controller`: instead of `substeps`, a [`PIController`][vertax.dynamics.PIController]: step
        sizes from an error tolerance.
    - `order`: 1, or 2 for two stages per step (an SDIRK method, stable for every $\Delta t$, but the energy
        may increase). Order 2 requires a dissipation that is half a sum of squares.
    - `boundary`: a function of time that returns the boundary, such as a sheared box. The tissue is mapped
        affinely into it before each step. By default the boundary is constant.
    - `pins`: a function of time that returns positions of all vertices; those of pinned vertices are used.
    - `relaxation`: the relaxation of each step.

    **Raises:**

    - `TypeError` for an argument of the wrong class, or if `boundary` or `pins` is not a function.
    - `ValueError` for an activity without a key, times that do not increase, `substeps` below 1, an order
        other than 1 and 2, or order 2 with a dissipation that is not a sum of squares.
    """

    dissipation: AbstractDissipation
    times: Float[Array, " times"]
    activity: AbstractActivity | None
    key: PRNGKeyArray | None
    drive: Any
    substeps: int = eqx.field(static=True)
    stepsize_controller: PIController | None
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
        drive: Any = None,
        substeps: int = 1,
        stepsize_controller: PIController | None = None,
        order: int = 1,
        boundary: Callable[[Float[Array, ""]], AbstractBoundary] | None = None,
        pins: Callable[[Float[Array, ""]], Float[Array, "vertices 2"]] | None = None,
        relaxation: Relaxation = Relaxation(),
    ):
        expected = "one of vertax.dissipations, e.g. SubstrateFriction(1.0)"
        check_instance("dissipation", dissipation, AbstractDissipation, expected)
        expected = "one of vertax.activities, e.g. ThermalNoise(0.01)"
        check_instance("activity", activity, AbstractActivity | None, expected)
        if activity is not None and activity.deterministic and key is None:
            key = 0
        if activity is not None and key is None and drive is None:
            raise ValueError(
                "Argument `key` is missing: an activity draws random numbers. Pass a seed, e.g. key=0, or "
                "the `drive` of an evolution to continue."
            )
        self.activity, self.drive = activity, drive
        self.key = None if key is None else as_key(key)
        self.relaxation = relaxation
        check_instance("relaxation", self.relaxation, Relaxation, "a vertax.Relaxation")
        for name, function in (("boundary", boundary), ("pins", pins)):
            if function is not None:
                check_function(name, function, "a function of time", "Omit it if it is constant.")
        check_integer("substeps", substeps, at_least=1)
        check_choice("order", order, (1, 2))
        check_order(order, dissipation)
        expected = "a vertax.dynamics.PIController, e.g. PIController(1e-3)"
        check_instance("stepsize_controller", stepsize_controller, PIController | None, expected)
        random = activity is not None and not activity.deterministic
        if stepsize_controller is not None and (substeps != 1 or random):
            conflict = "`activity`" if random else "`substeps`"
            raise ValueError(
                f"Argument `stepsize_controller` does not go with {conflict}: "
                + (
                    "it determines the number of steps."
                    if not random
                    else "random numbers must not depend on which steps are rejected. Use `substeps`."
                )
            )
        self.dissipation, self.stepsize_controller = dissipation, stepsize_controller
        self.times = as_times(times)
        self.substeps, self.order = substeps, order
        self.boundary, self.pins = boundary, pins

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy],
        *,
        adjoint: AbstractAdjoint = ImplicitDifferentiation(),
        throw: bool = True,
        progress: bool = False,
        checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    ) -> Evolved:
        """Evolve a tissue in time.

        **Arguments:** as [`evolve`][vertax.evolve].

        **Returns:** an [`Evolved`][vertax.dynamics.Evolved].

        **Raises:** as [`evolve`][vertax.evolve].
        """
        response = self
        if isinstance(energy, Material):
            response, energy = self.of(energy), energy.energy
        response.relaxation.check(tissue, energy, adjoint)
        response._check(tissue)
        response._check_drive(tissue)
        warn_of_memory_maps()
        tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
        response = response.traced()
        points = response.times.astype(tissue.vertices.dtype)
        start, parts = (tissue, response.key, response.drive), lambda e: (e.times, e.key, e.drive)
        is_none = lambda x: x is None
        rule = eqx.tree_at(parts, response, (None, None, None), is_leaf=is_none)
        with announce_compilations(f"the evolution of {tissue.n_cells} cells"):
            return simulate(
                Motion(energy, rule, adjoint),
                start,
                points,
                progress=progress,
                checkpoint=checkpoint,
                throw=throw,
            )

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Raise an error for options that require a tissue at rest.

        **Arguments:** as for every response.

        **Raises:**

        - `ValueError` for guidance, a nudge by the cost, and a fitted position.
        """
        by_cost = isinstance(adjoint, EquilibriumPropagation) and adjoint.nudge == "cost"
        for option, is_set in (
            ("`fit_position`", placed),
            ("`guidance`", guided),
            ("EquilibriumPropagation(nudge='cost')", by_cost),
        ):
            if is_set:
                raise ValueError(
                    f"{option} goes with a tissue at rest, but the response is an Evolution. Leave it out."
                )

    @property
    def supports_warm_start(self) -> bool:
        """False: each epoch of a fit starts from the tissue at the first of the times."""
        return False

    def of(self, material: Material) -> Evolution:
        """A copy with the dissipation and the activity of a material, where it has them."""
        dissipation, activity = material.dissipation, material.activity
        parts = {"dissipation": dissipation, "activity": activity}
        replaced = {name: part for name, part in parts.items() if part is not None}
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Evolution(**(fields | replaced))

    def traced(self) -> Evolution:
        """A copy with its numbers as arrays: other values need no recompilation."""
        numbers = traced((self.dissipation, self.activity, self.stepsize_controller))
        new = (*numbers, self.relaxation.traced())
        parts = lambda e: (e.dissipation, e.activity, e.stepsize_controller, e.relaxation)
        return eqx.tree_at(parts, self, new, is_leaf=lambda x: x is None)

    def finer(self, tolerance: Float[Array, ""]) -> Evolution:
        """A copy in which each step also requires the largest force to be below this tolerance."""
        return eqx.tree_at(lambda e: e.relaxation, self, self.relaxation.finer(tolerance))

    def placed(self, tissue: Tissue, time: Float[Array, ""]) -> Tissue:
        """A tissue mapped into the boundary at a time, with its pinned vertices at their positions then."""
        if self.boundary is not None:
            tissue = tissue.carried(self.boundary(time))
        if self.pins is not None and tissue.pinned is not None:
            vertices = jnp.where(tissue.pinned[:, None], self.pins(time), tissue.vertices)
            tissue = tissue.with_vertices(vertices)
        return tissue

    def _check_drive(self, tissue: Tissue) -> None:
        """Raise an error for the drive of another activity, or of another tissue."""
        if self.activity is None or self.drive is None:
            return
        key = jax.eval_shape(lambda: jax.random.key(0))
        expected = eqx.filter_eval_shape(self.activity.init, tissue, key)
        types = lambda tree: jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), tree)
        is_pair = isinstance(self.drive, tuple) and len(self.drive) == 2
        if not is_pair or not eqx.tree_equal(types(expected), types(self.drive[0])):
            raise ValueError(
                "Argument `drive` does not go with this activity and this tissue: it must be that of an "
                "evolution of a tissue of this size with this activity. Pass a key to start anew."
            )

    def _check(self, tissue: Tissue) -> None:
        """Raise an error for pins without pinned vertices, and for vertices without dissipation."""
        if self.pins is not None:
            if tissue.pinned is None:
                raise ValueError(
                    "Argument `pins` needs pinned vertices, but the tissue has none. Select them with "
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
            indices = np.nonzero(free)[0]
            listed = ", ".join(map(str, indices[:5])) + (", ..." if len(indices) > 5 else "")
            raise ValueError(
                f"Argument `dissipation` must resist the motion of every vertex, but is 0 for {len(indices)} "
                f"of {tissue.n_vertices} vertices ({listed}): their velocities would be infinite. Add "
                "friction there, e.g. + vertax.dissipations.SubstrateFriction(0.01)."
            )


def evolve(
    tissue: Tissue,
    energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy],
    dissipation: AbstractDissipation,
    times: ArrayLike | Sequence[Any],
    *,
    activity: AbstractActivity | None = None,
    key: PRNGKeyArray | int | None = None,
    drive: Any = None,
    substeps: int = 1,
    stepsize_controller: PIController | None = None,
    order: int = 1,
    boundary: Callable[[Float[Array, ""]], AbstractBoundary] | None = None,
    pins: Callable[[Float[Array, ""]], Float[Array, "vertices 2"]] | None = None,
    relaxation: Relaxation = Relaxation(),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    throw: bool = True,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
) -> Evolved:
    r"""Overdamped motion of a tissue in time, $\partial R / \partial \dot x = - \partial E / \partial x$.

    ```python
    friction = vx.dissipations.SubstrateFriction(1.0)
    movie = vx.evolve(tissue, energy, friction, jnp.linspace(0, 10, 51))
    vx.animate(movie.trajectory, "movie.gif")
    ```

    Works under `jax.jit`, `jax.vmap` and `jax.grad` with respect to the energy, the dissipation, the box
    and the initial tissue. A gradient solves one linear system per step, backwards in time, and stores one
    configuration per step. It is valid as long as the same transitions happen in the same steps.

    **Arguments:**

    - `tissue`: the initial tissue, at the first of the times.
    - `energy`: its energy, or a function of time that returns one (a function, or an `equinox.Module` to
        differentiate with respect to its fields).
    - `dissipation`: the dissipation $R$.
    - `times`: the times of the frames, increasing.
    - `activity`, `key`, `drive`, `substeps`, `stepsize_controller`, `order`, `boundary`, `pins`,
        `relaxation`: see [`Evolution`][vertax.Evolution].
    - `adjoint`: the differentiation method of each step,
        [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by default.
    - `throw`: raise an error if a step does not converge. If False, check `converged`.
    - `progress`: show a progress bar (only on a terminal).
    - `checkpoint`: a file, or a [`Checkpoint`][vertax.Checkpoint], to which the frames are written. If it
        exists, the run continues from it, with bitwise the same results as without the interruption. With
        `progress` or `checkpoint` each frame is a separate call of a compiled function, so the call cannot be
        inside `jax.jit`.

    **Returns:** an [`Evolved`][vertax.dynamics.Evolved]: `tissue` at the end, and `frames`.

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    - `ValueError` for times that do not increase, a dissipation that is 0 for some vertices, or a checkpoint
        that is broken or of another run.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step did not converge, or cells overlap.
    """
    evolution = Evolution(
        dissipation,
        times,
        activity=activity,
        key=key,
        drive=drive,
        substeps=substeps,
        stepsize_controller=stepsize_controller,
        order=order,
        boundary=boundary,
        pins=pins,
        relaxation=relaxation,
    )
    return evolution(
        tissue, energy, adjoint=adjoint, throw=throw, progress=progress, checkpoint=checkpoint
    )


@eqx.filter_jit
def _resistance(tissue: Tissue, dissipation: AbstractDissipation) -> Float[Array, " vertices"]:
    """Squared resistance of each vertex to a motion of all vertices in different directions."""
    size = 1e-3 * tissue.cell_size
    angles = 2.4 * jnp.arange(tissue.n_vertices, dtype=tissue.vertices.dtype)
    displacements = size * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    dissipated = lambda vertices: dissipation(tissue.with_vertices(vertices), tissue, 1.0)
    return jnp.sum(jax.grad(dissipated)(tissue.vertices + displacements) ** 2, axis=-1)
