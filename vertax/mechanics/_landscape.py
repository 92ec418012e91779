"""A potential around a tissue, as a function of a strain of the whole and of further motions in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree

from vertax._base.tracing import is_concrete
from vertax.dissipations import AbstractDissipation
from vertax.mechanics._arguments import as_matrix, check_tissue
from vertax.mesh import Periodic, Tissue

Motion: TypeAlias = tuple[Float[Array, "2 2"], PyTree[Float[Array, "..."]]]
"""A strain of box and vertices, and what moves in addition: a change of the configuration."""


def deformed(tissue: Tissue, gradient: Float[Array, "2 2"]) -> Tissue:
    r"""A tissue deformed uniformly, box and vertices alike: $x \to F x$.

    Pinned vertices move too. The angles of arcs stay what they are.

    **Arguments:**

    - `tissue`: the tissue.
    - `gradient`, shape `(2, 2)`: the deformation gradient $F$; for a simple shear by $\gamma$ along $x$
        `[[1, γ], [0, 1]]`.

    **Returns:** the deformed tissue.

    **Raises:**

    - `ValueError` for another shape, or a determinant that is not positive.
    """
    check_tissue(tissue)
    gradient = as_matrix("gradient", gradient)
    if is_concrete(gradient) and not np.linalg.det(np.asarray(gradient, float)) > 0:
        raise ValueError(
            "Argument `gradient` must have a positive determinant, lest cells be turned inside out, but is "
            f"{np.asarray(gradient).tolist()}."
        )
    # Written out: a matrix product would run in reduced precision on some accelerators.
    moved = lambda x: x[:, :1] * gradient[:, 0] + x[:, 1:] * gradient[:, 1]
    boundary = tissue.boundary
    if isinstance(boundary, Periodic):
        boundary = eqx.tree_at(lambda b: b.lattice, boundary, moved(boundary.lattice))
    places = (boundary, moved(tissue.vertices))
    return eqx.tree_at(lambda t: (t.boundary, t.vertices), tissue, places)


def area_of(tissue: Tissue) -> Float[Array, ""]:
    """The area of the box, or of all cells of a free tissue."""
    boundary = tissue.boundary
    return boundary.area if isinstance(boundary, Periodic) else jnp.sum(tissue.areas)


class Landscape(eqx.Module):
    r"""A potential $\Phi(\epsilon, u)$: that of the tissue displaced by $u$, then strained by $\epsilon$.

    The strain is logarithmic, $F = e^\epsilon$, up to its second order.
    """

    tissue: Tissue
    potential: Callable[[Tissue], Float[Array, ""]]

    def __call__(self, motion: Motion) -> Float[Array, ""]:
        """The potential after a motion."""
        strain, change = motion
        there = jax.tree.map(jnp.add, self.tissue.configuration, change)
        gradient = jnp.eye(2, dtype=strain.dtype) + strain + 0.5 * strain @ strain
        return self.potential(deformed(self.tissue.with_configuration(there), gradient))

    @property
    def still(self) -> Motion:
        """No motion."""
        y = self.tissue.configuration
        return jnp.zeros((2, 2), self.tissue.vertices.dtype), jax.tree.map(jnp.zeros_like, y)

    def pushes(self) -> Motion:
        """First derivatives: the stress times the area, and minus the forces."""
        return jax.grad(self)(self.still)

    def curvature(self) -> Callable[[Motion], Motion]:
        """Products with the second derivatives."""
        return jax.linearize(jax.grad(self), self.still)[1]


class _Dissipation(eqx.Module):
    """What a motion from a tissue dissipates if it takes the time 1."""

    dissipation: AbstractDissipation
    before: Tissue

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        return self.dissipation(tissue, self.before, 1.0)


def dissipation_landscape(tissue: Tissue, dissipation: AbstractDissipation) -> Landscape:
    """What motions of the rate 1 dissipate: its second derivatives are those of the dissipation R."""
    return Landscape(tissue, _Dissipation(dissipation, tissue))


# Engineering strains: of the third, γ = 2 ε_xy = 1.
VOIGT = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], [[0.0, 0.5], [0.5, 0.0]]])


def voigt_basis(
    tissue: Tissue,
) -> tuple[Float[Array, "3 2 2"], PyTree[Float[Array, "3 ..."]]]:
    """The three affine strains xx, yy and xy, along a first axis."""
    still = jax.tree.map(lambda x: jnp.zeros((3, *x.shape), x.dtype), tissue.configuration)
    return jnp.asarray(VOIGT, tissue.vertices.dtype), still


def dot(a: PyTree[Array], b: PyTree[Array]) -> Float[Array, ""]:
    """Scalar product of two motions."""
    products = jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)
    return jax.tree.reduce(jnp.add, products)


def solve(
    product: Callable[[PyTree[Array]], PyTree[Array]],
    rhs: PyTree[Array],
    solver: lx.AbstractLinearSolver,
    otherwise: lx.AbstractLinearSolver | None = None,
) -> PyTree[Array]:
    """A symmetric system, of which each product is given; NaN where the solver failed, and the other too."""
    structure = jax.eval_shape(lambda: rhs)
    operator = lx.FunctionLinearOperator(product, structure, tags=lx.symmetric_tag)
    solution = lx.linear_solve(operator, rhs, solver, throw=False)
    good = solution.result == lx.RESULTS.successful
    unknown = lambda: jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), rhs)
    again = unknown if otherwise is None else lambda: solve(product, rhs, otherwise)
    return jax.lax.cond(good, lambda: solution.value, again)


# Moduli are minima of a quadratic form over motions u, and eigenvalues stationary values of one. Their
# derivatives are those of the form with u held, so none of them needs the derivative of u; derivatives of
# higher order do, and get it, since the rule below solves for u as a function of the arguments.
@eqx.filter_custom_jvp
def stationary(args: Any, system: Any) -> Array:
    """The stationary value of a system, which has a method `solve(args)` and one `value(args, solution)`.

    Its first derivatives solve nothing that is not solved anyway.
    """
    return system.value(args, system.solve(args))


@stationary.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (args, system), (t_args, _) = primals, tangents
    solution = system.solve(args)
    value, slope = eqx.filter_jvp(lambda a: system.value(a, solution), (args,), (t_args,))
    return value, slope


def checked(value: Array, reason: str) -> Array:
    """The same value, and an error if it is not finite."""
    failed = ~jnp.all(jnp.isfinite(value))
    if not is_concrete(value):
        return eqx.error_if(value, failed, reason)
    if failed:
        raise RuntimeError(reason)
    return value
