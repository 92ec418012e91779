"""States of self-stress: pressures and tensions that balance everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vertax._base.checks import check_concrete, check_number
from vertax.mechanics._arguments import check_tissue
from vertax.mechanics._hessian import movable
from vertax.mesh import Tissue

_KINDS = ("areas", "perimeters", "edge_lengths")


def compatibility(
    tissue: Tissue,
    constraints: Sequence[Literal["areas", "perimeters", "edge_lengths"]] = ("areas", "perimeters"),
) -> Float[Array, "constraints dofs"]:
    r"""The compatibility matrix $\mathcal C = \partial f / \partial X$ of what the energy constrains.

    **Arguments:**

    - `tissue`: the tissue.
    - `constraints`: what the energy asks for: `"areas"`, `"perimeters"`, `"edge_lengths"`. By default
        those of area and perimeter elasticity, two a cell.

    **Returns:** one row a constraint, one column a degree of freedom (with arcs, vertices first). Its
        transpose is the equilibrium matrix.

    **Raises:**

    - `ValueError` for another kind of constraint, or none.
    """
    check_tissue(tissue)
    names = tuple(constraints) if isinstance(constraints, Sequence) else ()
    if isinstance(constraints, str) or not names or not set(names) <= set(_KINDS):
        raise ValueError(
            f"Argument `constraints` must name some of {', '.join(_KINDS)}, but is {constraints!r}."
        )
    return _compatibility(tissue, names)


@eqx.filter_jit
def _compatibility(tissue: Tissue, names: tuple[str, ...]) -> Float[Array, "constraints dofs"]:
    y, unravel = ravel_pytree(tissue.configuration)

    def values(y: Array) -> Array:
        there = tissue.with_configuration(unravel(y))
        return jnp.concatenate([getattr(there, name) for name in names])

    return jax.jacrev(values)(y)


class SelfStress(eqx.Module):
    """States of self-stress and the count of Maxwell and Calladine."""

    states: Float[Array, "states constraints"]
    """Orthonormal generalised tensions (minus pressures for areas, tensions for lengths) in balance."""
    zero_modes: int
    """Number of motions that change no constraint to first order, those of the whole among them."""
    degrees_of_freedom: int
    """Number of numbers that can move."""

    @property
    def number(self) -> int:
        """Number of states of self-stress."""
        return self.states.shape[0]


def self_stresses(
    tissue: Tissue,
    constraints: Sequence[Literal["areas", "perimeters", "edge_lengths"]] = ("areas", "perimeters"),
    *,
    tolerance: float = 1e-9,
) -> SelfStress:
    r"""States of self-stress: null vectors of the transposed compatibility matrix.

    $N_\mathrm{states} = N_\mathrm{zero} + N_\mathrm{constraints} - N_\mathrm{dof}$ (Calladine 1978,
    doi:10.1016/0020-7683(78)90052-5). A tissue in a box always has one, since its areas sum to that of
    the box; a rigid one has one more, which is what its tensions and pressures are (Merkel & Manning 2018,
    doi:10.1088/1367-2630/aaaa13).

    **Arguments:**

    - `tissue`: the tissue; its arrays must not be traced.
    - `constraints`: see [`compatibility`][vertax.mechanics.compatibility].
    - `tolerance`: singular values that are that much smaller than the largest one count as 0.

    **Returns:** a [`SelfStress`][vertax.mechanics.SelfStress].

    **Raises:**

    - `ValueError` for another kind of constraint.
    - `TypeError` inside `jax.jit`.
    """
    check_tissue(tissue)
    check_concrete("self_stresses", tissue)
    check_number("tolerance", tolerance, above=0)
    free = np.asarray(ravel_pytree(movable(tissue))[0])
    matrix = np.asarray(compatibility(tissue, constraints))[:, free]
    left, singular, _ = np.linalg.svd(matrix)
    rank = int(np.sum(singular > tolerance * singular.max(initial=0)))
    return SelfStress(jnp.asarray(left[:, rank:].T), int(free.sum()) - rank, int(free.sum()))
