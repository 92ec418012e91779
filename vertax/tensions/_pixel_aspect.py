"""The height over the width of pixels, from the angles at junctions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from vertax._base.pixels import PixelSize, pixel_sides
from vertax.mesh import Tissue
from vertax.tensions._observed_geometry import observed_geometry

# Smallest ratio, number of standard errors, and number of junctions for a warning. (In a wing of a fly, where
# tensions depend on the direction, the ratio is 1.3.)
_RATIO, _ERRORS, _JUNCTIONS = 1.5, 4.0, 10


# Three equal tensions balance at angles of 120 degrees, where the sum of t tᵀ over the unit tangents t is 3/2
# times the identity, for cells of any elongation. Directions that are multiplied by (1, s) in pixels which
# are not square violate that, all along the axes of the image. So s is estimated as the stretch after which
# the mean of tx² - ty² over all junctions is zero.
def pixel_aspect_warning(
    tissue: Tissue, holes: Bool[np.ndarray, " cells"], pixel_size: PixelSize
) -> str | None:
    """A warning if angles at junctions suggest other pixels than assumed.

    A tissue can be so too, if tensions differ by direction or forces do not balance: it is not refused.

    **Arguments:**

    - `tissue`: the tissue.
    - `holes`: faces that are no cells.
    - `pixel_size`: the size of a pixel that was assumed.

    **Returns:** a sentence with the remedy, or None.
    """
    geometry = observed_geometry(tissue, holes)
    junctions = np.flatnonzero(geometry.inner)
    if len(junctions) < _JUNCTIONS:
        return None
    edge, forward = geometry.half_edge[junctions], geometry.forward[junctions]
    chord, angle = geometry.chord[edge], geometry.angle[edge]
    # Short edges have no direction.
    long = np.linalg.norm(chord, axis=-1) > 0.1 * geometry.size
    direction = np.arctan2(chord[..., 1], chord[..., 0]) + np.where(forward, -angle, np.pi + angle)
    tangent = np.stack([np.cos(direction), np.sin(direction)], axis=-1)[long.all(axis=1)]
    if len(tangent) < _JUNCTIONS:
        return None
    logs = np.linspace(-2.5, 2.5, 501)
    anisotropy = np.array([_anisotropy(tangent, np.exp(log)).mean() for log in logs])
    best = float(np.interp(0.0, -anisotropy, logs))
    slope = -np.gradient(anisotropy, logs)[np.argmin(np.abs(logs - best))]
    spread = _anisotropy(tangent, np.exp(best)).std() / np.sqrt(len(tangent))
    error = spread / max(slope, 1e-9)
    if abs(best) < max(np.log(_RATIO), _ERRORS * error):
        return None
    width, height = pixel_sides(pixel_size)
    ratio = float(np.exp(best) * height / width)
    size = f"({ratio:.2f}, 1)" if ratio > 1 else f"(1, {1 / ratio:.2f})"
    return (
        f"angles at junctions are as if the height of a pixel were {ratio:.2f} of its width instead of "
        f"{height / width:.2f}: if that is so, pass pixel_size=(height, width), such as {size}; if it is "
        "not, tensions depend on the direction, or the tissue is stretched faster than its junctions move"
    )


def _anisotropy(
    tangent: Float[np.ndarray, "junctions 3 2"], stretch: float
) -> Float[np.ndarray, " junctions"]:
    """Mean of tx² - ty² at each junction after a stretch along y."""
    x, y = tangent[..., 0], stretch * tangent[..., 1]
    return np.mean((x**2 - y**2) / (x**2 + y**2), axis=1)
