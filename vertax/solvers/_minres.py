"""MINRES: symmetric linear systems that may be indefinite, singular or inconsistent."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, Bool, Float, Int, PyTree

_Map: TypeAlias = Callable[[Float[Array, " n"]], Float[Array, " n"]]

# Why a Lanczos loop ended. _RUNNING at the end means that the steps ran out.
_RUNNING, _CONVERGED, _LEAST_SQUARES, _BREAKDOWN, _NONFINITE = range(5)

# Rounding errors are counted in eps times the size of what was added up: a product, two
# orthogonalisations and a norm make a handful of them in each step.
_ROUNDING_UNITS = 10

# |r| from the recurrence and |b - A x| recomputed agree if they differ by less than this factor.
_SLACK = 2
_LS = 10
_BIG = 0.5


class _Loop(NamedTuple):
    """What one Lanczos step hands to the next; subscripts as in the derivation below."""

    step: Int[Array, ""]
    status: Int[Array, ""]
    u: Float[Array, " n"]  # u_{k-1}
    q_old: Float[Array, " n"]  # q_{k-1}
    q: Float[Array, " n"]  # q_k
    v: Float[Array, " n"]  # v_k = P q_k
    beta: Float[Array, ""]  # β_k, but 0 at the first step, where q_0 = 0
    w_old: Float[Array, " n"]  # w_{k-2}
    w: Float[Array, " n"]  # w_{k-1}
    c: Float[Array, ""]  # c_{k-1}
    s: Float[Array, ""]  # s_{k-1}
    delta_bar: Float[Array, ""]  # δ̄_k
    epsilon: Float[Array, ""]  # ε_k
    residual: Float[Array, ""]  # φ̄_{k-1} = |r_{k-1}|
    operator_norm: Float[Array, ""]
    negative_curvature: Bool[Array, ""]


class _Solve(NamedTuple):
    """What one of the at most three Lanczos solves hands to the next."""

    index: Int[Array, ""]
    more: Bool[Array, ""]
    rhs: Float[Array, " n"]
    target: Float[Array, ""]
    u: Float[Array, " n"]
    r: Float[Array, " n"]  # r_0 - A P u
    a_r: Float[Array, " n"]  # A P r
    step: Int[Array, ""]
    status: Int[Array, ""]
    operator_norm: Float[Array, ""]
    negative_curvature: Bool[Array, ""]


def _dot(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.dot(a, b, precision=lax.Precision.HIGHEST)


def _norm(z: Float[Array, " n"], p_z: Float[Array, " n"]) -> Float[Array, ""]:
    """The norm √(z·P z) in which a preconditioned residual is measured."""
    # If z is nothing but rounding error, z·P z may come out negative.
    return jnp.sqrt(jnp.maximum(_dot(z, p_z), 0))


def _over(a: Array, b: Array) -> Array:
    """`a / b`, and `a` where `b` is zero."""
    return a / jnp.where(b == 0, 1, b)


def _power_of_two_near(size: Float[Array, ""]) -> Float[Array, ""]:
    """A power of two, because dividing by it costs no rounding; 1 for zero, inf and nan."""
    usable = jnp.isfinite(size) & (size > 0)
    _, exponent = jnp.frexp(jnp.where(usable, size, 1))
    return jnp.where(usable, jnp.ldexp(jnp.ones_like(size), exponent - 1), 1)


def _not_definite(z: Float[Array, " n"], p_z: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether z·P z is negative by more than rounding."""
    rounding = _ROUNDING_UNITS * jnp.finfo(z.dtype).eps
    return _dot(z, p_z) < -rounding * jnp.sqrt(_dot(z, z) * _dot(p_z, p_z))


# Paige & Saunders (1975), with a preconditioner P ≈ A⁻¹. The unknown is u with x = P u, residuals
# are measured in |r| = √(r·P r), and only P itself is ever applied. Without a preconditioner P = I.
#
# Lanczos. From β_1 q_1 = b, q_0 = 0, for k = 1, 2, ..., with v_k = P q_k,
#     z = A v_k - β_k q_{k-1},  α_k = v_k·z,  z ← z - α_k q_k,  β_{k+1} = |z|,  q_{k+1} = z/β_{k+1}.
# Then q_i·P q_j = δ_ij and A P Q_k = Q_{k+1} T_k, where T_k is (k+1)-by-k and tridiagonal, with α on
# its diagonal and β on both sides of it. Measuring α_k after β_k q_{k-1} is gone is Paige's order,
# which keeps the q orthogonal for longest.
#
# Least residual. For u = Q_k t the residual is Q_{k+1} (β_1 e_1 - T_k t), so t is the solution of a
# small least-squares problem. Reflections [c_k s_k; s_k -c_k] of the rows k and k+1 make T_k upper
# triangular, with three diagonals ε, δ and γ. Column k is (β_k, α_k, β_{k+1}), and
#     reflection k-2 makes    ε_k = s_{k-2} β_k,                δ̄_k = -c_{k-2} β_k,
#     reflection k-1 makes    δ_k = c_{k-1} δ̄_k + s_{k-1} α_k,  γ̄_k = s_{k-1} δ̄_k - c_{k-1} α_k,
#     reflection k is         γ_k = √(γ̄_k² + β_{k+1}²),         c_k = γ̄_k/γ_k,  s_k = β_{k+1}/γ_k.
# They turn β_1 e_1 into (φ_1, ..., φ_k, φ̄_k), φ_k = c_k φ̄_{k-1}, φ̄_k = s_k φ̄_{k-1}, φ̄_0 = β_1, so
#     |r_k| = φ̄_k,    w_k = (q_k - ε_k w_{k-2} - δ_k w_{k-1})/γ_k,    u_k = u_{k-1} + φ_k w_k.
# To start, c_0 = -1 and s_0 = 0.
#
# What r_{k-1} tells, once step k has made its product:
#     |A P r_{k-1}| = φ̄_{k-1} √(γ̄_k² + δ̄_{k+1}²)     (zero for a least-squares solution), and
#     r_{k-1}·P A P r_{k-1} = -φ̄²_{k-1} c_{k-1} γ̄_k    (Liu & Roosta 2022: not positive for some k as
# soon as A has a direction of non-positive curvature in the Krylov space).
def _lanczos(
    a: _Map,
    p: _Map | None,
    start: _Solve,
    null_tolerance: Float[Array, ""],
    max_steps: int,
) -> _Loop:
    """Solves A P u = rhs from u = 0, until |rhs - A P u| ≤ target or |A P r| ≤ tolerance |A| |r|."""
    eps = jnp.finfo(start.rhs.dtype).eps
    precondition = (lambda z: z) if p is None else p
    p_rhs = precondition(start.rhs)
    beta_1 = _norm(start.rhs, p_rhs)

    def rounding_level(operator_norm, u):
        # No residual can be told from zero below eps (|A| |x| + |b|). With a preconditioner the
        # size of x is known only from below, by Cauchy and Schwarz: |u·P b| ≤ |u| |b|.
        size = jnp.sqrt(_dot(u, u)) if p is None else _over(jnp.abs(_dot(u, p_rhs)), beta_1)
        return eps * (operator_norm * size + beta_1)

    # A right-hand side whose norm vanishes although it does not, shows a P that is not definite.
    indefinite = (_dot(start.rhs, p_rhs) <= 0) & (_dot(start.rhs, start.rhs) > 0)
    status = jnp.where(beta_1 <= start.target, _CONVERGED, _RUNNING)
    status = jnp.where(indefinite, _BREAKDOWN, status)
    status = jnp.where(jnp.isfinite(beta_1), status, _NONFINITE)

    zero, zeros = jnp.zeros_like(beta_1), jnp.zeros_like(start.rhs)
    initial = _Loop(
        step=start.step,
        status=status,
        u=zeros,
        q_old=zeros,
        q=_over(start.rhs, beta_1),
        v=_over(p_rhs, beta_1),
        beta=zero,
        w_old=zeros,
        w=zeros,
        c=zero - 1,
        s=zero,
        delta_bar=zero,
        epsilon=zero,
        residual=beta_1,
        operator_norm=start.operator_norm,
        negative_curvature=start.negative_curvature,
    )

    def go_on(loop: _Loop) -> Bool[Array, ""]:
        return (loop.status == _RUNNING) & (loop.step < max_steps)

    def one_step(loop: _Loop) -> _Loop:
        z = a(loop.v) - loop.beta * loop.q_old
        alpha = _dot(loop.v, z)
        z = z - alpha * loop.q
        p_z = precondition(z)
        beta = _norm(z, p_z)
        # |T e_k| = |A P q_k| bounds the norm from below.
        operator_norm = jnp.maximum(
            loop.operator_norm, jnp.sqrt(loop.beta**2 + alpha**2 + beta**2)
        )

        delta = loop.c * loop.delta_bar + loop.s * alpha
        gamma_bar = loop.s * loop.delta_bar - loop.c * alpha
        epsilon, delta_bar = loop.s * beta, -loop.c * beta
        gamma = jnp.hypot(gamma_bar, beta)
        # β = 0 means that the Krylov space is exhausted: s = 0 and φ̄ = 0, the system is solved.
        # γ = 0 means besides that A P r = 0: then `null` is true, and none of this is used.
        c, s = _over(gamma_bar, gamma), _over(beta, gamma)
        w = _over(loop.q - loop.epsilon * loop.w_old - delta * loop.w, gamma)
        u = loop.u + c * loop.residual * w
        residual = s * loop.residual

        # The test on A P r concerns the iterate before this step, and comes before the step is
        # taken: along a null direction γ is rounding error, and u would grow by 1/γ.
        null = jnp.hypot(gamma_bar, delta_bar) <= null_tolerance * operator_norm
        solved = (residual <= start.target) | (residual <= rounding_level(operator_norm, u))
        status = jnp.where(solved, _CONVERGED, loop.status)
        status = jnp.where(null, _LEAST_SQUARES, status)
        status = jnp.where(_not_definite(z, p_z), _BREAKDOWN, status)
        # A comparison with nan is false, so that nan would otherwise run to the last step.
        status = jnp.where(jnp.isfinite(alpha) & jnp.isfinite(beta), status, _NONFINITE)
        take = (status == _RUNNING) | (status == _CONVERGED)

        # The curvature along r, over |r|². A null direction has one of the size of the rounding.
        curvature = -loop.c * gamma_bar
        negative = curvature < -_ROUNDING_UNITS * eps * operator_norm
        return _Loop(
            step=loop.step + 1,
            status=status,
            u=jnp.where(take, u, loop.u),
            q_old=loop.q,
            q=_over(z, beta),
            v=_over(p_z, beta),
            beta=beta,
            w_old=loop.w,
            w=w,
            c=c,
            s=s,
            delta_bar=delta_bar,
            epsilon=epsilon,
            residual=jnp.where(take, residual, loop.residual),
            operator_norm=operator_norm,
            negative_curvature=loop.negative_curvature | negative,
        )

    return lax.while_loop(go_on, one_step, initial)


class MINRES(lx.AbstractLinearSolver[lx.AbstractLinearOperator]):
    r"""Minimal residual method for symmetric $A$: definite, indefinite or singular.

    $$x_k = \arg\min_{x \in \mathcal{K}_k(A, b)} \|b - A x\|, \qquad
    \mathcal{K}_k(A, b) = \mathrm{span}\{b, A b, \dots, A^{k-1} b\}$$

    One product with $A$ in each step, and memory for a handful of vectors. It suits Hessians at a
    minimum that is degenerate (zero modes) or is no minimum at all (saddles), where CG breaks down.

    The result is the pseudo-inverse solution $A^+ b$, for a singular system too and whether or not
    it is consistent. Inconsistent systems need more: rounding keeps $\|A r\| / \|A\|\|r\|$ from
    falling below about $\sqrt{\epsilon}$, and the iterate then grows without bound. So once it falls
    to $10\sqrt{\epsilon}$ the iteration stops, the part of the residual in the range of $A$
    is found from the *consistent* systems $A y = A r$ and $A d = y$, and $x + d$ is freed of its
    part along the remaining residual, which is a null vector. Inconsistent systems, and those with
    a condition above $0.1/\sqrt{\epsilon}$, take about three times as many steps for this.

    It stops if one of these holds, with $\|A\|$ estimated on the way:

    - $\|r\| \le \mathtt{atol} + \mathtt{rtol}\,\|b\|$: solved;
    - $\|r\| \le \epsilon\,(\|A\|\|x\| + \|b\|)$: as good as rounding allows. It is called successful
        if then $\|r\| \le \mathtt{rtol}\,(\|A\|\|x\| + \|b\|)$ and $\|r\| \le \sqrt\epsilon\,\|b\|$;
        `stats["stagnated"]` tells it from the first;
    - $\|A r\| \le \mathtt{tol}\,\|A\|\|r\|$: a least-squares solution, as described above.

    This supports the following `options` (as passed to `lineax.linear_solve(..., options=...)`):

    - `preconditioner`: a positive definite operator $P \approx A^{-1}$, tagged as such. Residuals
        are then measured as $\sqrt{r \cdot P r}$, lengths of solutions as $\sqrt{x \cdot P^{-1} x}$.
        For a nonsingular $A$ that changes the number of steps only. For a singular one it changes
        which solution comes out: the weighted pseudo-inverse, not $A^+ b$, of which the derivative
        is then not the one that Lineax computes.
    - `y0`: the first guess. For a singular $A$ the result is the solution nearest to `y0`. Give none
        when differentiating through a singular system: Lineax hands it to the tangent systems too.

    **Arguments:**

    - `rtol`: tolerance of the residual, relative to $\|b\|$. Defaults to $\epsilon^{2/3}$ of the
        dtype: 3.7e-11 in float64 and 2.4e-5 in float32.
    - `atol`: absolute tolerance of the residual, added to the relative one.
    - `max_steps`: the largest number of products in the iteration. Defaults to 30 times the size of
        the system (rounding makes hard systems need several times their size).

    **Returns:**

    From `lineax.linear_solve`, a solution with these `stats`:

    - `num_steps`, `max_steps`: number of iterations done and allowed. The number of products is
        larger by one (for a first estimate of $\|A\|$), two after each solve, and one for `y0`.
    - `residual_norm`: $\|b - A x\| / \|b\|$ as recomputed at the end ($\|A x\|$ if $b = 0$).
    - `operator_norm`: lower bound of $\|A\|$ (of $\|P^{1/2} A P^{1/2}\|$ with a preconditioner).
    - `negative_curvature`: whether a residual $r$ with $r \cdot A r < 0$ was met. In exact arithmetic
        it is met, if one runs to the end, exactly if $b$ has a part in eigenspaces of negative
        eigenvalue; an early stop can miss it.
    - `inconsistent`: whether the result is a least-squares solution with a residual that is not small.
    - `stagnated`: whether the residual is above the tolerances, because rounding stopped the solve.

    and one of these results: `successful`; `max_steps_reached`; `stagnation` (rounding ended the
    solve too far from a solution); `breakdown` (the preconditioner is not positive definite);
    `nonfinite_input` ($A$, $b$ or `y0` has nan or inf; the value is then nan).

    **Raises:**

    A `ValueError` for a negative tolerance, a `max_steps` below one, an operator that is not square,
    not tagged symmetric or complex, and a preconditioner not tagged positive definite or of another
    shape.

    ??? cite "References"

        - Paige & Saunders (1975), Solution of sparse indefinite systems of linear equations,
            doi:10.1137/0712047. The method.
        - Choi, Paige & Saunders (2011), MINRES-QLP: a Krylov subspace method for indefinite or
            singular symmetric systems, doi:10.1137/100787921. The stopping rules.
        - Liu & Roosta (2022), MINRES: from negative curvature detection to monotonicity properties,
            doi:10.48550/arXiv.2206.05732. The sign of the curvature.
        - Liu, Milzarek & Roosta (2023), Obtaining pseudo-inverse solutions with MINRES,
            doi:10.48550/arXiv.2309.17096. Removal of the part along the residual.
    """

    rtol: float | None = None
    atol: float = 0.0
    max_steps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            if value is not None and not value >= 0:
                raise ValueError(f"Argument `{name}` must not be negative, but {value} was given.")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(
                f"Argument `max_steps` must be at least one, but {self.max_steps} was given."
            )

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> lx.AbstractLinearOperator:
        """Checks the operator, and linearises it so that each product costs one linear map."""
        del options
        structure = operator.in_structure()
        if eqx.tree_equal(structure, operator.out_structure()) is not True:
            raise ValueError(
                "Argument `operator` must be square, but it maps "
                f"{structure} to {operator.out_structure()}. Use `lineax.LSMR` instead."
            )
        if any(jnp.iscomplexobj(leaf) for leaf in jtu.tree_leaves(structure)):
            raise ValueError(
                "Argument `operator` must be real, but a complex one was given. "
                "Write the system in real and imaginary parts instead."
            )
        if not lx.is_symmetric(operator):
            raise ValueError(
                f"Argument `operator` must be symmetric, but a {type(operator).__name__} without "
                "that tag was given. Tag it with `lineax.symmetric_tag` if it is symmetric; use "
                "`lineax.GMRES` or `lineax.LSMR` if it is not."
            )
        return lx.linearise(operator)

    def compute(
        self,
        state: lx.AbstractLinearOperator,
        vector: PyTree[Array],
        options: dict[str, Any],
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        """Solves the system; see the class."""
        b, unravel = jfu.ravel_pytree(vector)
        eps = float(jnp.finfo(b.dtype).eps)
        rtol = eps ** (2 / 3) if self.rtol is None else self.rtol
        max_steps = 30 * max(b.size, 1) if self.max_steps is None else self.max_steps
        # A residual with |A r| below this is taken for a least-squares one. Rounding acts on Lanczos
        # as if each eigenvalue were a cluster (Greenbaum 1989, doi:10.1016/0024-3795(89)90285-1).
        # Close to convergence the cluster at zero, on which an inconsistent b has a large part, is
        # resolved like any other, and u grows by its inverse width. The √eps is where that begins.
        least_squares = max(rtol, _LS * eps**0.5)
        rounding = _ROUNDING_UNITS * eps

        flat = lambda operator: lambda v: jfu.ravel_pytree(operator.mv(unravel(v)))[0]
        a = flat(state)
        preconditioner = _preconditioner(state.in_structure(), options)
        p = None if preconditioner is None else flat(preconditioner)
        precondition = (lambda z: z) if p is None else p

        # The cotangents of a float32 loss may be so small that their squares vanish.
        scale = _power_of_two_near(jnp.max(jnp.abs(b), initial=0))
        b = b / scale
        p_b = precondition(b)
        norm_b = _norm(b, p_b)
        target = self.atol / scale + rtol * norm_b
        if options.get("y0") is None:
            x_0, r_0 = jnp.zeros_like(b), b
        else:
            if not _same_structure(options["y0"], vector):
                raise ValueError(
                    "Argument `options['y0']` must have the structure of the vector, but "
                    f"{jax.eval_shape(lambda: options['y0'])} was given."
                )
            x_0 = jfu.ravel_pytree(options["y0"])[0] / scale
            r_0 = b - a(x_0)

        # |A| is needed before Lanczos knows it: if b is a null vector, A b is rounding error, and
        # only in comparison with |A| does it look like it. For random signs g the mean square of
        # |A g|/|g| is that of the eigenvalues.
        g = jax.random.rademacher(jax.random.key(0), b.shape, b.dtype)
        p_g = precondition(g)
        a_g = a(p_g)
        operator_norm = _over(_norm(a_g, precondition(a_g)), _norm(g, p_g))

        def residual(u):
            r = r_0 - a(precondition(u))
            p_r = precondition(r)
            return r, p_r, _norm(r, p_r)

        # Solve 0 is the system itself. Only if it ends with a residual that is not small do solves
        # 1 and 2 follow; both are consistent, and so have none of the trouble of solve 0:
        #     A P y = A P r   makes y the part of r in the range,     A P d = y   adds A⁺ r to u.
        # In exact arithmetic y would be zero after a least-squares stop, in rounding it is √eps.
        def one_solve(solve: _Solve) -> _Solve:
            first, second = solve.index == 0, solve.index == 1
            tolerance = jnp.where(first, least_squares, rounding).astype(b.dtype)
            loop = _lanczos(a, p, solve, tolerance, max_steps)
            u = jnp.where(second, solve.u, solve.u + loop.u)
            r, p_r, norm_r = residual(u)
            # A blown-up u can pass for solved at the rounding level, which grows with it. No such u
            # is worth keeping.
            blown_up = first & (loop.status == _CONVERGED) & (norm_r > eps**_BIG * norm_b + target)
            u = jnp.where(blown_up, 0, u)
            r, p_r = jnp.where(blown_up, r_0, r), jnp.where(blown_up, precondition(r_0), p_r)
            norm_r = _norm(r, p_r)
            a_r = a(p_r)
            # How far solve 1 goes: as far as the user wants |A r| to be small, or else to rounding.
            fine = _SLACK * rtol if rtol >= least_squares else rounding
            ended = (loop.status == _CONVERGED) | (loop.status == _LEAST_SQUARES)
            return _Solve(
                index=solve.index + 1,
                more=jnp.where(
                    first, (loop.status == _LEAST_SQUARES) | blown_up, second & ended
                ),
                rhs=jnp.where(first, a_r, loop.u),
                target=jnp.where(first, fine * loop.operator_norm * norm_r, target),
                u=u,
                r=r,
                a_r=a_r,
                step=loop.step,
                status=loop.status,
                operator_norm=loop.operator_norm,
                negative_curvature=loop.negative_curvature,
            )

        solve = lax.while_loop(
            lambda solve: solve.more,
            one_solve,
            _Solve(
                index=jnp.array(0),
                more=jnp.array(True),
                rhs=r_0,
                target=target,
                u=jnp.zeros_like(b),
                r=r_0,
                a_r=jnp.zeros_like(b),
                step=jnp.array(0),
                status=jnp.array(_RUNNING),
                operator_norm=operator_norm,
                negative_curvature=jnp.array(False),
            ),
        )
        r, p_r, u, p_u = solve.r, precondition(solve.r), solve.u, precondition(solve.u)
        norm_r, norm_a_r = _norm(r, p_r), _norm(solve.a_r, precondition(solve.a_r))
        x = x_0 + p_u

        size = jnp.sqrt(_dot(x, x)) if p is None else _over(jnp.abs(_dot(x, b)), norm_b)
        size = jnp.maximum(size, _norm(u, p_u))
        backward_error = _over(norm_r, solve.operator_norm * size + norm_b)
        ended = (solve.status == _CONVERGED) | (solve.status == _LEAST_SQUARES)
        within = norm_r <= _SLACK * target
        inconsistent = (
            ended
            & ~within
            & (solve.index > 1)
            & (backward_error > _ROUNDING_UNITS * rounding)
            & (norm_a_r <= _SLACK * least_squares * solve.operator_norm * norm_r)
        )
        stagnated = ended & ~within & ~inconsistent
        failed = stagnated & (
            (backward_error > max(rtol, _ROUNDING_UNITS * rounding))
            | (norm_r > eps**_BIG * norm_b)
        )
        # Lifting: P r is a null vector of A, and the only one along which u - d has a part.
        lifted = x - _over(_dot(r, p_u), norm_r**2) * p_r
        x = jnp.where(inconsistent, lifted, x)

        result = lx.RESULTS.where(ended, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
        result = lx.RESULTS.where(failed, lx.RESULTS.stagnation, result)
        broken, nonfinite = solve.status == _BREAKDOWN, solve.status == _NONFINITE
        result = lx.RESULTS.where(broken, lx.RESULTS.breakdown, result)
        result = lx.RESULTS.where(nonfinite, lx.RESULTS.nonfinite_input, result)
        x = jnp.where(nonfinite, jnp.nan, x)
        stats = {
            "num_steps": solve.step,
            "max_steps": max_steps,
            "residual_norm": _over(jnp.sqrt(_dot(r, r)), jnp.sqrt(_dot(b, b))),
            "operator_norm": solve.operator_norm,
            "negative_curvature": solve.negative_curvature,
            "inconsistent": inconsistent,
            "stagnated": stagnated,
        }
        return unravel(x * scale), result, stats

    def transpose(
        self, state: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[lx.AbstractLinearOperator, dict[str, Any]]:
        """The same state, for the operator is symmetric; `y0` was meant for the other system."""
        return state, {name: option for name, option in options.items() if name != "y0"}

    def conj(
        self, state: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[lx.AbstractLinearOperator, dict[str, Any]]:
        """The same state, for the operator is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """False: the pseudo-inverse solution is found for any rank."""
        return False


def _same_structure(x: PyTree[Array], y: PyTree[Array]) -> bool:
    strong = lambda tree: jtu.tree_map(
        lambda leaf: (leaf.shape, leaf.dtype), jax.eval_shape(lambda: tree)
    )
    return strong(x) == strong(y)


def _preconditioner(
    structure: PyTree[jax.ShapeDtypeStruct], options: dict[str, Any]
) -> lx.AbstractLinearOperator | None:
    """The linearised preconditioner of `options`, checked; `None` if there is none to apply."""
    preconditioner = options.get("preconditioner")
    if preconditioner is None or isinstance(preconditioner, lx.IdentityLinearOperator):
        return None
    given = type(preconditioner).__name__
    if not isinstance(preconditioner, lx.AbstractLinearOperator):
        raise ValueError(
            "Argument `options['preconditioner']` must be a `lineax.AbstractLinearOperator`, but "
            f"a {given} was given."
        )
    if not lx.is_positive_semidefinite(preconditioner):
        raise ValueError(
            "Argument `options['preconditioner']` must be positive definite, but a "
            f"{given} without that tag was given. Tag it with `lineax.positive_semidefinite_tag` if "
            "it is so."
        )
    if not (
        _same_structure(preconditioner.in_structure(), structure)
        and _same_structure(preconditioner.out_structure(), structure)
    ):
        raise ValueError(
            "Argument `options['preconditioner']` must map the space of the operator to itself, "
            f"{structure}, but it maps {preconditioner.in_structure()} to "
            f"{preconditioner.out_structure()}."
        )
    return lx.linearise(preconditioner)
