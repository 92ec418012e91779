"""The abstract activity and sums of activities."""

from __future__ import annotations

import abc
import functools
import operator
from typing import ClassVar

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from vertax._base.field_checks import check_fields
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractActivity(eqx.Module):
    """Active forces on a tissue in time, which are not the gradient of its energy.

    In each time step an activity returns an energy that is added to that of the tissue, such as
    [`Push`][vertax.activities.Push] for forces on vertices or [`LineTension`][vertax.energies.LineTension]
    for tensions. It may have a state, such as the direction of propulsion of each cell, and draw random
    numbers. Subclass it, put the parameters into fields and write `drive`, and `init` if there is a state:

    ```python
    class Wind(vx.AbstractActivity):
        force: float

        def drive(self, state, tissue, dissipation, time, dt, key):
            return vx.activities.Push(jnp.full_like(tissue.vertices, self.force)), state
    ```

    Activities add with `+`.
    """

    deterministic: ClassVar[bool] = False
    """Whether the activity draws no random numbers. Then it needs no key, and step sizes may be adaptive."""

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The initial state; by default None."""
        return None

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy | None, PyTree]:
        """The energy that acts during one step (None for no force), and the next state.

        **Arguments:**

        - `state`: the state returned by `init` or by the previous step.
        - `tissue`: the tissue at the start of the step.
        - `dissipation`: the dissipation of the tissue; None in a growth without one.
        - `time`, `dt`: the start time of the step and its length.
        - `key`: the key for random numbers.
        """

    def step_dissipation(
        self, state: PyTree, tissue: Tissue, dissipation: AbstractDissipation | None
    ) -> AbstractDissipation | None:
        """The dissipation during one step, after `drive`; by default that of the tissue."""
        return dissipation

    def finish(self, state: PyTree, before: Tissue, tissue: Tissue) -> PyTree[Array]:
        """The state at the end of a step from `before` to `tissue`, such as after deaths of cells.

        It holds arrays only; that of `drive` may hold other objects for `step_dissipation` and this method.
        """
        return state

    def born(self, state: PyTree[Array], tissue: Tissue, pair: Int[Array, "2"]) -> PyTree[Array]:
        """The state after a division into the cells `pair`, which hold the inherited state of the mother.

        Arrays outside of modules have one entry per cell; fields declare other axes, see
        [`Change.inherited`][vertax.transitions.Change].
        """
        return state

    def record(self, state: PyTree[Array], tissue: Tissue) -> PyTree[Array]:
        """Arrays to record in each frame, and to compare for adaptive step sizes; by default None.

        The evolution fails if they are not finite.
        """
        return None

    def __add__(self, other: AbstractActivity) -> AbstractActivity:
        """The sum of two activities."""
        if not isinstance(other, AbstractActivity):
            return NotImplemented
        return Sum((*_terms(self), *_terms(other)))


class Sum(AbstractActivity):
    """A sum of activities; made by `+`."""

    terms: tuple[AbstractActivity, ...]

    @property
    def deterministic(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether no term draws random numbers."""
        return all(term.deterministic for term in self.terms)

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The initial states of all terms."""
        keys = jax.random.split(key, len(self.terms))
        return tuple(term.init(tissue, k) for term, k in zip(self.terms, keys, strict=True))

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy | None, PyTree]:
        """The sum of the energies of all terms, and their next states."""
        keys = jax.random.split(key, len(self.terms))
        parts = zip(self.terms, state, keys, strict=True)
        results = [term.drive(s, tissue, dissipation, time, dt, key) for term, s, key in parts]
        energies = [energy for energy, _ in results if energy is not None]
        energy = functools.reduce(operator.add, energies) if energies else None
        return energy, tuple(state for _, state in results)

    def step_dissipation(
        self, state: PyTree, tissue: Tissue, dissipation: AbstractDissipation | None
    ) -> AbstractDissipation | None:
        """The dissipation of the last term that replaces it."""
        for term, s in zip(self.terms, state, strict=True):
            dissipation = term.step_dissipation(s, tissue, dissipation)
        return dissipation

    def finish(self, state: PyTree, before: Tissue, tissue: Tissue) -> PyTree[Array]:
        """The states of all terms at the end of a step."""
        pairs = zip(self.terms, state, strict=True)
        return tuple(term.finish(s, before, tissue) for term, s in pairs)

    def born(self, state: PyTree[Array], tissue: Tissue, pair: Int[Array, "2"]) -> PyTree[Array]:
        """The states of all terms after a division."""
        return tuple(term.born(s, tissue, pair) for term, s in zip(self.terms, state, strict=True))

    def record(self, state: PyTree[Array], tissue: Tissue) -> PyTree[Array]:
        """The record of the term that has one; of several a tuple."""
        pairs = zip(self.terms, state, strict=True)
        records = [r for r in (term.record(s, tissue) for term, s in pairs) if r is not None]
        return records[0] if len(records) == 1 else tuple(records) or None


def _terms(activity: AbstractActivity) -> tuple[AbstractActivity, ...]:
    return activity.terms if isinstance(activity, Sum) else (activity,)
