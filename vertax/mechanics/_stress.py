"""Stress of a tissue and of its cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.announce import announced_jit
from vertax._base.arcs import area_factor, length_factor
from vertax._base.checks import as_real
from vertax._base.model_checks import check_planar, real_scalar
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_system
from vertax.mechanics._forces import pressures_and_tensions
from vertax.mechanics._landscape import area_of, deformed
from vertax.mesh import Tissue


def stress(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, "2 2"]:
    r"""Stress of a tissue, $\sigma = \frac1A\,\partial E / \partial F$, energy per area.

    $F$ deforms box and vertices together, and $A$ is the area of the box, or of all cells of a free
    tissue. If the energy depends on areas and lengths only,

    $$\sigma = \frac1A \Big( -\sum_c p_c A_c\, I + \sum_e T_e \frac{\ell_e \otimes \ell_e}{|\ell_e|} \Big)$$

    (Batchelor 1970; Ishihara & Sugimura 2012, doi:10.1016/j.jtbi.2012.08.017). The stress of a free tissue at
    rest without external load is 0.

    **Arguments:**

    - `tissue`: the tissue, relaxed or not.
    - `energy`: any energy.

    **Returns:** a matrix, shape `(2, 2)`, symmetric if the energy is invariant under rotations; positive in
        tension. Differentiable with respect to all arguments.

    **Raises:**

    - `TypeError` if `tissue` or `energy` is an object of another class.
    - `ValueError` for a batch of tissues, and for a tissue on a surface, which has no uniform deformation.
    """
    check_system(tissue, energy)
    check_planar("the stress of the whole tissue (see cell_stress)", tissue)
    return _stress(*traced((tissue, energy), tissue.vertices.dtype))


@announced_jit
def _stress(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, "2 2"]:
    identity = jnp.eye(2, dtype=tissue.vertices.dtype)
    at = lambda gradient: real_scalar(energy(deformed(tissue, gradient)))
    return jax.grad(at)(identity) / area_of(tissue)


def cell_stress(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, "cells 2 2"]:
    r"""Stress of each cell, from its pressure and half of the tension of each of its edges.

    $$\sigma_c = -p_c\, I + \frac1{2 A_c} \sum_{e \in c} T_e \int_e t \otimes t\, \mathrm ds$$

    with unit tangents $t$. An edge on the outline of a free tissue has one cell only, which gets all of
    its tension. At rest the mean over cells, weighted by their areas, is the
    [`stress`][vertax.mechanics.stress] of the tissue (if all edges are straight, also away from rest).

    On a surface it is the stress in the tangent plane at the centroid of the cell (in the chart), with
    components along the unit vectors $e_1 = \partial_x r / |\partial_x r|$ and $e_2 = n \times e_1$, where
    $n$ is the normal. Sides are projected to this plane; the normal component of their tension is the load on
    the surface.

    **Arguments:**

    - `tissue`: the tissue.
    - `energy`: an energy of areas and lengths, see [`pressures`][vertax.mechanics.pressures].

    **Returns:** one symmetric matrix per cell, energy per area, positive in tension.

    **Raises:**

    - `TypeError` if `tissue` or `energy` is an object of another class.
    - `ValueError` for a batch of tissues.
    """
    check_system(tissue, energy)
    return _cell_stress(*traced((tissue, energy), tissue.vertices.dtype))


@announced_jit
def _cell_stress(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, "cells 2 2"]:
    pressure, tension = pressures_and_tensions(tissue, energy)
    cells = tissue.topology.edge_cells
    # An edge with the exterior on one side belongs to its one cell.
    inside = cells < tissue.n_cells
    tension_per_cell = tension / jnp.maximum(jnp.sum(inside, axis=1), 1)
    moments = tension_per_cell[:, None, None] * _directed_lengths(tissue)
    sides = cells.T.ravel()
    sums = jax.ops.segment_sum(jnp.tile(moments, (2, 1, 1)), sides, tissue.n_cells)
    if tissue.surface is not None:
        frame = tissue.surface.tangent_frame(tissue.centroids)[0]
        sums = jnp.einsum("cik,ckl,cjl->cij", frame, sums, frame)
    isotropic = pressure[:, None, None] * jnp.eye(2, dtype=moments.dtype)
    areas = tissue.areas
    if tissue.topology.spare:
        areas = jnp.where(tissue.alive, areas, 1)
    return sums / areas[:, None, None] - isotropic


def _directed_lengths(tissue: Tissue) -> Float[Array, "edges space space"]:
    """The integral of t ⊗ t along each edge; its trace is the length of the edge. On a surface in space."""
    # For an arc with half-angle α and chord c, with R = c / (2 sin α), the principal values are
    # R (α + sin α cos α) along the chord and R (α - sin α cos α) = 2 c g sin α across it.
    chord, angle = tissue.edge_chords, tissue.edge_angles
    squared = jnp.sum(chord**2, axis=-1) + tissue.softening**2
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1))
    outer = lambda v: v[:, :, None] * v[:, None, :] / length[:, None, None]
    if tissue.arcs is None:
        return outer(chord)
    across = 2 * area_factor(angle) * jnp.sin(angle)
    along = length_factor(angle) - across
    normal = jnp.stack([-chord[:, 1], chord[:, 0]], axis=-1)
    return along[:, None, None] * outer(chord) + across[:, None, None] * outer(normal)


def principal(
    stresses: Float[Array, "*cells 2 2"],
) -> tuple[Float[Array, "*cells 2"], Float[Array, "*cells 2 2"]]:
    """Principal stresses and their directions.

    **Arguments:**

    - `stresses`, shape `(…, 2, 2)`: symmetric matrices, of the tissue or of cells.

    **Returns:** the principal stresses, the larger one first, shape `(…, 2)`; and unit vectors along their
        directions as rows, shape `(…, 2, 2)`. (If both stresses are equal the directions are arbitrary.)

    **Raises:**

    - `ValueError` for another shape.
    """
    stresses = as_real("stresses", stresses)
    if stresses.shape[-2:] != (2, 2):
        raise ValueError(
            f"Argument `stresses` must have shape (…, 2, 2), but its shape is {stresses.shape}."
        )
    values, vectors = jnp.linalg.eigh(0.5 * (stresses + jnp.swapaxes(stresses, -1, -2)))
    return values[..., ::-1], jnp.swapaxes(vectors, -1, -2)[..., ::-1, :]
