"""Drawing of a tissue on a surface, in space."""

from __future__ import annotations

from typing import Any, SupportsFloat

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Real
from matplotlib.colors import Colormap, LightSource
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from vertax.mesh import Tissue
from vertax.mesh._outlines import Drawing
from vertax.plotting import _style
from vertax.plotting._colours import Colours, add_bar
from vertax.plotting._tissue import checked, single


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

    Each cell is drawn as triangles about its centroid with edges as they lie on the surface. A periodic cell
    is drawn in one piece.

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
    shown = (drawing.cell < drawing.n_cells) & np.append(drawing.alive, [False] * 2)[drawing.cell]
    cell = drawing.cell[shown]
    sides = drawing.lines[shown][:, :1] * (1 - _FRACTIONS) + drawing.lines[shown][:, 1:] * _FRACTIONS
    centres = np.broadcast_to(drawing.centroids[cell][:, None], sides[:, :-1].shape)
    lift = lambda x: np.asarray(surface.points(jnp.asarray(x)), float)
    lines, middles = lift(sides), lift(centres)
    triangles = np.stack([middles, lines[:, :-1], lines[:, 1:]], axis=2).reshape(-1, 3, 3)
    owner = np.repeat(cell, len(_FRACTIONS) - 1)
    with _style.house_style():
        if ax is None:
            import matplotlib.pyplot as plt  # imported late: it selects a window system

            ax = plt.figure(figsize=(4.6, 4.0)).add_subplot(projection="3d")
        assert isinstance(ax, Axes3D)
        options: dict[str, Any] = {"linewidths": 0, "antialiased": False}
        if values is None:
            light = LightSource(azdeg=315, altdeg=45)
            options |= {"facecolors": _style.BLANK, "shade": True, "lightsource": light}
        faces = Poly3DCollection(triangles, **options)
        ax.add_collection3d(faces)
        ax.add_collection3d(Line3DCollection(_raised(lines, triangles), colors=_style.INK, lw=0.7))
        if values is not None:
            colours = Colours(cmap, vmin, vmax, label)
            colours.apply(faces, values[owner])
            add_bar(ax, faces, values[drawing.alive], label, shrink=0.55, pad=0.02)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        ax.set_box_aspect(np.maximum(high - low, 1e-3 * (high - low).max()))
        ax.view_init(elev=float(elevation), azim=float(azimuth))
        ax.set_axis_off()
    return ax


_FRACTIONS = np.linspace(0, 1, 4)[:, None]
"""Points of a side, in its chart: sides follow the surface."""
