"""Curves of moduli, densities of states, and stress against strain."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Complex, Float, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vertax._base.results import RESULTS
from vertax.mechanics import Ramp
from vertax.plotting import _style


def plot_moduli(
    frequencies: Real[Array | np.ndarray, " frequencies"],
    moduli: Complex[Array | np.ndarray, " frequencies"],
    *,
    ax: Axes | None = None,
    figure: Figure | None = None,
    label: str | None = None,
) -> Axes:
    """Draw storage and loss modulus against frequency on logarithmic axes.

    Frequencies of 0 are left out.

    **Arguments:**

    - `frequencies`: angular frequencies.
    - `moduli`: the complex modulus at each, from
        [`complex_modulus`][vertax.mechanics.complex_modulus].
    - `ax`: the axes to draw in, also for several curves to compare; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `label`: name of this tissue in the legend.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if there is not one modulus for each frequency.
    """
    x, y = _curve("frequencies", frequencies, "moduli", np.asarray(moduli, complex))
    kept, of = x > 0, "" if label is None else f", {label}"
    with _style.house_style():
        ax = _axes(ax, figure)
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
    - `ax`, `figure`: as in [`plot_moduli`][vertax.plotting.plot_moduli].
    - `label`: name in the legend, which the caller draws.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if there is not one density for each frequency.
    """
    x, y = _curve("frequencies", frequencies, "density", np.asarray(density, float))
    with _style.house_style():
        ax = _axes(ax, figure)
        ax.step(x, y, where="mid", label=label)
        names = {"xlabel": r"frequency $\omega$", "ylabel": r"density of states $D(\omega)$"}
        ax.set(**names, ylim=(0, None))
    return ax


def plot_stress_strain(
    ramp: Ramp,
    *,
    component: Literal["xy", "xx-yy", "xx", "yy"] = "xy",
    ax: Axes | None = None,
    figure: Figure | None = None,
    label: str | None = None,
) -> Axes:
    r"""Draw stress against strain, with the plastic events.

    Steps with T1 transitions are dashed and end in a dot, with an area proportional to the square root of the
    number of transitions; those before the first strain are not drawn. Strains at which the relaxation did
    not converge are gaps.

    **Arguments:**

    - `ramp`: from [`ramp`][vertax.mechanics.ramp].
    - `component`: of the stress: `"xy"`, the conjugate of the strain in
        [`simple_shear`][vertax.mechanics.simple_shear];
        `"xx-yy"`, $\sigma_{xx} - \sigma_{yy}$, that in [`pure_shear`][vertax.mechanics.pure_shear];
        `"xx"` or `"yy"`.
    - `ax`, `figure`: as in [`plot_moduli`][vertax.plotting.plot_moduli].
    - `label`: name in the legend, which the caller draws.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` for another component, or several ramps at once.
    """
    if component not in _COMPONENTS:
        raise ValueError(
            f"Argument `component` must be one of {', '.join(_COMPONENTS)}, but is {component!r}."
        )
    weights, symbol = _COMPONENTS[component]
    along = np.asarray(ramp.stresses, float)
    along = np.tensordot(along, weights, 2) if along.ndim == 3 else along
    x, y = _curve("ramp.strains", ramp.strains, "ramp.stresses", along)
    y = np.where(np.asarray(ramp.results == RESULTS.successful), y, np.nan)
    number = np.asarray(ramp.num_t1) * (np.arange(x.size) > 0)
    with _style.house_style():
        ax = _axes(ax, figure)
        # Elastic branches: each begins after an event.
        branch = np.cumsum(number > 0)
        (line,) = ax.plot(*_branches(x, y, branch), label=label)
        colour = line.get_color()
        for i in np.flatnonzero(number):
            ax.plot(x[i - 1 : i + 1], y[i - 1 : i + 1], ":", color=colour, lw=0.8)
        events = number > 0
        sizes = 6.0 * np.sqrt(number[events])
        ax.scatter(x[events], y[events], sizes, color=colour, zorder=3)
        ax.set(xlabel="strain", ylabel=f"stress ${symbol}$")
    return ax


# The weight of each entry of the stress tensor, and the symbol.
_COMPONENTS: dict[str, tuple[Any, str]] = {
    "xy": (np.array([[0.0, 0.5], [0.5, 0.0]]), r"\sigma_{xy}"),
    "xx-yy": (np.diag([1.0, -1.0]), r"\sigma_{xx} - \sigma_{yy}"),
    "xx": (np.diag([1.0, 0.0]), r"\sigma_{xx}"),
    "yy": (np.diag([0.0, 1.0]), r"\sigma_{yy}"),
}


def _branches(x: np.ndarray, y: np.ndarray, branch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same curve with a gap wherever the branch changes."""
    gaps = np.flatnonzero(np.diff(branch)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def _curve(x_name: str, x: Any, y_name: str, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Abscissae and values, one for each."""
    x = np.asarray(x, float)
    if x.ndim != 1 or y.shape != x.shape:
        raise ValueError(
            f"Argument `{y_name}` must have one entry for each of `{x_name}`, but has shape {y.shape}, and "
            f"`{x_name}` {x.shape}."
        )
    return x, y


def _axes(ax: Axes | None, figure: Figure | None) -> Axes:
    """The given axes, or new ones."""
    _style.one_of(ax, figure)
    return _style.new_axes(width=3.0, height=2.3, figure=figure)[0] if ax is None else ax
