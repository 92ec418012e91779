"""Repairs that make a label image one of a trivalent mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import distance_transform_edt, label as connected_regions
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vertax.initialise._cracks import CrackGraph, Mesh, NotADiskError, build_mesh, enclosed_cells


def fill_gaps(image: Int[np.ndarray, "rows columns"], periodic: bool) -> np.ndarray:
    """Give each gap (-1) the nearest label."""
    gap = image < 0
    if not gap.any():
        return image
    pad = np.zeros((2, 2), int)
    if periodic:
        # The nearest label around the torus is no farther than the nearest within the image. (A
        # mirror image is never nearer than its original, so a mirrored mask needs no such care.)
        reach = np.ceil(np.asarray(distance_transform_edt(gap)).max())
        pad = np.repeat(np.minimum(reach, image.shape)[:, None], 2, axis=1).astype(int)
        gap = np.pad(gap, pad, mode="wrap")
    y, x = np.asarray(distance_transform_edt(gap, return_distances=False, return_indices=True))
    rows, columns = image.shape
    home = (slice(pad[0, 0], pad[0, 0] + rows), slice(pad[1, 0], pad[1, 0] + columns))
    return image[(y[home] - pad[0, 0]) % rows, (x[home] - pad[1, 0]) % columns]


def join_pieces(image: Int[np.ndarray, "rows columns"], periodic: bool) -> np.ndarray:
    """Keep the largest piece of each label, and give the others to their neighbours."""
    # Runs of equal pixels along a row are the nodes: far fewer than pixels. Two runs in adjacent
    # rows overlap where one of them starts.
    start = np.ones(image.shape, bool)
    start[:, 1:] = image[:, 1:] != image[:, :-1]
    run = np.cumsum(start.ravel()).reshape(image.shape) - 1
    met = start[1:] | start[:-1]
    above, below = [run[:-1][met]], [run[1:][met]]
    if periodic:
        above += [run[-1], run[:, -1]]
        below += [run[0], run[:, 0]]
    a, b = np.concatenate(above), np.concatenate(below)
    label = image[start]
    same = label[a] == label[b]
    links = coo_array((np.ones(same.sum(), bool), (a[same], b[same])), shape=(len(label),) * 2)
    n_pieces, piece = connected_components(links, directed=False)
    n_labels = int(label.max()) + 1
    if n_pieces == n_labels:
        return image
    label_of = np.zeros(n_pieces, int)
    label_of[piece] = label
    piece = piece[run]
    sizes = np.bincount(piece.ravel(), minlength=n_pieces)
    order = np.lexsort((np.arange(n_pieces), -sizes, label_of))
    kept = np.zeros(n_pieces, bool)
    kept[order[np.unique(label_of[order], return_index=True)[1]]] = True
    a, b = piece[:, :-1].ravel(), piece[:, 1:].ravel()
    c, d = piece[:-1].ravel(), piece[1:].ravel()
    pairs = [np.stack([a, b])[:, a != b], np.stack([c, d])[:, c != d]]
    if periodic:
        pairs += [np.stack([piece[:, -1], piece[:, 0]]), np.stack([piece[-1], piece[0]])]
    a, b = np.concatenate(pairs, axis=1)
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    while not kept.all():  # pieces among pieces wait until a neighbour has found its label
        use = ~kept[a] & kept[b]
        joining, into = _longest_interface(a[use], label_of[b[use]])
        label_of[joining] = into
        kept[joining] = True
    return label_of.astype(image.dtype)[piece]


def with_exterior(
    image: Int[np.ndarray, "rows columns"], exterior: int, gap_width: float
) -> tuple[Int[np.ndarray, "padded_rows padded_columns"], int]:
    """The image in a margin, its gaps given to the exterior or to the nearest label; and the margin."""
    # The distance to the nearest label tells wide gaps from narrow ones: in the middle of a line of n
    # pixels it is (n + 1) / 2. Wide gaps connected with the margin are exterior, and take back the rim
    # that this leaves around the labels.
    reach = (gap_width + 1) / 2
    margin = int(np.ceil(2 * reach)) + 2
    image = np.pad(image, margin, constant_values=-1)
    gap = image < 0
    wide = np.asarray(distance_transform_edt(gap)) > reach
    pieces = np.zeros(image.shape, np.int32)
    connected_regions(wide, output=pieces)
    core = pieces == pieces[0, 0]
    near = np.asarray(distance_transform_edt(~core)) <= reach
    return fill_gaps(np.where(gap & near, exterior, image), periodic=False), margin


def largest_cluster(
    image: Int[np.ndarray, "rows columns"], exterior: int
) -> Int[np.ndarray, "rows columns"]:
    """All clusters but the one of most pixels become exterior."""
    cluster = np.zeros(image.shape, np.int32)
    connected_regions(image != exterior, output=cluster)
    sizes = np.bincount(cluster.ravel())
    sizes[0] = 0
    return np.where(cluster == np.argmax(sizes), image, exterior)


def mesh_or_repairs(
    graph: CrackGraph, values: Int[np.ndarray, " labels"], exterior: int | None = None
) -> Mesh | Int[np.ndarray, " labels"]:
    """The mesh, or which label each label must become first."""
    n = len(values)
    label = np.arange(n)
    left, right = (side % n for side in graph.interfaces())
    too_few = (
        "Argument `mask` must hold enough cells for a mesh of cells with three sides and more, but "
        f"of its {n - (exterior is not None)} labels too few remain after those inside others or with "
        "two sides are absorbed. Give a larger image, or a finer segmentation; if a label stands for the "
        "background, name it by the argument `background`."
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
        # Two sides are enough if one is an arc.
        too_small[mesh.cell[mesh.cells[mesh.cell[mesh.twin]] == exterior]] = False
        too_small[-1] = False
    if not too_small.any():
        return mesh
    small = np.zeros(n, bool)
    small[mesh.cells[too_small] % n] = True
    guest, host = _longest_interface(left[small[left]], right[small[left]])
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


def _longest_interface(
    a: Int[np.ndarray, " sides"], b: Int[np.ndarray, " sides"]
) -> tuple[Int[np.ndarray, " distinct"], Int[np.ndarray, " distinct"]]:
    """For each number in `a`, the number in `b` paired with it most often (or the smallest)."""
    pairs, counts = np.unique(np.stack([a, b]), axis=1, return_counts=True)
    order = np.lexsort((pairs[1], -counts, pairs[0]))
    first = order[np.unique(pairs[0][order], return_index=True)[1]]
    return pairs[0][first], pairs[1][first]


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
