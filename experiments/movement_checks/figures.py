"""The picture of all checks of movement in time."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from vertax.plotting import INK, SERIES, house_style, new_figure


@house_style()
def checks(config: Any, found: Any) -> Figure:
    """A panel for each of the checks.

    **Arguments:**

    - `config`: of the experiment.
    - `found`: its findings.

    **Returns:** the figure.
    """
    figure, axes = new_figure(2, 3, width=2.6)
    _decay(axes[0, 0], found)
    _energies(axes[0, 1], found)
    _events(axes[0, 2], found)
    _noise(axes[1, 0], found)
    _gradients(axes[1, 1], found)
    _controlled(axes[1, 2], config, found)
    return figure


def _decay(ax: Axes, found: Any) -> None:
    for order, errors in enumerate(found.decay_errors, 1):
        colour = SERIES[order - 1]
        ax.plot(found.decay_steps, errors, "o", ms=3, color=colour, label=f"order {order}")
        guide = errors[-1] * (found.decay_steps / found.decay_steps[-1]) ** order
        ax.plot(found.decay_steps, guide, color=colour, lw=0.8)
    ax.set(
        xscale="log", yscale="log", xlabel=r"$\Delta t\,\lambda / \zeta$", ylabel="relative error"
    )
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_title("1. decay of a mode")
    ax.legend()


def _energies(ax: Axes, found: Any) -> None:
    shown = (0, min(2, len(found.quench_times) - 1), len(found.quench_times) - 1)
    for colour, i in zip(SERIES, dict.fromkeys(shown), strict=False):
        times, energies = found.quench_times[i], found.quench_energies[i]
        style: Any = {"marker": ".", "ms": 4} if i == 0 else {}
        ax.plot(times, energies, color=colour, label=f"$\\Delta t$ = {times[1]:.2g}", **style)
    ax.set(xlabel="time", ylabel="energy", title="2. a quench")
    ax.legend()


def _events(ax: Axes, found: Any) -> None:
    steps = [times[1] - times[0] for times in found.quench_times]
    edges = dict.fromkeys(found.events[-1][:, 0].tolist())
    for number, edge in enumerate(edges):
        points = [
            (step, when)
            for step, events in zip(steps, found.events, strict=True)
            for when in events[events[:, 0] == edge, 1][:1]
        ]
        x, y = np.array(points).T
        ax.plot(x, y, ".-", ms=4, lw=0.8, color=SERIES[number % len(SERIES)])
    for step, events in zip(steps, found.events, strict=True):
        others = events[~np.isin(events[:, 0], list(edges)), 1]
        ax.plot(np.full(len(others), step), others, "x", ms=3.5, color=INK)
    ax.set(xscale="log", xlabel=r"$\Delta t$", ylabel="time of each T1", title="3. transitions")


def _noise(ax: Axes, found: Any) -> None:
    ax.plot(found.eigenvalues, found.mode_energies, "o", ms=2.5, color=SERIES[0])
    ax.axhline(1, color=INK, lw=0.8, ls=":")
    ax.set(xscale="log", xlabel=r"eigenvalue $\lambda$", ylim=(0, 2))
    ax.set(ylabel=r"$\lambda \langle q^2 \rangle / T$", title="4. equipartition")


def _gradients(ax: Axes, found: Any) -> None:
    names = ("implicit", "propagation")
    for colour, name, errors in zip(SERIES, names, found.gradient_errors, strict=False):
        ax.plot(found.differences, errors, "o-", ms=3, lw=0.8, color=colour, label=name)
    ax.set(xscale="log", yscale="log", xlabel="width of the difference", ylabel="relative error")
    ax.set_title("5. gradient against differences")
    ax.legend()


def _controlled(ax: Axes, config: Any, found: Any) -> None:
    rows = zip(found.control_errors, found.control_steps, strict=True)
    for order, (errors, counts) in enumerate(rows, 1):
        colour = SERIES[order - 1]
        ax.plot(config.tolerances, errors, "o-", ms=3, lw=0.8, color=colour, label=f"order {order}")
        for x, y, n in zip(config.tolerances, errors, counts, strict=True):
            ax.annotate(f"{n:.0f}", (x, y), xytext=(3, -7), textcoords="offset points", fontsize=6)
    ax.set(xscale="log", yscale="log", xlabel="tolerance of a step", ylabel="error at the end")
    ax.set_title("6. controlled steps")
    ax.legend()
