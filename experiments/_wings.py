r"""Fly wings with an energy of areas and tensions, and the forces at their vertices.

Each wing is a free tissue of straight edges; the cells at its outline are pinned. The energy is that of
`wing_posteriors`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity


class Model(eqx.Module):
    """The energy of a wing, or of a batch of wings, as a function of the parameters."""

    areas: Float[Array, "*wings cells"]
    perimeter: Float[Array, "*wings"]

    def __call__(self, parameters: Any) -> vx.AbstractEnergy:
        """The energy, with the leading axis of the batch."""
        build = eqx.filter_vmap(energy, in_axes=(0, 0, None)) if self.areas.ndim == 2 else energy
        return build(self.areas, self.perimeter, parameters)


class Wing(NamedTuple):
    """A wing in units of the size of a cell."""

    tissue: vx.Tissue
    model: Model


def energy(areas: Array, perimeter: Array, parameters: Any) -> vx.AbstractEnergy:
    """The energy of a wing."""
    tension, share = parameters["tension"], parameters["share"]
    area = AreaElasticity(jnp.ones_like(perimeter), 1 + parameters["targets"] * (areas - 1))
    contractility = PerimeterElasticity(share * tension / (2 * perimeter), jnp.zeros_like(perimeter))
    return area + contractility + LineTension(tension * (1 - share))


def priors() -> dict[str, Any]:
    """The priors of both posteriors."""
    import numpyro.distributions as dist  # (Of an extra: `bayes` names it if it is missing.)

    return {
        "tension": dist.LogNormal(np.log(0.1), 1.0),
        "share": dist.Normal(0.0, 1.0),
        "targets": dist.Normal(0.5, 0.5),
        "noise": dist.LogNormal(np.log(0.1), 1.0),
    }


def pinned(tissue: vx.Tissue) -> Wing:
    """A free tissue in units of the size of its inner cells, with those at the outline pinned."""
    topology, n = tissue.topology, tissue.n_cells
    outer = np.zeros(n + 1, bool)  # the exterior is the last one
    outer[np.asarray(topology.edge_cells)[np.asarray(topology.on_outline)]] = True
    held = np.zeros(tissue.n_vertices, bool)
    held[np.asarray(topology.source)[outer[np.asarray(topology.cell)]]] = True
    inner = ~outer[:n]
    if not inner.any():
        raise ValueError(f"A wing must have cells inside, but all of its {n} cells are at the outline.")
    size = np.sqrt(np.mean(np.asarray(tissue.areas)[inner]))
    scaled = vx.Tissue(np.asarray(tissue.vertices) / size, topology, vx.Free(), pinned=held)
    areas = jnp.where(inner, scaled.areas, 1.0)
    return Wing(scaled, Model(areas, jnp.mean(scaled.perimeters[inner])))


def padded(wing: Wing, capacity: int) -> Wing:
    """The wing with spare cells: all wings share compiled functions."""
    room = (0, capacity - wing.tissue.n_cells)
    areas = jnp.pad(wing.model.areas, room, constant_values=1.0)
    return Wing(wing.tissue.with_capacity(capacity), Model(areas, wing.model.perimeter))


def synthetic(wing: Wing, parameters: Any, noise: float, seed: int) -> Wing:
    """The equilibrium of given parameters, seen with noise."""
    relaxed = response()(wing.tissue, wing.model(parameters)).tissue
    errors = noise * jax.random.normal(jax.random.key(seed), relaxed.vertices.shape)
    return Wing(relaxed.with_vertices(relaxed.vertices + errors), wing.model)


def response() -> vx.Relaxation:
    """A relaxation that keeps the topology; an energy without a minimum fails after 200 steps."""
    return vx.Relaxation(transitions=None, contact_range=None, max_steps=200)


def forces(wings: Sequence[Wing], *values: float) -> Float[np.ndarray, " components"]:
    """Derivatives of the energy at the free vertices of all wings, for a tension, share and targets."""
    parameters = dict(zip(("tension", "share", "targets"), map(jnp.asarray, values), strict=True))
    return np.concatenate(
        [np.asarray(gradient(wing, parameters))[~np.asarray(wing.tissue.held)].ravel() for wing in wings]
    )


@eqx.filter_jit
def gradient(wing: Wing, parameters: Any) -> Float[Array, "vertices 2"]:
    """The derivative of the energy at the observed vertices."""
    at = lambda x: wing.model(parameters)(wing.tissue.with_vertices(x))
    return jax.grad(at)(wing.tissue.vertices)
