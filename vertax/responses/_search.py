"""The way to an equilibrium: steps of a minimiser, and transitions between them. Not differentiable."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.modules import choose
from vertax._base.sums import total
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._measured import Measured
from vertax.mesh._sides import dot
from vertax.mesh._topology import source, take
from vertax.responses._contact import Contacts, no_contacts
from vertax.solvers._edge_blocks import EdgeBlocks
from vertax.solvers._known_hessian import KnownHessian
from vertax.solvers._long_waves import LongWaves
from vertax.solvers._patience import Patient, PatientState
from vertax.transitions import AbstractTransitions


class SearchState(eqx.Module):
    """How far a search has come."""

    tissue: Tissue
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    minimiser: PatientState
    pending: Bool[Array, ""]
    """Whether the minimiser has yet to find out what the forces are."""
    contacts: Contacts | None
    overlaps: Bool[Array, ""]
    """Whether the tissue overlaps, and always has."""
    relieved: Int[Array, " vertices"] | None
    """How often each vertex was taken out of contacts; None where none is."""
    counts: Int[Array, "*rules edges"]
    """How often each edge took part in a transition."""
    num_steps: Int[Array, ""]
    started: Bool[Array, ""]
    finished: Bool[Array, ""]

    @property
    def num_t1(self) -> Int[Array, ""]:
        """Transitions so far."""
        return jnp.sum(self.counts)


class _Arrival(eqx.Module):
    """Where a step has led."""

    tissue: Tissue
    contacts: Contacts | None
    counts: Int[Array, "*rules edges"]
    share: Float[Array, " vertices"]
    """Which share of the step each vertex has taken."""
    blamed: Bool[Array, " vertices"]
    """Those that overlapped on the way here, or stay because of them."""
    overlapping: Bool[Array, " vertices"]
    relief: Float[Array, "vertices 2"] | None
    """How far vertices have gone besides, out of contacts."""
    relieves: Bool[Array, ""]
    """Whether that is new."""
    tries: Int[Array, ""]


class Search(eqx.Module):
    """A relaxation with topology changes, which can stop after any step and go on.

    **Arguments:**

    - `minimiser`: takes the steps and knows when the tissue is at rest.
    - `transitions`: the rule for topology changes, or None.
    - `options`: of the minimiser: typical sizes and the tolerance.
    - `contact_range`: of contacts; None to let cells overlap.
    - `known_hessian`: of an equilibrium near by, if one is known.
    """

    minimiser: Patient
    transitions: AbstractTransitions | None
    options: dict[str, Array]
    contact_range: float | Float[Array, ""] | None
    known_hessian: KnownHessian | None = None

    def begin(self, tissue: Tissue, energy: AbstractEnergy) -> SearchState:
        """The state before the first step."""
        rule = self.transitions
        counts = jnp.zeros(0, jnp.int32) if rule is None else rule.init(tissue)
        # The first step only makes it what it is, lest all of that be compiled twice.
        empty = lambda function, *args: _empty(eqx.filter_eval_shape(function, *args))
        contacts = None
        if self.contact_range is not None:
            contacts = no_contacts(self.contact_range, self.options, tissue)
        minimiser = empty(self._restarted, tissue, energy, contacts)
        relieves = contacts is not None and tissue.arcs is None and tissue.n_cells >= _FEWEST_CELLS
        relieved = jnp.zeros(tissue.n_vertices, jnp.int32) if relieves else None
        no = jnp.array(False)
        return SearchState(
            tissue,
            tissue.configuration,
            minimiser,
            no,
            contacts,
            no,
            relieved,
            counts,
            jnp.array(0),
            started=no,
            finished=no,
        )

    def advance(
        self, state: SearchState, energy: AbstractEnergy, num_steps: int | Int[Array, ""]
    ) -> SearchState:
        """Go on until the tissue is at rest, or so many steps are done in all."""
        # Minimisers may keep functions in their state, which a loop cannot carry.
        arrays, static = eqx.partition(state, eqx.is_array)

        def unfinished(arrays: SearchState) -> Bool[Array, ""]:
            return ~arrays.finished & ((arrays.num_steps < num_steps) | arrays.pending)

        def iterate(arrays: SearchState) -> SearchState:
            last = arrays.num_steps >= num_steps
            return eqx.filter(self._step(eqx.combine(arrays, static), energy, last), eqx.is_array)

        return eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static)

    def result(self, state: SearchState) -> optx.RESULTS:
        """The outcome of a search that is not to go on."""
        result = optx.RESULTS.where(
            self.minimiser.at_rest(state.minimiser),
            optx.RESULTS.successful,
            optx.RESULTS.nonlinear_max_steps_reached,
        )
        finite = jnp.isfinite(state.minimiser.force) & jnp.all(jnp.isfinite(state.tissue.vertices))
        return optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)

    def _step(
        self, state: SearchState, energy: AbstractEnergy, last: Bool[Array, ""]
    ) -> SearchState:
        """A step of the minimiser (not the first time), then transitions.

        Or only a look at the forces, if they are pending and no more is to be done, or may be (`last`).
        """
        before = state.tissue
        args = (before, energy, state.contacts)
        rest = self.options["tolerance"]
        options = self.options | {
            "collective": collective_of(before, self.known_hessian),
            "edge_blocks": blocks_of(before, energy, state.contacts),
            "stays_below": jnp.where(state.pending, jnp.where(last, jnp.inf, rest), 0),
        }

        def step() -> tuple[PyTree, PatientState]:
            y, new, _ = self.minimiser.step(
                objective, before.configuration, args, options, state.minimiser, _TAGS
            )
            return y, new

        here = (before.configuration, state.minimiser)
        goal, minimiser = _either(state.started, step, lambda: here, here)
        done = self.minimiser.at_rest(minimiser) | jnp.isnan(minimiser.force)
        stays = state.pending & (last | done)
        arrived = self._arrive(state, before.with_configuration(goal), energy, stays)
        tissue, contacts = arrived.tissue, arrived.contacts
        flipped = jnp.any(arrived.counts != state.counts)
        # (NaN is equal to NaN here: the search would otherwise restart without end where an energy
        # ignores a coordinate that is NaN.)
        elsewhere = jax.tree.map(
            lambda a, b: jnp.any((a != b) & ~(jnp.isnan(a) & jnp.isnan(b))),
            tissue.configuration,
            tissue.with_configuration(goal).configuration,
        )
        changed = flipped | jnp.any(jnp.stack(jax.tree.leaves(elsewhere)))
        if contacts is not None and state.contacts is not None:
            changed |= contacts.differ(state.contacts)

        def restart() -> PatientState:
            fresh = self._restarted(tissue, energy, contacts)
            share = before.by_row(jnp.where(arrived.blamed, arrived.share, 1))
            resumed = self.minimiser.resumed(fresh, minimiser, share, flipped)
            return choose(state.started, resumed, fresh)

        minimiser = _either(changed | ~state.started, restart, lambda: minimiser, minimiser)
        relieved = state.relieved
        if relieved is not None and arrived.relief is not None:
            relieved += jnp.any(arrived.relief != 0, axis=-1)
        return SearchState(
            tissue=tissue,
            origin=choose(flipped, tissue.configuration, state.origin),
            minimiser=minimiser,
            pending=(changed | ~state.started) & self.minimiser.solver.evaluates_late,
            contacts=contacts,
            overlaps=jnp.where(stays, state.overlaps, jnp.any(arrived.overlapping)),
            relieved=relieved,
            counts=arrived.counts,
            num_steps=state.num_steps + jnp.where(state.started & ~stays, 1, 0),
            started=jnp.array(True),
            finished=(self.minimiser.at_rest(minimiser) & ~flipped & jnp.all(arrived.share == 1))
            | jnp.isnan(minimiser.force),
        )

    def _arrive(
        self, state: SearchState, goal: Tissue, energy: AbstractEnergy, stays: Bool[Array, ""]
    ) -> _Arrival:
        """Transitions where a step leads; vertices of what would overlap go less far.

        If it `stays` where it was, that is all known.
        """
        before = state.tissue
        # What overlapped from the start is not mended in this way.
        guarded = state.started & ~state.overlaps

        def partway(a: Array, b: Array, share: Float[Array, " rows"]) -> Array:
            rows = share.reshape(share.shape + (1,) * (a.ndim - 1))
            return jnp.where(rows < 1, a + rows * (b - a), b)

        def attempt(last: _Arrival) -> _Arrival:
            less = jnp.where(last.tries <= _SHORTER, 0.25, 0) * last.share
            share = jnp.where(last.overlapping, less, last.share)
            # Where that does not help, more and more around it stays as well: elsewhere all go on.
            # (To be blamed as well: it may be what comes to those that stay.)
            around = _around(before, last.overlapping | (last.share == 0))
            around &= last.tries > _SHORTER + 1
            blamed = last.blamed | last.overlapping | around
            share = jnp.where(around | (last.tries == _TRIES - 1), 0, share)
            on_the_way = jax.tree.map(
                partway, before.configuration, goal.configuration, before.by_row(share)
            )
            there = before.with_configuration(on_the_way)
            besides = _carried(before, goal, share)
            if last.relief is not None:
                besides += last.relief
            there = there.with_vertices(there.vertices + besides)
            tissue, counts = there, state.counts
            if self.transitions is not None:
                tissue, counts = self.transitions.sweep(there, energy, state.counts)
            swept = jnp.any(tissue.vertices != there.vertices, axis=-1)
            twins = tissue.topology.twin != there.topology.twin
            swept |= jnp.any(twins.reshape(-1, 3), axis=-1) | ~state.started
            contacts, overlapping, relief = self._near(tissue, state, swept)
            relieves = jnp.array(False)
            if relief is not None and last.relief is not None:
                relieves = guarded & (last.tries < _SHORTER) & jnp.any(relief != 0)
                relief = last.relief + jnp.where(relieves, relief, 0)
                relief = jnp.where(overlapping[:, None], 0, relief)
            if contacts is not None and self.transitions is not None:
                # What turned around, and has not flipped, was put upright.
                turned = dot(there.edge_vectors, tissue.edge_vectors) < 0
                turned &= jnp.all(counts == state.counts, axis=tuple(range(counts.ndim - 1)))
                # If it is held, the step has jumped over its barrier, and the next one would again.
                over = turned & contacts.upheld.held & guarded & (last.tries < _SHORTER)
                ends = tissue.topology.edge_vertices
                overlapping = overlapping.at[ends].max(over[:, None])
                upheld = contacts.upheld.updated(tissue, turned)
                contacts = contacts.holding(tissue.topology, upheld)
            seen = (share, blamed, overlapping, relief, relieves, last.tries + 1)
            return _Arrival(tissue, contacts, counts, *seen)

        whole = jnp.ones(goal.n_vertices, goal.vertices.dtype)
        none = jnp.zeros(goal.n_vertices, bool)
        still = None if state.relieved is None else jnp.zeros_like(goal.vertices)
        no, zero = jnp.array(False), jnp.array(0)
        seen = (whole, none, none, still, no, zero)
        start = _Arrival(goal, state.contacts, state.counts, *seen)
        arrays, static = eqx.partition(start, eqx.is_array)

        def unfinished(arrays: _Arrival) -> Bool[Array, ""]:
            again = guarded & jnp.any(arrays.overlapping) & (arrays.tries < _TRIES)
            return ((arrays.tries == 0) & ~stays) | again | arrays.relieves

        def iterate(arrays: _Arrival) -> _Arrival:
            return eqx.filter(attempt(eqx.combine(arrays, static)), eqx.is_array)

        arrived = eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static)
        # Not even a sweep of transitions from where it was leads to a valid tissue.
        stuck = guarded & jnp.any(arrived.overlapping)
        seen = (0 * whole, ~none, none, still, no, arrived.tries)
        same = _Arrival(before, state.contacts, state.counts, *seen)
        return choose(stuck, same, arrived)

    def _near(
        self, tissue: Tissue, last: SearchState, swept: Bool[Array, " vertices"]
    ) -> tuple[Contacts | None, Bool[Array, " vertices"], Float[Array, "vertices 2"] | None]:
        """The contacts of a tissue; the vertices of what overlaps, and ways out of contacts, if that matters.

        Vertices that transitions have placed, or given other neighbours, come from nowhere.
        """
        nowhere = jnp.zeros(tissue.n_vertices, bool)
        if last.contacts is None:
            return None, nowhere, None
        still = None if last.relieved is None else jnp.zeros_like(tissue.vertices)
        contacts, clear = last.contacts.moved(last.tissue, tissue)
        clear &= ~jnp.any(swept) & ~last.overlaps

        def looked_at() -> tuple:
            found, overlapping = contacts.found(tissue)
            before = last.tissue.with_topology(tissue.topology)
            relief = None
            if last.relieved is not None:
                free = last.relieved < _RELIEFS
                if tissue.held is not None:
                    free &= ~tissue.held
                relief = found.relief(before, tissue, ~swept, free)
            return found, overlapping | found.crushed(before, tissue, ~swept), relief

        return jax.lax.cond(clear, lambda: (contacts, nowhere, still), looked_at)

    def _restarted(
        self, tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
    ) -> PatientState:
        struct = jax.ShapeDtypeStruct((), tissue.vertices.dtype)
        start, args = tissue.configuration, (tissue, energy, contacts)
        if self.minimiser.solver.evaluates_late:
            return self.minimiser.unevaluated(start, self.options, struct, None)
        return self.minimiser.init(objective, start, args, self.options, struct, None, _TAGS)


_TAGS: frozenset[object] = frozenset()
# The preconditioner of edges costs smaller tissues more than it saves; and in those few contacts are hit.
_FEWEST_CELLS = 300
# So often what overlaps goes less far before it stays where it is; and after so many attempts nothing moves.
_SHORTER = 3
_TRIES = 9
# In so many rounds those that go less far agree how far they all go.
_ROUNDS = 16
# So often a vertex is taken out of contacts: forces may press it there again and again.
_RELIEFS = 4


# A relaxation evaluates it in several places: so it is traced once.
@eqx.filter_jit
def objective(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Contacts | None]
) -> tuple[Float[Array, ""], None]:
    """The energy of a configuration and of its contacts, as Optimistix wants it."""
    tissue, energy, contacts = args
    there = tissue.with_configuration(configuration)
    value = energy(Measured(there))
    return value if contacts is None else value + contacts(there), None


def collective_of(
    tissue: Tissue, known_hessian: KnownHessian | None
) -> KnownHessian | LongWaves | None:
    """A preconditioner for collective motions; None for a small tissue of which no Hessian is given."""
    if known_hessian is None:
        return LongWaves.of(tissue)
    return known_hessian.seen_from(tissue.configuration)


def blocks_of(
    tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
) -> EdgeBlocks | None:
    """How edges resist, and contacts; None if edges are arcs, or few: they would cost more than they save."""
    if tissue.n_cells < _FEWEST_CELLS:
        return None
    if contacts is None or tissue.arcs is not None:
        return EdgeBlocks.of(tissue, energy)
    return EdgeBlocks.of(tissue, energy, contacts.resistance(tissue))


def _around(tissue: Tissue, vertices: Bool[Array, " vertices"]) -> Bool[Array, " vertices"]:
    """The vertices of all faces that have one of these."""
    m = tissue.topology
    corners = jnp.repeat(vertices, 3)
    cells = jnp.zeros(m.n_cells, bool).at[m.cell].max(corners, mode="drop")
    there = cells.at[m.cell].get(mode="fill", fill_value=False)
    return vertices | jnp.any(there.reshape(-1, 3), axis=-1)


def _carried(
    before: Tissue, goal: Tissue, share: Float[Array, " vertices"]
) -> Float[Array, "vertices 2"]:
    """How far vertices go besides that share of a step: as others next to them that go less far.

    Cells that would overlap go along with the tissue, and only change their shape less. Where nothing is left
    of the share they stay.
    """
    short = (share > 0) & (share < 1)
    if before.held is not None:
        short &= ~before.held
    step = goal.vertices - before.vertices
    neighbours = source(before.topology.twin).reshape(-1, 3)
    each = jnp.concatenate([neighbours, jnp.arange(before.n_vertices)[:, None]], axis=1)
    counted = take(short, each).astype(step.dtype)
    weights = counted / jnp.maximum(jnp.sum(counted, axis=1, keepdims=True), 1)

    def further(_: Any, common: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        return total(weights[:, k, None] * take(common, each[:, k]) for k in range(4))

    rounds = jnp.where(jnp.any(short), _ROUNDS, 0)
    common = jax.lax.fori_loop(0, rounds, further, step)
    return jnp.where(short[:, None], (1 - share[:, None]) * common, 0)


def _empty(tree: PyTree) -> PyTree:
    """Zeros for the arrays of a pytree of which only their shapes are known."""
    is_shape = lambda x: isinstance(x, jax.ShapeDtypeStruct)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_shape(x) else x, tree)


def _either(condition: Bool[Array, ""], yes: Any, no: Any, like: Any) -> Any:
    """`jax.lax.cond` of two functions whose results may hold more than arrays; that stays as in `like`."""
    arrays_of = lambda function: lambda: eqx.filter(function(), eqx.is_array)
    arrays = jax.lax.cond(condition, arrays_of(yes), arrays_of(no))
    return eqx.combine(arrays, eqx.partition(like, eqx.is_array)[1])
