"""Trust-region Newton minimisation with truncated conjugate gradients."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree
from optax import tree

from vertax.solvers._solver import AbstractSolver, evaluated_anew, value_and_gradient


class _NewtonState(eqx.Module):
    value: Float[Array, ""]
    gradient: PyTree[Float[Array, "..."]]
    radius: Float[Array, ""]
    num_products: Int[Array, ""]
    aux: PyTree


class NewtonCG(AbstractSolver):
    r"""Newton's method in a trust region, each step by truncated conjugate gradients (Steihaug).

    A step minimises the quadratic model $g \cdot p + \tfrac12 p \cdot (H + \lambda) p$ over
    $|p| \le \Delta$ with Hessian-vector products only. Directions of negative curvature are followed to
    the edge of the region, so the Hessian may be indefinite far from equilibrium. Converges
    quadratically: the way to a *true* equilibrium. (Steihaug 1983, doi:10.1137/0720042; Nocedal & Wright
    2006, alg. 4.1 and 7.2, doi:10.1007/978-0-387-40065-5.)

    The damping $\lambda = |g| / \Delta$ is what holds a step in a small region. Conjugate gradients that
    are merely cut off at its edge go down the steepest slope there, to and fro across a narrow valley: a
    four-fold vertex is one, a thousand times stiffer against opening than against being moved. Damped,
    they go along it. Near equilibrium $\lambda$ vanishes with the force.

    **Arguments:**

    - `max_displacement`: the furthest one vertex may move in a step, in units of the length scale (in
        [`equilibrate`][vertax.equilibrate] the root mean cell area; otherwise 1).
    - `max_products`: most Hessian-vector products in one step.
    """

    max_displacement: float = 0.2
    max_products: int = eqx.field(static=True, default=200)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _NewtonState:
        value, gradient, aux = value_and_gradient(fn, y, args)
        # The 2-norm of a step in which every coordinate moves as far as it may.
        reach = self.max_displacement * options.get("length_scale", 1.0)
        radius = reach * jnp.sqrt(jnp.asarray(tree.size(y), value.dtype))
        return _NewtonState(value, gradient, radius, jnp.array(0), aux)

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _NewtonState, tags: Any
    ) -> tuple[Any, _NewtonState, Any]:
        reach = self.max_displacement * options.get("length_scale", 1.0)
        g = state.gradient
        _, hessian = jax.linearize(lambda x: value_and_gradient(fn, x, args)[1], y)
        # Forces are measured in that which moves a vertex by the length scale.
        force = options.get("stiffness", 1.0) * options.get("length_scale", 1.0)
        p, hp, products = self._truncated_cg(hessian, g, state.radius, force)
        # The region bounds the 2-norm; no single vertex may jump far either.
        largest = tree.norm(p, ord=jnp.inf)
        shrink = jnp.minimum(1.0, reach / jnp.where(largest > 0, largest, 1))
        p = tree.scale(shrink, p)
        predicted = -(_dot(g, p) + 0.5 * shrink * _dot(p, hp))

        trial = tree.add(y, p)
        value, gradient, aux = value_and_gradient(fn, trial, args)
        actual = state.value - value
        # Near equilibrium the gain drowns in the rounding of E; there a step is good if it lowers the
        # force.
        noise = 20 * jnp.finfo(value.dtype).eps * jnp.abs(value)
        lost = predicted <= noise
        lower_force = _dot(gradient, gradient) < _dot(g, g)
        ratio = actual / jnp.where(predicted > 0, predicted, 1)
        finite = jnp.isfinite(value) & jnp.isfinite(_dot(gradient, gradient))
        accept = finite & jnp.where(lost, lower_force, ratio > 1e-4)

        length = jnp.sqrt(_dot(p, p))
        far = length > 0.3 * state.radius
        radius = jnp.where(
            accept & (lost | (ratio > 0.25)),
            jnp.where(far & (ratio > 0.75), 2 * state.radius, state.radius),
            0.25 * length,
        )
        kept = (y, state.value, g, state.aux)
        y, value, g, aux = tree.where(accept, (trial, value, gradient, aux), kept)
        return y, _NewtonState(value, g, radius, state.num_products + products, aux), aux

    def resumed(self, fresh: _NewtonState, old: _NewtonState) -> _NewtonState:
        return evaluated_anew(fresh, old)

    def retreat(
        self,
        fn: Any,
        y: Any,
        way: Any,
        args: Any,
        options: Any,
        state: _NewtonState,
        tags: Any,
        inside: Any,
    ) -> tuple[Any, _NewtonState]:
        return y, eqx.tree_at(lambda s: s.radius, state, 0.25 * jnp.sqrt(_dot(way, way)))

    def gradient(self, state: _NewtonState) -> PyTree[Float[Array, "..."]]:
        return state.gradient

    def _truncated_cg(
        self, hessian: Any, g: PyTree, radius: Float[Array, ""], force: float | Float[Array, ""]
    ) -> tuple[PyTree, PyTree, Int[Array, ""]]:
        """A step `p` inside the trust region, and `H p`."""
        # Conjugate gradients on (H + λ) p = -g from p = 0; |p| grows from iterate to iterate, so the first
        # one to leave the region, or to meet negative curvature, ends on its edge.
        squared = _dot(g, g)
        size = jnp.sqrt(squared)
        forcing = jnp.minimum(0.1, jnp.sqrt(size / force))
        damping = size / radius
        zero = tree.zeros_like(g)
        first = tree.scale(-1, g)

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            *_, rr, done, k = carry
            return ~done & (jnp.sqrt(rr) > forcing * size) & (k < self.max_products)

        def iterate(carry: tuple) -> tuple:
            p, hp, r, d, rr, _, k = carry
            hd = hessian(d)
            damped = tree.add_scale(hd, damping, d)
            curvature = _dot(d, damped)
            convex = curvature > 0
            alpha = rr / jnp.where(convex, curvature, 1)
            pp, pd, dd = _dot(p, p), _dot(p, d), _dot(d, d)
            leaves = pp + 2 * alpha * pd + alpha**2 * dd >= radius**2
            done = leaves | ~convex
            to_edge = (-pd + jnp.sqrt(jnp.maximum(pd**2 + dd * (radius**2 - pp), 0))) / dd
            alpha = jnp.where(done, to_edge, alpha)
            p, hp, r = (
                tree.add_scale(p, alpha, d),
                tree.add_scale(hp, alpha, hd),
                tree.add_scale(r, alpha, damped),
            )
            new = _dot(r, r)
            d = tree.sub(tree.scale(new / rr, d), r)
            return p, hp, r, d, new, done, k + 1

        start = (zero, zero, g, first, squared, squared == 0, jnp.array(0))
        p, hp, *_, products = jax.lax.while_loop(unfinished, iterate, start)
        return p, hp, products


def _dot(a: PyTree, b: PyTree) -> Float[Array, ""]:
    return jnp.asarray(tree.vdot(a, b))
