"""The abstract activity and sums of activities."""

from __future__ import annotations

import abc
import functools
import operator

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

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
        dissipation: AbstractDissipation,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """The energy that acts during one step, and the next state.

        **Arguments:**

        - `state`: the state returned by `init` or by the previous step.
        - `tissue`: the tissue at the start of the step.
        - `dissipation`: the dissipation of the tissue.
        - `time`, `dt`: the start time of the step and its length.
        - `key`: the key for random numbers.
        """

    def __add__(self, other: AbstractActivity) -> AbstractActivity:
        """The sum of two activities."""
        if not isinstance(other, AbstractActivity):
            return NotImplemented
        return Sum((*_terms(self), *_terms(other)))


class Sum(AbstractActivity):
    """A sum of activities; made by `+`."""

    terms: tuple[AbstractActivity, ...]

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The initial states of all terms."""
        keys = jax.random.split(key, len(self.terms))
        return tuple(term.init(tissue, k) for term, k in zip(self.terms, keys, strict=True))

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """The sum of the energies of all terms, and their next states."""
        keys = jax.random.split(key, len(self.terms))
        parts = zip(self.terms, state, keys, strict=True)
        results = [term.drive(s, tissue, dissipation, time, dt, key) for term, s, key in parts]
        first, *rest = (energy for energy, _ in results)
        return functools.reduce(operator.add, rest, first), tuple(state for _, state in results)


def _terms(activity: AbstractActivity) -> tuple[AbstractActivity, ...]:
    return activity.terms if isinstance(activity, Sum) else (activity,)
