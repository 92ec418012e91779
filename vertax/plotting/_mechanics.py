"""Stresses and displacements drawn over a tissue."""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from vertax._base.checks import check_number, check_shape
from vertax.mesh import Drawing, Tissue
from vertax.plotting import _style
from vertax.plotting._tissue import plot_tissue, single


def plot_stress(
    tissue: Tissue,
    stresses: Float[Array | np.ndarray, "cells 2 2"],
    *,
    scale: SupportsFloat | None = None,
    **options: Any,
) -> Axes:
    """Draw the stress of each cell as a cross over it.

    Its two bars are parallel to the principal directions, with lengths proportional to the principal
    stresses: red for tension (positive), blue for pressure (negative). On a surface they are bars in space,
    drawn in the coordinates of the chart.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `stresses`: one symmetric matrix for each cell, from
        [`cell_stress`][vertax.mechanics.cell_stress]. Subtract half their trace to see the anisotropic part.
    - `scale`: the stress for which a bar is as long as a cell; by default the largest one.
    - `options`: of [`plot_tissue`][vertax.plot_tissue].

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for stresses of the wrong shape, or a scale that is not positive.
    """
    drawing = Drawing(single(tissue))
    matrices = _shaped("stresses", stresses, (drawing.n_cells, 2, 2))
    values, vectors = np.linalg.eigh(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
    half = 0.5 * drawing.cell_size * np.abs(values) / _unit(np.abs(values), scale)
    if tissue.surface is not None:  # the bars in space, in the coordinates of the chart
        upper = np.asarray(tissue.surface.tangent_frame(tissue.centroids)[1], float)
        vectors = np.linalg.solve(upper, vectors)
    way = (half[:, None, :] * vectors).swapaxes(1, 2)
    centres = drawing.centroids[:, None]
    bars = np.stack([centres - way, centres + way], axis=2).reshape(-1, 2, 2)
    ax = plot_tissue(tissue, **options)
    colours = np.where(values.ravel() > 0, _TENSION, _PRESSURE)
    lines = LineCollection(list(bars), colors=list(colours), linewidths=1.6, zorder=4)
    ax.add_collection(lines, autolim=False)
    return ax


# Red and blue that colour-blind readers can distinguish.
_TENSION, _PRESSURE = "#c8322d", "#2b6cb0"


def plot_mode(
    tissue: Tissue,
    displacements: Float[Array | np.ndarray, "vertices 2"],
    *,
    scale: SupportsFloat | None = None,
    **options: Any,
) -> Axes:
    """Draw displacements of the vertices as arrows: a mode, or velocities after a cut.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `displacements`: of each vertex, such as one of the `displacements` of
        [`Modes`][vertax.mechanics.Modes] or what [`recoil`][vertax.mechanics.recoil] returns.
    - `scale`: the displacement for which an arrow is as long as a cell; by default the largest one.
    - `options`: of [`plot_tissue`][vertax.plot_tissue].

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for displacements of the wrong shape, or a scale that is not positive.
    """
    drawing = Drawing(single(tissue))
    places = drawing.lines[::3, 0]  # each vertex at one of its cells
    moves = _shaped("displacements", displacements, places.shape)
    alive = np.asarray(tissue.topology.alive_vertices)
    unit = _unit(np.linalg.norm(moves[alive], axis=1), scale)
    ax = plot_tissue(tissue, **options)
    arrows = drawing.cell_size * moves / unit
    ax.quiver(
        *places[alive].T,
        *arrows[alive].T,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.006,
        color=_style.MARK,
        zorder=4,
    )
    return ax


def _shaped(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The values as an array; raise an error unless it has the given shape."""
    array = np.asarray(values, float)
    check_shape(name, array, shape)
    return array


def _unit(sizes: np.ndarray, scale: SupportsFloat | None) -> float:
    """The size that is drawn as long as a cell: by default the largest, or 1 if all are 0."""
    if scale is None:
        return float(sizes.max()) or 1.0
    check_number("scale", scale, above=0)
    return float(scale)
