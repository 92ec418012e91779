"""Newton's method by conjugate gradients, with a trust region for each vertex."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.rows import (
    Table,
    inner,
    max_size,
    point_of,
    rounding_error,
    sizes,
    table_of,
    typical_size,
)
from vertax._base.scales import Scales
from vertax._base.tracing import tree_where
from vertax.solvers._conjugate_gradients import (
    AbstractInverse,
    DiagonalInverse,
    Proposal,
    TruncatedCG,
)
from vertax.solvers._solver import AbstractIteration, Progress, value_and_gradient
from vertax.solvers._trust_region import VertexTrustRegion

# The purpose of the next evaluation.
_EVALUATE, _STEP, _CORRECTION, _RETURN = range(4)


class Model(NamedTuple):
    """The objective at a point: its value, its gradient and its products with the Hessian."""

    value: Float[Array, ""]
    gradient: Table
    product: Callable[[Table], Table]
    point: Callable[[Table], PyTree[Array]]
    """A table as a point."""


class NewtonState(eqx.Module):
    """The state of `NewtonCG`. The iterate is the last accepted point."""

    phase: Int[Array, ""]
    trial: Table
    """The point to evaluate next, relative to the iterate."""
    base: Table
    """The point that a correction begins at, relative to the iterate."""
    base_value: Float[Array, ""]
    value: Float[Array, ""]
    gradient: Table
    proposal: Proposal
    """The last step, without corrections."""
    predicted: Float[Array, ""]
    """Its predicted gain."""
    error: Float[Array, " rows"]
    """The error of the predicted forces after it."""
    radii: Float[Array, " rows"]
    typical: Float[Array, ""]
    """The typical force at the iterate,"""
    previous: Float[Array, ""]
    """and at the one before it."""
    num_corrections: Int[Array, ""]
    num_products: Int[Array, ""]
    progress: Progress


class NewtonCG(AbstractIteration[NewtonState]):
    r"""Newton's method, each step by conjugate gradients, with a trust region for each vertex.

    A step from $x$ solves $(H + \Lambda) p = -g$ by conjugate gradients, with $\Lambda$ diagonal:
    $|g_v| / \Delta_v$ for a vertex with the radius $\Delta_v$. It is accepted if the energy falls by at least
    `accept` times the predicted gain $-(g \cdot p + \tfrac12 p \cdot H p)$; where that is below rounding, if
    $|g|$ falls.

    Each trip of the loop is one evaluation of value, gradient and Hessian products, at the trial point:

    1. Evaluate the trial point.
    2. *Second-order correction* (Nocedal & Wright 2006, section 15.6): if the step gained less than
        `corrected_gain` of the prediction, or left more than `remaining_force` of the typical force, compute
        a short step from the trial point, back to the floor of a curved valley. Evaluate again, at most
        `max_corrections` times. A correction that does not lower the energy is undone.
    3. Accept or reject the point, and update the radii ([`VertexTrustRegion`]
        [vertax.solvers.VertexTrustRegion]).
    4. Compute the next step, with the forcing term
        $\eta = \min(0.35, \max(\sqrt{14 f / k \ell}, \min(0.1, 0.9 (f / f_\text{before})^2)))$
        of the typical force $f$ (Eisenstat & Walker 1996, doi:10.1137/0917003), the stiffness $k$ and the
        length scale $\ell$.

    Near an equilibrium $\Lambda$ vanishes with the force, and convergence is quadratic.

    **Arguments:**

    - `max_displacement`: first and largest radius, in units of the length scale (in
        [`equilibrate`][vertax.equilibrate] the root mean cell area; otherwise 1).
    - `max_products`: most Hessian-vector products in one step.
    - `max_corrections`: most second-order corrections of one step; 0 for none. (In fluid tissues and
        in free clusters in which arcs press on each other, some relaxations creep with fewer.)
    """

    max_displacement: float = 0.2
    max_products: int = eqx.field(static=True, default=600)
    max_corrections: int = 12
    accept: float = eqx.field(static=True, default=1e-4)
    forcing: float = eqx.field(static=True, default=0.35)
    corrected_gain: float = eqx.field(static=True, default=0.9)
    remaining_force: float = eqx.field(static=True, default=0.4)
    cheap_products: int = eqx.field(static=True, default=30)
    """Up to this number of products, `remaining_force` counts a quarter: a correction is as cheap."""
    correction_forcing: float = eqx.field(static=True, default=0.3)
    correction_displacement: float = eqx.field(static=True, default=0.3)
    """The largest displacement of a correction, in units of that of a step."""
    correction_products: int = eqx.field(static=True, default=60)
    conjugate_gradients: TruncatedCG = TruncatedCG()
    trust_region: VertexTrustRegion = VertexTrustRegion()

    def unevaluated(self, fn: Any, y: Any, args: Any, scales: Scales) -> NewtonState:
        struct = eqx.filter_eval_shape(fn, y, args)[0]
        table = table_of(y)
        zero, rows = jnp.zeros_like(table), jnp.zeros(len(table), table.dtype)
        number, infinite = jnp.array(0), jnp.full(struct.shape, jnp.inf, struct.dtype)
        return NewtonState(
            phase=jnp.array(_EVALUATE),
            trial=zero,
            base=zero,
            base_value=infinite,
            value=infinite,
            gradient=zero,
            proposal=Proposal(zero, zero, rows, number),
            predicted=jnp.zeros_like(infinite),
            error=rows,
            radii=rows + self._reach(scales),
            typical=infinite,
            previous=infinite,
            num_corrections=number,
            num_products=number,
            progress=Progress.initial(infinite),
        )

    def evaluate(
        self, fn: Any, y: Any, args: Any, scales: Scales, state: NewtonState
    ) -> tuple[Any, NewtonState, Model, Any]:
        start = table_of(y)

        def force_and_value(table: Table) -> tuple[Table, tuple[Array, PyTree]]:
            value, gradient, aux = value_and_gradient(fn, point_of(table, y), args)
            return table_of(gradient), (value, aux)

        trial = start + state.trial
        g, product, (value, aux) = jax.linearize(force_and_value, trial, has_aux=True)
        model = Model(value, g, product, lambda table: point_of(table, y))
        state = self._judged(model, scales, state)
        return point_of(tree_where(state.progress.accepted, trial, start), y), state, model, aux

    def _judged(self, model: Model, scales: Scales, s: NewtonState) -> NewtonState:
        """Accept or reject the trial point, or correct the step."""
        value, g, region = model.value, model.gradient, self.trust_region
        anew, first, corrected = (s.phase == p for p in (_EVALUATE, _STEP, _CORRECTION))
        squared, typical = inner(g, g), typical_size(g)
        finite = jnp.isfinite(value) & jnp.isfinite(squared)
        gained, predicted = s.value - value, s.predicted
        unit = scales.force
        below_rounding = jnp.abs(predicted) <= rounding_error(value, unit * scales.length)
        # Where the gain is below rounding, the force must fall; or the gain be as predicted.
        as_predicted = gained > region.good_gain * predicted
        falls = squared < inner(s.gradient, s.gradient)
        falls |= as_predicted & (gained > 20 * jnp.finfo(value.dtype).eps * jnp.abs(value))
        enough = jnp.where(below_rounding, falls, gained >= self.accept * predicted)
        improves = first | (corrected & finite & (value < s.base_value))
        wanting = gained < self.corrected_gain * predicted
        cheap = s.proposal.num_products < self.cheap_products
        wanting |= typical > jnp.where(cheap, 0.25, 1) * self.remaining_force * s.typical
        corrects = wanting & improves & finite & ~below_rounding & self._near(s, unit)
        corrects &= s.num_corrections < self.max_corrections
        returns = corrected & ~improves
        error = region.error(s.gradient, s.proposal.product, s.proposal.step, g, predicted)
        error = jnp.where(first, error, s.error)
        judged = ~anew & ~corrects & ~returns
        # (A point that is evaluated anew is the iterate, whatever its value.)
        accepted = anew | (judged & finite & enough)
        stepped = judged & accepted
        good = below_rounding | as_predicted
        reach = self._reach(scales)
        radii = region.updated(s.radii, s.proposal.step, error, reach, accepted, good)
        now = jnp.where(corrects, s.trial, s.base)
        phase = jnp.where(corrects, _CORRECTION, jnp.where(returns, _RETURN, _EVALUATE))
        force = jnp.where(accepted, max_size(g), s.progress.force)
        return dataclasses.replace(
            s,
            phase=phase,
            trial=jnp.where(corrects | returns, now, 0),
            base=now,
            base_value=jnp.where(corrects, value, s.base_value),
            value=jnp.where(accepted, value, s.value),
            gradient=jnp.where(accepted, g, s.gradient),
            error=error,
            radii=jnp.where(judged, radii, s.radii),
            typical=jnp.where(accepted, typical, s.typical),
            previous=jnp.where(stepped, s.typical, s.previous),
            num_corrections=jnp.where(judged, 0, s.num_corrections + corrects),
            progress=Progress(accepted, judged, stepped, force),
        )

    def propose(
        self,
        model: Model,
        scales: Scales,
        state: NewtonState,
        active: Bool[Array, ""],
        preconditioner: Any = None,
    ) -> NewtonState:
        """The next step from the point that was evaluated, or a correction."""
        s, unit = state, scales.force
        corrects = s.phase == _CORRECTION
        choose = lambda correction, step: jnp.where(corrects, correction, step)
        useful = jnp.minimum(0.1, 0.9 * (s.typical / jnp.where(s.previous > 0, s.previous, 1)) ** 2)
        useful = jnp.where(jnp.isfinite(s.previous), useful, 0)
        forcing = jnp.minimum(self.forcing, jnp.maximum(self._finest(s, unit), useful))
        short = self.correction_displacement * self._reach(scales)
        proposal = self.conjugate_gradients(
            model.product,
            model.gradient,
            choose(s.proposal.damping, sizes(s.gradient) / s.radii),
            choose(jnp.minimum(s.radii, short), s.radii),
            self._inverse(model, scales, preconditioner, self._near(s, unit) & active),
            choose(self.correction_forcing, forcing),
            choose(self.correction_products, self.max_products),
            active | corrects,
        )
        steps = active & ~corrects
        p = proposal.step
        predicted = -inner(p, model.gradient + 0.5 * proposal.product)
        trial = choose(s.base + p, jnp.where(steps, p, s.trial))
        return dataclasses.replace(
            s,
            phase=jnp.where(steps, _STEP, s.phase),
            trial=trial,
            base=jnp.where(steps, trial, s.base),
            proposal=tree_where(steps, proposal, s.proposal),
            predicted=jnp.where(steps, predicted, s.predicted),
            num_products=s.num_products + proposal.num_products,
        )

    def _inverse(
        self, model: Model, scales: Scales, preconditioner: Any, coarse: Bool[Array, ""]
    ) -> AbstractInverse:
        """The approximate inverse of the Hessian."""
        stiffness: Any = scales.stiffness
        if preconditioner is None or preconditioner.is_diagonal:
            return DiagonalInverse(stiffness)
        product = lambda v: model.point(model.product(table_of(v)))
        return preconditioner.inverse(product, model.point(model.gradient), stiffness, coarse)

    def moved(
        self,
        state: NewtonState,
        fraction: PyTree[Array],
        flipped: Bool[Array, ""],
        changed: Bool[Array, ""],
        scales: Scales,
    ) -> NewtonState:
        rows = table_of(fraction)[:, 0]
        radii = self.trust_region.cut(state.radii, state.proposal.step, rows, self._reach(scales))
        return eqx.tree_at(lambda s: s.radii, state, jnp.where(changed, radii, state.radii))

    @property
    def uses_preconditioner(self) -> bool:
        return True

    def value(self, state: NewtonState) -> Float[Array, ""]:
        return state.value

    def gradient(self, state: NewtonState) -> Table:
        return state.gradient

    def progress(self, state: NewtonState) -> Progress:
        return state.progress

    def _finest(self, state: NewtonState, unit: Any) -> Float[Array, ""]:
        # (14: the ratio of the norm of all forces and the typical force in a tissue of a hundred cells.)
        return jnp.sqrt(14.0 * state.typical / unit)

    def _near(self, state: NewtonState, unit: Any) -> Bool[Array, ""]:
        """Whether the typical force is small."""
        return self._finest(state, unit) < self.forcing

    def _reach(self, scales: Scales) -> Any:
        """The largest radius."""
        return self.max_displacement * scales.length
