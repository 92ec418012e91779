"""The loop of a relaxation: steps of a minimiser, with transitions between them. Not differentiable."""

from __future__ import annotations

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.probe_vector import probe_vector
from vertax._base.reductions import any_of
from vertax._base.tracing import tree_where
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.mesh._topology import take
from vertax.precondition._edge_blocks import EdgeBlocks
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._recycled_hessian import RecycledHessian
from vertax.precondition._sum import Preconditioner
from vertax.relax._contacts import Contacts, no_contacts
from vertax.solvers._newton import NewtonCG
from vertax.solvers._rows import Table, inner, table_of
from vertax.solvers._solver import AbstractIteration
from vertax.transitions import AbstractTransitions


class SearchState(eqx.Module):
    """The state of a relaxation."""

    tissue: Tissue
    """At the iterate: the last accepted point, made feasible."""
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    iteration: PyTree
    stiffness: Float[Array, ""]
    """A typical second derivative of the energy, see `Units`; 1 before it is measured."""
    contacts: Contacts | None
    preconditioner: Preconditioner
    """Of steps from the iterate."""
    overlaps: Bool[Array, ""]
    """Whether the tissue overlaps, as it has since the start."""
    counts: Int[Array, "*rules edges"]
    """How often each edge took part in a transition."""
    force: Float[Array, ""]
    num_below: Int[Array, ""]
    """Consecutive steps after which the force is below the tolerance."""
    num_steps: Int[Array, ""]
    started: Bool[Array, ""]
    finished: Bool[Array, ""]

    @property
    def num_t1(self) -> Int[Array, ""]:
        """Transitions so far."""
        return jnp.sum(self.counts)


class Feasible(eqx.Module):
    """A tissue after transitions in which cells do not overlap."""

    tissue: Tissue
    contacts: Contacts | None
    counts: Int[Array, "*rules edges"]
    fraction: Float[Array, " vertices"]
    """Which fraction of the step each vertex has taken."""
    length_fraction: Float[Array, " edges"]
    """The length of new edges, in units of the usual one."""
    overlapping: Bool[Array, " vertices"]
    num_attempts: Int[Array, ""]


class Search(eqx.Module):
    """A relaxation with topology changes, which can stop after any step and continue.

    **Arguments:**

    - `iteration`: the minimiser.
    - `transitions`: the rule for topology changes, or None.
    - `length`: the size of a cell.
    - `stiffness`: see `Units`; None to measure it in the first evaluation.
    - `tolerance`: largest force at rest; None for 1e-10 of the unit of force (1e-5 in float32).
    - `consecutive_steps`: steps in a row after which the force must be below the tolerance.
    - `contact_range`: of contacts; None to let cells overlap.
    """

    iteration: AbstractIteration
    transitions: AbstractTransitions | None
    length: Float[Array, ""]
    stiffness: Float[Array, ""] | None
    tolerance: Float[Array, ""] | None
    consecutive_steps: int | Int[Array, ""]
    contact_range: float | Float[Array, ""] | None
    recycled_hessian: RecycledHessian | None = None
    max_attempts: int = eqx.field(static=True, default=12)
    """Most attempts to make a point feasible; then the step is rejected."""
    max_shortenings: int = eqx.field(static=True, default=4)
    """After so many attempts vertices that overlap stay where they are."""
    shortening: float = eqx.field(static=True, default=0.25)

    def begin(self, tissue: Tissue, energy: AbstractEnergy) -> SearchState:
        """The state before the first step."""
        rule = self.transitions
        none = jnp.zeros(tissue.n_edges, jnp.int32)
        counts = none if rule is None else rule.init(tissue)
        contacts = None
        if self.contact_range is not None:
            contacts = no_contacts(self.contact_range, self.length, tissue)
        args = (tissue, energy, contacts)
        stiffness = jnp.ones_like(self.length) if self.stiffness is None else self.stiffness
        options = self.options(stiffness)
        iteration = self.iteration.unevaluated(objective, tissue.configuration, args, options)
        no, none = jnp.array(False), jnp.array(0)
        infinite = jnp.full((), jnp.inf, tissue.vertices.dtype)
        return SearchState(
            tissue,
            tissue.configuration,
            iteration,
            stiffness,
            contacts,
            _empty(eqx.filter_eval_shape(self._preconditioner, *args)),
            no,
            counts,
            infinite,
            none,
            none,
            started=no,
            finished=no,
        )

    def options(self, stiffness: Float[Array, ""]) -> dict[str, Array]:
        """What a minimiser is told: typical sizes and the tolerance."""
        tolerance = self.tolerance
        if tolerance is None:
            precise = stiffness.dtype == jnp.float64
            tolerance = (1e-10 if precise else 1e-5) * stiffness * self.length
        tolerance = jnp.asarray(tolerance, stiffness.dtype)
        return {"length_scale": self.length, "stiffness": stiffness, "tolerance": tolerance}

    def advance(
        self, state: SearchState, energy: AbstractEnergy, num_steps: int | Int[Array, ""]
    ) -> SearchState:
        """Continue until the tissue is at rest, or after so many steps in all."""
        # Minimisers may keep functions in their state, which a loop cannot carry.
        arrays, static = eqx.partition(state, eqx.is_array)

        def unfinished(arrays: SearchState) -> Bool[Array, ""]:
            return ~arrays.finished & (arrays.num_steps < num_steps)

        def iterate(arrays: SearchState) -> SearchState:
            return eqx.filter(self._step(eqx.combine(arrays, static), energy), eqx.is_array)

        return eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static)

    def result(self, state: SearchState) -> optx.RESULTS:
        """The result of a search that does not continue."""
        result = optx.RESULTS.where(
            state.num_below >= self.consecutive_steps,
            optx.RESULTS.successful,
            optx.RESULTS.nonlinear_max_steps_reached,
        )
        finite = jnp.isfinite(state.force) & jnp.all(jnp.isfinite(state.tissue.vertices))
        return optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)

    def _step(self, state: SearchState, energy: AbstractEnergy) -> SearchState:
        """One evaluation: accept or reject the trial point, make it feasible, compute the next one."""
        iteration, before, known = self.iteration, state.tissue, state.contacts
        options = self.options(state.stiffness)
        args = (before, energy, known)
        y, minimiser, model, _ = iteration.evaluate(
            objective, before.configuration, args, options, state.iteration
        )
        stiffness = state.stiffness
        if self.stiffness is None:
            measure = lambda: mean_curvature(model.product, before)
            stiffness = jax.lax.cond(state.started, lambda: state.stiffness, measure)
            options = self.options(stiffness)
            if known is not None:
                known = known.with_stiffness(stiffness)
        state = eqx.tree_at(lambda s: s.contacts, state, known, is_leaf=lambda x: x is None)
        progress = iteration.progress(minimiser)
        arrives = progress.moved | ~state.started
        goal = before.with_configuration(y)
        feasible = self._feasible(state, goal, energy, arrives)
        tissue, contacts = feasible.tissue, feasible.contacts
        flipped = any_of(feasible.counts != state.counts)
        # (NaN equals NaN here, or the search would not end where an energy ignores a coordinate that is NaN.)
        same = lambda a, b: ~any_of((a != b) & ~(jnp.isnan(a) & jnp.isnan(b)))
        unmoved = jax.tree.leaves(jax.tree.map(same, tissue.configuration, goal.configuration))
        changed = flipped | ~functools.reduce(jnp.logical_and, unmoved)
        if contacts is not None and state.contacts is not None:
            changed |= contacts.differ(state.contacts)
        fraction = before.by_row(feasible.fraction)
        minimiser = iteration.moved(minimiser, fraction, flipped, changed, options)
        below = progress.force < options["tolerance"]
        num_below = jnp.where(below, state.num_below + 1, 0)
        num_below = jnp.where(progress.accepted, num_below, state.num_below)
        num_below = jnp.where(changed, 0, num_below)
        finished = (num_below >= self.consecutive_steps) | jnp.isnan(progress.force)
        active = progress.accepted & ~changed & ~finished
        preconditioner = state.preconditioner
        if not preconditioner.is_diagonal:
            arrays, static = eqx.partition(preconditioner, eqx.is_array)
            build = lambda: eqx.filter(self._preconditioner(tissue, energy, contacts), eqx.is_array)
            arrays = jax.lax.cond(active, build, lambda: arrays)
            preconditioner = eqx.combine(arrays, static)
        if self.recycled_hessian is not None:
            known = self.recycled_hessian.seen_from(tissue.configuration)
            options = options | {"preconditioner": Preconditioner(preconditioner.edges, known)}
        else:
            options = options | {"preconditioner": preconditioner}
        return SearchState(
            tissue=tissue,
            origin=tree_where(flipped, tissue.configuration, state.origin),
            iteration=iteration.propose(model, options, minimiser, active),
            stiffness=stiffness,
            contacts=contacts,
            preconditioner=preconditioner,
            overlaps=jnp.where(arrives, any_of(feasible.overlapping), state.overlaps),
            counts=feasible.counts,
            force=progress.force,
            num_below=num_below,
            num_steps=state.num_steps + progress.stepped,
            started=jnp.array(True),
            finished=finished,
        )

    def _preconditioner(
        self, tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
    ) -> Preconditioner:
        """What is computed where a step begins, for the step and its corrections."""
        if not isinstance(self.iteration, NewtonCG):
            return Preconditioner(None, None)
        coarse = None if self.recycled_hessian is not None else ElasticMedium.of(tissue)
        return Preconditioner(blocks_of(tissue, energy, contacts), coarse)

    def _feasible(
        self, state: SearchState, goal: Tissue, energy: AbstractEnergy, arrives: Bool[Array, ""]
    ) -> Feasible:
        """Apply transitions where a step leads, if it `arrives`; shorten it where cells would overlap.

        1. Apply transitions, and compute the contacts.
        2. Where cells overlap, the vertices take a quarter of the step, and new edges are a quarter as long.
            Try again.
        3. After `max_shortenings` attempts these vertices stay; then with each attempt also the vertices
            around them; all other vertices take the whole step. At the last attempt all stay.
        4. If cells overlap even then, reject the step.
        """
        before, rule = state.tissue, self.transitions
        n_edges, dtype = goal.n_edges, goal.vertices.dtype
        ones = lambda n: jnp.ones(n, dtype)
        no = jnp.zeros(goal.n_vertices, bool)
        start = Feasible(
            goal,
            state.contacts,
            state.counts,
            ones(goal.n_vertices),
            ones(n_edges),
            no,
            jnp.array(0),
        )
        if rule is None and state.contacts is None:
            return start
        arrays, static = eqx.partition(start, eqx.is_array)

        def attempt(last: Feasible) -> Feasible:
            less = jnp.where(last.num_attempts < self.max_shortenings, self.shortening, 0)
            fraction = jnp.where(last.overlapping, less, 1) * last.fraction
            frozen = dilated(before, last.overlapping | (fraction == 0))
            frozen &= last.num_attempts > self.max_shortenings
            frozen |= last.num_attempts == self.max_attempts - 1
            fraction = jnp.where(frozen, 0, fraction)
            rows = before.by_row(fraction)
            partway = lambda a, b, rows: jnp.where(
                _column(rows, a) < 1, a + _column(rows, a) * (b - a), b
            )
            y = jax.tree.map(partway, before.configuration, goal.configuration, rows)
            point = before.with_configuration(y)
            swept, counts = point, state.counts
            ends = take(frozen, before.topology.edge_vertices)
            length_fraction = jnp.where(ends[:, 0] | ends[:, 1], 0, last.length_fraction)
            if rule is not None:
                swept, counts = rule.sweep(point, energy, state.counts, length_fraction)
            contacts, overlapping = state.contacts, no
            if contacts is not None:
                contacts, overlapping = contacts.updated(
                    point, swept, counts == state.counts, last.num_attempts < self.max_shortenings
                )
                flips = (counts != state.counts).reshape(-1, n_edges)
                flips = functools.reduce(jnp.logical_or, list(flips))
                ends = take(overlapping, swept.topology.edge_vertices)
                crowded = flips & (ends[:, 0] | ends[:, 1])
                length_fraction = jnp.where(crowded, self.shortening, 1) * length_fraction
            return Feasible(
                swept,
                contacts,
                counts,
                fraction,
                length_fraction,
                overlapping,
                last.num_attempts + 1,
            )

        # An overlap of the initial tissue is not the fault of a step.
        guarded = state.started & ~state.overlaps

        def unfinished(arrays: Feasible) -> Bool[Array, ""]:
            more = arrays.num_attempts < self.max_attempts
            again = guarded & any_of(arrays.overlapping) & more
            return ((arrays.num_attempts == 0) & arrives) | again

        def iterate(arrays: Feasible) -> Feasible:
            return eqx.filter(attempt(eqx.combine(arrays, static)), eqx.is_array)

        end = jax.lax.while_loop(unfinished, iterate, arrays)
        rejected = guarded & any_of(end.overlapping)

        def nothing() -> Feasible:
            stays = (before, state.contacts, state.counts, jnp.zeros_like(end.fraction), no)
            same = lambda f: (f.tissue, f.contacts, f.counts, f.fraction, f.overlapping)
            return eqx.tree_at(same, end, eqx.filter(stays, eqx.is_array))

        # (A selection would be a kernel for each array.)
        return eqx.combine(jax.lax.cond(rejected, nothing, lambda: end), static)


def mean_curvature(product: Callable[[Table], Table], tissue: Tissue) -> Float[Array, ""]:
    """The size of a typical second derivative: the Rayleigh quotient of a vector without pattern.

    **Arguments:**

    - `product`: multiplies by the Hessian.
    - `tissue`: at which it is.
    """
    like = table_of(tissue.configuration)
    direction = probe_vector(like)
    if tissue.topology.spare:  # what cannot move must not make the rest look soft
        alive = tissue.by_row(tissue.topology.alive_vertices.astype(like.dtype))
        direction *= table_of(alive)
    curvature = jnp.abs(inner(direction, product(direction))) / inner(direction, direction)
    return jnp.where(jnp.isfinite(curvature) & (curvature > 0), curvature, 1)


def dilated(tissue: Tissue, vertices: Bool[Array, " vertices"]) -> Bool[Array, " vertices"]:
    """The corners of all faces that have one of these corners."""
    m = tissue.topology
    faces = jnp.zeros(m.n_faces, bool).at[m.cell].max(jnp.repeat(vertices, 3))
    corners = take(faces, m.cell)
    # (The exterior has corners everywhere.)
    if m.n_faces > m.n_cells:
        corners &= m.cell < m.n_cells
    return vertices | corners[::3] | corners[1::3] | corners[2::3]


def _empty(tree: PyTree) -> PyTree:
    """Zeros for the arrays of a pytree of which only their shapes are known."""
    is_shape = lambda x: isinstance(x, jax.ShapeDtypeStruct)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_shape(x) else x, tree)


def _column(rows: Float[Array, " rows"], x: Array) -> Array:
    return rows.reshape(rows.shape + (1,) * (x.ndim - 1))


# In smaller tissues the preconditioner of edges costs more than it saves.
_FEWEST_CELLS = 300


# A relaxation evaluates it in several places: so it is traced once.
@eqx.filter_jit
def objective(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Contacts | None]
) -> tuple[Float[Array, ""], None]:
    """The energy of a configuration and of its contacts, as Optimistix wants it."""
    tissue, energy, contacts = args
    there = tissue.with_configuration(configuration)
    value = energy(MeasuredTissue(there))
    return value if contacts is None else value + contacts(there), None


def collective_of(
    tissue: Tissue, recycled_hessian: RecycledHessian | None
) -> RecycledHessian | ElasticMedium | None:
    """A preconditioner for collective motions; None for a small tissue of which no Hessian is given."""
    if recycled_hessian is None:
        return ElasticMedium.of(tissue)
    return recycled_hessian.seen_from(tissue.configuration)


def blocks_of(
    tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
) -> EdgeBlocks | None:
    """How edges resist, and contacts; None if edges are arcs, or few: they would cost more than they save."""
    if tissue.n_cells < _FEWEST_CELLS:
        return None
    if contacts is None or tissue.arcs is not None:
        return EdgeBlocks.of(tissue, energy)
    return EdgeBlocks.of(tissue, energy, contacts.resistance(tissue))
