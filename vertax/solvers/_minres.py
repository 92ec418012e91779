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
_SLACK = 2


class _Solve(NamedTuple):
    """What one of the solves in Krylov spaces, four at most, hands to the next."""

    number: Int[Array, ""]
    more: Bool[Array, ""]
    rhs: Float[Array, "n"]
    target: Float[Array, ""]
    last: "_Looks"
    step: Int[Array, ""]
    status: Int[Array, ""]
    operator_norm: Float[Array, ""]
    negative_curvature: Bool[Array, ""]


class _Looks(NamedTuple):
    """What is looked at after a solve, each with a product or what the preconditioner makes of it."""

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

    One product with $A$ in each step, and memory for a dozen vectors. It suits Hessians at a
    minimum that is degenerate (zero modes) or is no minimum (saddles), where CG breaks down. The
    result is the pseudo-inverse solution $A^+ b$, also if $A$ is singular, and also if the system
    then has no solution (is inconsistent).

    It ends if one of these holds, where $\|A\|$ is estimated on the way:

    - $\|r\| \le \mathtt{atol} + \mathtt{rtol}\,\|b\|$, with $r = b - A x$: solved.
    - $\|r\| \le \epsilon\,(\|A\|\|x\| + \|b\|)$: as good as rounding allows. If the first test then
        fails for the recomputed $r$, this is told by `stats["stagnated"]`. It still is called
        successful if $\|r\| \le \mathtt{rtol}\,(\|A\|\|x\| + \|b\|)$, which allows for a large $x$,
        and $\|r\| \le \epsilon^{1/8} \|b\|$, so that some of $b$ is explained.
    - $\|A r\| \le \mathtt{rtol}\,\|A\|\|r\|$: a least-squares solution. Rounding lets the left side
        come down to about $\sqrt{\epsilon}\,\|A\|\|r\|$ only, and then $x$ grows without bound.
        The rest is therefore done, from the last good $x$, by two more solves, $A y = A r$ and
        $A d = y$, which are consistent. Finally $x + d$ is freed of its part along the remaining
        $r$, which is a null vector. Inconsistent systems take two to three times as many steps.

    The relative rounding error of $x$ can be as large as $\epsilon$ times the square of the
    condition number. Above a condition of $1/\sqrt{\epsilon}$ (in float32 some thousands) be
    prepared for `stagnation`, and for small eigenvalues to be taken for zero.

    This supports the following `options`, passed as `lineax.linear_solve(..., options=...)`:

    - `preconditioner`: a positive definite operator $P \approx A^{-1}$, tagged as such. Residuals
        are then measured as $\sqrt{r \cdot P r}$, and lengths of $x$ as $\sqrt{x \cdot P^{-1} x}$.
        If $A$ is nonsingular, that changes the number of steps and nothing else. If it is singular,
        the result is the pseudo-inverse solution in these lengths, which is not $A^+ b$, and for
        which the derivative that Lineax computes does not hold.
    - `y0`: a first guess. If $A$ is singular, the result is the solution nearest to it. Give none
        when differentiating through a singular system: Lineax hands it to the tangent system too.

    **Arguments:**

    - `rtol`: tolerance of the residual relative to $\|b\|$. Defaults to $\epsilon^{2/3}$ of the
        dtype, which is 3.7e-11 in float64 and 2.4e-5 in float32.
    - `atol`: absolute tolerance of the residual, added to the relative one.
    - `max_steps`: the most steps to take, all solves together. Defaults to 50 times the size of the
        system: without rounding one solve takes as many as there are distinct eigenvalues.

    **Returns:**

    From `lineax.linear_solve`, a solution with one of the results `successful`;
    `max_steps_reached`; `stagnation` (rounding ended it too far from a solution); `breakdown` (the
    preconditioner is not positive definite); `nonfinite_input` ($A$, $b$ or `y0` has nan or inf;
    the value is nan). Its `stats` are

    - `num_steps` and `max_steps`: the steps taken and allowed. Each makes one product with $A$;
        another one is made at the beginning, one for `y0`, and three after each solve.
    - `residual_norm`: $\|b - A x\| / \|b\|$ recomputed at the end, or $\|A x\|$ if $b = 0$.
    - `operator_norm`: a lower bound of $\|A\|$, or of $\|P^{1/2} A P^{1/2}\|$.
    - `negative_curvature`: whether a direction $z$ with $z \cdot A z < 0$ was met. Without
        rounding, and if solved to the end, it is so exactly if $b$ has a part in an eigenspace
        of a negative eigenvalue. A loose tolerance can miss a small part.
    - `inconsistent`: whether the result is a least-squares solution with a residual that is not
        small.
    - `stagnated`: whether rounding ended the solve with a residual above the tolerances.

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
            if value is not None and not value >= 0:
                raise ValueError(f"Argument `{name}` must not be negative, but {value} was given.")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(
                f"Argument `max_steps` must be positive, but {self.max_steps} was given."
            )

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
        """The same state: the operator is symmetric. A first guess is for this vector only."""
        return state, {name: value for name, value in options.items() if name != "y0"}

    def conj(
        self, state: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[lx.AbstractLinearOperator, dict[str, Any]]:
        """The same state: the operator is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """False: the result is the pseudo-inverse solution whatever the rank."""
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
    hardly_solved = eps**0.125
    # Why √eps: see the end of the derivation. If no more than that is asked for, solve 0 stops
    # there at once and the others have nothing to add.
    nearly_null = max(rtol, 4 * eps**0.5)
    coarse = rtol == nearly_null

    flat = lambda operator: lambda v: jfu.ravel_pytree(operator.mv(unravel(v)))[0]
    a = flat(state)
    preconditioner = _preconditioner(state.in_structure(), options)
    p = None if preconditioner is None else flat(preconditioner)
    precondition = (lambda z: z) if p is None else p

    # The cotangents of a float32 loss can be so small that their squares vanish.
    scale = _power_of_two_near(jnp.max(jnp.abs(b), initial=0))
    b = b / scale
    norm_b = norm(b, precondition(b))
    target = solver.atol / scale + rtol * norm_b
    x_0, r_0 = jnp.zeros_like(b), b
    if options.get("y0") is not None:
        x_0 = _first_guess(vector, options) / scale
        r_0 = b - a(x_0)

    # |A| must be known before Lanczos can tell it: if b is a null vector, A b is rounding
    # error, and this shows only in comparison with |A|. With no pattern in g, the mean square
    # of |A g|/|g| is that of the eigenvalues.
    g = probe_vector(b)
    norm_g = norm(g, precondition(g))

    # Solve 0 is the system itself; solve -1 solves nothing, and has A P g looked at instead. If the
    # system has only a least-squares solution, two more follow:
    #     solve 1, A P y = A P r, makes y the part of r in the range of A,
    #     solve 2, A P d = y,     makes A⁺ r to be added to u.
    # Both are consistent, and so do not blow up. Without rounding, A P r and y would be zero.
    def one_solve(solve: _Solve) -> _Solve:
        probing, first, second = (solve.number == k for k in (-1, 0, 1))
        null = jnp.where(first & coarse, rtol, ROUNDING_UNITS * rounding).astype(b.dtype)
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

        # The looks, one in a turn of a loop: what takes long to compile is the operator, and it stands
        # here once.
        def look(turn: Int[Array, ""], seen: _Looks) -> _Looks:
            begin = jnp.where(probing, g, end.u)
            v = lax.select_n(turn, begin, seen.rest, seen.u, seen.r, seen.a_r)
            p_v = precondition(v)
            turns = [turn == k for k in range(5)]
            a_v = lax.cond(turns[1] | turns[4], lambda: v, lambda: a(p_v))

            # The level of rounding grows with u, so a u that blows up at one stroke reaches it. It
            # shows in the recomputed residual, which is that of the suspect or larger.
            norm_v = norm(v, p_v)
            no_gain = (end.residual_suspect > 0) & (norm_v > 0.5 * end.residual_suspect)
            blown_up = (
                (end.status == CONVERGED)
                & (norm_v > _SLACK * solve.target)
                & (no_gain | (norm_v > hardly_solved * norm_rhs))
            )
            # The test for LEAST_SQUARES, too, can be late, when u has already grown.
            least_squares = blown_up | (end.status == LEAST_SQUARES)
            change = jnp.where(least_squares, end.u_suspect, end.u)
            u = jnp.where(second, seen.u, seen.u + change)
            new = _Looks(
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
            when = (0, 1, 1, 2, 2, 3, 3, 4, 1)
            each = zip(when, new, seen, strict=True)
            return _Looks(*(jnp.where(turns[k], now, before) for k, now, before in each))

        seen = lax.fori_loop(0, jnp.where(probing, 2, 5), look, solve.last)
        least_squares = seen.status == LEAST_SQUARES
        change = jnp.where(least_squares, end.u_suspect, end.u)
        ended = least_squares | (seen.status == CONVERGED)
        more = jnp.where(first, least_squares & (not coarse), second & ended)
        operator_norm = jnp.where(probing, over(seen.norm_rest, norm_g), end.operator_norm)
        # Solve 1 goes as far as A P r means anything.
        finest = rounding * operator_norm * norm(seen.r, seen.p_r)
        return _Solve(
            number=solve.number + 1,
            more=more | probing,
            rhs=jnp.where(probing, r_0, jnp.where(first, seen.a_r, change)),
            target=jnp.where(first, finest, target),
            last=tree_where(probing, solve.last, seen),
            step=end.step,
            status=seen.status,
            operator_norm=operator_norm,
            negative_curvature=end.negative_curvature,
        )

    zero, zeros, running = jnp.zeros_like(norm_g), jnp.zeros_like(b), jnp.array(RUNNING)
    start = _Solve(
        number=jnp.array(-1),
        more=jnp.array(True),
        rhs=zeros,
        target=zero,
        last=_Looks(zeros, zero, zeros, zeros, zeros, zeros, zeros, zero, running),
        step=jnp.array(0),
        status=running,
        operator_norm=zero,
        negative_curvature=jnp.array(False),
    )
    solve = lax.while_loop(lambda solve: solve.more, one_solve, start)

    seen = solve.last
    u, r, p_u, p_r, norm_a_r = seen.u, seen.r, seen.p_u, seen.p_r, seen.norm_a_r
    norm_r = norm(r, p_r)
    x = x_0 + p_u
    # With a preconditioner this is the lower bound of |x| by Cauchy and Schwarz, for x_0 is not
    # known in the form P u.
    size_x = jnp.sqrt(dot(x, x)) if p is None else over(jnp.abs(dot(x, b)), norm_b)
    size_x = jnp.maximum(size_x, norm(u, p_u))
    reach = solve.operator_norm * size_x + norm_b
    # The recomputed r has errors of this size, and A P r those times |A|.
    noise = ROUNDING_UNITS * rounding * reach

    ended = (solve.status == CONVERGED) | (solve.status == LEAST_SQUARES)
    within = norm_r <= _SLACK * target
    inconsistent = (
        ended
        & ~within
        & ((solve.number > 1) | (solve.status == LEAST_SQUARES))
        & (norm_r > noise)
        & (norm_a_r <= solve.operator_norm * (_SLACK * nearly_null * norm_r + noise))
    )
    stagnated = ended & ~within & ~inconsistent
    explained = norm_r <= hardly_solved * norm_b
    acceptable = explained & (norm_r <= jnp.maximum(rtol * reach, noise))
    # P r is a null vector, and the only one along which P u can have a part: u is in the span
    # of b, A P b, ..., of which only b has a part outside the range.
    lifted = x - over(dot(r, p_u), norm_r**2) * p_r
    x = jnp.where(inconsistent, lifted, x)

    result = lx.RESULTS.where(ended, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
    for where, what in (
        (stagnated & ~acceptable, lx.RESULTS.stagnation),
        (solve.status == BREAKDOWN, lx.RESULTS.breakdown),
        (solve.status == NONFINITE, lx.RESULTS.nonfinite_input),
    ):
        result = lx.RESULTS.where(where, what, result)
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
    """A power of two, because dividing by it costs no rounding; 1 for zero, inf and nan."""
    usable = jnp.isfinite(size) & (size > 0)
    _, exponent = jnp.frexp(jnp.where(usable, size, 1))
    return jnp.where(usable, jnp.ldexp(jnp.ones_like(size), exponent - 1), 1)


def _same_structure(x: PyTree[Any], y: PyTree[Any]) -> bool:
    """Whether trees, shapes and dtypes are equal; weak types do not count."""
    same = lambda a, b: a.shape == b.shape and a.dtype == b.dtype
    equal_trees = jtu.tree_structure(x) == jtu.tree_structure(y)
    return equal_trees and jtu.tree_all(jtu.tree_map(same, x, y))


def _first_guess(vector: PyTree[Array], options: dict[str, Any]) -> Float[Array, "n"]:
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
    """The preconditioner of `options`, checked and linearised; `None` if it would do nothing."""
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
