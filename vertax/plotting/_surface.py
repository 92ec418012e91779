"""Drawing of a tissue on a surface, in space."""

from __future__ import annotations

from typing import Any, SupportsFloat

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real
from matplotlib.colors import Colormap
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from vertax.mesh import Drawing, Tissue
from vertax.plotting import _style
from vertax.plotting._colours import Colours, add_bar
from vertax.plotting._tissue import checked, single
from vertax.surfaces import AbstractSurface


def plot_surface(
    tissue: Tissue,
    cells: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    ax: Axes3D | None = None,
    cmap: str | Colormap = "viridis",
    vmin: SupportsFloat | None = None,
    vmax: SupportsFloat | None = None,
    label: str | None = None,
    elevation: SupportsFloat = 35.0,
    azimuth: SupportsFloat = -60.0,
) -> Axes3D:
    """Draw a tissue on a surface in space, its cells coloured by values.

    Sides are drawn as they lie on the surface. A periodic cell is drawn in one piece. Matplotlib draws cells
    in the order of their distance, those in front last.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue], on a surface.
    - `cells`: one value for each cell; cells with a value that is not finite are grey. By default cells are
        pale and shaded by their slope.
    - `ax`: the axes to draw in, of `figure.add_subplot(projection="3d")`; by default those of a new figure.
    - `cmap`, `vmin`, `vmax`, `label`: colour map, limits and label of the colour bar.
    - `elevation`, `azimuth`: direction of the view, in degrees.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for a tissue in the plane, a batch of tissues, or values of the wrong length.
    """
    surface = single(tissue).surface
    if surface is None:
        raise ValueError(
            "Argument `tissue` must lie on a surface to be drawn in space: tissue.with_surface(surface). For "
            "a tissue in the plane call plot_tissue."
        )
    drawing = Drawing(tissue)
    values = checked("cells", cells, drawing.n_cells)
    shown = np.flatnonzero(drawing.alive)
    flat = [_sides(polygon[:n]) for polygon, n in zip(*drawing.polygons(), strict=True) if n > 0]
    corners = np.asarray(surface.points(jnp.asarray(np.concatenate(flat))), float)
    polygons = np.split(corners, np.cumsum([len(each) for each in flat])[:-1])
    with _style.house_style():
        if ax is None:
            import matplotlib.pyplot as plt  # imported late: it selects a window system

            ax = plt.figure(figsize=(4.6, 4.0)).add_subplot(projection="3d")
        assert isinstance(ax, Axes3D)
        faces = Poly3DCollection(polygons, edgecolors=_style.INK, linewidths=0.5)
        if values is None:
            faces.set_facecolor(_shades(surface, drawing.centroids[shown]))
        ax.add_collection3d(faces)
        if values is not None:
            colours = Colours(cmap, vmin, vmax, label)
            colours.apply(faces, values[shown])
            add_bar(ax, faces, values[shown], label, shrink=0.55, pad=0.02)
        low, high = corners.min(axis=0), corners.max(axis=0)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        # A long tissue fills the width of the figure already. (Matplotlib declares an integer.)
        size = np.maximum(high - low, 1e-3 * (high - low).max())
        zoom: Any = 0.95 * min(1.0, np.sort(size)[1] / size.max() + 0.15)
        ax.set_box_aspect(size, zoom=zoom)
        ax.view_init(elev=float(elevation), azim=float(azimuth))
        ax.set_axis_off()
    return ax


def _sides(corners: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "points 2"]:
    """Points on the sides of a polygon in the chart, so that its sides follow the surface."""
    sides = np.roll(corners, -1, axis=0) - corners
    return (corners[:, None] + _FRACTIONS * sides[:, None]).reshape(-1, 2)


_FRACTIONS = np.arange(4)[:, None] / 4
"""Points of a side, as fractions of its length."""


def _shades(surface: AbstractSurface, x: Float[np.ndarray, "cells 2"]) -> list[str]:
    """Grey values of cells by the angle between their normals and the light."""
    u, v = (np.asarray(each, float) for each in surface.tangents(jnp.asarray(x)))
    normals = np.cross(u, v)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lit = 0.5 + 0.5 * normals @ _LIGHT
    return [f"{0.55 + 0.42 * each:.3f}" for each in lit]


_LIGHT = np.array([-0.36, -0.48, 0.8])
"""Direction to the light, a unit vector."""
