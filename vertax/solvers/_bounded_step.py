"""A step of Newton's method within bounds: conjugate gradients, damped where they go too far."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree
from optax import tree

from vertax._base.modules import choose
from vertax.solvers._edge_blocks import EdgeBlocks
from vertax.solvers._known_hessian import KnownHessian
from vertax.solvers._long_waves import LongWaves
from vertax.solvers._rows import inner, row_inner, sizes, times
from vertax.solvers._solver import Rows


class System(NamedTuple):
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


def bounded_step(
    hessian: Callable[[PyTree], PyTree],
    g: PyTree,
    shift: Rows,
    bounds: Rows,
    *,
    start: tuple[PyTree, PyTree],
    resumes: Bool[Array, ""],
    forcing: Float[Array, ""],
    helped: Bool[Array, ""],
    max_products: int | Int[Array, ""],
    options: dict[str, Any],
    active: Bool[Array, ""] | bool = True,
) -> System:
    """A step that goes downhill, and nowhere much beyond its bounds.

    **Arguments:**

    - `hessian`: multiplies by it.
    - `g`: the gradient.
    - `shift`: the damping to begin with.
    - `bounds`: about how far each row may go.
    - `start`: the step to begin with, and its product with the Hessian.
    - `resumes`: whether that is more than nothing, and may go too far.
    - `forcing`: the residual to come to, in units of the first one.
    - `helped`: whether it is preconditioned by what is known of collective motions: the long waves of a
        large tissue, or the Hessian of an equilibrium near by.
    - `max_products`: most products with the Hessian.
    - `options`: of the minimiser: typical sizes, and what preconditions it.
    - `active`: whether to do anything at all.
    """
    stiffness = options.get("stiffness", 1.0)
    blocks: EdgeBlocks | None = options.get("edge_blocks")
    collective: LongWaves | KnownHessian | None = options.get("collective")
    zero = tree.zeros_like(g)
    medium: Any = None
    if collective is not None:
        # Far from rest steps are short, and what is soft may have negative curvature.
        helped &= collective.ready
        measure = lambda: collective.measured(hessian, g, stiffness)
        medium = jax.lax.cond(helped & active, measure, lambda: collective.unmeasured)

    def preconditioner(shift: Rows) -> Callable[[PyTree], PyTree]:
        yielding = jax.tree.map(lambda s: 1 / (stiffness + s), shift)
        near = lambda r: jax.tree.map(times, yielding, r)
        if blocks is not None:
            near = blocks.compliance(jax.tree.leaves(shift)[0])
        if collective is None:
            return near
        # A place that is held tightly must not hold all others, nor drag them along.
        held = jnp.mean(jnp.minimum(jax.tree.leaves(shift)[0], stiffness))
        shares = jax.tree.map(lambda y: stiffness * y, yielding)
        yields = collective.compliance(medium, held, shares)

        def both(r: PyTree) -> PyTree:
            z = near(r)
            return jax.lax.cond(helped, lambda: yields.added(z, r), lambda: z)

        return both

    def unfinished(system: System) -> Bool[Array, ""]:
        return ~system.done & (system.cuts | (system.k < max_products))

    def solved(system: System) -> System:
        """A system solved, or so far that it needs another shift."""
        shift, cuts = system.shift, system.cuts
        # A step that goes on from another one is cut first, and solved then.
        cut_first = system.rounds < 0
        left = lambda g, h, s, p: g + h + times(s, p)
        r = jax.tree.map(left, g, system.hp, shift, system.p)
        preconditioned = preconditioner(shift)
        z = preconditioned(r)
        rz = inner(r, z)
        whole = jnp.where(system.k == 0, rz, system.whole)
        nothing_left = (system.k == 0) & (rz <= 0)

        def proceed(last: _Directions) -> Bool[Array, ""]:
            going = last.convex & ~last.small & ~last.far
            return going & ~nothing_left & (cuts | (last.k < max_products))

        def iterate(last: _Directions) -> _Directions:
            d = tree.sub(tree.scale(last.beta, last.d), last.z)
            hd = hessian(d)
            damped = jax.tree.map(lambda hd, s, d: hd + times(s, d), hd, shift, d)
            curvature = inner(d, damped)
            convex = cuts | (curvature > 0)
            alpha = jnp.where(convex, last.rz / jnp.where(convex, curvature, 1), 0)
            alpha = jnp.where(cuts, 1, alpha)
            r = tree.add_scale(last.r, alpha, damped)
            z = preconditioned(r)
            rz = inner(r, z)
            small = cuts | (convex & (rz <= forcing**2 * whole))
            # Once it is solved: what goes too far is damped more.
            furthest = _furthest(tree.add_scale(last.p, alpha, d), bounds)
            far = ~cuts & convex & (furthest > jnp.where(small, 1.5, _FURTHEST))
            # (Where there is hardly any curvature it may be far too far: it goes on from the limit.)
            room, gone = _FURTHEST - last.furthest, furthest - last.furthest
            room = jnp.clip(room / jnp.where(gone > 0, gone, 1), 0, 1)
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
        furthest = _furthest(system.p, bounds)
        end = _Directions(*begin, furthest, convex=yes, small=no, far=no, k=system.k)
        end = jax.lax.while_loop(proceed, iterate, end)
        # (A cut must not tear what is stiff, or nothing is gained: then the whole step is shortened.)
        share = jnp.minimum(1, _OVER / jnp.where(furthest > 0, furthest, 1))
        shortened = tree.scale(share, system.p), tree.scale(share, system.hp)
        torn = cuts & ~cut_first & (gain(g, end.p, end.hp) < gain(g, *shortened))
        p, hp = choose(torn, shortened, (end.p, end.hp))
        end = end._replace(p=p, hp=hp)

        # That is a new system, which goes on from here, as does one that is made convex.
        typical = jnp.abs(inner(g, end.p)) / inner(end.p, end.p)

        def tighter(
            shift: Array, p: Array, bound: Array, d: Array, hd: Array
        ) -> Float[Array, " rows"]:
            more = jnp.maximum(sizes(p) / bound - 1, 0) * (shift + typical)
            along, squared = row_inner(d, hd), row_inner(d, d)
            concave = jnp.where(along < 0, -2 * along / jnp.where(squared > 0, squared, 1), 0)
            return shift + jnp.where(end.convex, jnp.where(end.far, more, 0), concave)

        shift = jax.tree.map(tighter, shift, end.p, bounds, end.d, end.hd)
        # (Not for ever: then what goes too far is cut.)
        done = nothing_left | jnp.where(end.far, system.rounds >= _ROUNDS, end.small)
        # Vertices may go somewhat further than they should, but none by much.
        over = ~cuts & (end.furthest > _OVER) & (done | (end.k >= max_products))
        rounds = system.rounds + (end.far | cut_first)
        return System(end.p, end.hp, shift, rounds, done & ~over & ~cut_first, end.k, whole, over)

    rounds, done = jnp.where(resumes, -1, 0), jnp.logical_not(active)
    unknown = jnp.zeros_like(forcing)
    begin = System(*start, shift, rounds, done, jnp.array(0), unknown, resumes)
    return jax.lax.while_loop(unfinished, solved, begin)


# So often what goes too far is damped more; then it is cut.
_ROUNDS = 8
# How far a step may go before it is solved, in units of the bounds.
_FURTHEST = 4.0
# Further no vertex goes in the end.
_OVER = 2.0


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


def gain(g: PyTree, p: PyTree, hp: PyTree) -> Float[Array, ""]:
    """The energy that a step gains in the quadratic model, from its product with the Hessian."""
    return -(inner(g, p) + 0.5 * inner(p, hp))


def _furthest(p: PyTree, bounds: Rows) -> Float[Array, ""]:
    """How far a step goes where it goes furthest, in units of the bounds there."""
    squares = jax.tree.map(lambda p, b: row_inner(p, p) / b**2, p, bounds)
    return jnp.sqrt(jnp.asarray(tree.max(jax.tree.map(_largest, squares))))


def _largest(x: Float[Array, " n"]) -> Float[Array, ""]:
    # (XLA takes ten times as long for what it knows as a maximum, of many numbers on a CPU.)
    return jax.lax.reduce(x, np.zeros((), x.dtype), lambda a, b: jnp.where(b > a, b, a), (0,))


def _cut(p: Float[Array, "rows ..."], bound: Float[Array, " rows"]) -> Float[Array, "rows ..."]:
    """From a step back to one that goes nowhere beyond its bounds by much."""
    size = sizes(p)
    share = jnp.minimum(1, _OVER * bound / jnp.where(size > 0, size, 1))
    return times(share - 1, p)
