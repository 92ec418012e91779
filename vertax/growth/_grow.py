"""Tissues that grow: their cells live by rules, and between events the tissue relaxes or moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.checks import as_key, check_whole, increasing, named
from vertax._base.modules import is_concrete, traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.dissipations import AbstractDissipation
from vertax.dynamics._incremental_potential import IncrementalPotential
from vertax.energies import AbstractEnergy
from vertax.growth._life_cycle import AbstractLifeCycle
from vertax.growth._lineage import Lineage, died_at, divided_at, founded
from vertax.mesh import Tissue, Trajectory
from vertax.relax import Relaxation
from vertax.transitions import T1, T2
from vertax.transitions._division import divided

Energy = Callable[[Any], AbstractEnergy]


class Grown(eqx.Module):
    """What became of a tissue that grew."""

    tissue: Tissue
    """The tissue at the end."""
    cells: PyTree[Array]
    """What its cells know of themselves then, see [`AbstractLifeCycle`][vertax.growth.AbstractLifeCycle]."""
    times: Float[Array, "*batch times"]
    """The times of the frames, of which the first is the start."""
    frames: Tissue
    """The tissue at these times: the same tissue with a leading axis."""
    cells_then: PyTree[Array]
    """What cells knew at these times."""
    number: Int[Array, "*batch times cells"]
    """Which cell of the lineage was in each slot; -1 in spare ones."""
    lineage: Lineage
    """Who came from whom, and when."""
    sound: Bool[Array, "*batch times"]
    """Whether all steps up to a frame came to an end, in tissues without overlaps."""
    full: Bool[Array, "*batch"]
    """Whether a cell could not divide for want of a spare slot."""
    failed_divisions: Int[Array, "*batch times"]
    """How many divisions up to a frame were due and could not happen: there was no spare slot, or the cell
    could not be cut in two. A cell that remains due is tried in each step, and counted each time."""
    failed_deaths: Int[Array, "*batch times"]
    """How many deaths up to a frame were overdue, see `overdue` of the life cycle, and could not happen, such
    as that of a cell without which a neighbour had too few sides. Counted in each step that it remains."""
    log_likelihood: Float[Array, "*batch"]
    """The logarithm of how likely the choices of the cycle were, see
    [`score_function`][vertax.growth.score_function]."""

    @property
    def n_alive(self) -> Int[Array, "*batch times"]:
        """How many cells there were."""
        return jnp.sum(self.number >= 0, axis=-1)

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for files."""
        trajectory = Trajectory()
        arrays, static = eqx.partition(self.frames, eqx.is_array)
        for i, time in enumerate(self.times):
            frame = eqx.combine(jax.tree.map(lambda x, i=i: x[i], arrays), static)
            trajectory.append(frame, time=time, cells=self.n_alive[i])
        return trajectory

    def checked(self) -> Grown:
        """The same, if all went as it should.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if a step came to no end or cells overlap, or if there
            was no room for a cell, or none in the lineage.
        """
        capacity, records = self.tissue.n_cells, self.lineage.mother.shape[-1]
        checked = self
        for wrong, reason in (
            (
                ~self.sound[..., -1],
                "A step in time came to no end, or cells overlap. Take shorter steps (more `substeps`) or "
                "slower rates, or pass throw=False and look at `sound`.",
            ),
            (
                self.full,
                f"A cell could not divide: the tissue has a capacity of {capacity} cells, and all are alive. "
                "Make room with tissue.with_capacity(...) before, or pass throw=False.",
            ),
            (
                ~self.lineage.complete,
                f"There were more cells than the {records} that the lineage has room for. Raise `records`.",
            ),
        ):
            if not is_concrete(wrong):
                checked = eqx.error_if(checked, wrong, reason)
            elif np.any(np.asarray(wrong)):
                raise RuntimeError(reason)
        return checked


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
    relaxation: Relaxation | None = None,
    adjoint: AbstractAdjoint | None = None,
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

    In each step cells age by the rules of the cycle, those whose time has come divide, and then the tissue
    comes to rest; or, if there is a dissipation, it moves for the length of the step as in
    [`evolve`][vertax.evolve]. Works under `jax.jit` and `jax.vmap`. A gradient tells how the course changes
    as long as the same events happen in the same steps; it does not see that rates change which happen, for
    which there is [`score_function`][vertax.growth.score_function].

    **Arguments:**

    - `tissue`: where it begins, with room for all that will be alive at a time, see
        [`with_capacity`][vertax.Tissue.with_capacity]: one cell or more in a periodic box, two or more of a
        free tissue.
    - `energy`: a function of what cells know of themselves that returns their energy.
    - `cycle`: the rules, such as [`GrowAndDivide`][vertax.growth.GrowAndDivide].
    - `times`: when there is to be a frame; they increase, and the first is that of the start.
    - `key`: for random numbers, a key or a seed.
    - `substeps`: steps from one frame to the next.
    - `divisions`: most divisions in a step, by default four and a twentieth of the capacity; what is due
        beyond that waits for the next one.
    - `records`: room in the lineage; by default for eight times as many cells as the tissue has slots.
    - `dissipation`: what resists the motion; by default the tissue is at rest at the end of each step.
    - `relaxation`: how each step is found, by default with T1 and T2 transitions.
    - `adjoint`: how to differentiate each step.
    - `throw`: raise an error if a step found no end, or if there was no room. If False, look at `sound` and
        `full`.

    **Returns:** what became of it, [`Grown`][vertax.growth.Grown].

    **Raises:**

    - `TypeError` for a cycle, an energy, a dissipation or a relaxation that is none.
    - `ValueError` for times that do not increase, or a tissue without spare slots.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step found no end, or there is no room.
    """
    for name, value, kind in (
        ("cycle", cycle, AbstractLifeCycle),
        ("dissipation", dissipation, AbstractDissipation | None),
        ("relaxation", relaxation, Relaxation | None),
    ):
        if not isinstance(value, kind):
            raise TypeError(f"Argument `{name}` is of a wrong kind: {named(value)}.")
    wrong = isinstance(energy, AbstractEnergy) or not callable(energy)
    if wrong or (isinstance(energy, type) and issubclass(energy, AbstractEnergy)):
        name = energy.__name__ if isinstance(energy, type) else "energy"
        raise TypeError(
            "Argument `energy` must be a function of what cells know of themselves that returns an energy, "
            f"but is {named(energy)}. Pass such a function, e.g. lambda cells: {name}"
            f"{'(...)' if isinstance(energy, type) else ''}."
        )
    if not tissue.topology.spare:
        raise ValueError(
            "Argument `tissue` must have room for cells to come: pass tissue.with_capacity(...)."
        )
    check_whole("substeps", substeps, least=1)
    divisions = 4 + tissue.n_cells // 20 if divisions is None else divisions
    check_whole("divisions", divisions, least=1)
    records = 8 * tissue.n_cells if records is None else records
    check_whole("records", records, least=1)
    if is_concrete(tissue.topology.cell):
        labels = np.unique(np.asarray(tissue.topology.cell))
        check_whole("records", records, least=int(np.sum(labels < tissue.n_cells)))
    adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
    relaxation = Relaxation(transitions=T1() + T2()) if relaxation is None else relaxation
    times = increasing(times)
    parts = traced((tissue, energy, cycle, dissipation), tissue.vertices.dtype)
    settings = (relaxation.traced(), adjoint, times, as_key(key), (substeps, divisions, records))
    with announce_compilations(f"the growth of a tissue with room for {tissue.n_cells} cells"):
        grown = _grow(*parts, *settings)
    return grown.checked() if throw else grown


class _State(eqx.Module):
    """How far it has come."""

    tissue: Tissue
    cells: PyTree[Array]
    number: Int[Array, " cells"]
    lineage: Lineage
    sound: Bool[Array, ""]
    full: Bool[Array, ""]
    failed_divisions: Int[Array, ""]
    failed_deaths: Int[Array, ""]
    log_likelihood: Float[Array, ""]


@announced_jit
def _grow(
    tissue: Tissue,
    energy: Energy,
    cycle: AbstractLifeCycle,
    dissipation: AbstractDissipation | None,
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
        turn, draw = jax.random.split(key)
        axis = cycle.axis(state.cells, state.tissue, cell, turn)
        change = divided(state.tissue, cell, axis, jnp.any(due))
        daughter = jnp.argmax(change.tissue.alive & ~state.tissue.alive).astype(jnp.int32)
        pair = jnp.stack([cell, daughter])
        cells = cycle.born(change.inherited(state.cells, axis="cells"), change.tissue, pair, draw)
        cells = jax.tree.map(lambda a, b: jnp.where(change.done, a, b), cells, state.cells)
        lineage, number = divided_at(state.lineage, state.number, pair, time, change.done)
        full = state.full | (jnp.any(due) & jnp.all(state.tissue.alive))
        failed = state.failed_divisions + (jnp.any(due) & ~change.done)
        after = _State(
            tissue=change.tissue,
            cells=cells,
            number=number,
            lineage=lineage,
            sound=state.sound,
            full=full,
            failed_divisions=failed,
            failed_deaths=state.failed_deaths,
            log_likelihood=state.log_likelihood,
        )
        return after, due & (jnp.arange(due.size) != cell)

    def step(state: _State, start: Array, end: Array, key: Array) -> _State:
        aging, *dividing = jax.random.split(key, 1 + divisions)
        cells, due = cycle.advance(state.cells, state.tissue, end - start, aging)
        likely = cycle.log_likelihood(state.cells, cells, state.tissue, end - start)
        parts = lambda s: (s.cells, s.log_likelihood)
        state = eqx.tree_at(parts, state, (cells, state.log_likelihood + likely))
        due &= state.tissue.alive

        def one(carry: tuple, key: Array) -> tuple:
            state, due = carry
            happens = lambda: _arrays(divide_one(whole(state), due, end, key))
            return jax.lax.cond(jnp.any(due), happens, lambda: (state, due)), None

        (arrays, _), _ = jax.lax.scan(one, (_arrays(state), due), jnp.stack(dividing))
        state = whole(arrays)
        before, potential = state.tissue, energy(state.cells)
        if dissipation is not None:
            potential = IncrementalPotential(potential, dissipation, before, end - start)
        moved = relaxation.solve(before, potential, adjoint, thrifty=True)
        gone = before.alive & ~moved.tissue.alive
        lineage, number = died_at(state.lineage, state.number, gone, end)
        sound = state.sound & (moved.result == optx.RESULTS.successful) & moved.valid
        overdue = moved.tissue.alive & cycle.overdue(state.cells, moved.tissue)
        return _State(
            tissue=moved.tissue,
            cells=state.cells,
            number=number,
            lineage=lineage,
            sound=sound,
            full=state.full,
            failed_divisions=state.failed_divisions,
            failed_deaths=state.failed_deaths + jnp.sum(overdue),
            log_likelihood=state.log_likelihood,
        )

    def interval(arrays: _State, inputs: tuple) -> tuple[_State, tuple]:
        (start, end), key = inputs
        marks = start + jnp.linspace(0, 1, substeps + 1, dtype=times.dtype) * (end - start)

        def substep(arrays: _State, inputs: tuple) -> tuple[_State, None]:
            return _arrays(step(whole(arrays), *inputs)), None

        keys = jax.random.split(key, substeps)
        arrays, _ = jax.lax.scan(substep, arrays, (marks[:-1], marks[1:], keys))
        return arrays, frame_of(arrays)

    def frame_of(arrays: _State) -> tuple:
        failed = (arrays.failed_divisions, arrays.failed_deaths)
        return arrays.tissue, arrays.cells, arrays.number, arrays.sound, failed

    first, rest = jax.random.split(key)
    lineage, number = founded(tissue, times[0], records)
    begin = _State(
        tissue=tissue,
        cells=cycle.init(tissue, first),
        number=number,
        lineage=lineage,
        sound=jnp.array(True),
        full=jnp.array(False),
        failed_divisions=jnp.array(0),
        failed_deaths=jnp.array(0),
        log_likelihood=jnp.zeros((), tissue.vertices.dtype),
    )
    arrays, static = eqx.partition(begin, eqx.is_array)
    whole = lambda arrays: eqx.combine(arrays, static)
    keys = jax.random.split(rest, times.shape[0] - 1)
    end, frames = jax.lax.scan(interval, arrays, ((times[:-1], times[1:]), keys))
    join = lambda first, rest: jnp.concatenate([jnp.asarray(first)[None], rest])
    tissues, cells, numbers, sound, failed = jax.tree.map(join, frame_of(arrays), frames)
    last = whole(end)
    return Grown(
        tissue=last.tissue,
        cells=last.cells,
        times=times,
        frames=eqx.combine(tissues, static.tissue),
        cells_then=eqx.combine(cells, static.cells),
        number=numbers,
        lineage=last.lineage,
        sound=sound,
        full=last.full,
        failed_divisions=failed[0],
        failed_deaths=failed[1],
        log_likelihood=last.log_likelihood,
    )


def _arrays(tree: Any) -> Any:
    return eqx.filter(tree, eqx.is_array)
