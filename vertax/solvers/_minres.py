"""MINRES: symmetric linear systems that may be indefinite, singular or inconsistent."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.checks import check_integer, check_number
from vertax._base.probe_vector import probe_vector
from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import tree_where
from vertax.solvers._lanczos import (
    BREAKDOWN,
    CONVERGED,
    LEAST_SQUARES,
    NONFINITE,
    ROUNDING_UNITS,
    RUNNING,
    dot,
    norm,
    over,
    solve_in_krylov_space,
)

# |r| from the recurrence and |b - A x| recomputed agree if they differ by less than this factor.
_RESIDUAL_SLACK = 2


class _Solve(NamedTuple):
    """The state between the solves in Krylov spaces, of which there are four at most."""

    number: Int[Array, ""]
    more: Bool[Array, ""]
    rhs: Float[Array, "n"]
    target: Float[Array, ""]
    last: "_Evaluations"
    step: Int[Array, ""]
    status: Int[Array, ""]
    operator_norm: Float[Array, ""]
    negative_curvature: Bool[Array, ""]


class _Evaluations(NamedTuple):
    """Vectors and norms that are recomputed after a solve, with products with A and P."""

    rest: Float[Array, "n"]  # of this solve, rhs - A P end.u
    norm_rest: Float[Array, ""]
    u: Float[Array, "n"]
    p_u: Float[Array, "n"]
    r: Float[Array, "n"]  # r_0 - A P u
    p_r: Float[Array, "n"]
    a_r: Float[Array, "n"]  # A P r
    norm_a_r: Float[Array, ""]
    status: Int[Array, ""]


class MINRES(lx.AbstractLinearSolver[lx.AbstractLinearOperator]):
    r"""Minimal residual method for symmetric $A$: definite, indefinite or singular.

    $$x_k = \arg\min_{x \in \mathcal{K}_k(A, b)} \|b - A x\|, \qquad
    \mathcal{K}_k(A, b) = \mathrm{span}\{b, A b, \dots, A^{k-1} b\}$$

    Each step takes one product with $A$; the memory is a dozen vectors. The method suits Hessians with zero
    modes and Hessians at saddles, where CG breaks down. The result is the pseudo-inverse solution
    $A^+ b$, also if $A$ is singular and the system inconsistent.

    The iteration ends if one of these conditions holds, with an estimate of $\|A\|$ from the iteration:

    - $\|r\| \le \mathtt{atol} + \mathtt{rtol}\,\|b\|$, with $r = b - A x$: solved.
    - $\|r\| \le \epsilon\,(\|A\|\|x\| + \|b\|)$: the residual is at the level of rounding errors. If the
        first test then fails for the recomputed $r$, `stats["stagnated"]` is true. The result is still
        `successful` if $\|r\| \le \mathtt{rtol}\,(\|A\|\|x\| + \|b\|)$, which allows for a large $x$,
        and $\|r\| \le \epsilon^{1/8} \|b\|$, which excludes $x = 0$.
    - $\|A r\| \le \mathtt{rtol}\,\|A\|\|r\|$: a least-squares solution. With rounding errors the left side
        decreases to about $\sqrt{\epsilon}\,\|A\|\|r\|$ only, and then $x$ grows without bound.
        Therefore the solution is completed, from the last good $x$, by two further solves, $A y = A r$ and
        $A d = y$, which are consistent. Finally the component along the remaining $r$, a null vector,
        is removed from $x + d$. Inconsistent systems take two to three times as many steps.

    The relative rounding error of $x$ can be as large as $\epsilon$ times the square of the
    condition number. Above a condition number of $1/\sqrt{\epsilon}$ (in float32 some thousands) the result
    may be `stagnation`, and small eigenvalues may be treated as zero.

    This supports the following `options`, passed as `lineax.linear_solve(..., options=...)`:

    - `preconditioner`: a positive definite operator $P \approx A^{-1}$, tagged as such. Residuals
        are then measured as $\sqrt{r \cdot P r}$, and lengths of $x$ as $\sqrt{x \cdot P^{-1} x}$.
        If $A$ is nonsingular, this changes only the number of steps. If $A$ is singular, the result is the
        pseudo-inverse solution in these norms, which is not $A^+ b$, and the derivative that Lineax computes
        is not valid for it.
    - `y0`: an initial guess. If $A$ is singular, the result is the solution nearest to it. Do not pass it
        when differentiating through a singular system: Lineax passes it to the tangent system too.

    **Arguments:**

    - `rtol`: tolerance of the residual relative to $\|b\|$. Defaults to $\epsilon^{2/3}$ of the
        dtype, which is 3.7e-11 in float64 and 2.4e-5 in float32.
    - `atol`: absolute tolerance of the residual, added to the relative one.
    - `max_steps`: maximum number of steps of all solves together. Defaults to 50 times the size of the
        system. (Without rounding errors one solve takes as many steps as there are distinct eigenvalues.)

    **Returns:**

    From `lineax.linear_solve`, a solution with one of the results `successful`;
    `max_steps_reached`; `stagnation` (rounding errors prevent a smaller residual); `breakdown` (the
    preconditioner is not positive definite); `nonfinite_input` ($A$, $b$ or `y0` has nan or inf;
    the value is nan). Its `stats` are

    - `num_steps` and `max_steps`: the number of steps and its maximum. Each step takes one product with $A$;
        further products are one at the start, one for `y0`, and three after each solve.
    - `residual_norm`: $\|b - A x\| / \|b\|$ recomputed at the end, or $\|A x\|$ if $b = 0$.
    - `operator_norm`: a lower bound of $\|A\|$, or of $\|P^{1/2} A P^{1/2}\|$.
    - `negative_curvature`: whether a direction $z$ with $z \cdot A z < 0$ was found. Without rounding errors
        and after a full solve this holds if and only if $b$ has a component in an eigenspace of a negative
        eigenvalue. With a loose tolerance a small component can be missed.
    - `inconsistent`: whether the result is a least-squares solution with a residual that is not
        small.
    - `stagnated`: whether the solve ended by rounding errors with a residual above the tolerances.

    **Raises:**

    - `ValueError` if a tolerance is negative or `max_steps` is not positive; if the operator is not
        square, not real or not tagged symmetric; if the preconditioner is not tagged positive
        semidefinite; if it or `y0` does not fit the system.

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

    rtol: float | None = eqx.field(default=None, static=True)
    atol: float = eqx.field(default=0.0, static=True)
    max_steps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            if value is not None:
                check_number(name, value, at_least=0)
        if self.max_steps is not None:
            check_integer("max_steps", self.max_steps, at_least=1)

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> lx.AbstractLinearOperator:
        """Checks the operator, and linearises it so that each product costs one linear map."""
        del options
        given, structure = type(operator).__name__, operator.in_structure()
        if not _same_structure(structure, operator.out_structure()):
            raise ValueError(
                f"Argument `operator` must be square, but a {given} from {structure} to "
                f"{operator.out_structure()} was given. Use `lineax.LSMR` instead."
            )
        if any(jnp.issubdtype(x.dtype, jnp.complexfloating) for x in jtu.tree_leaves(structure)):
            raise ValueError(
                f"Argument `operator` must be real, but a complex {given} was given. Solve for "
                "real and imaginary parts instead."
            )
        if not lx.is_symmetric(operator):
            raise ValueError(
                f"Argument `operator` must be symmetric, but a {given} without that tag was given. "
                "Tag it with `lineax.symmetric_tag` if it is symmetric, and use `lineax.GMRES` or "
                "`lineax.LSMR` if it is not."
            )
        return lx.linearise(operator)

    def compute(
        self,
        state: lx.AbstractLinearOperator,
        vector: PyTree[Array],
        options: dict[str, Any],
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        """Solves the system for one vector; see the class."""
        return sequential_vmap_on_cpu(_solve)(self, state, vector, options)

    def transpose(
        self, state: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[lx.AbstractLinearOperator, dict[str, Any]]:
        """The same state: the operator is symmetric. The initial guess is valid for this vector only."""
        return state, {name: value for name, value in options.items() if name != "y0"}

    def conj(
        self, state: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[lx.AbstractLinearOperator, dict[str, Any]]:
        """The same state: the operator is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """False: the result is the pseudo-inverse solution for any rank."""
        return False


def _solve(
    solver: MINRES,
    state: lx.AbstractLinearOperator,
    vector: PyTree[Array],
    options: dict[str, Any],
) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
    b, unravel = jfu.ravel_pytree(vector)
    eps = float(jnp.finfo(b.dtype).eps)
    rtol = eps ** (2 / 3) if solver.rtol is None else solver.rtol
    max_steps = 50 * max(b.size, 1) if solver.max_steps is None else solver.max_steps
    rounding = ROUNDING_UNITS * eps
    loose_tolerance = eps**0.125
    # For √eps see the end of the derivation in `_lanczos`. If `rtol` is not smaller, solve 0 stops there and
    # the others are not needed.
    nearly_null = max(rtol, 4 * eps**0.5)
    is_coarse = rtol == nearly_null

    flat = lambda operator: lambda v: jfu.ravel_pytree(operator.mv(unravel(v)))[0]
    a = flat(state)
    preconditioner = _preconditioner(state.in_structure(), options)
    p = None if preconditioner is None else flat(preconditioner)
    precondition = (lambda z: z) if p is None else p

    # Scale b: the squares of small float32 cotangents would underflow.
    scale = _power_of_two_near(jnp.max(jnp.abs(b), initial=0))
    b = b / scale
    norm_b = norm(b, precondition(b))
    target = solver.atol / scale + rtol * norm_b
    x_0, r_0 = jnp.zeros_like(b), b
    if options.get("y0") is not None:
        x_0 = _initial_guess(vector, options) / scale
        r_0 = b - a(x_0)

    # An estimate of |A| is needed before the Lanczos iteration: if b is a null vector, A b is rounding error,
    # which can be detected only by comparison with |A|. For a random g the mean square of |A g|/|g| is the
    # mean square of the eigenvalues.
    g = probe_vector(b)
    norm_g = norm(g, precondition(g))

    # Solve -1 computes only A P g. Solve 0 is the system itself. If it has only a least-squares solution, two
    # more follow:
    #     solve 1, A P y = A P r: y is the component of r in the range of A,
    #     solve 2, A P d = y:     d = A⁺ r is added to u.
    # Both are consistent, so their solutions are bounded. Without rounding errors A P r and y would be zero.
    def one_solve(solve: _Solve) -> _Solve:
        probing, first, second = (solve.number == k for k in (-1, 0, 1))
        null = jnp.where(first & is_coarse, rtol, ROUNDING_UNITS * rounding).astype(b.dtype)
        end = solve_in_krylov_space(
            a,
            p,
            solve.rhs,
            target=solve.target,
            null=null,
            nearly_null=nearly_null,
            operator_norm=solve.operator_norm,
            negative_curvature=solve.negative_curvature,
            step=solve.step,
            max_steps=max_steps,
        )
        norm_rhs = end.norm_rhs

        # The evaluations, one in each iteration of a loop, so that the operator is compiled once here.
        def evaluate(index: Int[Array, ""], evaluations: _Evaluations) -> _Evaluations:
            begin = jnp.where(probing, g, end.u)
            v = lax.select_n(
                index, begin, evaluations.rest, evaluations.u, evaluations.r, evaluations.a_r
            )
            p_v = precondition(v)
            is_index = [index == k for k in range(5)]
            a_v = lax.cond(is_index[1] | is_index[4], lambda: v, lambda: a(p_v))

            # The rounding level grows with u, so a u that diverges in one step passes the test for
            # CONVERGED. Its recomputed residual is not smaller than that of the suspect.
            norm_v = norm(v, p_v)
            is_not_smaller = (end.residual_suspect > 0) & (norm_v > 0.5 * end.residual_suspect)
            blown_up = (
                (end.status == CONVERGED)
                & (norm_v > _RESIDUAL_SLACK * solve.target)
                & (is_not_smaller | (norm_v > loose_tolerance * norm_rhs))
            )
            # The test for LEAST_SQUARES can also be late, after u has grown.
            least_squares = blown_up | (end.status == LEAST_SQUARES)
            change = jnp.where(least_squares, end.u_suspect, end.u)
            u = jnp.where(second, evaluations.u, evaluations.u + change)
            new = _Evaluations(
                rest=solve.rhs - a_v,
                norm_rest=norm_v,
                u=u,
                p_u=p_v,
                r=r_0 - a_v,
                p_r=p_v,
                a_r=a_v,
                norm_a_r=norm_v,
                status=jnp.where(least_squares, LEAST_SQUARES, end.status),
            )
            order = (0, 1, 1, 2, 2, 3, 3, 4, 1)
            each = zip(order, new, evaluations, strict=True)
            return _Evaluations(*(jnp.where(is_index[k], now, before) for k, now, before in each))

        evaluations = lax.fori_loop(0, jnp.where(probing, 2, 5), evaluate, solve.last)
        least_squares = evaluations.status == LEAST_SQUARES
        change = jnp.where(least_squares, end.u_suspect, end.u)
        ended = least_squares | (evaluations.status == CONVERGED)
        more = jnp.where(first, least_squares & (not is_coarse), second & ended)
        operator_norm = jnp.where(probing, over(evaluations.norm_rest, norm_g), end.operator_norm)
        # The target of solve 1 is the rounding error of A P r.
        finest = rounding * operator_norm * norm(evaluations.r, evaluations.p_r)
        return _Solve(
            number=solve.number + 1,
            more=more | probing,
            rhs=jnp.where(probing, r_0, jnp.where(first, evaluations.a_r, change)),
            target=jnp.where(first, finest, target),
            last=tree_where(probing, solve.last, evaluations),
            step=end.step,
            status=evaluations.status,
            operator_norm=operator_norm,
            negative_curvature=end.negative_curvature,
        )

    zero, zeros, running = jnp.zeros_like(norm_g), jnp.zeros_like(b), jnp.array(RUNNING)
    start = _Solve(
        number=jnp.array(-1),
        more=jnp.array(True),
        rhs=zeros,
        target=zero,
        last=_Evaluations(zeros, zero, zeros, zeros, zeros, zeros, zeros, zero, running),
        step=jnp.array(0),
        status=running,
        operator_norm=zero,
        negative_curvature=jnp.array(False),
    )
    solve = lax.while_loop(lambda solve: solve.more, one_solve, start)

    evaluations = solve.last
    u, r, p_u, p_r, norm_a_r = (
        evaluations.u,
        evaluations.r,
        evaluations.p_u,
        evaluations.p_r,
        evaluations.norm_a_r,
    )
    norm_r = norm(r, p_r)
    x = x_0 + p_u
    # With a preconditioner this is the Cauchy-Schwarz lower bound of |x|, because x_0 is not given as P u.
    size_x = jnp.sqrt(dot(x, x)) if p is None else over(jnp.abs(dot(x, b)), norm_b)
    size_x = jnp.maximum(size_x, norm(u, p_u))
    reach = solve.operator_norm * size_x + norm_b
    # The recomputed r has errors of this size, and A P r those times |A|.
    noise = ROUNDING_UNITS * rounding * reach

    ended = (solve.status == CONVERGED) | (solve.status == LEAST_SQUARES)
    is_within_tolerance = norm_r <= _RESIDUAL_SLACK * target
    inconsistent = (
        ended
        & ~is_within_tolerance
        & ((solve.number > 1) | (solve.status == LEAST_SQUARES))
        & (norm_r > noise)
        & (norm_a_r <= solve.operator_norm * (_RESIDUAL_SLACK * nearly_null * norm_r + noise))
    )
    stagnated = ended & ~is_within_tolerance & ~inconsistent
    explained = norm_r <= loose_tolerance * norm_b
    acceptable = explained & (norm_r <= jnp.maximum(rtol * reach, noise))
    # P r is a null vector, and the only one along which P u can have a component: u is in the span of b,
    # A P b, ..., of which only b has a component outside the range.
    projected = x - over(dot(r, p_u), norm_r**2) * p_r
    x = jnp.where(inconsistent, projected, x)

    result = lx.RESULTS.where(ended, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
    for condition, code in (
        (stagnated & ~acceptable, lx.RESULTS.stagnation),
        (solve.status == BREAKDOWN, lx.RESULTS.breakdown),
        (solve.status == NONFINITE, lx.RESULTS.nonfinite_input),
    ):
        result = lx.RESULTS.where(condition, code, result)
    x = jnp.where(solve.status == NONFINITE, jnp.nan, x)
    stats = {
        "num_steps": solve.step,
        "max_steps": max_steps,
        "residual_norm": over(jnp.sqrt(dot(r, r)), jnp.sqrt(dot(b, b))),
        "operator_norm": solve.operator_norm,
        "negative_curvature": solve.negative_curvature,
        "inconsistent": inconsistent,
        "stagnated": stagnated,
    }
    return unravel(x * scale), result, stats


def _power_of_two_near(size: Float[Array, ""]) -> Float[Array, ""]:
    """A power of two, because division by it is exact; 1 for zero, inf and nan."""
    usable = jnp.isfinite(size) & (size > 0)
    _, exponent = jnp.frexp(jnp.where(usable, size, 1))
    return jnp.where(usable, jnp.ldexp(jnp.ones_like(size), exponent - 1), 1)


def _same_structure(x: PyTree[Any], y: PyTree[Any]) -> bool:
    """Whether trees, shapes and dtypes are equal; weak types do not count."""
    same = lambda a, b: a.shape == b.shape and a.dtype == b.dtype
    equal_trees = jtu.tree_structure(x) == jtu.tree_structure(y)
    return equal_trees and jtu.tree_all(jtu.tree_map(same, x, y))


def _initial_guess(vector: PyTree[Array], options: dict[str, Any]) -> Float[Array, "n"]:
    y0 = jtu.tree_map(jnp.asarray, options["y0"])
    if not _same_structure(y0, vector):
        raise ValueError(
            "Argument `options['y0']` must have the structure of the vector, but "
            f"{jax.eval_shape(lambda: y0)} was given for {jax.eval_shape(lambda: vector)}."
        )
    return jfu.ravel_pytree(y0)[0]


def _preconditioner(
    structure: PyTree[jax.ShapeDtypeStruct], options: dict[str, Any]
) -> lx.AbstractLinearOperator | None:
    """The preconditioner of `options`, checked and linearised; None if it is missing or the identity."""
    preconditioner = options.get("preconditioner")
    if preconditioner is None or isinstance(preconditioner, lx.IdentityLinearOperator):
        return None
    name, given = "Argument `options['preconditioner']` must", type(preconditioner).__name__
    if not isinstance(preconditioner, lx.AbstractLinearOperator):
        raise ValueError(f"{name} be a `lineax.AbstractLinearOperator`, but a {given} was given.")
    if not lx.is_positive_semidefinite(preconditioner):
        raise ValueError(
            f"{name} be positive definite, but a {given} without that tag was given. Tag it with "
            "`lineax.positive_semidefinite_tag` if it is so."
        )
    into, out = preconditioner.in_structure(), preconditioner.out_structure()
    if not (_same_structure(into, structure) and _same_structure(out, structure)):
        raise ValueError(
            f"{name} map the space of the operator, {structure}, to itself, but a {given} from "
            f"{into} to {out} was given."
        )
    return lx.linearise(preconditioner)
