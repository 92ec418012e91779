"""Label images of foams on a sphere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from vertax._base.checks import check_number


# The stereographic projection is conformal, and maps circles to circles. So it keeps the angles at junctions,
# arcs of constant curvature become circles of the sphere, which have a constant geodesic curvature, and by
#   κ' = e^{-φ} (κ + ∂φ/∂n),   Σ γ ∂φ/∂n = ∇φ · Σ γ n = 0
# the sum of γ κ at each junction stays 0: a foam in equilibrium keeps its tensions (Weaire & Rivier 1984).
def labels_on_sphere(
    labels: Int[np.ndarray, "rows columns"], radius: float
) -> tuple[Int[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """The image of a foam on a sphere, seen from above, from that of a planar foam with the same tensions.

    The foam is projected stereographically from the plane that touches the sphere, and then along the
    axis of the sphere. The middle of the image is the pole.

    **Arguments:**

    - `labels`: label image of the planar foam.
    - `radius`: radius of the sphere, in pixels.

    **Returns:** the label image, and the height of each pixel in pixels (NaN outside of the sphere).

    **Raises:**

    - `ValueError` for a radius that is not positive.
    """
    check_number("radius", radius, above=0)
    rows, columns = labels.shape
    x, y = np.meshgrid(np.arange(columns) + 0.5 - columns / 2, np.arange(rows) + 0.5 - rows / 2)
    distance = np.hypot(x, y)
    sphere = distance < radius
    height = np.sqrt(np.where(sphere, radius**2 - distance**2, np.nan))
    # A point at the angle θ from the pole is at R sin θ in the image, and at 2 R tan(θ/2) in the plane.
    stretch = 2 * radius / (radius + np.where(sphere, height, radius))
    row = np.floor(y * stretch + rows / 2).astype(int)
    column = np.floor(x * stretch + columns / 2).astype(int)
    inside = sphere & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    image = labels[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return np.where(inside, image, 0), height
