"""The steps of a growth, as a simulation of frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, Shaped

from vertax._base.frame_loop import AbstractSimulation, Frame
from vertax._base.results import RESULTS, finite_record, first_failure, result_of
from vertax._base.tracing import tree_where
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint
from vertax.dissipations import AbstractDissipation
from vertax.dynamics._incremental_potential import IncrementalPotential
from vertax.dynamics._time_integration import max_force
from vertax.energies import AbstractEnergy
from vertax.growth._grown import Grown
from vertax.growth._life_cycle import AbstractLifeCycle
from vertax.growth._lineage import Lineage, initial_lineage, record_deaths, record_division
from vertax.mesh import Tissue
from vertax.relax import Relaxation
from vertax.transitions import T2
from vertax.transitions._division import divided


class State(eqx.Module):
    """The state of a growth between two steps."""

    tissue: Tissue
    cells: Any
    drive: Any
    number: Int[Array, " cells"]
    lineage: Lineage
    result: RESULTS
    failed_divisions: Int[Array, ""]
    failed_deaths: Int[Array, ""]
    log_likelihood: Float[Array, ""]


class Growth(AbstractSimulation):
    """The growth of a tissue; for its fields see `vertax.growth.grow`."""

    name: ClassVar[str] = "growth"
    points: ClassVar[str] = "times"

    energy: Callable[[Any], AbstractEnergy]
    cycle: AbstractLifeCycle
    dissipation: AbstractDissipation | None
    activity: AbstractActivity | None
    relaxation: Relaxation
    adjoint: AbstractAdjoint
    substeps: int = eqx.field(static=True)
    divisions: int = eqx.field(static=True)
    records: int = eqx.field(static=True)

    def begin(self, start: tuple[Tissue, PRNGKeyArray], points: Array) -> tuple[State, Frame]:
        """The initial state and frame of a tissue, with a random key."""
        tissue, key = start
        key, _ = jax.random.split(key)
        lineage, number = initial_lineage(tissue, points[0], self.records)
        activity = self.activity
        state = State(
            tissue=tissue,
            cells=self.cycle.init(tissue, key),
            drive=None if activity is None else activity.init(tissue, jax.random.fold_in(key, 1)),
            number=number,
            lineage=lineage,
            result=result_of(jnp.array(0)),
            failed_divisions=jnp.array(0),
            failed_deaths=jnp.array(0),
            log_likelihood=jnp.zeros((), tissue.vertices.dtype),
        )
        return state, self._frame(state)

    def keys(self, start: tuple[Tissue, PRNGKeyArray], n: int) -> Shaped[Array, "intervals ..."]:
        """A random key for each interval."""
        return jax.random.split(jax.random.split(start[1])[1], n)

    def advance(self, state: State, interval: Array, key: Any) -> tuple[State, Frame]:
        """The steps between two frames; none after one of the last two cells of a free tissue died."""
        arrays, static = eqx.partition(state, eqx.is_array)
        start, end = interval
        times = start + jnp.linspace(0, 1, self.substeps + 1, dtype=start.dtype) * (end - start)

        def substep(arrays: State, inputs: tuple) -> tuple[State, None]:
            state = eqx.combine(arrays, static)
            ended = state.result == RESULTS.too_few_cells
            advance = lambda: eqx.filter(self._step(state, *inputs), eqx.is_array)
            return jax.lax.cond(ended, lambda: arrays, advance), None

        keys = jax.random.split(key, self.substeps)
        arrays, _ = jax.lax.scan(substep, arrays, (times[:-1], times[1:], keys))
        state = eqx.combine(arrays, static)
        return state, self._frame(state)

    def outcome(self, points: Array, end: State, frames: Frame) -> Grown:
        """The result of the growth."""
        return Grown(
            tissue=end.tissue,
            cells=end.cells,
            times=points,
            lineage=end.lineage,
            log_likelihood=end.log_likelihood,
            **frames,
        )

    def counts(self, state: State) -> dict[str, Array]:
        """The number of living cells."""
        return {"cells": jnp.sum(state.number >= 0)}

    def _frame(self, state: State) -> Frame:
        return {
            "frames": state.tissue,
            "cells_then": state.cells,
            "number": state.number,
            "results": state.result,
            "failed_divisions": state.failed_divisions,
            "failed_deaths": state.failed_deaths,
            "signals": self._record(state.drive, state.tissue),
        }

    def _record(self, drive: Any, tissue: Tissue) -> PyTree[Array]:
        return None if self.activity is None else self.activity.record(drive, tissue)

    def _divide(self, state: State, due: Array, time: Array, key: Array) -> tuple[State, Array]:
        """Divide the first of the cells that are due; return the state and the remaining ones."""
        cell = jnp.argmax(due).astype(jnp.int32)
        axis_key, state_key = jax.random.split(key)
        axis = self.cycle.axis(state.cells, state.tissue, cell, axis_key)
        change = divided(state.tissue, cell, axis, jnp.any(due))
        done = change.result == RESULTS.successful
        daughter = jnp.argmax(change.tissue.alive & ~state.tissue.alive).astype(jnp.int32)
        pair = jnp.stack([cell, daughter])
        cells = change.inherited(state.cells, axis="cells")
        cells = self.cycle.born(cells, change.tissue, pair, state_key)
        drive = state.drive
        if self.activity is not None:
            drive = self.activity.born(change.inherited(drive, axis="cells"), change.tissue, pair)
            drive = tree_where(done, drive, state.drive)
        lineage, number = record_division(state.lineage, state.number, pair, time, done)
        full = jnp.any(due) & jnp.all(state.tissue.alive)
        full = RESULTS.where(full, RESULTS.capacity_reached, RESULTS.successful)
        after = State(
            tissue=change.tissue,
            cells=jax.tree.map(lambda a, b: jnp.where(done, a, b), cells, state.cells),
            drive=drive,
            number=number,
            lineage=lineage,
            result=first_failure(state.result, full),
            failed_divisions=state.failed_divisions + (jnp.any(due) & ~done),
            failed_deaths=state.failed_deaths,
            log_likelihood=state.log_likelihood,
        )
        return after, due & (jnp.arange(due.size) != cell)

    def _step(self, previous: State, start: Array, end: Array, key: Array) -> State:
        """One time step: the life cycle advances, cells divide, the tissue relaxes or moves."""
        aging, *dividing = jax.random.split(key, 1 + self.divisions)
        cells, due = self.cycle.advance(previous.cells, previous.tissue, end - start, aging)
        log_likelihood = previous.log_likelihood + self.cycle.log_likelihood(
            previous.cells, cells, previous.tissue, end - start
        )
        parts = lambda s: (s.cells, s.log_likelihood)
        aged = eqx.tree_at(parts, previous, (cells, log_likelihood))
        arrays, static = eqx.partition(aged, eqx.is_array)

        def divide(carry: tuple, key: Array) -> tuple:
            arrays, due = carry

            def perform() -> tuple[State, Array]:
                state, rest = self._divide(eqx.combine(arrays, static), due, end, key)
                return eqx.filter(state, eqx.is_array), rest

            return jax.lax.cond(jnp.any(due), perform, lambda: carry), None

        due &= previous.tissue.alive
        (arrays, _), _ = jax.lax.scan(divide, (arrays, due), jnp.stack(dividing))
        state = eqx.combine(arrays, static)
        before, potential = state.tissue, self.energy(state.cells)
        active, drive, resistance = None, state.drive, self.dissipation
        if self.activity is not None:
            # (Folded in, so that the other random numbers are those of a growth without activity.)
            drive_key = jax.random.fold_in(key, self.divisions + 1)
            active, drive = self.activity.drive(
                drive, before, self.dissipation, start, end - start, drive_key
            )
            resistance = self.activity.step_dissipation(drive, before, self.dissipation)
        if active is not None:
            potential += active
        if resistance is not None:
            driving_force = None if active is None else max_force(active, before)
            potential = IncrementalPotential(
                potential, resistance, before, end - start, max_driving_force=driving_force
            )
        moved = self.relaxation.solve(before, potential, self.adjoint, recompute=True)
        died = before.alive & ~moved.tissue.alive
        lineage, number = record_deaths(state.lineage, state.number, died, end)
        # (A relaxation that failed matters more than a tissue that is full.)
        failed = moved.result != RESULTS.successful
        failed &= (state.result == RESULTS.successful) | (state.result == RESULTS.capacity_reached)
        result = RESULTS.where(failed, moved.result, state.result)
        if self.activity is not None:
            drive = self.activity.finish(drive, before, moved.tissue)
            result = first_failure(result, finite_record(self._record(drive, moved.tissue)))
        recorded = lineage.count <= self.records
        recorded = RESULTS.where(recorded, RESULTS.successful, RESULTS.lineage_full)
        overdue = moved.tissue.alive & self.cycle.overdue(state.cells, moved.tissue)
        after = State(
            tissue=moved.tissue,
            cells=state.cells,
            drive=drive,
            number=number,
            lineage=lineage,
            result=first_failure(result, recorded),
            failed_divisions=state.failed_divisions,
            failed_deaths=state.failed_deaths + jnp.sum(overdue),
            log_likelihood=state.log_likelihood,
        )
        if not after.tissue.topology.exterior:
            return after
        # The last two cells cannot vanish: the tissue stays as it was when one of them has collapsed.
        few = jnp.sum(after.tissue.alive) <= 2
        small = after.tissue.areas < T2().threshold * after.tissue.mean_area
        collapsed = few & jnp.any(after.tissue.alive & small)
        result = first_failure(previous.result, RESULTS.too_few_cells)
        ended = eqx.tree_at(lambda s: s.result, previous, result)
        return tree_where(collapsed, ended, after)
