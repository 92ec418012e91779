"""Growth of a tissue: a life cycle updates the cells, and the tissue relaxes or moves in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.checks import as_key, as_times, check_integer, describe
from vertax._base.results import RESULTS, checked, first_failure, result_of
from vertax._base.tracing import is_concrete, traced, tree_where
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.dissipations import AbstractDissipation
from vertax.dynamics._incremental_potential import IncrementalPotential
from vertax.dynamics._time_integration import finite_record, max_force
from vertax.energies import AbstractEnergy
from vertax.growth._life_cycle import AbstractLifeCycle
from vertax.growth._lineage import Lineage, initial_lineage, record_deaths, record_division
from vertax.mesh import Tissue, Trajectory
from vertax.mesh._tissue import mean_area
from vertax.relax import Relaxation
from vertax.transitions import T1, T2
from vertax.transitions._division import divided

Energy = Callable[[Any], AbstractEnergy]


class Grown(eqx.Module):
    """Result of [`grow`][vertax.growth.grow]."""

    tissue: Tissue
    """The final tissue."""
    cells: Any
    """The final cell states, see [`AbstractLifeCycle`][vertax.growth.AbstractLifeCycle]."""
    times: Float[Array, "*batch times"]
    """The times of the frames; the first is the initial time."""
    frames: Tissue
    """The tissue at these times, with a leading axis."""
    cells_then: Any
    """The cell states at these times, with a leading axis."""
    number: Int[Array, "*batch times cells"]
    """Index in the lineage of the cell in each slot; -1 for spare slots."""
    lineage: Lineage
    """The mother, birth and end of each cell."""
    results: RESULTS
    """The first failure of the steps up to each frame, `successful` if there is none: a relaxation that did
    not converge, overlaps, a division without a spare slot, a lineage with too few records, or the death of
    one of the last two cells of a free tissue, after which the tissue does not change."""
    failed_divisions: Int[Array, "*batch times"]
    """Number of failed divisions up to a frame: there was no spare slot, or the cell could not be cut in two.
    A failed division is tried again, and counted again, in each following step."""
    failed_deaths: Int[Array, "*batch times"]
    """Number of overdue deaths up to a frame (see `overdue` of the life cycle), e.g. because a neighbour
    would have too few sides without the cell. Counted again in each step."""
    log_likelihood: Float[Array, "*batch"]
    """Log-likelihood of the discrete random choices of the life cycle, see
    [`score_function`][vertax.growth.score_function]."""

    signals: Any
    """The concentrations in each frame, shape `(times, species, cells)`, 0 in spare slots; see
    [`Signals`][vertax.signals.Signals]. In general the record of the activity, None without one."""

    @property
    def n_alive(self) -> Int[Array, "*batch times"]:
        """Number of living cells in each frame."""
        return jnp.sum(self.number >= 0, axis=-1)

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for writing files."""
        trajectory = Trajectory()
        arrays, static = eqx.partition(self.frames, eqx.is_array)
        for i, time in enumerate(self.times):
            frame = eqx.combine(jax.tree.map(lambda x, i=i: x[i], arrays), static)
            record = {"signals": self.signals[i]} if eqx.is_array(self.signals) else {}
            trajectory.append(frame, time=time, cells=self.n_alive[i], **record)
        return trajectory

    @property
    def result(self) -> RESULTS:
        """How the growth ended: the first failure."""
        return jax.tree.map(lambda x: x[..., -1], self.results)

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether all steps succeeded."""
        return self.result == RESULTS.successful

    def checked(self) -> Grown:
        """The same, if all steps succeeded.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) with the message of `result` if they did not.
        """
        capacity, records = self.tissue.n_cells, self.lineage.mother.shape[-1]
        return checked(self, self.result, lambda: f"{capacity} cell slots, {records} records")


def grow(
    tissue: Tissue,
    energy: Energy,
    cycle: AbstractLifeCycle,
    times: ArrayLike | Sequence[Any],
    *,
    key: PRNGKeyArray | int,
    substeps: int = 1,
    divisions: int | None = None,
    records: int | None = None,
    dissipation: AbstractDissipation | None = None,
    activity: AbstractActivity | None = None,
    relaxation: Relaxation = Relaxation(transitions=T1() + T2()),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    throw: bool = True,
) -> Grown:
    r"""Let the cells of a tissue grow, divide and die.

    ```python
    def energy(cells):
        return vx.energies.AreaElasticity(1.0, cells.target_area) + vx.energies.LineTension(0.1)

    cycle = vx.growth.GrowAndDivide(growth_rate=0.1, division_area=1.5)
    tissue = vx.initialise.free_voronoi(4, key=0).with_capacity(100)
    grown = vx.growth.grow(tissue, energy, cycle, jnp.linspace(0, 40, 81), key=1)
    vx.animate(grown.trajectory, "growth.gif")
    ```

    Each time step:

    1. The life cycle updates the cell states and selects the cells that divide.
    2. The selected cells divide.
    3. The tissue relaxes to equilibrium; with a dissipation it moves for the length of the step instead, as
       in [`evolve`][vertax.evolve]. T1 and T2 transitions happen here.

    Works under `jax.jit` and `jax.vmap`. Gradients hold the discrete events (divisions, deaths and their
    steps) fixed; [`score_function`][vertax.growth.score_function] adds the dependence of their probabilities
    on the parameters.

    **Arguments:**

    - `tissue`: the initial tissue, with spare slots for all cells alive at the same time, see
        [`with_capacity`][vertax.Tissue.with_capacity]. At least one cell in a periodic box, two in a free
        tissue.
    - `energy`: a function of the cell states that returns the energy of the tissue.
    - `cycle`: the life cycle, e.g. [`GrowAndDivide`][vertax.growth.GrowAndDivide].
    - `times`: increasing times of the frames; the first is the initial time.
    - `key`: key or seed for random numbers.
    - `substeps`: number of time steps between two frames.
    - `divisions`: maximum number of divisions per step, by default 4 + capacity / 20; further divisions wait
        for the next step.
    - `records`: capacity of the lineage, by default eight times the number of cell slots.
    - `dissipation`: friction and viscosity; by default none, and the tissue relaxes in each step.
    - `activity`: active forces, noise or [signals][vertax.signals.Signals]. Daughters inherit its state, see
        `born` of [`AbstractActivity`][vertax.AbstractActivity]. An activity that draws random numbers needs a
        dissipation.
    - `relaxation`: solver and transitions of each step, by default with T1 and T2 transitions.
    - `adjoint`: how to differentiate each step.
    - `throw`: raise an error if a step does not converge or capacity is exhausted. If False, look at
        `result`.

    **Returns:** a [`Grown`][vertax.growth.Grown].

    **Raises:**

    - `TypeError` for a cycle, an energy, a dissipation, an activity or a relaxation of a wrong type.
    - `ValueError` for times that do not increase, a tissue without spare slots, or noise without a
        dissipation.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step does not converge or capacity is
        exhausted.
    """
    for name, value, kind, expected in (
        ("cycle", cycle, AbstractLifeCycle, "an AbstractLifeCycle"),
        ("dissipation", dissipation, AbstractDissipation | None, "an AbstractDissipation or None"),
        ("activity", activity, AbstractActivity | None, "an AbstractActivity or None"),
        ("relaxation", relaxation, Relaxation, "a Relaxation"),
    ):
        if not isinstance(value, kind):
            raise TypeError(f"Argument `{name}` must be {expected}, but is {describe(value)}.")
    invalid = isinstance(energy, AbstractEnergy) or not callable(energy)
    if invalid or (isinstance(energy, type) and issubclass(energy, AbstractEnergy)):
        name = energy.__name__ if isinstance(energy, type) else "energy"
        raise TypeError(
            "Argument `energy` must be a function of the cell states that returns an energy, "
            f"but is {describe(energy)}. Pass such a function, e.g. lambda cells: {name}"
            f"{'(...)' if isinstance(energy, type) else ''}."
        )
    if activity is not None and dissipation is None and not activity.deterministic:
        raise ValueError(
            "Argument `dissipation` is missing: an activity with random numbers needs one. Pass e.g. "
            "vertax.dissipations.SubstrateFriction(1.0)."
        )
    if not tissue.topology.spare:
        raise ValueError(
            "Argument `tissue` must have spare slots for new cells, but has none. Pass "
            "tissue.with_capacity(...)."
        )
    check_integer("substeps", substeps, at_least=1)
    divisions = 4 + tissue.n_cells // 20 if divisions is None else divisions
    check_integer("divisions", divisions, at_least=1)
    records = 8 * tissue.n_cells if records is None else records
    check_integer("records", records, at_least=1)
    if is_concrete(tissue.topology.cell):
        labels = np.unique(np.asarray(tissue.topology.cell))
        check_integer("records", records, at_least=int(np.sum(labels < tissue.n_cells)))
    times = as_times(times)
    parts = traced((tissue, energy, cycle, dissipation, activity), tissue.vertices.dtype)
    settings = (relaxation.traced(), adjoint, times, as_key(key), (substeps, divisions, records))
    with announce_compilations(f"the growth of a tissue with {tissue.n_cells} cell slots"):
        grown = _grow(*parts, *settings)
    return grown.checked() if throw else grown


class _State(eqx.Module):
    """State of the loop over time steps."""

    tissue: Tissue
    cells: Any
    drive: Any
    number: Int[Array, " cells"]
    lineage: Lineage
    result: RESULTS
    failed_divisions: Int[Array, ""]
    failed_deaths: Int[Array, ""]
    log_likelihood: Float[Array, ""]


@announced_jit
def _grow(
    tissue: Tissue,
    energy: Energy,
    cycle: AbstractLifeCycle,
    dissipation: AbstractDissipation | None,
    activity: AbstractActivity | None,
    relaxation: Relaxation,
    adjoint: AbstractAdjoint,
    times: Float[Array, " times"],
    key: PRNGKeyArray,
    sizes: tuple[int, int, int],
) -> Grown:
    substeps, divisions, records = sizes
    times = times.astype(tissue.vertices.dtype)

    def divide_one(state: _State, due: Array, time: Array, key: Array) -> tuple[_State, Array]:
        cell = jnp.argmax(due).astype(jnp.int32)
        axis_key, state_key = jax.random.split(key)
        axis = cycle.axis(state.cells, state.tissue, cell, axis_key)
        change = divided(state.tissue, cell, axis, jnp.any(due))
        done = change.result == RESULTS.successful
        daughter = jnp.argmax(change.tissue.alive & ~state.tissue.alive).astype(jnp.int32)
        pair = jnp.stack([cell, daughter])
        cells = cycle.born(
            change.inherited(state.cells, axis="cells"), change.tissue, pair, state_key
        )
        cells = jax.tree.map(lambda a, b: jnp.where(done, a, b), cells, state.cells)
        drive = state.drive
        if activity is not None:
            drive = activity.born(change.inherited(drive, axis="cells"), change.tissue, pair)
            drive = tree_where(done, drive, state.drive)
        lineage, number = record_division(state.lineage, state.number, pair, time, done)
        full = jnp.any(due) & jnp.all(state.tissue.alive)
        full = RESULTS.where(full, RESULTS.capacity_reached, RESULTS.successful)
        failed = state.failed_divisions + (jnp.any(due) & ~done)
        after = _State(
            tissue=change.tissue,
            cells=cells,
            drive=drive,
            number=number,
            lineage=lineage,
            result=first_failure(state.result, full),
            failed_divisions=failed,
            failed_deaths=state.failed_deaths,
            log_likelihood=state.log_likelihood,
        )
        return after, due & (jnp.arange(due.size) != cell)

    def step(state: _State, start: Array, end: Array, key: Array) -> _State:
        previous = state
        aging, *dividing = jax.random.split(key, 1 + divisions)
        cells, due = cycle.advance(state.cells, state.tissue, end - start, aging)
        log_likelihood = cycle.log_likelihood(state.cells, cells, state.tissue, end - start)
        parts = lambda s: (s.cells, s.log_likelihood)
        state = eqx.tree_at(parts, state, (cells, state.log_likelihood + log_likelihood))
        due &= state.tissue.alive

        def one(carry: tuple, key: Array) -> tuple:
            state, due = carry
            perform = lambda: _arrays(divide_one(combine(state), due, end, key))
            return jax.lax.cond(jnp.any(due), perform, lambda: (state, due)), None

        (arrays, _), _ = jax.lax.scan(one, (_arrays(state), due), jnp.stack(dividing))
        state = combine(arrays)
        before, potential = state.tissue, energy(state.cells)
        active, drive, resistance = None, state.drive, dissipation
        if activity is not None:
            # (Folded in, so that the other random numbers are those of a growth without activity.)
            drive_key = jax.random.fold_in(key, divisions + 1)
            active, drive = activity.drive(
                drive, before, dissipation, start, end - start, drive_key
            )
            resistance = activity.step_dissipation(drive, before, dissipation)
        if active is not None:
            potential += active
        if resistance is not None:
            driving_force = None if active is None else max_force(active, before)
            potential = IncrementalPotential(
                potential, resistance, before, end - start, max_driving_force=driving_force
            )
        moved = relaxation.solve(before, potential, adjoint, recompute=True)
        died = before.alive & ~moved.tissue.alive
        lineage, number = record_deaths(state.lineage, state.number, died, end)
        # (A relaxation that failed matters more than a tissue that is full.)
        failed = moved.result != RESULTS.successful
        failed &= (state.result == RESULTS.successful) | (state.result == RESULTS.capacity_reached)
        result = RESULTS.where(failed, moved.result, state.result)
        recorded = RESULTS.where(lineage.count <= records, RESULTS.successful, RESULTS.lineage_full)
        if activity is not None:
            drive = activity.finish(drive, before, moved.tissue)
            result = first_failure(result, finite_record(activity.record(drive, moved.tissue)))
        overdue = moved.tissue.alive & cycle.overdue(state.cells, moved.tissue)
        after = _State(
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
        if not tissue.topology.exterior:
            return after
        # The last two cells cannot vanish: the tissue stays as it was when one of them has collapsed.
        few = jnp.sum(after.tissue.alive) <= 2
        small = after.tissue.areas < T2().threshold * mean_area(after.tissue)
        collapsed = few & jnp.any(after.tissue.alive & small)
        result = first_failure(previous.result, RESULTS.too_few_cells)
        ended = eqx.tree_at(lambda s: s.result, previous, result)
        return combine(tree_where(collapsed, _arrays(ended), _arrays(after)))

    def interval(arrays: _State, inputs: tuple) -> tuple[_State, tuple]:
        (start, end), key = inputs
        step_times = start + jnp.linspace(0, 1, substeps + 1, dtype=times.dtype) * (end - start)

        def substep(arrays: _State, inputs: tuple) -> tuple[_State, None]:
            ended = combine(arrays).result == RESULTS.too_few_cells
            advance = lambda: _arrays(step(combine(arrays), *inputs))
            return jax.lax.cond(ended, lambda: arrays, advance), None

        keys = jax.random.split(key, substeps)
        arrays, _ = jax.lax.scan(substep, arrays, (step_times[:-1], step_times[1:], keys))
        return arrays, frame_of(arrays)

    def frame_of(arrays: _State) -> tuple:
        failed = (arrays.failed_divisions, arrays.failed_deaths)
        signals = (
            None if activity is None else activity.record(arrays.drive, combine(arrays).tissue)
        )
        return arrays.tissue, arrays.cells, arrays.number, arrays.result, failed, signals

    first, rest = jax.random.split(key)
    lineage, number = initial_lineage(tissue, times[0], records)
    begin = _State(
        tissue=tissue,
        cells=cycle.init(tissue, first),
        drive=None if activity is None else activity.init(tissue, jax.random.fold_in(first, 1)),
        number=number,
        lineage=lineage,
        result=result_of(jnp.array(0)),
        failed_divisions=jnp.array(0),
        failed_deaths=jnp.array(0),
        log_likelihood=jnp.zeros((), tissue.vertices.dtype),
    )
    arrays, static = eqx.partition(begin, eqx.is_array)
    combine = lambda arrays: eqx.combine(arrays, static)
    keys = jax.random.split(rest, times.shape[0] - 1)
    end, frames = jax.lax.scan(interval, arrays, ((times[:-1], times[1:]), keys))
    prepend = lambda first, rest: jnp.concatenate([jnp.asarray(first)[None], rest])
    rows = jax.tree.map(prepend, frame_of(arrays), frames)
    tissues, cells, numbers, results, failed, signals = rows
    last = combine(end)
    return Grown(
        tissue=last.tissue,
        cells=last.cells,
        times=times,
        frames=eqx.combine(tissues, static.tissue),
        cells_then=eqx.combine(cells, static.cells),
        number=numbers,
        lineage=last.lineage,
        results=results,
        failed_divisions=failed[0],
        failed_deaths=failed[1],
        log_likelihood=last.log_likelihood,
        signals=signals,
    )


def _arrays(tree: Any) -> Any:
    return eqx.filter(tree, eqx.is_array)
