"""Preparation of images for the comparison with a mesh."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter, zoom

from vertax.costs import MeshImage
from vertax.energies import ShapeFactorEnergy
from vertax.mesh import Periodic, Tissue


def in_even_light(
    pixels: Float[np.ndarray, "rows columns"],
    pixel_size: float,
    background_width: float,
    longest_side: int,
) -> Float[np.ndarray, "coarse_rows coarse_columns"]:
    """The image with a uniform background, and at most `longest_side` pixels wide and high."""
    # The logarithm reduces the contrast of bright junctions with faint membranes, as the segmentation does.
    bright = pixels - pixels.min()
    bright = np.log1p(bright / bright.mean())
    diameter = 1 / pixel_size  # the mean cell area is 1
    even = bright - gaussian_filter(bright, background_width * diameter, mode="reflect")
    factor = longest_side / max(pixels.shape)
    if factor >= 1:
        return even
    shape = [max(16, round(side * factor)) for side in pixels.shape]
    smooth = gaussian_filter(even, 0.35 / factor, mode="reflect")
    steps = [new / old for new, old in zip(shape, pixels.shape, strict=True)]
    # Pixels as areas: the coarse image covers the same extent as the fine one.
    return np.asarray(zoom(smooth, steps, order=1, mode="reflect", grid_mode=True))


def away_from_outline(
    tissue: Tissue,
    on_outline: Bool[np.ndarray, " edges"],
    cells: Bool[np.ndarray, "rows columns"],
    pixel: float,
    shape: tuple[int, ...],
) -> Float[np.ndarray, "coarse_rows coarse_columns"]:
    """Weights of pixels: 1 inside the outline, in the image and in the mesh, and not close to it; 0
    elsewhere."""
    # The outline is not an interface of two cells, and the mesh cuts its corners: it has no weight.
    inside = binary_closing(np.pad(cells, 8), iterations=6)[8:-8, 8:-8]
    margin = 0.15 / pixel * cells.shape[1] / shape[1]
    inside = distance_transform_edt(inside) > margin
    steps = [new / old for new, old in zip(shape, cells.shape, strict=True)]
    near = np.asarray(zoom(inside.astype(float), steps, order=1, grid_mode=True, mode="nearest"))
    start, vector = (np.asarray(x, float)[on_outline, None] for x in tissue.edge_segments)
    points = ((np.indices(shape)[::-1] + 0.5) * pixel).reshape(2, -1).T
    along = np.sum((points - start) * vector, axis=-1) / np.sum(vector**2, axis=-1)
    foot = start + np.clip(along, 0, 1)[..., None] * vector
    distance = np.linalg.norm(points - foot, axis=-1).min(axis=0).reshape(shape)
    return np.where(distance > 0.15, np.clip(near, 0, 1), 0.0)


def best_psf_width(tissue: Tissue, options: dict[str, Any], shape: tuple[int, ...]) -> float:
    """The width of the blur, in units of length, at which the rendered mesh fits the image best.

    `options` are those of `MeshImage`, and `shape` is that of the image, which in a mirrored tissue is a
    quarter of the whole.
    """
    no_energy = ShapeFactorEnergy(0.0)  # the image cost does not depend on the energy

    @eqx.filter_jit
    def misfit(width: Float[Array, ""]) -> Float[Array, ""]:
        return MeshImage(psf_width=width, **options)(tissue, no_energy)

    if isinstance(tissue.boundary, Periodic):
        pixel = float(tissue.boundary.lattice[0, 0]) / (2 * shape[1])
    else:
        pixel = options["pixel_size"]
    widths = pixel * np.geomspace(1.0, 12.0, 30)
    return float(widths[np.argmin([float(misfit(jnp.asarray(w))) for w in widths])])
