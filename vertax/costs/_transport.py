"""Entropic optimal transport between two sets of n points, with derivatives of any order."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Why not a library: between similar tissues the plan is nearly a permutation, for which plain Sinkhorn
# iterations need about 1e6 sweeps; and transport libraries define derivatives in reverse mode only, but
# Hessian-vector products need forward mode too.


@jax.custom_jvp
def entropic_transport(costs: Float[Array, "n n"], epsilon: Float[Array, ""]) -> Float[Array, ""]:
    r"""Cost of the entropic optimal transport between two uniform measures of $n$ points.

    **Arguments:**

    - `costs`: cost of moving a point (row) to a point (column).
    - `epsilon`: strength of the entropy.

    **Returns:** the cost $\sum P C + \varepsilon (\sum P \log P + \log n)$.
    """
    return _value(costs, epsilon, transport_plan(costs, epsilon))


@entropic_transport.defjvp
def _(primals, tangents):
    (costs, epsilon), (d_costs, d_epsilon) = primals, tangents
    log_plan = transport_plan(costs, epsilon)
    # Envelope theorem: at the optimum the derivative with respect to the plan vanishes.
    change = jnp.sum(jnp.exp(log_plan) * d_costs) + _entropy(log_plan) * d_epsilon
    return _value(costs, epsilon, log_plan), change


def _value(costs: Array, epsilon: Array, log_plan: Array) -> Float[Array, ""]:
    return jnp.sum(jnp.exp(log_plan) * costs) + epsilon * _entropy(log_plan)


def _entropy(log_plan: Float[Array, "n n"]) -> Float[Array, ""]:
    """Negative entropy of a plan plus log n; 0 for a permutation."""
    return jnp.sum(jnp.exp(log_plan) * log_plan) + jnp.log(1.0 * len(log_plan))


@jax.custom_jvp
def transport_plan(costs: Float[Array, "n n"], epsilon: Float[Array, ""]) -> Float[Array, "n n"]:
    r"""Logarithm of the entropic transport plan between two uniform measures.

    Log-domain Sinkhorn sweeps with epsilon scaling. Each sweep is followed by a Newton step of the row
    potential $u$, with a line search that maximises the dual.

    **Arguments:**

    - `costs`: cost of moving a point (row) to a point (column).
    - `epsilon`: strength of the entropy.

    **Returns:** $\log P$; the rows and columns of $P$ sum to $1/n$. NaN if the plan is not balanced after 300
    sweeps, e.g. because $\varepsilon$ is too small for the floating-point precision.
    """
    n = len(costs)
    log_n = jnp.log(1.0 * n).astype(costs.dtype)

    def plan_of(u: Array, kernel: Array) -> Float[Array, "n n"]:
        """The log plan of a row potential: its columns sum to 1/n, its rows need not."""
        joint = kernel + u[:, None]
        return joint - jax.nn.logsumexp(joint, axis=0) - log_n

    def dual(u: Array, kernel: Array) -> Float[Array, ""]:
        """The dual objective, which the optimal row potential maximises."""
        return jnp.mean(u) - jnp.mean(jax.nn.logsumexp(kernel + u[:, None], axis=0))

    def imbalance(log_plan: Array) -> Float[Array, ""]:
        return jnp.max(jnp.abs(n * jnp.sum(jnp.exp(log_plan), axis=1) - 1))

    def keep_going(carry: _State) -> Bool[Array, ""]:
        current = imbalance(carry.log_plan)
        # Continue below the tolerance until rounding stops the decrease.
        converged = (carry.sharpness == 1) & (current < tolerance) & (current >= 0.5 * carry.last)
        return (carry.step < _MAX_SWEEPS) & ~converged

    def sweep(carry: _State) -> _State:
        previous = imbalance(carry.log_plan)
        # Epsilon scaling: start at a larger entropy ε / sharpness, and double the sharpness up to 1.
        sharper = jnp.where(previous < 0.1, jnp.minimum(1, 2 * carry.sharpness), carry.sharpness)
        kernel = sharper * log_kernel
        u = carry.u * sharper / carry.sharpness
        u = u - jax.nn.logsumexp(plan_of(u, kernel), axis=1) - log_n
        plan = jnp.exp(plan_of(u, kernel))
        deficit = 1 / n - jnp.sum(plan, axis=1)
        direction, _ = _balance(plan, deficit, jnp.zeros_like(deficit))
        duals = jax.vmap(lambda step_size: dual(u + step_size * direction, kernel))(step_sizes)
        # Near convergence the duals differ by less than rounding; the full Newton step is then right.
        best = jnp.where(jnp.max(jnp.abs(n * deficit)) < 1e-2, 0, jnp.argmax(duals))
        u = u + step_sizes[best] * direction
        u = u - jnp.mean(u)
        return _State(carry.step + 1, sharper, u, plan_of(u, kernel), previous)

    step_sizes = jnp.asarray([1.0, 0.3, 0.1, 0.03, 0.0], costs.dtype)
    log_kernel = -costs / epsilon
    # Rounding errors of the log kernel are relative errors of the plan.
    tolerance = 100 * jnp.finfo(costs.dtype).eps * (10 + jnp.ptp(log_kernel))
    sharpness = jnp.minimum(1, 20 / jnp.maximum(jnp.ptp(log_kernel), 1))
    zero = jnp.zeros(n, costs.dtype)
    infinity = jnp.asarray(jnp.inf, costs.dtype)
    initial = _State(jnp.array(0), sharpness, zero, plan_of(zero, sharpness * log_kernel), infinity)
    log_plan = jax.lax.while_loop(keep_going, sweep, initial).log_plan
    # NaN for an unbalanced plan, so that a batched fit stops only this member.
    balanced = imbalance(log_plan) <= jnp.maximum(1e-3, 10 * tolerance)
    return jnp.where(balanced, log_plan, jnp.nan)


class _State(NamedTuple):
    """Loop state; `u` is the row potential, `last` the imbalance of the previous plan."""

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
    # The tangents of the potentials keep the sums of rows and columns.
    deficit = jnp.exp(log_plan) * change
    u, v = _balance(jnp.exp(log_plan), -jnp.sum(deficit, axis=1), -jnp.sum(deficit, axis=0))
    return log_plan, change + u[:, None] + v


def _balance(
    plan: Float[Array, "n n"], rows: Float[Array, " n"], columns: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Changes of the potentials that change the row and column sums by given amounts, to first order."""
    n = len(plan)
    row_sums, column_sums = jnp.sum(plan, axis=1), jnp.sum(plan, axis=0)
    schur = jnp.diag(row_sums) - (plan / column_sums) @ plan.T
    # Adding a constant to one potential and subtracting it from the other leaves the plan unchanged; for a
    # permutation so does a constant for each pair. Regularise these zero modes.
    schur += (1 / n**2) + (1e3 * jnp.finfo(plan.dtype).eps / n) * jnp.eye(n, dtype=plan.dtype)
    u = jnp.linalg.solve(schur, rows - plan @ (columns / column_sums))
    return u, (columns - u @ plan) / column_sums
