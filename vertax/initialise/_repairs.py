"""Repairs that make a label image one of a trivalent mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from vertax.initialise._cracks import CrackGraph, Mesh, NotADiskError, build_mesh, enclosed_cells
from vertax.initialise._pieces import longest_interface

_REMEDY = (
    "Give a larger image, or a finer segmentation; if a label stands for the background, name it by the "
    "argument `background`."
)


def mesh_or_repairs(
    graph: CrackGraph,
    values: Int[np.ndarray, " labels"],
    exterior: int | None = None,
    remedy: str = "",
    *,
    arcs: bool = True,
) -> Mesh | Int[np.ndarray, " labels"]:
    """The mesh, or the label that replaces each label before there can be one.

    **Arguments:**

    - `graph`: the sides between pixels of different labels.
    - `values`: the label of each number in the image; 0 for holes and the exterior.
    - `exterior`: number of the exterior.
    - `remedy`: what to do if too few labels remain.
    - `arcs`: whether edges on the outline are arcs, so that a cell there may have two sides.
    """
    n = len(values)
    label = np.arange(n)
    left, right = (side % n for side in graph.interfaces())
    too_few = (
        "Argument `mask` must hold enough cells for a mesh of cells with three sides and more, but of its "
        f"{np.count_nonzero(values)} labels too few remain after those inside others, with two sides or "
        "apart from the largest cluster are left out. " + (remedy or _REMEDY)
    )
    if len(np.unique(left)) < (2 if exterior is None else 3):
        raise ValueError(too_few)
    try:
        inside = enclosed_cells(graph, exterior)
    except NotADiskError as error:
        raise ValueError(
            "Argument `mask` must hold cells that do not surround the others or reach from one "
            "border of the image to the opposite one (where they would meet themselves across the "
            f"mirrored or periodic boundary), but the labels {listed(values[error.cells % n])} "
            "do. Crop the image, split them, or take a larger image; if one of them is the background, "
            "name it by the argument `background`."
        ) from None
    if inside:
        into = label.copy()
        into[np.array(list(inside)) % n] = np.array(list(inside.values())) % n
        return into
    mesh = build_mesh(graph, graph.left % n)
    too_small = np.bincount(mesh.cell) < 3
    if exterior is not None:
        too_small[-1] = False
        if arcs:
            too_small[mesh.cell[mesh.cells[mesh.cell[mesh.twin]] == exterior]] = False
    if not too_small.any():
        return mesh
    small = np.zeros(n, bool)
    small[mesh.cells[too_small] % n] = True
    guest, host = longest_interface(left[small[left]], right[small[left]])
    # Two small cells must not go to each other: between them, the one with the shorter outline goes
    # first. Then every chain of cells that are absorbed one into the other has an end.
    outline = np.bincount(left, minlength=n)
    first = ~small[host] | (outline[guest] < outline[host])
    first |= small[host] & (outline[guest] == outline[host]) & (guest > host)
    into = label.copy()
    into[guest[first]] = host[first]
    while not np.array_equal(into[into], into):
        into = into[into]
    return into


def untangle(
    mesh: Mesh,
    size: Float[np.ndarray, " xy"],
    pixels: Int[np.ndarray, " cells"],
    bulge: Shaped[np.ndarray, " cells"],
) -> tuple[Float[np.ndarray, "vertices 2"] | None, Bool[np.ndarray, " cells"]]:
    """Vertices such that every cell has a positive area, and the cells that had next to none.

    `bulge` is what arcs add to the areas. Without vertices, the cells that are left over.
    """
    vertices = mesh.vertices.astype(float)
    before = np.empty_like(mesh.following)
    before[mesh.following] = np.arange(len(before))
    # Each cell that has less than a hundredth of its pixels gets the smallest displacement of its
    # corners that makes this two hundredths, to first order: goal - A = sum of (dA/dp) . dp has the
    # least-norm solution dp = (goal - A) dA/dp / sum of |dA/dp|^2. A few rounds settle what cells
    # take from each other.
    least, goal = 0.01 * pixels, 0.02 * pixels
    ever = bad = np.zeros(len(pixels), bool)
    for _ in range(300):
        corners = np.repeat(vertices, 3, axis=0) + mesh.frame * size
        ends, starts = corners[mesh.following], corners[before]
        areas = 0.5 * np.bincount(mesh.cell, np.linalg.det(np.stack([corners, ends], axis=1)))
        areas += bulge
        bad = areas < least
        if not bad.any():
            return vertices, ever
        ever = ever | bad
        slope = 0.5 * (ends - starts)[:, ::-1] * [1, -1]
        norm = np.bincount(mesh.cell, (slope**2).sum(axis=1))
        factor = np.where(bad, (goal - areas) / np.maximum(norm, 1e-3), 0.0)
        vertices = vertices + (factor[mesh.cell, None] * slope).reshape(-1, 3, 2).sum(axis=1)
    return None, bad


def listed(labels: Int[np.ndarray, " labels"]) -> str:
    unique = np.unique(labels).tolist()
    return ", ".join(map(str, unique[:10])) + (" and more" if len(unique) > 10 else "")
