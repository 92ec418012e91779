"""States of self-stress: pressures and tensions in mechanical equilibrium without external load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vertax._base.announce import announced_jit
from vertax._base.checks import check_concrete, check_number
from vertax.mechanics._arguments import check_tissue
from vertax.mechanics._hessian import movable, zero_threshold
from vertax.mesh import Tissue

_CONSTRAINTS = ("areas", "perimeters", "edge_lengths")


def compatibility(
    tissue: Tissue,
    constraints: Sequence[Literal["areas", "perimeters", "edge_lengths"]] = ("areas", "perimeters"),
) -> Float[Array, "constraints dofs"]:
    r"""The compatibility matrix $\mathcal C = \partial f / \partial X$ of constraint functions $f$.

    **Arguments:**

    - `tissue`: the tissue.
    - `constraints`: the quantities $f$ in the energy: `"areas"`, `"perimeters"`, `"edge_lengths"`. By default
        those of area and perimeter elasticity, two per cell.

    **Returns:** one row per constraint, one column per degree of freedom (with arcs, vertices first). Its
        transpose is the equilibrium matrix.

    **Raises:**

    - `ValueError` for another kind of constraint, or an empty sequence.
    """
    check_tissue(tissue)
    names = tuple(constraints) if isinstance(constraints, Sequence) else ()
    if isinstance(constraints, str) or not names or not set(names) <= set(_CONSTRAINTS):
        raise ValueError(
            f"Argument `constraints` must name some of {', '.join(_CONSTRAINTS)}, but is {constraints!r}."
        )
    return _compatibility(tissue, names)


@announced_jit
def _compatibility(tissue: Tissue, names: tuple[str, ...]) -> Float[Array, "constraints dofs"]:
    y, unravel = ravel_pytree(tissue.configuration)

    def values(y: Array) -> Array:
        moved = tissue.with_configuration(unravel(y))
        return jnp.concatenate([getattr(moved, name) for name in names])

    return jax.jacrev(values)(y)


class SelfStress(eqx.Module):
    """States of self-stress and the Maxwell-Calladine count."""

    states: Float[Array, "states constraints"]
    """Orthonormal generalised tensions (minus pressures for areas, tensions for lengths) in equilibrium; 0 in
    spare slots."""
    zero_modes: int
    """Number of motions that change no constraint to first order, rigid motions included."""
    degrees_of_freedom: int
    """Number of coordinates that can move."""

    @property
    def number(self) -> int:
        """Number of states of self-stress."""
        return self.states.shape[0]


def self_stresses(
    tissue: Tissue,
    constraints: Sequence[Literal["areas", "perimeters", "edge_lengths"]] = ("areas", "perimeters"),
    *,
    tolerance: float | None = None,
) -> SelfStress:
    r"""States of self-stress: null vectors of the transposed compatibility matrix.

    $N_\mathrm{states} = N_\mathrm{zero} + N_\mathrm{constraints} - N_\mathrm{dof}$ (Calladine 1978,
    doi:10.1016/0020-7683(78)90052-5). A periodic tissue always has one, because its areas sum to the area of
    the box. A rigid tissue has one more, its own tensions and pressures (Merkel & Manning 2018,
    doi:10.1088/1367-2630/aaaa13).

    **Arguments:**

    - `tissue`: the tissue; its arrays must not be traced.
    - `constraints`: see [`compatibility`][vertax.mechanics.compatibility].
    - `tolerance`: singular values of at most this fraction of the largest one count as 0; by default 1e-9,
        or 100 times the rounding of the data type if that is larger.

    **Returns:** a [`SelfStress`][vertax.mechanics.SelfStress].

    **Raises:**

    - `ValueError` for another kind of constraint.
    - `TypeError` inside `jax.jit`.
    """
    check_tissue(tissue)
    check_concrete("self_stresses", tissue)
    if tolerance is not None:
        check_number("tolerance", tolerance, above=0)
    free = np.asarray(ravel_pytree(movable(tissue))[0])
    matrix = np.asarray(compatibility(tissue, constraints))[:, free]
    m = tissue.topology
    of_edges = np.asarray(m.alive_edges)
    alive = np.concatenate(
        [of_edges if name == "edge_lengths" else np.asarray(m.alive) for name in constraints]
    )
    left, singular, _ = np.linalg.svd(matrix[alive])
    rank = int(np.sum(singular > zero_threshold(singular, tolerance, 1e-9)))
    states = np.zeros((alive.sum() - rank, alive.size), matrix.dtype)
    states[:, alive] = left[:, rank:].T
    return SelfStress(jnp.asarray(states), int(free.sum()) - rank, int(free.sum()))
