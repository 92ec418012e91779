"""Entropic optimal transport between two sets of equally many points, with derivatives of any order."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# The usual remedy, thousands of Sinkhorn sweeps, does not serve here: between tissues that nearly agree
# the plan is nearly a permutation, and then the sweeps converge without end. Libraries for transport,
# moreover, define derivatives in reverse mode alone, and an energy needs products with its Hessian.


@jax.custom_jvp
def entropic_transport(costs: Float[Array, "n n"], epsilon: Float[Array, ""]) -> Float[Array, ""]:
    r"""Cost of the entropic optimal transport between two uniform measures of $n$ points.

    **Arguments:**

    - `costs`: of moving a point (row) to a point (column).
    - `epsilon`: strength of the entropy.

    **Returns:** the cost, with the entropy counted from that of a one-to-one transport.
    """
    return _value(costs, epsilon, transport_plan(costs, epsilon))


@entropic_transport.defjvp
def _(primals, tangents):
    (costs, epsilon), (d_costs, d_epsilon) = primals, tangents
    log_plan = transport_plan(costs, epsilon)
    # At the optimum a change of the plan does not count (envelope theorem).
    change = jnp.sum(jnp.exp(log_plan) * d_costs) + _entropy(log_plan) * d_epsilon
    return _value(costs, epsilon, log_plan), change


def _value(costs: Array, epsilon: Array, log_plan: Array) -> Float[Array, ""]:
    return jnp.sum(jnp.exp(log_plan) * costs) + epsilon * _entropy(log_plan)


def _entropy(log_plan: Float[Array, "n n"]) -> Float[Array, ""]:
    """Negative entropy of a plan, 0 if one point goes to one point."""
    return jnp.sum(jnp.exp(log_plan) * log_plan) + jnp.log(1.0 * len(log_plan))


@jax.custom_jvp
def transport_plan(costs: Float[Array, "n n"], epsilon: Float[Array, ""]) -> Float[Array, "n n"]:
    """Logarithm of the entropic transport plan between two uniform measures.

    Sinkhorn's sweeps in the domain of logarithms, with decreasing entropy, each followed by a Newton
    step for the potential of the rows, as far along as makes the dual greatest.

    **Arguments:**

    - `costs`: of moving a point (row) to a point (column).
    - `epsilon`: strength of the entropy.

    **Returns:** the logarithms; rows and columns of the plan sum to $1/n$. NaN if 300 sweeps do not balance
    it, as with an entropy too weak for the precision of the numbers.
    """
    n = len(costs)
    log_n = jnp.log(1.0 * n).astype(costs.dtype)

    def plan_of(u: Array, kernel: Array) -> Float[Array, "n n"]:
        """The plan of a potential of the rows: its columns are balanced, its rows are not yet."""
        joint = kernel + u[:, None]
        return joint - jax.nn.logsumexp(joint, axis=0) - log_n

    def dual(u: Array, kernel: Array) -> Float[Array, ""]:
        """What the potential of a balanced plan makes greatest."""
        return jnp.mean(u) - jnp.mean(jax.nn.logsumexp(kernel + u[:, None], axis=0))

    def imbalance(log_plan: Array) -> Float[Array, ""]:
        return jnp.max(jnp.abs(n * jnp.sum(jnp.exp(log_plan), axis=1) - 1))

    def unfinished(carry: _Search) -> Bool[Array, ""]:
        now = imbalance(carry.log_plan)
        # The last steps, at the level of rounding, no longer better the balance.
        done = (carry.sharpness == 1) & (now < tight) & (now >= 0.5 * carry.last)
        return (carry.step < _MAX_SWEEPS) & ~done

    def sweep(carry: _Search) -> _Search:
        before = imbalance(carry.log_plan)
        # With little entropy the way is long: it is gone along plans that become sharper and sharper.
        sharper = jnp.where(before < 0.1, jnp.minimum(1, 2 * carry.sharpness), carry.sharpness)
        kernel = sharper * full
        u = carry.u * sharper / carry.sharpness
        u = u - jax.nn.logsumexp(plan_of(u, kernel), axis=1) - log_n
        swept = jnp.exp(plan_of(u, kernel))
        lost = 1 / n - jnp.sum(swept, axis=1)
        ahead, _ = _balance(swept, lost, jnp.zeros_like(lost))
        reach = jax.vmap(lambda share: dual(u + share * ahead, kernel))(shares)
        # Near the end the dual no longer tells steps apart; then the whole step is the right one.
        best = jnp.where(jnp.max(jnp.abs(n * lost)) < 1e-2, 0, jnp.argmax(reach))
        u = u + shares[best] * ahead
        u = u - jnp.mean(u)
        return _Search(carry.step + 1, sharper, u, plan_of(u, kernel), before)

    shares = jnp.asarray([1.0, 0.3, 0.1, 0.03, 0.0], costs.dtype)
    full = -costs / epsilon
    # Rounding of the kernel is rounding of the plan.
    tight = 100 * jnp.finfo(costs.dtype).eps * (10 + jnp.ptp(full))
    sharpness = jnp.minimum(1, 20 / jnp.maximum(jnp.ptp(full), 1))
    zero = jnp.zeros(n, costs.dtype)
    infinite = jnp.asarray(jnp.inf, costs.dtype)
    begin = _Search(jnp.array(0), sharpness, zero, plan_of(zero, sharpness * full), infinite)
    end = jax.lax.while_loop(unfinished, sweep, begin).log_plan
    # An unbalanced plan is no transport plan: NaN, so that a fit of a batch stops this member alone.
    balanced = imbalance(end) <= jnp.maximum(1e-3, 10 * tight)
    return jnp.where(balanced, end, jnp.nan)


class _Search(NamedTuple):
    step: Int[Array, ""]
    sharpness: Float[Array, ""]
    u: Float[Array, " n"]
    log_plan: Float[Array, "n n"]
    last: Float[Array, ""]


_MAX_SWEEPS = 300


@transport_plan.defjvp
def _(primals, tangents):
    (costs, epsilon), (d_costs, d_epsilon) = primals, tangents
    log_plan = transport_plan(costs, epsilon)
    change = -d_costs / epsilon + costs * d_epsilon / epsilon**2
    # The potentials change so that rows and columns keep their sums.
    lost = jnp.exp(log_plan) * change
    u, v = _balance(jnp.exp(log_plan), -jnp.sum(lost, axis=1), -jnp.sum(lost, axis=0))
    return log_plan, change + u[:, None] + v


def _balance(
    plan: Float[Array, "n n"], rows: Float[Array, " n"], columns: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Changes of the potentials that change the sums of rows and columns by so much, to first order."""
    n = len(plan)
    row_sums, column_sums = jnp.sum(plan, axis=1), jnp.sum(plan, axis=0)
    schur = jnp.diag(row_sums) - (plan / column_sums) @ plan.T
    # A constant may go from one potential to the other, and in a permutation so may a constant for
    # every point: such modes count for nothing, and stay where they are.
    schur += (1 / n**2) + (1e3 * jnp.finfo(plan.dtype).eps / n) * jnp.eye(n, dtype=plan.dtype)
    u = jnp.linalg.solve(schur, rows - plan @ (columns / column_sums))
    return u, (columns - u @ plan) / column_sums
