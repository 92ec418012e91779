"""Typical sizes of a tissue and of its energy, in which solvers and adjoints measure."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vertax._base.probe_vector import probe_vector
from vertax.mesh import Tissue
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.mesh._tissue import mean_area


class Units(eqx.Module):
    """The units of a tissue: whatever unit of length and energy the user chose, it relaxes alike."""

    length: Float[Array, ""]
    """The size of a cell: the root mean cell area."""
    stiffness: Float[Array, ""]
    """A typical second derivative of the energy; 1 for one that has none."""

    @property
    def force(self) -> Float[Array, ""]:
        """The force that moves a vertex by the size of a cell."""
        return self.stiffness * self.length


def units_of(tissue: Tissue, energy: Callable[[Tissue], Array]) -> Units:
    """The units of a tissue and of its energy."""
    stiffness = mean_stiffness(tissue, energy)
    sound = jnp.isfinite(stiffness) & (stiffness > 0)
    return Units(cell_size(tissue), jnp.where(sound, stiffness, 1))


def cell_size(tissue: Tissue) -> Float[Array, ""]:
    """The root mean cell area. Arcs that are nearly full circles, or beyond, count as shorter ones."""
    if tissue.angles is not None:
        tissue = tissue.with_angles(jnp.clip(tissue.angles, -_LARGEST_ANGLE, _LARGEST_ANGLE))
    return jnp.sqrt(mean_area(tissue))


# Half of the angle that an arc spans. (The segment of a circle has 8 times the area of the half disc then.)
_LARGEST_ANGLE = 2.5


def mean_stiffness(tissue: Tissue, energy: Callable[[Tissue], Array]) -> Float[Array, ""]:
    """The size of a typical second derivative of an energy, or of any number that a tissue has."""
    # The Rayleigh quotient of a vector without pattern is the mean eigenvalue, near enough.
    y, unravel = ravel_pytree(tissue.configuration)
    there = lambda x: MeasuredTissue(tissue.with_configuration(unravel(x)))
    slope = jax.grad(lambda x: energy(there(x)))
    direction = probe_vector(y)
    if tissue.topology.spare:  # what cannot move must not make the rest look soft
        weights = tissue.by_row(tissue.topology.alive_vertices.astype(y.dtype))
        weigh = lambda x, w: (x.T * w).T
        direction, _ = ravel_pytree(jax.tree.map(weigh, unravel(direction), weights))
    _, response = jax.jvp(slope, (y,), (direction,))
    return jnp.abs(jnp.sum(direction * response)) / jnp.sum(direction**2)
