"""Periodic Voronoi tissues and the hexagonal lattice."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray
from scipy.spatial import Delaunay, KDTree

from vertax._base.checks import as_float64, as_key, check_concrete, check_integer, check_number
from vertax.initialise._spatial_order import spatial_order
from vertax.mesh import Periodic, Tissue, Topology

# Largest distance of seeds from the origin, in boxes; above, rounding changes their position in the box.
_MAX_DISTANCE = 1e8


def periodic_voronoi(
    n_cells: int | None = None,
    *,
    seeds: ArrayLike | None = None,
    key: PRNGKeyArray | int | None = None,
    lattice: ArrayLike | None = None,
    lloyd_steps: int = 0,
    softening: float | None = None,
) -> Tissue:
    r"""Periodic Voronoi tessellation of random or given seeds (paper, Methods, "Mesh initialization").

    Cells have the numbers of their seeds. Random seeds are numbered along a space-filling curve.

    **Arguments:**

    - `n_cells`: number of random seeds, uniform in the box; needs `key`. Or
    - `seeds`, shape `(cells, 2)`: the seeds themselves; they may lie outside the box.
    - `key`: a key from `jax.random.key`, or an integer as its seed, for random seeds.
    - `lattice`, shape `(2, 2)`: the two lattice vectors of the box as rows; by default a square of side
        $\sqrt N$, so that the mean cell area is 1. Boxes may be sheared.
    - `lloyd_steps`: number of Lloyd iterations (each seed moves to the mean of its cell's corners),
        which make the tissue more regular.
    - `softening`: passed on to [`Tissue`][vertax.Tissue].

    **Returns:** a [`Tissue`][vertax.Tissue] with a [`Periodic`][vertax.Periodic] boundary.

    **Raises:**

    - `ValueError` if both or neither of `n_cells` and `seeds` are given, if seeds are not finite, of
        the wrong shape, fewer than one, or coincide (also across the periodic boundary).
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`, because the topology
        depends on concrete values.
    """
    check_concrete("periodic_voronoi", seeds, key, lattice)
    if (n_cells is None) == (seeds is None):
        raise ValueError("Give either `n_cells` (with `key`) or `seeds`, and not both.")
    if n_cells is not None:
        check_integer("n_cells", n_cells, at_least=1)
    check_integer("lloyd_steps", lloyd_steps, at_least=0)
    dtype = jnp.result_type(float)
    points = np.zeros((0, 2))
    if seeds is not None:
        points = as_float64("seeds", seeds)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(
                f"Argument `seeds` must have shape (cells, 2), but has {points.shape}."
            )
        n_cells = len(points)
    if n_cells is None or n_cells < 1:
        raise ValueError(f"A tissue needs at least one cell, but got {n_cells} seeds.")
    box = np.sqrt(n_cells) * np.eye(2)
    if lattice is not None:
        box = as_float64("lattice", lattice)
    boundary = Periodic(jnp.asarray(box, dtype))
    if seeds is None:
        if key is None:
            raise ValueError(
                "Argument `key` is needed for random seeds: pass jax.random.key(seed)."
            )
        fractions = np.asarray(jax.random.uniform(as_key(key), (n_cells, 2), dtype), float)
        points = fractions[spatial_order(fractions)] @ box

    _, vertices, topology = tessellate(points, box, lloyd_steps)
    return Tissue(jnp.asarray(vertices, dtype), topology, boundary, softening)


def hexagonal(nx: int, ny: int, *, area: float = 1.0, softening: float | None = None) -> Tissue:
    """Periodic lattice of `nx` × `ny` regular hexagons.

    The box is a rectangle for even `ny`; for odd `ny` its second vector leans by half a cell.

    **Arguments:**

    - `nx`, `ny`: number of cells in a row, and number of rows.
    - `area`: area of each hexagon.
    - `softening`: passed on to [`Tissue`][vertax.Tissue].

    **Returns:** a [`Tissue`][vertax.Tissue] with a [`Periodic`][vertax.Periodic] boundary.

    **Raises:**

    - `ValueError` for fewer than one cell or row, or an area that is not positive.
    """
    check_concrete("hexagonal", area)
    check_integer("nx", nx, at_least=1)
    check_integer("ny", ny, at_least=1)
    check_number("area", area, above=0)
    spacing = np.sqrt(2 * area / np.sqrt(3))
    column, row = np.meshgrid(np.arange(nx), np.arange(ny))
    x = column + 0.5 * (row % 2)
    y = row * np.sqrt(3) / 2
    seeds = spacing * np.stack([x.ravel(), y.ravel()], axis=1)
    lattice = spacing * np.array([[nx, 0.0], [0.5 * (ny % 2), ny * np.sqrt(3) / 2]])
    return periodic_voronoi(seeds=seeds, lattice=lattice, softening=softening)


def tessellate(
    seeds: np.ndarray, lattice: np.ndarray, lloyd_steps: int
) -> tuple[np.ndarray, np.ndarray, Topology]:
    """Seeds after some Lloyd iterations, and their periodic Voronoi tessellation."""
    for _ in range(lloyd_steps):
        vertices, topology = _voronoi(seeds, lattice)
        corners = np.repeat(vertices, 3, axis=0) + np.asarray(topology.frame) @ lattice
        cell = np.asarray(topology.cell)
        sides = np.bincount(cell, minlength=len(seeds))
        seeds = np.stack([np.bincount(cell, x, len(seeds)) / sides for x in corners.T], axis=1)
    return seeds, *_voronoi(seeds, lattice)


def _voronoi(seeds: np.ndarray, lattice: np.ndarray) -> tuple[np.ndarray, Topology]:
    """Vertices and topology of the periodic Voronoi tessellation of `seeds`."""
    # Cocircular seeds (as in a square lattice) have several Delaunay triangulations, and SciPy may return one
    # that is not periodic. A small displacement of the seeds (the same for all images) and of the lattice
    # selects one; the vertices are the circumcentres of the given seeds.
    for attempt, jitter in enumerate((0.0, 1e-9, 1e-7)):
        rng = np.random.default_rng(attempt)
        scale = jitter * np.sqrt(np.linalg.det(lattice) / len(seeds))
        moved = seeds + scale * rng.standard_normal(seeds.shape)
        strained = lattice @ (np.eye(2) + jitter * rng.standard_normal((2, 2)))
        triangles = _periodic_delaunay(moved, strained)
        if triangles is not None:
            return _dual(seeds, lattice, *triangles)
    raise ValueError(
        "Argument `seeds` has no periodic Voronoi tessellation with three cells at every vertex: too "
        "many seeds lie on one circle. Displace them a little."
    )


def _periodic_delaunay(
    seeds: np.ndarray, lattice: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """One triangle of each class of the periodic Delaunay triangulation, counter-clockwise.

    Returns seed numbers `(triangles, 3)` and lattice images `(triangles, 3, 2)`, or None if the
    triangulation is not periodic.
    """
    n = len(seeds)
    # With a reduced basis (Lagrange-Gauss) a small number of images suffices, also in sheared boxes.
    basis, change = _reduce(lattice)
    fractions = seeds @ np.linalg.inv(basis)
    if np.abs(fractions).max() > _MAX_DISTANCE:
        raise ValueError(
            f"Argument `seeds` must lie within {_MAX_DISTANCE:.0e} boxes of the origin, but the farthest is "
            f"{np.abs(fractions).max():.0e} boxes away."
        )
    home = np.floor(fractions).astype(int)
    fractions = fractions - home
    spacing = 1 / np.sqrt(n)
    tree = KDTree(fractions, boxsize=1.0)
    distance = tree.query(fractions, k=2)[0][:, 1] if n > 1 else np.ones(1)
    if distance.min() < 1e-12 * spacing:
        first, second = tree.query_pairs(1e-12 * spacing, output_type="ndarray")[0]
        raise ValueError(
            f"Argument `seeds` must be distinct, but seeds {first} and {second} coincide "
            "(up to periodicity)."
        )
    # The radius of an empty circle is at most the covering radius of the images of one seed, which is below
    # 0.71 of the longer reduced vector: a margin of 1.5 boxes always suffices, a smaller one for many seeds.
    for margin in (min(1.5, 8 * spacing), 1.5):
        reach = int(np.ceil(margin))
        grid = np.arange(-reach, reach + 1)
        images = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
        copies = fractions[None] + images[:, None]
        keep = np.all((copies > -margin) & (copies < 1 + margin), axis=-1)
        image_id, seed_id = np.nonzero(keep)
        points = copies[keep] @ basis
        mesh = Delaunay(points)
        simplices = mesh.simplices
        p, q, r = (points[simplices[:, k]] for k in range(3))
        upright = (q - p)[:, 0] * (r - p)[:, 1] > (q - p)[:, 1] * (r - p)[:, 0]
        simplices = np.where(upright[:, None], simplices, simplices[:, ::-1])
        at_home = (images[image_id] == 0).all(axis=1)
        simplices = simplices[at_home[simplices].any(axis=1)]
        centre = _circumcentres(points[simplices])
        radius = np.linalg.norm(centre - points[simplices[:, 0]], axis=1)
        # Width of the margin across each pair of box sides.
        heights = np.abs(np.linalg.det(basis)) / np.linalg.norm(basis, axis=1)
        if margin == 1.5 or 2 * radius.max() < margin * heights.min():
            break
    ids = seed_id[simplices]
    image = images[image_id[simplices]]

    # Canonical form of a class: translate a corner to the home box, rotate the smallest to the front.
    rotations = np.stack([np.stack([np.roll(ids, -k, 1)], -1) for k in range(3)])[..., 0]
    shifts = np.stack([np.roll(image, -k, 1) for k in range(3)])
    shifts = shifts - shifts[:, :, :1]
    rows = np.concatenate([rotations, shifts.reshape(3, len(ids), 6)], axis=-1)
    front = np.zeros(len(ids), int)
    for k in (1, 2):
        best = rows[front, np.arange(len(ids))]
        difference = rows[k] - best
        first_nonzero = np.argmax(difference != 0, axis=1)
        smaller = difference[np.arange(len(ids)), first_nonzero] < 0
        front = np.where(smaller, k, front)
    classes = np.unique(rows[front, np.arange(len(ids))], axis=0)
    if len(classes) != 2 * n:
        return None
    ids, image = classes[:, :3], classes[:, 3:].reshape(-1, 3, 2)
    # Convert to images of the given seeds in the given lattice.
    return ids, (image - home[ids]) @ change


def _dual(
    seeds: np.ndarray, lattice: np.ndarray, ids: np.ndarray, image: np.ndarray
) -> tuple[np.ndarray, Topology]:
    """The trivalent mesh with the circumcentres of the triangles as vertices."""
    vertices = _circumcentres(seeds[ids] + image @ lattice)
    box = np.floor(vertices @ np.linalg.inv(lattice) + 1e-12).astype(int)
    vertices = vertices - box @ lattice
    order = spatial_order(vertices @ np.linalg.inv(lattice))
    vertices, ids, image = vertices[order], ids[order], (image - box[:, None])[order]
    # Half-edge k of a triangle crosses the side opposite to its corner k, so the three half-edges are in
    # counter-clockwise order, with corner k + 2 on the left and corner k + 1 on the right.
    left, right = np.roll(ids, 1, axis=1).ravel(), np.roll(ids, -1, axis=1).ravel()
    left_image = np.roll(image, 1, axis=1).reshape(-1, 2)
    right_image = np.roll(image, -1, axis=1).reshape(-1, 2)
    step = right_image - left_image
    forward = np.column_stack([left, right, step])
    backward = np.column_stack([right, left, -step])
    # Each directed pair of neighbours (left, right, image) occurs once; its twin is the reversed pair.
    at_forward = np.lexsort(forward.T)
    at_backward = np.lexsort(backward.T)
    twin = np.empty(len(left), int)
    twin[at_forward] = at_backward
    return vertices, Topology(twin, left, -left_image)


def _circumcentres(triangles: np.ndarray) -> np.ndarray:
    """Circumcentres of triangles `(n, 3, 2)`."""
    p = triangles[:, 0]
    q, r = triangles[:, 1] - p, triangles[:, 2] - p
    q2, r2 = (q**2).sum(1), (r**2).sum(1)
    twice = 2 * (q[:, 0] * r[:, 1] - q[:, 1] * r[:, 0])
    offset = np.stack([r[:, 1] * q2 - q[:, 1] * r2, q[:, 0] * r2 - r[:, 0] * q2], axis=1)
    return p + offset / twice[:, None]


def _reduce(lattice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shortest basis of a lattice, and the integer matrix with basis = change @ lattice."""
    change = np.eye(2, dtype=int)
    basis = lattice
    for _ in range(64):
        u, v = basis
        if u @ u > v @ v:
            step = np.array([[0, 1], [-1, 0]])  # swap, keeping the orientation
        else:
            step = np.array([[1, 0], [-round((u @ v) / (u @ u)), 1]])
            if step[1, 0] == 0:
                break
        change = step @ change
        basis = change @ lattice
    return basis, change
