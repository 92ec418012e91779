"""How fast vertices move now: of their own, and after an edge is cut."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Int

from vertax._base.checks import check_integer
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
    linear_solver: lx.AbstractLinearSolver | None = None,
    throw: bool = True,
) -> Float[Array, "vertices 2"]:
    r"""Velocities of vertices, $\Gamma\,\dot x = - \nabla_X E$ with the matrix $\Gamma$ of the dissipation.

    This is what [`evolve`][vertax.evolve] integrates, in a fixed topology: the right-hand side of an ordinary
    differential equation for any other solver, such as those of Diffrax.

    ```python
    move = lambda t, x, args: vx.mechanics.velocities(tissue.with_vertices(x), energy, friction)
    diffrax.diffeqsolve(diffrax.ODETerm(move), diffrax.Tsit5(), 0, 1, 0.01, tissue.vertices)
    ```

    **Arguments:**

    - `tissue`: where it is.
    - `energy`: what pulls.
    - `dissipation`: what resists.
    - `linear_solver`: for systems with $\Gamma$, [`MINRES`][vertax.MINRES] by default. Motions that nothing
        resists do not take place.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** velocities, length per time. (Those of the angles of arcs are solved for, but not
    returned.)

    **Raises:**

    - `TypeError` for what is no tissue, energy, dissipation or linear solver.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the linear solver failed.
    """
    check_system(tissue, energy)
    check_dissipation(dissipation)
    solver = MINRES() if linear_solver is None else linear_solver
    check_linear_solver(solver)
    found = _velocities(*traced((tissue, energy, dissipation), tissue.vertices.dtype), solver)
    return checked(found, _REASON) if throw else found


@eqx.filter_jit
def _velocities(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    solver: lx.AbstractLinearSolver,
) -> Float[Array, "vertices 2"]:
    pulls = jax.grad(lambda configuration: energy(tissue.with_configuration(configuration)))
    forces = jax.tree.map(jnp.negative, pulls(tissue.configuration))
    resistance = dissipation_landscape(tissue, dissipation).curvature()
    still = jnp.zeros((2, 2), tissue.vertices.dtype)
    velocity = solve(lambda v: resistance((still, v))[1], forces, solver)
    return velocity if tissue.arcs is None else velocity[0]


def recoil(
    tissue: Tissue,
    energy: AbstractEnergy,
    edge: int | Int[Array, ""],
    dissipation: AbstractDissipation,
    *,
    linear_solver: lx.AbstractLinearSolver | None = None,
    throw: bool = True,
) -> Float[Array, "vertices 2"]:
    r"""Velocities of all vertices right after the tension of an edge is gone, as after laser ablation.

    $$\Gamma\,\dot x = - \nabla_X (E - T_e\,\ell_e), \qquad T_e = \partial E / \partial \ell_e$$

    with the matrix $\Gamma$ of the dissipation, and $T_e$ held: in a tissue at rest all that acts is
    what the edge pulled with (Mayer et al. 2010, doi:10.1038/nature09376).

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: an energy of areas and lengths, see [`tensions`][vertax.mechanics.tensions].
    - `edge`: the number of the edge.
    - `dissipation`: what resists.
    - `linear_solver`: for systems with $\Gamma$, [`MINRES`][vertax.MINRES] by default. Motions that nothing
        resists do not take place.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** velocities, length per time. (Those of the angles of arcs are solved for, but not
    returned.)

    **Raises:**

    - `TypeError` for what is no tissue, energy, dissipation or linear solver, or no whole number.
    - `ValueError` for an edge that is none.
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
    solver = MINRES() if linear_solver is None else linear_solver
    check_linear_solver(solver)
    tissue, energy, dissipation = traced((tissue, energy, dissipation), tissue.vertices.dtype)
    found = _recoil(tissue, energy, jnp.asarray(edge), dissipation, solver)
    return checked(found, _REASON) if throw else found


@eqx.filter_jit
def _recoil(
    tissue: Tissue,
    energy: AbstractEnergy,
    edge: Int[Array, ""],
    dissipation: AbstractDissipation,
    solver: lx.AbstractLinearSolver,
) -> Float[Array, "vertices 2"]:
    tension = tensions(tissue, energy)[edge]

    return _velocities(tissue, _Without(energy, edge, tension), dissipation, solver)


class _Without(AbstractEnergy):
    """An energy without the tension that an edge has now."""

    energy: AbstractEnergy
    edge: Int[Array, ""]
    tension: Float[Array, ""]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        return self.energy(tissue) - self.tension * tissue.edge_lengths[self.edge]


_REASON = (
    "The velocities are not known: the linear solve with the dissipation failed. Give another "
    "`linear_solver`, add some friction, or pass throw=False to get NaN."
)
