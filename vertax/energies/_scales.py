"""Typical sizes of a tissue and its energy."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vertax._base.model_checks import real_scalar
from vertax._base.probe_vector import probe_vector
from vertax._base.scales import Scales
from vertax.mesh import Tissue
from vertax.mesh._measured_tissue import MeasuredTissue


def scales_of(tissue: Tissue, energy: Callable[[Tissue], Array]) -> Scales:
    """The scales of a tissue and its energy, without a tolerance."""
    stiffness = mean_stiffness(tissue, energy)
    valid = jnp.isfinite(stiffness) & (stiffness > 0)
    return Scales(tissue.cell_size, jnp.where(valid, stiffness, 1))


def mean_stiffness(tissue: Tissue, energy: Callable[[Tissue], Array]) -> Float[Array, ""]:
    """A typical absolute second derivative of an energy, or of another function of a tissue."""
    # The Rayleigh quotient of an unstructured vector approximates the mean eigenvalue.
    y, unravel = ravel_pytree(tissue.configuration)
    at = lambda x: MeasuredTissue(tissue.with_configuration(unravel(x)))
    gradient = jax.grad(lambda x: real_scalar(energy(at(x))))
    direction = probe_vector(y)
    if tissue.topology.spare:  # their vertices have no stiffness and must not enter the mean
        weights = tissue.by_row(tissue.topology.alive_vertices.astype(y.dtype))
        weigh = lambda x, w: (x.T * w).T
        direction, _ = ravel_pytree(jax.tree.map(weigh, unravel(direction), weights))
    _, response = jax.jvp(gradient, (y,), (direction,))
    return jnp.abs(jnp.sum(direction * response)) / jnp.sum(direction**2)
