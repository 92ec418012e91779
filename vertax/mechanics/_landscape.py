"""A potential as a function of an affine strain of the tissue and of additional displacements."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree

from vertax._base.checks import as_matrix
from vertax._base.model_checks import check_planar, real_scalar
from vertax._base.tracing import is_concrete
from vertax.dissipations import AbstractDissipation
from vertax.mechanics._arguments import check_tissue
from vertax.mesh import Periodic, Tissue

Motion: TypeAlias = tuple[Float[Array, "2 2"], PyTree[Float[Array, "..."]]]
"""An affine strain of box and vertices, and an additional change of the configuration."""


def deformed(tissue: Tissue, gradient: Float[Array, "2 2"]) -> Tissue:
    r"""A tissue after a uniform deformation of box and vertices: $x \to F x$.

    Pinned vertices move too. The angles of arcs do not change.

    **Arguments:**

    - `tissue`: the tissue.
    - `gradient`, shape `(2, 2)`: the deformation gradient $F$; for a simple shear by $\gamma$ along $x$
        `[[1, γ], [0, 1]]`.

    **Returns:** the deformed tissue.

    **Raises:**

    - `ValueError` for another shape, a determinant that is not positive, or a tissue on a surface.
    """
    check_tissue(tissue)
    check_planar("a uniform deformation", tissue)
    gradient = as_matrix("gradient", gradient)
    if is_concrete(gradient) and not np.linalg.det(np.asarray(gradient, float)) > 0:
        raise ValueError(
            "Argument `gradient` must have a positive determinant, otherwise cells are inverted, but is "
            f"{np.asarray(gradient).tolist()}."
        )
    # Written out, because a matrix product runs in reduced precision on some accelerators.
    mapped = lambda x: x[:, :1] * gradient[:, 0] + x[:, 1:] * gradient[:, 1]
    boundary = tissue.boundary
    if isinstance(boundary, Periodic):
        boundary = eqx.tree_at(lambda b: b.lattice, boundary, mapped(boundary.lattice))
    positions = (boundary, mapped(tissue.vertices))
    return eqx.tree_at(lambda t: (t.boundary, t.vertices), tissue, positions)


def area_of(tissue: Tissue) -> Float[Array, ""]:
    """The area of the box, or of all cells of a free tissue."""
    boundary = tissue.boundary
    return boundary.area if isinstance(boundary, Periodic) else jnp.sum(tissue.areas)


class Landscape(eqx.Module):
    r"""$\Phi(\epsilon, u)$: the potential of the tissue after displacements $u$ and then a strain $\epsilon$.

    The strain is logarithmic, $F = e^\epsilon$, up to second order. A tissue on a surface has displacements
    only; all functions that strain a tissue reject it.
    """

    tissue: Tissue
    potential: Callable[[Tissue], Float[Array, ""]]

    def __call__(self, motion: Motion) -> Float[Array, ""]:
        """The potential after a motion."""
        strain, change = motion
        configuration = jax.tree.map(jnp.add, self.tissue.configuration, change)
        trial = self.tissue.with_configuration(configuration)
        if trial.surface is None:
            gradient = jnp.eye(2, dtype=strain.dtype) + strain + 0.5 * strain @ strain
            trial = deformed(trial, gradient)
        return real_scalar(self.potential(trial))

    @property
    def zero(self) -> Motion:
        """The motion 0."""
        y = self.tissue.configuration
        return jnp.zeros((2, 2), self.tissue.vertices.dtype), jax.tree.map(jnp.zeros_like, y)

    def gradient(self) -> Motion:
        """First derivatives at the motion 0: the stress times the area, and minus the forces."""
        return jax.grad(self)(self.zero)

    def hessian_product(self) -> Callable[[Motion], Motion]:
        """The linear map from a motion to the product of the second derivatives with it."""
        return jax.linearize(jax.grad(self), self.zero)[1]


class _Dissipation(eqx.Module):
    """The dissipation of a motion from `before` in unit time."""

    dissipation: AbstractDissipation
    before: Tissue

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        return self.dissipation(tissue, self.before, 1.0)


def dissipation_landscape(tissue: Tissue, dissipation: AbstractDissipation) -> Landscape:
    """The dissipation of motions in unit time; its second derivatives are those of R."""
    return Landscape(tissue, _Dissipation(dissipation, tissue))


# Unit strains in Voigt's notation; the third has γ = 2 ε_xy = 1.
VOIGT = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], [[0.0, 0.5], [0.5, 0.0]]])


def voigt_basis(
    tissue: Tissue,
) -> tuple[Float[Array, "3 2 2"], PyTree[Float[Array, "3 ..."]]]:
    """The motions of the affine strains xx, yy and xy, along a leading axis."""
    zeros = jax.tree.map(lambda x: jnp.zeros((3, *x.shape), x.dtype), tissue.configuration)
    return jnp.asarray(VOIGT, tissue.vertices.dtype), zeros


def dot(a: PyTree[Array], b: PyTree[Array]) -> Float[Array, ""]:
    """Scalar product of two motions."""
    products = jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)
    return jax.tree.reduce(jnp.add, products)


def solve(
    product: Callable[[PyTree[Array]], PyTree[Array]],
    rhs: PyTree[Array],
    solver: lx.AbstractLinearSolver,
    fallback: lx.AbstractLinearSolver | None = None,
) -> PyTree[Array]:
    """Solve a symmetric system given by its matrix-vector product; NaN if solver and fallback fail."""
    structure = jax.eval_shape(lambda: rhs)
    operator = lx.FunctionLinearOperator(product, structure, tags=lx.symmetric_tag)

    def attempt(vector: PyTree[Array], *solvers: lx.AbstractLinearSolver) -> PyTree[Array]:
        if not solvers:
            return jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), vector)
        first, *others = solvers
        solution, result, _ = first.compute(first.init(operator, {}), vector, {})
        retry = lambda: attempt(vector, *others)
        return jax.lax.cond(result == lx.RESULTS.successful, lambda: solution, retry)

    solvers = (solver,) if fallback is None else (solver, fallback)
    # (`lineax.linear_solve` has a callback to Python: derivatives could not be stored in a cache.)
    return jax.lax.custom_linear_solve(
        product, rhs, lambda _, vector: attempt(vector, *solvers), symmetric=True
    )


# A modulus is the minimum over motions u of a quadratic form q(θ, u), and an eigenvalue a stationary value of
# one. With ∂q/∂u = 0 the first derivative is dq/dθ = ∂q/∂θ at fixed u. Higher derivatives need du/dθ: the
# rule below solves for u as a function of the arguments, so JAX differentiates that solve.
@eqx.filter_custom_jvp
def stationary(args: Any, system: Any) -> Array:
    """The stationary value of a system with methods `solve(args)` and `value(args, solution)`.

    Its first derivatives need no further solve.
    """
    return system.value(args, system.solve(args))


@stationary.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (args, system), (t_args, _) = primals, tangents
    solution = system.solve(args)
    value, slope = eqx.filter_jvp(lambda a: system.value(a, solution), (args,), (t_args,))
    return value, slope


def checked(value: Array, reason: str) -> Array:
    """Return the value; raise an error if it is not finite."""
    failed = ~jnp.all(jnp.isfinite(value))
    if not is_concrete(value):
        return eqx.error_if(value, failed, reason)
    if failed:
        raise RuntimeError(reason)
    return value
