"""Newton minimisation by conjugate gradients, with a trust region for each vertex."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree
from optax import tree

from vertax._base.modules import choose
from vertax.solvers._bounded_step import bounded_step, gain
from vertax.solvers._rows import inner, number_of, row_inner, sizes, typical_size
from vertax.solvers._solver import AbstractSolver, Rows, value_and_gradient


class _NewtonState(eqx.Module):
    value: Float[Array, ""]
    gradient: PyTree[Float[Array, "..."]]
    radii: Rows
    tried: Rows
    """The regions of the last step, before they grew."""
    num_products: Int[Array, ""]
    force: Float[Array, ""]
    """What it typically was where the last step began; infinity before the first one."""
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

    How exactly a step is solved follows from what forces typically are (few large ones count little), and
    from how much the last step has lowered them (Eisenstat & Walker 1996, doi:10.1137/0917003).

    Soft motions follow curved valleys: a step along one climbs its side, and gains little or nothing. Such a
    step is corrected: a few products with the Hessian where it leads bring it back to the floor, and it is
    accepted for what it gains then (a second-order correction, Nocedal & Wright 2006, section 15.6). So is
    a step that leaves much of the forces, typically or (of 600 vertices and more) in few places: a correction
    is solved coarsely, and needs no look at the topology.
    It stays near, the nearer if the last one has gained nothing. While a step is cheap, as near rest, it is
    corrected until little is left.

    Where a step gains less energy than the model promised, the regions shrink of those vertices whose
    forces it did not foresee, and of no others; a step that gains nothing is tried again with them, if they
    are few: so one difficult place does not hold back a large tissue. What the error at a vertex does to the
    energy must matter, though: a vertex that hardly moves is not to blame for what its neighbours do. Where
    a step was good, small regions grow again, the faster the better it was foreseen, even those of vertices
    that moved little: damped too much, soft collective motions would not come out of it. What a correction
    has mended was good.

    **Arguments:**

    - `max_displacement`: about the furthest that one vertex moves in a step, in units of the length scale
        (in [`equilibrate`][vertax.equilibrate] the root mean cell area; otherwise 1).
    - `max_products`: most Hessian-vector products in one attempt at a step.
    """

    max_displacement: float = 0.2
    max_products: int = eqx.field(static=True, default=600)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _NewtonState:
        value, gradient, aux = value_and_gradient(fn, y, args)
        reach = self.max_displacement * options.get("length_scale", 1.0)
        radii = jax.tree.map(lambda x: jnp.full_like(sizes(x), reach), y)
        never = jnp.full_like(value, jnp.inf)
        return _NewtonState(value, gradient, radii, radii, jnp.array(0), never, aux)

    @property
    def evaluates_late(self) -> bool:
        return True

    def unevaluated(self, y: Any, options: Any, f_struct: Any, aux_struct: Any) -> _NewtonState:
        of_any_value = lambda y, args: (jnp.full(f_struct.shape, jnp.inf, f_struct.dtype), aux)
        aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct)
        state = self.init(of_any_value, y, None, options, f_struct, aux_struct, frozenset())
        return eqx.tree_at(lambda s: s.gradient, state, tree.full_like(y, jnp.inf))

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _NewtonState, tags: Any
    ) -> tuple[Any, _NewtonState, Any]:
        scale = options.get("length_scale", 1.0)
        reach = self.max_displacement * scale
        # Forces are measured in that which moves a vertex by the length scale. (That of most, lest few places
        # with large forces keep all others waiting.)
        unit = options.get("stiffness", 1.0) * scale
        n_rows = number_of(state.radii)
        few_products = min(self.max_products, _BRIEF)
        zero = tree.zeros_like(y)
        no, yes, none = jnp.array(False), jnp.array(True), jnp.array(0)

        def attempt(last: _Trial) -> _Trial:
            """Look where the last one has led, and judge that; and a step, or a correction, from here."""
            gradient, hessian, (value, aux) = jax.linearize(force_and_value, last.y, has_aux=True)
            here = _Point(last.y, value, gradient, aux, last.foreseen, last.shift)
            origin = choose(last.begins, (value, gradient, aux), last.origin)
            initial, g, _ = origin
            force = typical_size(g)
            finest = jnp.sqrt(_TYPICAL * force / unit)
            near = finest < _COARSEST
            # Where forces do not fall as they would near a minimum, exact steps are of no use (the second
            # choice of Eisenstat & Walker).
            before = jnp.where(state.force > 0, state.force, jnp.inf)
            useful = jnp.minimum(_ROUGH, _USEFUL * (force / before) ** 2)
            forcing = jnp.minimum(_COARSEST, jnp.maximum(finest, useful))

            first, arrived = ~last.corrects, last.arrives
            better = arrived & (first | (_finite(value, gradient) & (value < last.best.value)))
            best = choose(better, here, last.best)
            p, hp, there = last.step
            step = (p, hp, choose(arrived & first, gradient, there))

            # Near equilibrium the gain drowns in the rounding of E; there a step is good if it lowers the
            # force.
            predicted = last.predicted
            lost = jnp.abs(predicted) <= _rounding(best.value, unit * scale)
            gained, finite = initial - best.value, _finite(best.value, best.gradient)
            ratio = gained / jnp.where(predicted > 0, predicted, 1)
            squared, initial_squared = inner(best.gradient, best.gradient), inner(g, g)
            accepted = arrived & finite & jnp.where(lost, squared < initial_squared, ratio > 1e-4)
            fine = accepted & (lost | (ratio > 0.75))
            cheap = (last.products < _CHEAP) & (n_rows >= _MANY)
            left = typical_size(best.gradient) > jnp.where(cheap, _LITTLE, _LEFT) * force
            # (In large tissues few large forces are not typical, and few products lower them.)
            left |= (squared > _LEFT**2 * initial_squared) & (n_rows >= _LARGE)
            wanting = near & finite & ~lost & ((gained < _FINE * predicted) | left)
            corrections = last.corrections + (arrived & ~first)
            corrects = arrived & wanting & (corrections < _CORRECTIONS)
            narrower = jnp.where(better, 1, _NARROWER) * last.room
            room = jnp.where(arrived, jnp.where(first, _NARROW, narrower), last.room)

            # What a correction has not mended is to be blamed on the step.
            corrected = (tree.sub(best.y, y), tree.sub(best.foreseen, g), best.gradient)
            p, hp, there = choose(fine, corrected, step)
            missing = tree.sub(tree.sub(there, g), hp)
            errors = jax.tree.map(_relative, missing, g, hp)
            # What each row may be wrong about the energy, on average.
            due = jnp.maximum(predicted, 0) / n_rows
            harmless = lambda missing, p: 0.5 * jnp.abs(row_inner(missing, p)) < due
            foreseen = jax.tree.map(
                lambda error, *row: (error < 0.25) | harmless(*row), errors, missing, p
            )
            blamed = n_rows - sum(jnp.sum(rows) for rows in jax.tree.leaves(foreseen))
            retries = arrived & ~accepted & ~corrects & (blamed > 0) & (blamed < _FEW * n_rows)
            retries &= last.refusals < _RETRIES

            def adapted(
                radius: Array, step: Array, error: Array, foreseen: Array
            ) -> Float[Array, " rows"]:
                length = sizes(step)
                shrunk = jnp.maximum(0.25 * radius, jnp.minimum(0.5 * length, radius))
                # (A step without end has no length.)
                shrunk = jnp.where(accepted, shrunk, 0.25 * jnp.fmin(length, radius))
                grows = accepted & (fine | foreseen) & (length > 0.3 * radius)
                grows |= fine & foreseen & (radius < reach)
                # An error grows with the length of the step.
                larger = jnp.clip(_SMALL / error, 2, _MOST) * radius
                larger = jnp.minimum(larger, jnp.maximum(2 * radius, reach))
                # If there is no other attempt, those that were foreseen are to blame as well, if less.
                kept = jnp.where(accepted | retries, radius, 0.5 * radius)
                blamed = ~foreseen & (~accepted | (error > 0.75)) & ~fine
                kept = jnp.where(blamed, shrunk, kept)
                return jnp.maximum(jnp.where(grows, larger, kept), _LEAST * reach)

            radii = jax.tree.map(adapted, last.radii, p, errors, foreseen)
            radii = choose(arrived & ~corrects, radii, last.radii)

            # (From what is not a number no step leads away.)
            stays = last.begins & ~(self.norm(gradient) >= options.get("stays_below", 0.0))
            # A step is tried again from where it began, and as the step that it was; a correction that has
            # gained nothing, from the point before it. The Hessian here is that of neither: back there first.
            solves = jnp.where(arrived, corrects & better, ~stays)
            corrects = jnp.where(arrived, corrects, last.corrects)
            refusals = last.refusals + retries
            resumes = ~corrects & (refusals > 0)
            bound = room * reach
            damping = lambda g, radius: sizes(g) / radius
            solution = bounded_step(
                hessian,
                gradient,
                choose(last.begins, jax.tree.map(damping, g, radii), last.shift),
                jax.tree.map(lambda radius: jnp.minimum(radius, bound), radii),
                start=choose(resumes, step[:2], (zero, zero)),
                resumes=resumes,
                forcing=jnp.where(corrects, _LOOSE, forcing),
                helped=~corrects & ~resumes & near,
                max_products=jnp.where(corrects, few_products, self.max_products),
                options=options,
                active=solves,
            )
            tighter = lambda shift, g, radius: jnp.maximum(shift, damping(g, radius))
            back = choose(
                retries,
                (y, jax.tree.map(tighter, best.shift, g, radii)),
                (best.y, best.shift),
            )
            ahead = (tree.add(last.y, solution.p), solution.shift)
            there, shift = choose(solves, ahead, back)
            steps = solves & ~corrects
            return _Trial(
                y=there,
                foreseen=tree.add(gradient, solution.hp),
                shift=shift,
                origin=origin,
                best=best,
                step=(*choose(steps, (solution.p, solution.hp), step[:2]), step[2]),
                radii=radii,
                predicted=jnp.where(steps, gain(gradient, solution.p, solution.hp), predicted),
                products=last.products + jnp.where(solves, solution.k, 0),
                corrections=jnp.where(retries, 0, corrections),
                refusals=refusals,
                corrects=corrects,
                room=jnp.where(retries, 1, room),
                begins=no,
                arrives=solves,
                again=solves | (arrived & corrects) | retries,
                accepted=accepted,
            )

        def force_and_value(y: PyTree) -> tuple[PyTree, tuple[Array, PyTree]]:
            value, gradient, aux = value_and_gradient(fn, y, args)
            return gradient, (value, aux)

        unknown = (state.value, state.gradient, state.aux)
        begin = _Trial(
            y=y,
            foreseen=zero,
            shift=state.radii,
            origin=unknown,
            best=_Point(y, *unknown, zero, state.radii),
            step=(zero, zero, zero),
            radii=state.radii,
            predicted=jnp.zeros_like(state.value),
            products=none,
            corrections=none,
            refusals=none,
            corrects=no,
            room=jnp.ones_like(state.value),
            begins=yes,
            arrives=no,
            again=yes,
            accepted=no,
        )
        end = jax.lax.while_loop(lambda trial: trial.again, attempt, begin)
        # Where nothing can move any more, a fresh start may find another way.
        collapsed = jnp.asarray(tree.max(end.radii)) < _COLLAPSED * reach
        radii = jax.tree.map(lambda radius: jnp.where(collapsed, reach, radius), end.radii)
        best = (end.best.y, end.best.value, end.best.gradient, end.best.aux)
        y, value, gradient, aux = choose(end.accepted, best, (y, *end.origin))
        products = state.num_products + end.products
        force = typical_size(end.origin[1])
        return y, _NewtonState(value, gradient, radii, state.radii, products, force, aux), aux

    def resumed(
        self, fresh: _NewtonState, old: _NewtonState, share: Rows, flipped: Bool[Array, ""]
    ) -> _NewtonState:
        # Where it was cut short the regions are smaller than before, whatever the model says, lest the same
        # step be refused for ever; or as at first, if no short step helps. Elsewhere they are as good as they
        # were.
        def kept_short(radius: Array, tried: Array, whole: Array, share: Array) -> Array:
            less = 0.25 * jnp.minimum(radius, tried)
            less = jnp.where(less < _SHORTEST * whole, whole, less)
            return jnp.where(share < 1, less, radius)

        radii = jax.tree.map(kept_short, old.radii, old.tried, fresh.radii, share)
        kept = lambda s: (s.num_products, s.force)
        return eqx.tree_at(lambda s: (s.radii, *kept(s)), fresh, (radii, *kept(old)))

    def gradient(self, state: _NewtonState) -> PyTree[Float[Array, "..."]]:
        return state.gradient


class _Point(NamedTuple):
    """Where a step may end."""

    y: PyTree[Array]
    value: Float[Array, ""]
    gradient: PyTree[Array]
    aux: PyTree
    foreseen: PyTree[Array]
    """The gradient that the model had there."""
    shift: Rows


class _Trial(NamedTuple):
    """Where an attempt at a step leads."""

    y: PyTree[Array]
    """Where to look next."""
    foreseen: PyTree[Array]
    shift: Rows
    origin: tuple[Float[Array, ""], PyTree[Array], PyTree]
    """Value, gradient and auxiliary output where it began."""
    best: _Point
    """The step, or what the corrections have made of it so far."""
    step: tuple[PyTree[Array], PyTree[Array], PyTree[Array]]
    """The step itself, what it should do to the gradient, and the gradient where it leads."""
    radii: Rows
    predicted: Float[Array, ""]
    """The gain of the step itself."""
    products: Int[Array, ""]
    corrections: Int[Array, ""]
    refusals: Int[Array, ""]
    corrects: Bool[Array, ""]
    """Whether what led there, or is to be done there, is a correction."""
    room: Float[Array, ""]
    """How far the next attempt may go, in units of the furthest that a vertex may."""
    begins: Bool[Array, ""]
    arrives: Bool[Array, ""]
    """Whether a step or a correction leads there, and not the way back."""
    again: Bool[Array, ""]
    accepted: Bool[Array, ""]


# How near forces are to those at rest is their typical size so many times: their norm for a hundred cells.
_TYPICAL = 14.0
# How far conjugate gradients go at least.
_COARSEST = 0.35
# How far they go where the last step has not brought the force down by much more.
_ROUGH = 0.1
_USEFUL = 0.9
# A step is corrected that gains less than this share of what it should, or leaves more than that of the
# typical force (or, from so many vertices on, of the norm of all);
_FINE = 0.9
_LEFT = 0.4
_LARGE = 600
# or, while it has taken fewer products than these, more than that of the typical force, where there are so
# many vertices;
_CHEAP = 30
_LITTLE = 0.1
_MANY = 16
# so many times at most, so well, by no more products than that.
_CORRECTIONS = 12
_LOOSE = 0.3
_BRIEF = 60
# A correction goes no further than this share of what steps may; after one that gains nothing, of that.
_NARROW = 0.3
_NARROWER = 0.1
# A step that gains nothing is tried again so often, if less than this share of the vertices are to blame.
_RETRIES = 3
_FEW = 0.02
# A region grows until the error that is expected there is this, so many times at most.
_SMALL = 0.1
_MOST = 16
# No region is smaller than this, and if none is larger than that nothing moves; in units of the largest.
_LEAST = 1e-6
_COLLAPSED = 1e-5
# One that was cut short so often that it is smaller than this, in units of the first one, begins anew.
_SHORTEST = 1e-3


def _relative(missing: Array, old: Array, change: Array) -> Float[Array, " rows"]:
    """How far forces are from what the model said."""
    scale = jnp.maximum(sizes(old), sizes(change))
    return sizes(missing) / jnp.where(scale > 0, scale, 1)


def _finite(value: Float[Array, ""], gradient: PyTree[Array]) -> Bool[Array, ""]:
    return jnp.isfinite(value) & jnp.isfinite(inner(gradient, gradient))


def _rounding(value: Float[Array, ""], unit: Float[Array, ""] | float) -> Float[Array, ""]:
    """How well an energy is known, in a material with this unit of energy.

    A sum of squares may be far less than the unit: what is squared is a difference of lengths, then, and has
    their rounding.
    """
    size = jnp.abs(value)
    return 20 * jnp.finfo(value.dtype).eps * jnp.maximum(size, jnp.sqrt(size * unit))
