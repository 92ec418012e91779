"""Pictures of stress, modes and moduli."""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Array, Complex, Float, Real
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from vertax.mesh import Periodic, Tissue
from vertax.mesh._outlines import Drawing
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

    Its two bars lie along the principal directions and are as long as the principal stresses: red where
    the cell would contract (tension), blue where it would expand (pressure).

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `stresses`: one symmetric matrix for each cell, from
        [`cell_stress`][vertax.mechanics.cell_stress]. Less their trace they show what is anisotropic.
    - `scale`: the stress whose bar is as long as a cell; by default the largest one there is.
    - `options`: of [`plot_tissue`][vertax.plot_tissue].

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for stresses of the wrong shape, or a scale that is not positive.
    """
    drawing, matrices = Drawing(single(tissue)), np.asarray(stresses, float)
    if matrices.shape != (drawing.n_cells, 2, 2):
        raise ValueError(
            f"Argument `stresses` must have shape ({drawing.n_cells}, 2, 2), but has {matrices.shape}."
        )
    values, vectors = np.linalg.eigh(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
    longest = np.abs(values).max() if scale is None else float(scale)
    if scale is not None and not longest > 0:
        raise ValueError(f"Argument `scale` must be positive, but is {longest}.")
    half = 0.5 * drawing.cell_size * np.abs(values) / (longest or 1)
    way = (half[:, None, :] * vectors).swapaxes(1, 2)
    centres = drawing.centroids[:, None]
    bars = np.stack([centres - way, centres + way], axis=2).reshape(-1, 2, 2)
    ax = plot_tissue(tissue, **options)
    colours = np.where(values.ravel() > 0, _TENSION, _PRESSURE)
    lines = LineCollection(list(bars), colors=list(colours), linewidths=1.6, zorder=4)
    ax.add_collection(lines, autolim=False)
    return ax


# Red and blue that colour-blind readers tell apart.
_TENSION, _PRESSURE = "#c8322d", "#2b6cb0"


def plot_mode(
    tissue: Tissue,
    displacements: Float[Array | np.ndarray, "vertices 2"],
    *,
    scale: SupportsFloat | None = None,
    **options: Any,
) -> Axes:
    """Draw how vertices move, as arrows: a mode, or velocities after a cut.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `displacements`: of each vertex, such as one of the `displacements` of
        [`Modes`][vertax.mechanics.Modes] or what [`recoil`][vertax.mechanics.recoil] returns.
    - `scale`: the displacement whose arrow is as long as a cell; by default the largest one there is.
    - `options`: of [`plot_tissue`][vertax.plot_tissue].

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for displacements of the wrong shape, or a scale that is not positive.
    """
    places, moves = np.asarray(single(tissue).vertices, float), np.asarray(displacements, float)
    if moves.shape != places.shape:
        raise ValueError(
            f"Argument `displacements` must have shape {places.shape}, but has {moves.shape}."
        )
    largest = np.linalg.norm(moves, axis=1).max() if scale is None else float(scale)
    if scale is not None and not largest > 0:
        raise ValueError(f"Argument `scale` must be positive, but is {largest}.")
    size = float(np.sqrt(np.mean(np.abs(tissue.areas))))
    if isinstance(tissue.boundary, Periodic):
        lattice = np.asarray(tissue.boundary.lattice, float)
        fractions = places @ np.linalg.inv(lattice)
        places = (fractions - np.floor(fractions)) @ lattice
    ax = plot_tissue(tissue, **options)
    arrows = size * moves / (largest or 1)
    ax.quiver(
        *places.T,
        *arrows.T,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.006,
        color=_style.MARK,
        zorder=4,
    )
    return ax


def plot_moduli(
    frequencies: Real[Array | np.ndarray, " frequencies"],
    moduli: Complex[Array | np.ndarray, " frequencies"],
    *,
    ax: Axes | None = None,
    figure: Figure | None = None,
    label: str | None = None,
) -> Axes:
    """Draw storage and loss modulus over the frequency, on logarithmic axes.

    Frequencies of 0 have no place there and are left out.

    **Arguments:**

    - `frequencies`: angular frequencies.
    - `moduli`: the complex modulus at each, from
        [`complex_modulus`][vertax.mechanics.complex_modulus].
    - `ax`: the axes to draw in, also one after the other to compare; by default those of a new figure.
    - `figure`: an empty figure to draw in instead, which no window shows.
    - `label`: name of this tissue in the legend.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if there is not one modulus for each frequency.
    """
    x, y = np.asarray(frequencies, float), np.asarray(moduli, complex)
    _style.one_of(ax, figure)
    if x.ndim != 1 or y.shape != x.shape:
        raise ValueError(
            f"Argument `moduli` must have one entry for each frequency, but has shape {y.shape}, and "
            f"`frequencies` {x.shape}."
        )
    kept, of = x > 0, "" if label is None else f", {label}"
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=3.0, height=2.3, figure=figure)
        colour = _style.SERIES[len(ax.lines) // 2 % len(_style.SERIES)]
        for part, name, dashes in (
            (np.real(y), "storage $G'$", "-"),
            (np.imag(y), "loss $G''$", "--"),
        ):
            shown = kept & (part > 0)
            ax.plot(x[shown], part[shown], dashes, color=colour, label=f"{name}{of}")
        ax.set(xscale="log", yscale="log", xlabel=r"frequency $\omega$", ylabel="modulus")
        ax.legend()
    return ax


def plot_density_of_states(
    frequencies: Float[Array | np.ndarray, " bins"],
    density: Float[Array | np.ndarray, " bins"],
    *,
    ax: Axes | None = None,
    figure: Figure | None = None,
    label: str | None = None,
) -> Axes:
    r"""Draw a density of states $D(\omega)$.

    **Arguments:**

    - `frequencies`, `density`: from [`density_of_states`][vertax.mechanics.density_of_states].
    - `ax`: the axes to draw in, also one after the other to compare; by default those of a new figure.
    - `figure`: an empty figure to draw in instead, which no window shows.
    - `label`: name in the legend, which is up to the caller.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if there is not one density for each frequency.
    """
    x, y = np.asarray(frequencies, float), np.asarray(density, float)
    _style.one_of(ax, figure)
    if x.ndim != 1 or y.shape != x.shape:
        raise ValueError(
            f"Argument `density` must have one entry for each frequency, but has shape {y.shape}, and "
            f"`frequencies` {x.shape}."
        )
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=3.0, height=2.3, figure=figure)
        ax.step(x, y, where="mid", label=label)
        ax.set(
            xlabel=r"frequency $\omega$", ylabel=r"density of states $D(\omega)$", ylim=(0, None)
        )
    return ax
