"""Repair of overlaps in initial tissues."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax.mesh import Tissue, crossed_sides, geometry_of, pad

# Largest number of rounds of flattening, and of bending back.
_ROUNDS = 60
# Number of bisections for the largest angles without overlaps.
_BISECTIONS = 6


def repair_overlaps(tissue: Tissue, *, bend_back: bool = False) -> Tissue:
    """The same tissue, repaired where its cells overlap, and only there.

    Arcs are flattened; where straight edges cross, vertices move towards their neighbours. With
    `bend_back` each arc is then bent back as far as no overlap returns, which keeps the areas of cells.

    **Raises:**

    - `ValueError` if cells still overlap after 60 rounds.
    """
    angles = None if tissue.arcs is None else np.asarray(tissue.arcs.angles)
    for attempt in range(_ROUNDS):
        crossed = _crossed(tissue)
        if not crossed.any():
            if angles is None or not bend_back or attempt == 0:
                return tissue
            return _bent_back(tissue, angles)
        touched = _edges_of(tissue, crossed, whole_cells=True)
        geometry = geometry_of(tissue)
        ends = geometry.edge_vertices
        if tissue.arcs is not None:
            tissue = tissue.with_angles(jnp.where(touched, 0.7, 1) * tissue.arcs.angles)
        if tissue.arcs is None or attempt >= _ROUNDS // 4:
            moving = np.zeros(tissue.n_vertices, bool)
            moving[ends[touched]] = True
            step = np.zeros((tissue.n_vertices, 2))
            vectors = geometry.edge_vectors
            np.add.at(step, ends[:, 0], vectors / 3)
            np.add.at(step, ends[:, 1], -vectors / 3)
            tissue = tissue.with_vertices(
                tissue.vertices + 0.5 * jnp.asarray(np.where(moving[:, None], step, 0))
            )
    raise ValueError(
        f"Cells of the initial tissue overlap: {tissue.overlaps.describe()}. Smooth the outlines from "
        "which it is made, or leave these cells out."
    )


def _bent_back(tissue: Tissue, angles: Float[np.ndarray, " edges"]) -> Tissue:
    """The tissue with each arc as near to an angle as possible without overlaps."""
    assert tissue.arcs is not None
    flat = np.asarray(tissue.arcs.angles)
    bent = lambda x: tissue.with_angles(jnp.asarray(flat + x * (angles - flat), flat.dtype))
    fraction, limit = np.ones(len(flat)), np.ones(len(flat))
    for attempt in range(_ROUNDS):
        result = bent(fraction)
        crossed = _crossed(result)
        if not crossed.any():
            break
        # First the arcs that cross another side, then all arcs of these cells.
        touched = _edges_of(tissue, crossed, whole_cells=attempt >= _ROUNDS // 3)
        limit = np.where(touched, fraction, limit)
        fraction = np.where(touched, np.where(fraction > 0.05, 0.6 * fraction, 0.0), fraction)
    else:
        return tissue
    for _ in range(_BISECTIONS):
        middle = 0.5 * (fraction + limit)
        trial = bent(middle)
        crossed = _crossed(trial)
        touched = _edges_of(tissue, crossed, whole_cells=False)
        limit = np.where(touched, middle, limit)
        fraction = np.where(touched, fraction, middle)
        result = result if crossed.any() else trial
    return result


def _crossed(tissue: Tissue) -> Bool[np.ndarray, " halfedges"]:
    """Which half-edges cross another side of their face."""
    # (Tissues of similar sizes share the compiled function.)
    return np.asarray(pad(tissue).overlaps.sides)[: tissue.topology.n_half_edges]


def _edges_of(
    tissue: Tissue, crossed: Bool[np.ndarray, " halfedges"], *, whole_cells: bool
) -> Bool[np.ndarray, " edges"]:
    """The edges of half-edges, or all edges of their cells as well."""
    m = tissue.topology
    edges = np.zeros(m.n_edges, bool)
    edges[np.asarray(m.edge)[crossed]] = True
    if whole_cells:
        bad = np.bincount(np.asarray(m.cell), crossed, m.n_faces) > 0
        bad[m.n_cells :] = False
        edges |= np.any(bad[geometry_of(tissue).edge_cells], axis=1)
    return edges


def crossed_by(
    sides: Float[np.ndarray, "sides parts"],
    following: Int[np.ndarray, " sides"],
    face: Int[np.ndarray, " sides"],
) -> Int[np.ndarray, " sides"]:
    """For each side another side of its face that it crosses, or itself.

    **Arguments:**

    - `sides`: start, vector, and if there are arcs the angle of each side.
    - `following`: the next side of the face.
    - `face`: the number of the face.
    """
    # Padded to a power of two: tissues of similar sizes share the compiled function.
    n = following.size
    more = max(64, 1 << (n - 1).bit_length()) - n
    last = np.bincount(face)[face] - 2
    padded = (
        np.pad(sides, ((0, more), (0, 0))),
        np.concatenate([following, np.arange(n, n + more)]).astype(np.int32),
        np.pad(last, (0, more)).astype(np.int32),
    )
    return np.asarray(_compiled(*map(jnp.asarray, padded)))[:n]


_compiled = announced_jit(crossed_sides)
