"""The way to an equilibrium: steps of a minimiser, and transitions between them. Not differentiable."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.responses._contact import Contacts, no_contacts
from vertax.solvers._patience import Patient, PatientState
from vertax.transitions import AbstractTransitions


class SearchState(eqx.Module):
    """How far a search has come."""

    tissue: Tissue
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    minimiser: PatientState
    contacts: Contacts | None
    overlaps: Bool[Array, ""]
    """Whether the tissue overlaps, and always has."""
    counts: Int[Array, " edges"]
    """How often each edge took part in a transition."""
    num_steps: Int[Array, ""]
    started: Bool[Array, ""]
    finished: Bool[Array, ""]

    @property
    def num_t1(self) -> Int[Array, ""]:
        """Transitions so far."""
        return jnp.sum(self.counts)


class Search(eqx.Module):
    """A relaxation with topology changes, which can stop after any step and go on.

    **Arguments:**

    - `minimiser`: takes the steps and knows when the tissue is at rest.
    - `transitions`: the rule for topology changes, or None.
    - `options`: of the minimiser: typical sizes and the tolerance.
    - `contact_range`: of contacts; None to let cells overlap.
    """

    minimiser: Patient
    transitions: AbstractTransitions | None
    options: dict[str, Array]
    contact_range: float | Float[Array, ""] | None

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
        no = jnp.array(False)
        return SearchState(
            tissue,
            tissue.configuration,
            minimiser,
            contacts,
            no,
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
            return ~arrays.finished & (arrays.num_steps < num_steps)

        def iterate(arrays: SearchState) -> SearchState:
            return eqx.filter(self._step(eqx.combine(arrays, static), energy), eqx.is_array)

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

    def _step(self, state: SearchState, energy: AbstractEnergy) -> SearchState:
        """A step of the minimiser (not the first time), then transitions; what would overlap is undone."""
        before = state.tissue
        args = (before, energy, state.contacts)

        def step() -> tuple[PyTree, PatientState]:
            y, new, _ = self.minimiser.step(
                objective, before.configuration, args, self.options, state.minimiser, _TAGS
            )
            return y, new

        here = (before.configuration, state.minimiser)
        trial, minimiser = _either(state.started, step, lambda: here, here)
        tissue, counts = before.with_configuration(trial), state.counts
        if self.transitions is not None:
            tissue, counts = self.transitions.sweep(tissue, energy, state.counts)
        swept = jnp.any(tissue.vertices != before.with_configuration(trial).vertices) | jnp.any(
            counts != state.counts
        )
        contacts, overlaps = self._near(tissue, state, swept | ~state.started)
        refused = state.started & ~state.overlaps & overlaps
        kept = (before, state.contacts, state.overlaps, state.counts)
        tissue, contacts, overlaps, counts = jax.tree.map(
            lambda old, new: jnp.where(refused, old, new),
            kept,
            (tissue, contacts, overlaps, counts),
        )
        flipped = swept & ~refused
        anew = flipped | ~state.started
        others = jnp.array(False)
        if contacts is not None and state.contacts is not None:
            others = jnp.any(contacts.pairs != state.contacts.pairs)

        def restart() -> tuple[PyTree, PatientState]:
            fresh = self._restarted(tissue, energy, contacts)
            # What a minimiser remembers of the old topology misleads it in the new one.
            resumed = self.minimiser.resumed(fresh, minimiser)
            return tissue.configuration, _where(anew, fresh, resumed)

        def retreat() -> tuple[PyTree, PatientState]:
            inside = lambda y: ~before.with_configuration(y).overlaps.any
            way = optax.tree.sub(trial, before.configuration)
            return self.minimiser.retreat(
                objective,
                before.configuration,
                way,
                args,
                self.options,
                state.minimiser,
                _TAGS,
                inside,
            )

        here = (tissue.configuration, minimiser)
        y, minimiser = _either(anew | others, restart, lambda: here, here)
        if self.contact_range is not None:
            here = (y, minimiser)
            y, minimiser = _either(refused, retreat, lambda: here, here)
        moved = lambda new, old: jnp.where(flipped, new, old)
        return SearchState(
            tissue=tissue.with_configuration(y),
            origin=jax.tree.map(moved, tissue.configuration, state.origin),
            minimiser=minimiser,
            contacts=contacts,
            overlaps=overlaps,
            counts=counts,
            num_steps=state.num_steps + jnp.where(state.started, 1, 0),
            started=jnp.array(True),
            finished=(self.minimiser.at_rest(minimiser) & ~flipped & ~refused)
            | jnp.isnan(minimiser.force),
        )

    def _near(
        self, tissue: Tissue, last: SearchState, anew: Bool[Array, ""]
    ) -> tuple[Contacts | None, Bool[Array, ""]]:
        """The contacts of a tissue, and whether it overlaps, if that matters."""
        if last.contacts is None:
            return None, jnp.array(False)
        contacts, clear = last.contacts.moved(last.tissue, tissue)
        clear &= ~anew & ~last.overlaps
        same = lambda: (contacts, jnp.array(False))
        return jax.lax.cond(clear, same, lambda: contacts.found(tissue))

    def _restarted(
        self, tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
    ) -> PatientState:
        struct = jax.ShapeDtypeStruct((), tissue.vertices.dtype)
        args = (tissue, energy, contacts)
        return self.minimiser.init(
            objective, tissue.configuration, args, self.options, struct, None, _TAGS
        )


_TAGS: frozenset[object] = frozenset()


def objective(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Contacts | None]
) -> tuple[Float[Array, ""], None]:
    """The energy of a configuration and of its contacts, as Optimistix wants it."""
    tissue, energy, contacts = args
    there = tissue.with_configuration(configuration)
    value = energy(there)
    return value if contacts is None else value + contacts(there), None


def _empty(tree: PyTree) -> PyTree:
    """Zeros for the arrays of a pytree of which only their shapes are known."""
    is_shape = lambda x: isinstance(x, jax.ShapeDtypeStruct)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_shape(x) else x, tree)


def _where(condition: Bool[Array, ""], one: Any, other: Any) -> Any:
    """`jnp.where` of two pytrees that may hold more than arrays."""
    choose = lambda x, y: jnp.where(condition, x, y) if eqx.is_array(x) else x
    return jax.tree.map(choose, one, other)


def _either(condition: Bool[Array, ""], yes: Any, no: Any, like: Any) -> Any:
    """`jax.lax.cond` of two functions whose results may hold more than arrays; that stays as in `like`."""
    arrays_of = lambda function: lambda: eqx.filter(function(), eqx.is_array)
    arrays = jax.lax.cond(condition, arrays_of(yes), arrays_of(no))
    return eqx.combine(arrays, eqx.partition(like, eqx.is_array)[1])
