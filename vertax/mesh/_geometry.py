"""The geometry of a tissue as NumPy arrays."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax.mesh._padding import pad
from vertax.mesh._tissue import Tissue


class Geometry(NamedTuple):
    """Topology and geometry of a tissue, for code in NumPy."""

    edge_vertices: Int[np.ndarray, "edges 2"]
    edge_cells: Int[np.ndarray, "edges 2"]
    """Cell on the left and on the right; `n_cells` for the exterior."""
    forward: Bool[np.ndarray, " halfedges"]
    edge_vectors: Float[np.ndarray, "edges 2"]
    edge_lengths: Float[np.ndarray, " edges"]
    edge_angles: Float[np.ndarray, " edges"]
    areas: Float[np.ndarray, " cells"]


def geometry_of(tissue: Tissue) -> Geometry:
    """The geometry of a tissue; compiled once for each size class (see `pad`)."""
    padded = pad(tissue)
    parts = [np.asarray(x) for x in _measure(padded)]
    m = tissue.topology
    sizes = (m.n_edges, m.n_edges, m.n_half_edges, m.n_edges, m.n_edges, m.n_edges, m.n_cells)
    geometry = Geometry(*(x[:size] for x, size in zip(parts, sizes, strict=True)))
    cells = np.where(geometry.edge_cells == padded.n_cells, tissue.n_cells, geometry.edge_cells)
    names = ("edge_vectors", "edge_lengths", "edge_angles", "areas")
    floats = {name: getattr(geometry, name).astype(float) for name in names}
    return geometry._replace(edge_cells=cells, **floats)


@announced_jit
def _measure(tissue: Tissue) -> list[Array]:
    m = tissue.topology
    topology = [m.edge_vertices, m.edge_cells, m.forward]
    lengths = [tissue.edge_vectors, tissue.edge_lengths, tissue.edge_angles, tissue.areas]
    return jax.tree.map(jax.numpy.asarray, topology + lengths)
