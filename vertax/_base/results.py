"""How a computation ended: one enumeration of results with their messages, and one way to raise them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from vertax._base.tracing import is_concrete

Tree = TypeVar("Tree")

_SADDLE = (
    "the equilibrium is not unique. Along some motions (vertax.mechanics.zero_modes counts them) the tissue "
    "has no stiffness, and the cost depends on them. Use a cost of areas, perimeters or other shapes that "
    "these motions keep, pin vertices, or add a little stiffness"
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Equinox warns that two messages of Optimistix are replaced.

    class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
        """How a computation ended; `RESULTS[result]` is the message of a result.

        Extends `optimistix.RESULTS`. Functions with the argument `throw` raise the message of the first
        failure; with `throw=False` the field `result` of what they return holds it.
        """

        successful = ""
        nonlinear_max_steps_reached = (
            "A relaxation reached no equilibrium. Raise its `max_steps`, loosen its `tolerance`, use the "
            "default solver, take smaller steps of time or strain, or pass throw=False and look at `result`."
        )
        nonfinite = (
            "A relaxation broke down: its forces are not finite. The parameters of the energy must be "
            "finite, but may be NaN or infinity, or so extreme that the tissue collapses. Check them."
        )
        no_progress = (
            "A relaxation made no progress although its forces were large. Either its energy has no minimum: "
            "line tensions must be positive or outweighed, and an AreaElasticity must resist them. Or cells "
            "jam: lower the ratio of tensions (vertax.energies.BoundedTension), or use a positive "
            "`contact_range`."
        )
        overlap = (
            "Cells of the tissue overlap, or its box folds. A relaxation never makes cells overlap unless "
            "`contact_range` is None, but it may start from a tissue in which they do: look at its "
            "`overlaps`."
        )
        too_many_contacts = (
            "More corners are near a side of their cell than there is room for. "
            "Raise `max_contacts`."
        )
        max_time_steps_reached = (
            "The steps of an adaptive time integration did not reach the next frame. Raise `max_steps` of "
            "the `PIController`, or loosen its `tolerance`."
        )
        signals_not_finite = (
            "The concentrations of signals are not finite: their solver failed, or the reaction is not "
            "finite there. Check the reaction and its rates, take shorter steps, pass a solver for stiff "
            "equations such as diffrax.Kvaerno3(), or raise `max_steps` of Signals."
        )
        capacity_reached = (
            "A cell could not divide: all cell slots of the tissue are alive. Add spare slots before with "
            "tissue.with_capacity(...), or pass throw=False."
        )
        too_few_cells = (
            "One of the last two cells of a free tissue died, but a free tissue needs two cells. The tissue "
            "stays as it was before. Start with more cells, lower the death rate, end earlier, or pass "
            "throw=False."
        )
        lineage_full = "The lineage has fewer records than there were cells. Raise `records`."
        division_impossible = (
            "The cell cannot be cut in two there. Try another axis, or pass throw=False."
        )
        removal_impossible = (
            "The cell cannot be removed: a neighbour would have too few sides, cells would overlap, or a "
            "corner is pinned. Pass throw=False to keep it."
        )
        linear_solve_failed = (
            "The gradient through the equilibrium cannot be trusted: the linear solve with the Hessian "
            "failed. Relax to a smaller tolerance, or allow it with ImplicitDifferentiation(throw=False)."
        )
        unrolling_not_converged = (
            "The gradient through the unrolled relaxation cannot be trusted: it had not converged when "
            "`max_steps` ended it. Raise `max_steps`, choose a faster solver such as "
            "Optax(optax.sgd(1e-2, momentum=0.9)), or allow it with AutomaticDifferentiation(throw=False)."
        )
        nudge_not_at_rest = (
            "The gradient by equilibrium propagation cannot be trusted: a nudged relaxation did not come to "
            "rest. Raise `max_steps`, let an external program relax further, use the default solver or a "
            "larger `beta`, or allow it with EquilibriumPropagation(throw=False)."
        )
        nudge_not_linear = (
            "The gradient by equilibrium propagation cannot be trusted: a small nudge moved the tissue so "
            f"far that its response is not linear. The usual reason: {_SADDLE}. (For a cost of shapes use "
            "ImplicitDifferentiation: a nudged tissue also moves along motions that change them in second "
            "order only.) Otherwise the nudge is too strong: take a smaller `beta`. "
            "EquilibriumPropagation(throw=False) allows it."
        )
        degenerate = (
            f"The gradient through the equilibrium cannot be trusted: {_SADDLE}. "
            "ImplicitDifferentiation(throw=False) allows it."
        )
        not_finite_cost = (
            "The cost or its gradient is not finite. Try a smaller step of the optimiser."
        )
        interrupted = "A keyboard interrupt ended the fit."


def first_failure(first: RESULTS, then: RESULTS) -> RESULTS:
    """The first of two results unless it is successful, then the second."""
    return RESULTS.where(first == RESULTS.successful, then, first)


def first_of(results: RESULTS) -> RESULTS:
    """The first failure along the last axis, `successful` if there is none."""
    number = jnp.argmax(results != RESULTS.successful, axis=-1, keepdims=True)
    return result_of(jnp.take_along_axis(index_of(results), number, -1)[..., 0])


def result_of(index: Array) -> RESULTS:
    """The result with an index, which may be an array of floating-point numbers."""
    item = type(RESULTS.successful)
    return item(jnp.asarray(index, jnp.int32), RESULTS)  # pyright: ignore


def index_of(result: RESULTS) -> Array:
    """The index of a result, for arrays that must hold numbers."""
    return jnp.asarray(result._value)


def where_is(result: RESULTS, one: RESULTS) -> np.ndarray:
    """Which of the results are this one; they must not be traced.

    (A comparison by JAX takes twenty times as long.)
    """
    return np.asarray(np.equal(result._value, one._value))


def any_is(result: RESULTS, one: RESULTS) -> bool:
    """Whether any of the results is this one; False while they are traced."""
    return is_concrete(result._value) and bool(where_is(result, one).any())


def checked(tree: Tree, result: RESULTS, describe: Callable[[], str] = str) -> Tree:
    """`tree`, or an error with the message of `result` unless it is successful.

    **Arguments:**

    - `tree`: what is returned.
    - `result`: how it ended; of a batch the result with the largest index is raised.
    - `describe`: details of the failure, which are appended outside of `jax.jit`.

    **Raises:**

    - `RuntimeError` (of Equinox inside `jax.jit`).
    """
    if not is_concrete(result._value):
        # (Random keys cannot be arguments of a callback to the host.)
        keys, rest = eqx.partition(tree, _is_key)
        return eqx.combine(keys, result.error_if(rest, result != RESULTS.successful))
    failed = ~where_is(result, RESULTS.successful)
    if not np.any(failed):
        return tree
    details = [f"{np.sum(failed)} of {np.size(failed)} failed"] if np.ndim(failed) else []
    details += [text for text in [describe()] if text]
    message = RESULTS._index_to_message[int(np.max(index_of(result)))]
    raise RuntimeError(message + (f" ({'; '.join(details)}.)" if details else ""))


def _is_key(x: object) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


class AbstractOutcome(eqx.Module):
    """What a computation returns; its field or property `result` says how it ended."""

    # (Not declared here: as a field of this class, `result` would be the first argument of each subclass.)

    @property
    def converged(self: Any) -> Bool[Array, "*batch"]:
        """Whether the computation succeeded: `result` is `successful`."""
        return self.result == RESULTS.successful

    def checked(self: Tree) -> Tree:
        """The same, if the computation succeeded.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) with the message of `result` if it did not.
        """
        outcome: Any = self
        return checked(self, outcome.result, outcome._details)

    def _details(self) -> str:
        """Details of the failure for the message."""
        return ""


def finite_record(record: PyTree[Array]) -> RESULTS:
    """`signals_not_finite` if an array that an activity records is not finite."""
    finite = jnp.array(True)
    for leaf in jax.tree.leaves(record):
        finite &= jnp.all(jnp.isfinite(leaf))
    return RESULTS.where(finite, RESULTS.successful, RESULTS.signals_not_finite)
