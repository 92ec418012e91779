"""What every activity is, and how activities add up."""

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
    """What drives a tissue in time and is not the gradient of its energy.

    In each step it acts as an energy would: [`Push`][vertax.activities.Push] is forces on vertices,
    [`LineTension`][vertax.energies.LineTension] tensions. It may have a state, such as the directions in
    which cells want to go, and draw random numbers. Subclass it, put the parameters into fields and write
    `drive`, and `init` if there is a state:

    ```python
    class Wind(vx.AbstractActivity):
        force: float

        def drive(self, state, tissue, dissipation, time, dt, key):
            return vx.activities.Push(jnp.full_like(tissue.vertices, self.force)), state
    ```

    Activities add with `+`.
    """

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The state that it begins with; by default none."""
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
        """What acts in one step, and the next state.

        **Arguments:**

        - `state`: the one that `init` or the last step returned.
        - `tissue`: where the step begins.
        - `dissipation`: what resists.
        - `time`, `dt`: when the step begins, and its length.
        - `key`: for random numbers.
        """

    def __add__(self, other: AbstractActivity) -> AbstractActivity:
        """Both at once."""
        if not isinstance(other, AbstractActivity):
            return NotImplemented
        return Sum((*_terms(self), *_terms(other)))


class Sum(AbstractActivity):
    """Several activities at once; made by `+`."""

    terms: tuple[AbstractActivity, ...]

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The states of all."""
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
        """What all do in one step."""
        keys = jax.random.split(key, len(self.terms))
        parts = zip(self.terms, state, keys, strict=True)
        drawn = [term.drive(s, tissue, dissipation, time, dt, key) for term, s, key in parts]
        first, *rest = (acts for acts, _ in drawn)
        return functools.reduce(operator.add, rest, first), tuple(state for _, state in drawn)


def _terms(activity: AbstractActivity) -> tuple[AbstractActivity, ...]:
    return activity.terms if isinstance(activity, Sum) else (activity,)
