"""Repair of overlaps in initial tissues."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax.mesh import Periodic, Tissue, crossed_sides, geometry_of

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
    m = tissue.topology
    cell, twin = np.asarray(m.cell), np.asarray(m.twin)
    following = np.where(twin % 3 == 0, twin + 2, twin - 1)
    changed = np.ones(m.n_faces, bool)
    for attempt in range(_ROUNDS):
        crossed = _crossed(tissue, following, cell, changed)
        bad = np.bincount(cell, crossed, m.n_faces)[: m.n_cells] > 0
        if not crossed.any():
            if angles is None or not bend_back or attempt == 0:
                return tissue
            return _bent_back(tissue, angles, following, cell)
        geometry = geometry_of(tissue)
        ends, faces = geometry.edge_vertices, geometry.edge_cells
        touched = np.any(np.append(bad, False)[faces], axis=1)
        touched[np.asarray(m.edge)[crossed]] = True
        changed = np.zeros(m.n_faces, bool)
        changed[cell.reshape(-1, 3)[np.unique(ends[touched])]] = True
        if tissue.arcs is not None:
            tissue = tissue.with_angles(jnp.where(touched, 0.7, 1) * tissue.arcs.angles)
        if tissue.arcs is None or attempt >= _ROUNDS // 4:
            moving = np.zeros(m.n_vertices, bool)
            moving[ends[touched]] = True
            step = np.zeros((m.n_vertices, 2))
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


def _bent_back(
    tissue: Tissue,
    angles: Float[np.ndarray, " edges"],
    following: Int[np.ndarray, " halfedges"],
    cell: Int[np.ndarray, " halfedges"],
) -> Tissue:
    """The tissue with each arc as near to an angle as possible without overlaps."""
    m = tissue.topology
    edge = np.asarray(m.edge)
    assert tissue.arcs is not None
    flat = np.asarray(tissue.arcs.angles)
    faces = geometry_of(tissue).edge_cells
    fraction, limit = np.ones(len(flat)), np.ones(len(flat))
    changed = np.ones(m.n_faces, bool)
    for attempt in range(_ROUNDS):
        trial = tissue.with_angles(jnp.asarray(flat + fraction * (angles - flat), flat.dtype))
        crossed = _crossed(trial, following, cell, changed)
        if not crossed.any():
            tissue = trial
            break
        # First the arcs that cross another side, then all arcs of these cells.
        touched = np.zeros(len(flat), bool)
        touched[edge[crossed]] = True
        if attempt >= _ROUNDS // 3:
            bad = np.bincount(cell, crossed, m.n_faces)[: m.n_cells] > 0
            touched |= np.any(np.append(bad, False)[faces], axis=1)
        limit = np.where(touched, fraction, limit)
        changed = np.zeros(m.n_faces, bool)
        changed[faces[touched]] = True
        fraction = np.where(touched, np.where(fraction > 0.05, 0.6 * fraction, 0.0), fraction)
    else:
        return tissue
    changed = np.zeros(m.n_faces, bool)
    changed[faces[fraction < limit]] = True
    for _ in range(_BISECTIONS):
        middle = 0.5 * (fraction + limit)
        trial = tissue.with_angles(jnp.asarray(flat + middle * (angles - flat), flat.dtype))
        crossed = _crossed(trial, following, cell, changed)
        touched = np.zeros(len(flat), bool)
        touched[edge[crossed]] = True
        limit = np.where(touched, middle, limit)
        fraction = np.where(touched, fraction, middle)
        tissue = tissue if crossed.any() else trial
    return tissue


def _crossed(
    tissue: Tissue,
    following: Int[np.ndarray, " halfedges"],
    cell: Int[np.ndarray, " halfedges"],
    changed: Bool[np.ndarray, " faces"],
) -> Bool[np.ndarray, " halfedges"]:
    """Which half-edges cross another side of their face; only faces that `changed` are compared."""
    n = following.size
    start = np.repeat(np.asarray(tissue.vertices), 3, axis=0)
    if isinstance(tissue.boundary, Periodic):
        start = start + np.asarray(tissue.topology.frame) @ np.asarray(tissue.boundary.lattice)
    sides = np.concatenate([start, start[following] - start], axis=1)
    if tissue.arcs is not None:
        edge, half_edge = (np.asarray(x) for x in (tissue.topology.edge, tissue.topology.half_edge))
        angles = np.asarray(tissue.arcs.angles)
        if not tissue.inner_arcs:
            angles = np.where(
                cell[np.asarray(tissue.topology.twin)[half_edge]] == tissue.n_cells, angles, 0
            )
        forward = half_edge[edge] == np.arange(n)
        sides = np.column_stack([sides, np.where(forward, 1, -1) * angles[edge]])
    some = np.flatnonzero(changed[cell])
    number = np.zeros(n, int)
    number[some] = np.arange(len(some))
    crossed = np.zeros(n, bool)
    if len(some):
        other = crossed_by(sides[some], number[following[some]], cell[some])
        crossed[some] = other != np.arange(len(some))
    return crossed


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
