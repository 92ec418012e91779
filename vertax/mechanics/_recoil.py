"""Velocities of vertices: overdamped motion, and recoil after an edge is cut."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.checks import check_integer
from vertax._base.model_checks import real_scalar
from vertax._base.tracing import is_concrete, traced
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_dissipation, check_linear_solver, check_system
from vertax.mechanics._forces import tensions
from vertax.mechanics._landscape import checked, dissipation_landscape, solve
from vertax.mesh import Tissue
from vertax.solvers import MINRES


def velocities(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    *,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, "vertices 2"]:
    r"""Velocities of vertices, $\Gamma\,\dot x = - \nabla_X E$ with the matrix $\Gamma$ of the dissipation.

    [`evolve`][vertax.evolve] integrates these velocities. In a fixed topology they are the right-hand side of
    an ordinary differential equation, for example for the solvers of Diffrax:

    ```python
    move = lambda t, x, args: vx.mechanics.velocities(tissue.with_vertices(x), energy, friction)
    diffrax.diffeqsolve(diffrax.ODETerm(move), diffrax.Tsit5(), 0, 1, 0.01, tissue.vertices)
    ```

    **Arguments:**

    - `tissue`: the tissue.
    - `energy`: its energy.
    - `dissipation`: the dissipation, which defines $\Gamma$.
    - `linear_solver`: for systems with $\Gamma$, [`MINRES`][vertax.MINRES] by default. Null vectors of
        $\Gamma$ get the velocity 0.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** velocities, length per time. (The velocities of arc angles are solved for, but not returned.)

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the linear solver failed.
    """
    check_system(tissue, energy)
    check_dissipation(dissipation)
    check_linear_solver(linear_solver)
    arguments = traced((tissue, energy, dissipation), tissue.vertices.dtype)
    velocity = _velocities(*arguments, linear_solver)
    return checked(velocity, _REASON) if throw else velocity


@announced_jit
def _velocities(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    solver: lx.AbstractLinearSolver[Any],
) -> Float[Array, "vertices 2"]:
    gradient = jax.grad(lambda y: real_scalar(energy(tissue.with_configuration(y))))
    forces = jax.tree.map(jnp.negative, gradient(tissue.configuration))
    viscosity = dissipation_landscape(tissue, dissipation).hessian_product()
    no_strain = jnp.zeros((2, 2), tissue.vertices.dtype)
    velocity = solve(lambda v: viscosity((no_strain, v))[1], forces, solver)
    return velocity if tissue.arcs is None else velocity[0]


def recoil(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    edge: int | Int[Array, ""],
    *,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, "vertices 2"]:
    r"""Initial velocities of all vertices after the tension of an edge is removed, as by laser ablation.

    $$\Gamma\,\dot x = - \nabla_X (E - T_e\,\ell_e), \qquad T_e = \partial E / \partial \ell_e$$

    with the matrix $\Gamma$ of the dissipation and a constant $T_e$. In a tissue at rest the forces are
    $T_e \nabla_X \ell_e$ (Mayer et al. 2010, doi:10.1038/nature09376).

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: an energy of areas and lengths, see [`tensions`][vertax.mechanics.tensions].
    - `dissipation`: the dissipation, which defines $\Gamma$.
    - `edge`: the index of the edge.
    - `linear_solver`: for systems with $\Gamma$, [`MINRES`][vertax.MINRES] by default. Null vectors of
        $\Gamma$ get the velocity 0.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** velocities, length per time. (The velocities of arc angles are solved for, but not returned.)

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    - `ValueError` for an edge index out of range.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the linear solver failed.
    """
    check_system(tissue, energy)
    check_dissipation(dissipation)
    if is_concrete(edge):
        number = np.asarray(edge)[()] if isinstance(edge, jax.Array) else edge
        check_integer("edge", number, at_least=0)
        if number >= tissue.n_edges:
            raise ValueError(
                f"Argument `edge` must be one of the {tissue.n_edges} edges, from 0 on, but is {number}."
            )
    check_linear_solver(linear_solver)
    tissue, energy, dissipation = traced((tissue, energy, dissipation), tissue.vertices.dtype)
    velocity = _recoil(tissue, energy, jnp.asarray(edge), dissipation, linear_solver)
    return checked(velocity, _REASON) if throw else velocity


@announced_jit
def _recoil(
    tissue: Tissue,
    energy: AbstractEnergy,
    edge: Int[Array, ""],
    dissipation: AbstractDissipation,
    solver: lx.AbstractLinearSolver[Any],
) -> Float[Array, "vertices 2"]:
    tension = tensions(tissue, energy)[edge]
    return _velocities(tissue, _WithoutTension(energy, edge, tension), dissipation, solver)


class _WithoutTension(AbstractEnergy):
    """An energy minus a constant tension of one edge."""

    energy: AbstractEnergy
    edge: Int[Array, ""]
    tension: Float[Array, ""]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        return self.energy(tissue) - self.tension * tissue.edge_lengths[self.edge]


_REASON = (
    "The velocities could not be computed: the linear solve with the dissipation failed. Pass another "
    "`linear_solver`, add some friction, or pass throw=False to get NaN."
)
