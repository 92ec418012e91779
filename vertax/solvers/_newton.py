"""Newton minimisation by conjugate gradients, with a trust region for each vertex."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree
from optax import tree

from vertax._base.modules import choose
from vertax._base.sums import total
from vertax.solvers._long_waves import LongWaves, Medium
from vertax.solvers._solver import AbstractSolver, Rows, value_and_gradient


class _NewtonState(eqx.Module):
    value: Float[Array, ""]
    gradient: PyTree[Float[Array, "..."]]
    radii: Rows
    num_products: Int[Array, ""]
    aux: PyTree


class NewtonCG(AbstractSolver):
    r"""Newton's method, each step by conjugate gradients, with a trust region for each vertex.

    A step minimises the quadratic model $g \cdot p + \tfrac12 p \cdot (H + \Lambda) p$ with
    Hessian-vector products only. $\Lambda$ is diagonal, one number for each vertex: $|g_v| / \Delta_v$,
    so that no vertex means to leave its region of radius $\Delta_v$ (and more where one still does), and
    more where the Hessian has negative curvature, so that the model is convex. Near equilibrium it
    vanishes with the force, and convergence is quadratic: the way to a *true* equilibrium. What would still
    go beyond twice its region is cut back to that, and nothing else. (Steihaug 1983,
    doi:10.1137/0720042; Nocedal & Wright 2006, alg. 4.1 and 7.2, doi:10.1007/978-0-387-40065-5.)

    Soft motions follow curved valleys: a step along one climbs its side, and gains little or nothing. Such a
    step is corrected: a few products with the Hessian where it leads bring it back to the floor, and it is
    accepted for what it gains then (a second-order correction, Nocedal & Wright 2006, section 15.6).

    Where a step gains less energy than the model promised, the regions shrink of those vertices whose
    forces it did not foresee, and of no others: so one difficult place does not hold back a large tissue.
    What the error at a vertex does to the energy must matter, though: a vertex that hardly moves is not to
    blame for what its neighbours do. Where a step was good, small regions grow again, even of vertices that
    moved little: damped too much, soft collective motions would not come out of it. What a correction has
    mended was good.

    **Arguments:**

    - `max_displacement`: about the furthest that one vertex moves in a step, in units of the length scale
        (in [`equilibrate`][vertax.equilibrate] the root mean cell area; otherwise 1).
    - `max_products`: most Hessian-vector products in one step, and in each correction.
    """

    max_displacement: float = 0.2
    max_products: int = eqx.field(static=True, default=600)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _NewtonState:
        value, gradient, aux = value_and_gradient(fn, y, args)
        reach = self.max_displacement * options.get("length_scale", 1.0)
        radii = jax.tree.map(lambda x: jnp.full_like(_size(x), reach), y)
        return _NewtonState(value, gradient, radii, jnp.array(0), aux)

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _NewtonState, tags: Any
    ) -> tuple[Any, _NewtonState, Any]:
        reach = self.max_displacement * options.get("length_scale", 1.0)
        bounds = jax.tree.map(lambda radius: jnp.minimum(radius, reach), state.radii)
        # Forces are measured in that which moves a vertex by the length scale.
        force = options.get("stiffness", 1.0) * options.get("length_scale", 1.0)
        g = state.gradient
        forcing = jnp.minimum(_COARSEST, jnp.sqrt(tree.norm(g) / force))
        near = forcing < _COARSEST

        def attempt(last: _Trial) -> _Trial:
            """A step, or the correction of one."""
            first = last.tries == 0
            _, hessian = jax.linearize(lambda x: value_and_gradient(fn, x, args)[1], last.y)
            tolerance = jnp.where(first, forcing, _LOOSE)
            solution = self._conjugate_gradients(
                hessian, last.gradient, last.shift, bounds, tolerance, first & near, options
            )
            p, hp = solution.p, solution.hp
            predicted = -(_dot(last.gradient, p) + 0.5 * _dot(p, hp))
            y = tree.add(last.y, p)
            value, gradient, aux = value_and_gradient(fn, y, args)
            finite = jnp.isfinite(value) & jnp.isfinite(_dot(gradient, gradient))
            better = first | (finite & (value < last.value))
            predicted = jnp.where(first, predicted, last.predicted)
            wanting = state.value - value < _FINE * predicted
            again = near & finite & better & wanting & (predicted > _rounding(value))
            there = _Trial(
                y,
                value,
                gradient,
                aux,
                foreseen=tree.add(last.gradient, hp),
                shift=solution.shift,
                predicted=predicted,
                products=last.products + solution.k,
                tries=last.tries + 1,
                again=again & (last.tries < _CORRECTIONS),
                uncorrected=choose(first, (p, hp, gradient), last.uncorrected),
            )
            same = last._replace(products=there.products, tries=there.tries, again=jnp.array(False))
            return choose(better, there, same)

        shift = jax.tree.map(lambda g, radius: _size(g) / radius, g, state.radii)
        begin = (y, state.value, g, state.aux, g, shift, jnp.zeros_like(state.value))
        none, yes = jnp.array(0), jnp.array(True)
        trial = _Trial(*begin, products=none, tries=none, again=yes, uncorrected=(y, g, g))
        trial = jax.lax.while_loop(lambda trial: trial.again, attempt, trial)
        value, gradient, predicted = trial.value, trial.gradient, trial.predicted
        actual = state.value - value
        # Near equilibrium the gain drowns in the rounding of E; there a step is good if it lowers the
        # force.
        lost = predicted <= _rounding(value)
        lower_force = _dot(gradient, gradient) < _dot(g, g)
        ratio = actual / jnp.where(predicted > 0, predicted, 1)
        finite = jnp.isfinite(value) & jnp.isfinite(_dot(gradient, gradient))
        accept = finite & jnp.where(lost, lower_force, ratio > 1e-4)

        fine = accept & (lost | (ratio > 0.75))
        # What a correction has not mended is to be blamed on the step.
        corrected = (tree.sub(trial.y, y), tree.sub(trial.foreseen, g), gradient)
        moved = choose(fine, corrected, trial.uncorrected)
        # What each row may be wrong about the energy, on average.
        due = jnp.maximum(predicted, 0) / sum(r.shape[0] for r in jax.tree.leaves(state.radii))

        def adapted(
            radius: Array, old: Array, step: Array, change: Array, new: Array
        ) -> Float[Array, " rows"]:
            scale, length = jnp.maximum(_size(old), _size(change)), _size(step)
            # How far the force is from what the model said, and who is to blame if a step is no good.
            missing = new - old - change
            error = _size(missing) / jnp.where(scale > 0, scale, 1)
            harmless = 0.5 * jnp.abs(_row_dot(missing, step)) < due
            foreseen = (error < 0.25) | harmless
            blamed = ~foreseen & (~accept | (error > 0.75))
            shrunk = jnp.maximum(0.25 * radius, jnp.minimum(0.5 * length, radius))
            shrunk = jnp.where(accept, shrunk, 0.25 * radius)
            grows = accept & (fine | foreseen) & (length > 0.3 * radius)
            grows |= fine & foreseen & (radius < reach)
            # Of a refused step those that were foreseen are to blame as well, if less.
            kept = jnp.where(accept, radius, 0.5 * radius)
            kept = jnp.where(blamed & ~fine, shrunk, kept)
            # (Smaller than rounding makes no sense, and would end in numbers without digits.)
            return jnp.maximum(
                jnp.where(grows, 2 * radius, kept), jnp.finfo(kept.dtype).eps * reach
            )

        radii = jax.tree.map(adapted, state.radii, g, *moved)
        # Where nothing can move any more, a fresh start may find another way.
        collapsed = jnp.asarray(tree.max(radii)) < _COLLAPSED * reach
        radii = jax.tree.map(lambda radius: jnp.where(collapsed, reach, radius), radii)
        kept = (y, state.value, g, state.aux)
        y, value, g, aux = choose(accept, (trial.y, value, gradient, trial.aux), kept)
        return y, _NewtonState(value, g, radii, state.num_products + trial.products, aux), aux

    def resumed(
        self, fresh: _NewtonState, old: _NewtonState, share: Rows, flipped: Bool[Array, ""]
    ) -> _NewtonState:
        # Elsewhere the regions are as good as they were.
        radii = jax.tree.map(lambda r, s: jnp.where(s < 1, 0.25 * r, r), old.radii, share)
        return eqx.tree_at(lambda s: (s.radii, s.num_products), fresh, (radii, old.num_products))

    def gradient(self, state: _NewtonState) -> PyTree[Float[Array, "..."]]:
        return state.gradient

    def _conjugate_gradients(
        self,
        hessian: Any,
        g: PyTree,
        shift: Rows,
        bounds: Rows,
        forcing: Float[Array, ""],
        waving: Bool[Array, ""],
        options: dict[str, Any],
    ) -> _System:
        """A step `p`, `H p`, and the damping with which it is solved.

        **Arguments:**

        - `shift`: the damping to begin with.
        - `bounds`: about how far each vertex may go.
        - `forcing`: the residual to come to, in units of the first one.
        - `waving`: whether long waves precondition it.
        """
        stiffness = options.get("stiffness", 1.0)
        zero = tree.zeros_like(g)
        # Far from rest steps are short, and what is soft may have negative curvature.
        waves = _Waves.of(options, hessian, g, waving)

        def preconditioned(r: PyTree, shift: Rows) -> PyTree:
            near = jax.tree.map(lambda r, s: _times(1 / (stiffness + s), r), r, shift)
            return near if waves is None else waves.added(near, r, shift)

        def unfinished(system: _System) -> Bool[Array, ""]:
            return ~system.done & (system.cuts | (system.k < self.max_products))

        def solved(system: _System) -> _System:
            """A system solved, or so far that it needs another shift."""
            shift, cuts = system.shift, system.cuts
            left = lambda g, h, s, p: g + h + _times(s, p)
            r = jax.tree.map(left, g, system.hp, shift, system.p)
            z = preconditioned(r, shift)
            rz = _dot(r, z)
            whole = jnp.where(system.k == 0, rz, system.whole)
            nothing_left = (system.k == 0) & (rz <= 0)

            def proceed(last: _Directions) -> Bool[Array, ""]:
                going = last.convex & ~last.small & ~last.far
                return going & ~nothing_left & (cuts | (last.k < self.max_products))

            def iterate(last: _Directions) -> _Directions:
                d = tree.sub(tree.scale(last.beta, last.d), last.z)
                hd = hessian(d)
                damped = jax.tree.map(lambda hd, s, d: hd + _times(s, d), hd, shift, d)
                curvature = _dot(d, damped)
                convex = cuts | (curvature > 0)
                alpha = jnp.where(convex, last.rz / jnp.where(convex, curvature, 1), 0)
                alpha = jnp.where(cuts, 1, alpha)
                r = tree.add_scale(last.r, alpha, damped)
                z = preconditioned(r, shift)
                rz = _dot(r, z)
                small = cuts | (convex & (rz <= forcing**2 * whole))
                # Once it is solved: what goes too far is damped more.
                furthest = _furthest(tree.add_scale(last.p, alpha, d), bounds)
                far = ~cuts & (furthest > jnp.where(small, 1.5, _FURTHEST))
                # (Where there is hardly any curvature it may be far too far: it goes on from the limit.)
                room = (_FURTHEST - last.furthest) / (furthest - last.furthest)
                alpha *= jnp.where(far & (furthest > _FURTHEST), room, 1)
                p = tree.add_scale(last.p, alpha, d)
                hp = tree.add_scale(last.hp, alpha, hd)
                beta = rz / last.rz
                k = last.k + 1
                return _Directions(p, hp, r, z, rz, beta, d, hd, furthest, convex, small, far, k)

            yes, no = jnp.array(True), jnp.array(False)
            # A cut is a step back, to what no vertex goes beyond: so there is but one product to compile.
            back = jax.tree.map(_cut, system.p, bounds)
            d, z = choose(cuts, (back, zero), (zero, z))
            begin = (system.p, system.hp, r, z, rz, jnp.where(cuts, jnp.ones_like(rz), 0), d, zero)
            begin += (_furthest(system.p, bounds),)
            end = _Directions(*begin, convex=yes, small=no, far=no, k=system.k)
            end = jax.lax.while_loop(proceed, iterate, end)

            # That is a new system, which goes on from here, as does one that is made convex.
            typical = jnp.abs(_dot(g, end.p)) / _dot(end.p, end.p)

            def tighter(
                shift: Array, p: Array, bound: Array, d: Array, hd: Array
            ) -> Float[Array, " rows"]:
                more = jnp.maximum(_size(p) / bound - 1, 0) * (shift + typical)
                along, squared = _row_dot(d, hd), _row_dot(d, d)
                concave = jnp.where(along < 0, -2 * along / jnp.where(squared > 0, squared, 1), 0)
                return shift + jnp.where(end.convex, jnp.where(end.far, more, 0), concave)

            shift = jax.tree.map(tighter, shift, end.p, bounds, end.d, end.hd)
            # (Not for ever: then what goes too far is cut.)
            done = nothing_left | jnp.where(end.far, system.rounds >= _ROUNDS, end.small)
            # Vertices may go somewhat further than they should, but none by much.
            over = ~cuts & (end.furthest > _OVER) & (done | (end.k >= self.max_products))
            rounds = system.rounds + end.far
            return _System(end.p, end.hp, shift, rounds, done & ~over, end.k, whole, over)

        nothing = jnp.array(0)
        unknown = jnp.zeros_like(forcing)
        no = jnp.array(False)
        start = _System(zero, zero, shift, nothing, no, nothing, unknown, no)
        return jax.lax.while_loop(unfinished, solved, start)


class _Trial(NamedTuple):
    """Where a step leads, corrected so many times."""

    y: PyTree[Array]
    value: Float[Array, ""]
    gradient: PyTree[Array]
    aux: PyTree
    foreseen: PyTree[Array]
    """The gradient that the model had there."""
    shift: Rows
    predicted: Float[Array, ""]
    """The gain of the step itself."""
    products: Int[Array, ""]
    tries: Int[Array, ""]
    again: Bool[Array, ""]
    uncorrected: tuple[PyTree[Array], PyTree[Array], PyTree[Array]]
    """The step itself, what it should do to the gradient, and the gradient where it leads."""


class _System(NamedTuple):
    """How far the step is, and the damping `shift` with which it goes on."""

    p: PyTree[Array]
    hp: PyTree[Array]
    shift: Rows
    rounds: Int[Array, ""]
    done: Bool[Array, ""]
    k: Int[Array, ""]
    whole: Float[Array, ""]
    cuts: Bool[Array, ""]
    """Whether all that is left to do is to cut what goes too far."""


class _Directions(NamedTuple):
    """Conjugate gradients for one system."""

    p: PyTree[Array]
    hp: PyTree[Array]
    r: PyTree[Array]
    z: PyTree[Array]
    rz: Float[Array, ""]
    beta: Float[Array, ""]
    d: PyTree[Array]
    """The last direction,"""
    hd: PyTree[Array]
    """and its product with the Hessian."""
    furthest: Float[Array, ""]
    convex: Bool[Array, ""]
    small: Bool[Array, ""]
    far: Bool[Array, ""]
    k: Int[Array, ""]


_ROUNDS = 8
# How far a step may go before it is solved, in units of the bounds.
_FURTHEST = 4.0
# Further no vertex goes in the end.
_OVER = 2.0
# If no region is larger than this, in units of the largest, nothing moves.
_COLLAPSED = 1e-5
# How far conjugate gradients go at least.
_COARSEST = 0.35
# A step that gains less than this share of what it should is corrected, so many times at most, so well.
_FINE = 0.9
_CORRECTIONS = 3
_LOOSE = 0.3


class _Waves(eqx.Module):
    """The long waves of a large tissue, where they are of use."""

    medium: Medium
    stiffness: Float[Array, ""]
    used: Bool[Array, ""]

    @classmethod
    def of(
        cls, options: dict[str, Any], hessian: Any, like: PyTree, used: Bool[Array, ""]
    ) -> _Waves | None:
        waves: LongWaves | None = options.get("long_waves")
        if waves is None:
            return None
        stiffness = options["stiffness"]
        fitted = lambda: waves.fitted(hessian, like, stiffness)
        nothing = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), eqx.filter_eval_shape(fitted))
        return cls(jax.lax.cond(used, fitted, lambda: nothing), stiffness, used)

    def added(self, near: PyTree, r: PyTree, shift: Rows) -> PyTree:
        """A residual that was preconditioned near by, and its long waves."""
        # A place that is held tightly must not hold all others, nor drag them along.
        damping = jax.tree.leaves(shift)[0]
        held = jnp.mean(jnp.minimum(damping, self.stiffness))
        share = self.stiffness / (self.stiffness + damping)
        return jax.lax.cond(
            self.used, lambda: self.medium.added(near, r, held, share), lambda: near
        )


def _rounding(value: Float[Array, ""]) -> Float[Array, ""]:
    return 20 * jnp.finfo(value.dtype).eps * jnp.abs(value)


def _dot(a: PyTree, b: PyTree) -> Float[Array, ""]:
    return jnp.asarray(tree.vdot(a, b))


def _row_dot(a: Float[Array, "rows ..."], b: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    columns = (x.reshape(len(x), -1).T for x in (a, b))
    return total(x * y for x, y in zip(*columns, strict=True))


def _furthest(p: PyTree, bounds: Rows) -> Float[Array, ""]:
    """How far a step goes where it goes furthest, in units of the bounds there."""
    return jnp.asarray(tree.max(jax.tree.map(lambda p, b: _size(p) / b, p, bounds)))


def _cut(p: Float[Array, "rows ..."], bound: Float[Array, " rows"]) -> Float[Array, "rows ..."]:
    """From a step back to one that goes nowhere beyond its bounds by much."""
    size = _size(p)
    share = jnp.minimum(1, _OVER * bound / jnp.where(size > 0, size, 1))
    return _times(share - 1, p)


def _size(x: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    return jnp.sqrt(_row_dot(x, x))


def _times(rows: Float[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    return rows.reshape(rows.shape + (1,) * (x.ndim - rows.ndim)) * x
