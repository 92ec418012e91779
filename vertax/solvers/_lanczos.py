"""The recurrence of `MINRES`: Lanczos, and the minimal residual by QR factorisation."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

LinearMap: TypeAlias = Callable[[Float[Array, "n"]], Float[Array, "n"]]

# The reason why the recurrence ended. RUNNING at the end: the maximum number of steps was reached.
RUNNING, CONVERGED, LEAST_SQUARES, BREAKDOWN, NONFINITE = range(5)

# Rounding errors in units of eps times the size of the terms of a sum: a product, two orthogonalisations and
# a norm contribute a few units in each step.
ROUNDING_UNITS = 10


class Krylov(NamedTuple):
    """The state between two steps; subscripts as in the derivation below."""

    step: Int[Array, ""]
    status: Int[Array, ""]
    norm_rhs: Float[Array, ""]  # β_1
    u: Float[Array, "n"]  # u_{k-1}
    size: Float[Array, ""]  # and its length
    q_old: Float[Array, "n"]  # q_{k-1}
    q: Float[Array, "n"]  # q_k
    v: Float[Array, "n"]  # v_k = P q_k
    beta: Float[Array, ""]  # β_k, but 0 at the first step, where q_0 = 0
    w_old: Float[Array, "n"]  # w_{k-2}
    w: Float[Array, "n"]  # w_{k-1}
    c: Float[Array, ""]  # c_{k-1}
    s: Float[Array, ""]  # s_{k-1}
    delta_bar: Float[Array, ""]  # δ̄_k
    epsilon: Float[Array, ""]  # ε_k
    residual: Float[Array, ""]  # φ̄_{k-1} = |r_{k-1}|
    u_suspect: Float[Array, "n"]  # the u that may be a least-squares solution,
    residual_suspect: Float[Array, ""]  # its |r|, zero while there is none,
    size_suspect: Float[Array, ""]  # and its size
    operator_norm: Float[Array, ""]
    negative_curvature: Bool[Array, ""]


def dot(a: Float[Array, "n"], b: Float[Array, "n"]) -> Float[Array, ""]:
    """The inner product, in full precision on accelerators too."""
    return jnp.dot(a, b, precision=lax.Precision.HIGHEST)


def norm(z: Float[Array, "n"], p_z: Float[Array, "n"]) -> Float[Array, ""]:
    """The norm √(z·P z) in which residuals are measured."""
    # If z is rounding error, the computed z·P z may be negative.
    return jnp.sqrt(jnp.maximum(dot(z, p_z), 0))


def over(a: Array, b: Array) -> Array:
    """`a / b`, and `a` where `b` is zero."""
    return a / jnp.where(b == 0, 1, b)


def _not_definite(z: Float[Array, "n"], p_z: Float[Array, "n"]) -> Bool[Array, ""]:
    """Whether z·P z is negative by more than rounding."""
    rounding, product = ROUNDING_UNITS * jnp.finfo(z.dtype).eps, dot(z, p_z)
    below_rounding = lambda: product < -rounding * jnp.sqrt(dot(z, z) * dot(p_z, p_z))
    return lax.cond(product < 0, below_rounding, lambda: jnp.array(False))


# Paige & Saunders (1975), with a preconditioner P ≈ A⁻¹. The unknown is u with x = P u, residuals
# are measured in |r| = √(r·P r), and only P itself is ever applied. Without a preconditioner P = I.
#
# Lanczos. From β_1 q_1 = b, q_0 = 0, for k = 1, 2, ..., with v_k = P q_k,
#     z = A v_k - β_k q_{k-1},  α_k = v_k·z,  z ← z - α_k q_k,  β_{k+1} = |z|,  β_{k+1} q_{k+1} = z.
# Then q_i·P q_j = δ_ij and A P Q_k = Q_{k+1} T_k; T_k is (k+1)-by-k and tridiagonal, with α on its
# diagonal and β on both sides of it. To compute α_k after the subtraction of β_k q_{k-1} is Paige's order,
# which keeps the q orthogonal for longest.
#
# Minimal residual. For u = Q_k t the residual is Q_{k+1} (β_1 e_1 - T_k t), so t is the solution of a
# small least-squares problem. Reflections [c_k s_k; s_k -c_k] of the rows k and k+1 make T_k upper
# triangular, with three diagonals ε, δ and γ. Column k is (β_k, α_k, β_{k+1}), and
#     reflection k-2 makes    ε_k = s_{k-2} β_k,                δ̄_k = -c_{k-2} β_k,
#     reflection k-1 makes    δ_k = c_{k-1} δ̄_k + s_{k-1} α_k,  γ̄_k = s_{k-1} δ̄_k - c_{k-1} α_k,
#     reflection k is         γ_k = √(γ̄_k² + β_{k+1}²),         c_k = γ̄_k/γ_k,  s_k = β_{k+1}/γ_k.
# They map β_1 e_1 to (φ_1, ..., φ_k, φ̄_k), φ_k = c_k φ̄_{k-1}, φ̄_k = s_k φ̄_{k-1}, φ̄_0 = β_1, so
#     |r_k| = φ̄_k,    w_k = (q_k - ε_k w_{k-2} - δ_k w_{k-1})/γ_k,    u_k = u_{k-1} + φ_k w_k.
# To start, c_0 = -1 and s_0 = 0.
#
# After the product of step k, the residual r_{k-1} satisfies
#     |A P r_{k-1}| = φ̄_{k-1} √(γ̄_k² + δ̄_{k+1}²),        zero for a least-squares solution, and
#     r_{k-1}·P A P r_{k-1} = -φ̄²_{k-1} c_{k-1} γ̄_k,      the curvature along P r_{k-1}. It is not
# positive for some k exactly if A is not positive definite on the Krylov space (Liu & Roosta 2022).
#
# Rounding. Lanczos behaves as if each eigenvalue were a narrow cluster of eigenvalues (Greenbaum 1989,
# Linear Algebra Appl. 113, 7). For an inconsistent b only the cluster at zero remains at the end; it is
# resolved like any other, and u grows by its inverse width. This starts when |A P r| is about √eps |A| |r|,
# and often |A P r| decreases no further. At this point a null vector and the eigenvector of a small
# eigenvalue cannot be distinguished, so u is stored as suspect and the recurrence continues. Later they
# differ: for a small eigenvalue |r| decreases, for a null vector u grows.
def solve_in_krylov_space(
    a: LinearMap,
    p: LinearMap | None,
    rhs: Float[Array, "n"],
    *,
    target: Float[Array, ""],
    null: Float[Array, ""],
    nearly_null: float,
    operator_norm: Float[Array, ""],
    negative_curvature: Bool[Array, ""],
    step: Int[Array, ""],
    max_steps: int,
) -> Krylov:
    """Solve A P u = rhs from u = 0; steps are counted from `step` to `max_steps`.

    The suspect is the first u with |A P r| ≤ nearly_null |A| |r|; it is discarded if |r| decreases to
    half. The status is LEAST_SQUARES if |A P r| ≤ null |A| |r|, or if u grows to 1/√eps times the
    suspect. It is CONVERGED if |r| ≤ target, or if |r| is at the level of rounding.
    """
    eps = jnp.finfo(rhs.dtype).eps
    precondition = (lambda z: z) if p is None else p
    p_rhs = precondition(rhs)
    beta_1 = norm(rhs, p_rhs)

    def size(u: Float[Array, "n"]) -> Float[Array, ""]:
        return jnp.sqrt(dot(u, u))

    size_rhs = size(rhs)

    # A nonzero right-hand side with r·P r ≤ 0 shows that P is not positive definite.
    indefinite = (dot(rhs, p_rhs) <= 0) & (dot(rhs, rhs) > 0)
    status = jnp.where(beta_1 <= target, CONVERGED, RUNNING)
    status = jnp.where(indefinite, BREAKDOWN, status)
    status = jnp.where(jnp.isfinite(beta_1), status, NONFINITE)

    zero, zeros = jnp.zeros_like(beta_1), jnp.zeros_like(rhs)
    initial = Krylov(
        step=step,
        status=status,
        norm_rhs=beta_1,
        u=zeros,
        size=zero,
        q_old=zeros,
        q=over(rhs, beta_1),
        v=over(p_rhs, beta_1),
        beta=zero,
        w_old=zeros,
        w=zeros,
        c=zero - 1,
        s=zero,
        delta_bar=zero,
        epsilon=zero,
        residual=beta_1,
        u_suspect=zeros,
        residual_suspect=zero,
        size_suspect=zero,
        operator_norm=operator_norm,
        negative_curvature=negative_curvature,
    )

    def is_running(last: Krylov) -> Bool[Array, ""]:
        return (last.status == RUNNING) & (last.step < max_steps)

    def one_step(last: Krylov) -> Krylov:
        z = a(last.v) - last.beta * last.q_old
        alpha = dot(last.v, z)
        z = z - alpha * last.q
        p_z = precondition(z)
        beta = norm(z, p_z)
        # |A P q_k| = |T e_k| bounds |A| from below.
        column = jnp.sqrt(last.beta**2 + alpha**2 + beta**2)
        operator_norm = jnp.maximum(last.operator_norm, column)

        delta = last.c * last.delta_bar + last.s * alpha
        gamma_bar = last.s * last.delta_bar - last.c * alpha
        epsilon, delta_bar = last.s * beta, -last.c * beta
        gamma = jnp.hypot(gamma_bar, beta)
        # β = 0 means that the Krylov space is exhausted: then s = 0 and φ̄ = 0, all is solved.
        # If also γ = 0, then A P r = 0, and the step below is not taken.
        c, s = over(gamma_bar, gamma), over(beta, gamma)
        w = over(last.q - last.epsilon * last.w_old - delta * last.w, gamma)
        u = last.u + c * last.residual * w
        size_u, residual = size(u), s * last.residual
        # Residuals below eps (|A| |x| + |b|) are rounding error. With a preconditioner only a lower bound of
        # the size of x is available, by Cauchy and Schwarz: |u·P b| ≤ |u| |b|.
        size_x = size_u if p is None else over(jnp.abs(dot(u, p_rhs)), beta_1)
        rounding_level = eps * (operator_norm * size_x + beta_1)

        # The test on A P r concerns the u before this step, and comes before the step is taken:
        # along a null direction γ is rounding error, and u would grow by its inverse.
        a_r = jnp.hypot(gamma_bar, delta_bar)
        is_as_large = last.residual >= 0.5 * last.residual_suspect
        residual_suspect = jnp.where(is_as_large, last.residual_suspect, 0)
        suspect = (residual_suspect == 0) & (a_r <= nearly_null * operator_norm)
        residual_suspect = jnp.where(suspect, last.residual, residual_suspect)
        # A solution for b has at least the size |b| / |A|.
        size_last = jnp.maximum(last.size, over(size_rhs, operator_norm))
        size_suspect = jnp.where(suspect, size_last, last.size_suspect)
        blown_up = (
            (residual_suspect > 0)
            & (residual >= 0.5 * residual_suspect)
            & (size_u > eps**-0.5 * size_suspect)
        )

        status = jnp.where(residual <= rounding_level, CONVERGED, last.status)
        status = jnp.where(blown_up, LEAST_SQUARES, status)
        status = jnp.where(residual <= target, CONVERGED, status)
        status = jnp.where(a_r <= null * operator_norm, LEAST_SQUARES, status)
        status = jnp.where(_not_definite(z, p_z), BREAKDOWN, status)
        # Comparisons with nan are false: without this test the loop would run to the last step.
        status = jnp.where(jnp.isfinite(alpha) & jnp.isfinite(beta), status, NONFINITE)
        take = (status == RUNNING) | (status == CONVERGED)

        # Curvature along P r over |r|². In a null direction it is rounding error of either sign.
        curvature = -last.c * gamma_bar
        negative = curvature < -ROUNDING_UNITS * eps * operator_norm
        return Krylov(
            step=last.step + 1,
            status=status,
            norm_rhs=last.norm_rhs,
            u=jnp.where(take, u, last.u),
            size=jnp.where(take, size_u, last.size),
            q_old=last.q,
            q=over(z, beta),
            v=over(p_z, beta),
            beta=beta,
            w_old=last.w,
            w=w,
            c=c,
            s=s,
            delta_bar=delta_bar,
            epsilon=epsilon,
            residual=jnp.where(take, residual, last.residual),
            u_suspect=jnp.where(suspect, last.u, last.u_suspect),
            residual_suspect=residual_suspect,
            size_suspect=size_suspect,
            operator_norm=operator_norm,
            negative_curvature=last.negative_curvature | negative,
        )

    return lax.while_loop(is_running, one_step, initial)
