"""Pictures of a tissue that grows: its polygon classes, some frames, and who descends from whom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from vertax import Tissue
from vertax.growth import Lineage
from vertax.plotting import INK, SERIES, house_style, new_figure, plot_tissues

EPITHELIA = {5: 0.25, 6: 0.45, 7: 0.20}
"""About what many epithelia have, from M. Gibson et al. 2006."""


@house_style()
def classes(
    sides: Int[np.ndarray, " classes"],
    counts: Int[np.ndarray, "frames classes"],
    n_cells: Int[np.ndarray, " frames"],
    chain: Float[np.ndarray, " classes"],
) -> Figure:
    """Polygon classes at the end beside others, and how they came about.

    **Arguments:**

    - `sides`: of the classes.
    - `counts`: how many inner cells of each class there were.
    - `n_cells`: how many cells there were.
    - `chain`: shares by divisions alone.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 2, width=[3.2, 2.8])
    inner = counts.sum(axis=1)
    share = counts[-1] / max(inner[-1], 1)
    error = np.sqrt(share * (1 - share) / max(inner[-1], 1))
    label = f"grown ({inner[-1]} inner cells)"
    axes[0].bar(sides - 0.2, share, 0.4, yerr=error, color=SERIES[0], label=label)
    axes[0].bar(sides + 0.2, chain, 0.4, color=SERIES[4], label="divisions alone")
    axes[0].plot(
        list(EPITHELIA), list(EPITHELIA.values()), "D", color=INK, label="epithelia, about"
    )
    axes[0].set(xlabel="sides", ylabel="share of cells", xticks=sides, ylim=(0, 0.75))
    axes[0].legend(loc="upper right")
    enough = inner >= 10
    for k, n in enumerate((5, 6, 7)):
        at = counts[:, list(sides).index(n)][enough] / inner[enough]
        axes[1].plot(n_cells[enough], at, color=SERIES[k], label=f"{n} sides")
        axes[1].axhline(EPITHELIA[n], color=SERIES[k], lw=0.7, ls=":")
    axes[1].set_xlim(n_cells[0], n_cells[-1] + 1)  # (there may be no line)
    axes[1].set(xlabel="cells", ylabel="share of inner cells", ylim=(0, 0.75), xscale="log")
    axes[1].xaxis.set_minor_formatter(NullFormatter())
    axes[1].legend(loc="upper left")
    return figure


def sides_of(tissue: Tissue) -> Float[np.ndarray, " cells"]:
    """How many sides each cell has; NaN for spare slots.

    **Arguments:**

    - `tissue`: the tissue.

    **Returns:** the numbers, as values to draw.
    """
    return np.where(np.asarray(tissue.alive), np.asarray(tissue.neighbour_counts), np.nan)


@house_style()
def growth(frames: Sequence[Tissue], times: Float[np.ndarray, " frames"]) -> Figure:
    """Some frames, coloured by the number of sides.

    **Arguments:**

    - `frames`: the tissues.
    - `times`: their times.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 4, width=2.2, room=0.6)
    picked = np.unique(np.linspace(0, len(frames) - 1, 4).round().astype(int))
    tissues = {f"time {times[k]:g}": frames[k] for k in picked}
    values = [sides_of(frames[k]) for k in picked]
    plot_tissues(
        tissues,
        values,
        axes=axes[: len(picked)],
        cmap="RdYlBu",
        vmin=3.5,
        vmax=8.5,
        label="sides",
        linewidth=0.4,
    )
    return figure


@house_style()
def lineage(tree: Lineage, end: float) -> Figure:
    """Who descends from whom: a line for each cell from its birth to its end, in the colour of its founder.

    **Arguments:**

    - `tree`: the lineage.
    - `end`: when growth ended.

    **Returns:** the figure.
    """
    count = min(int(tree.count), tree.mother.shape[0])
    mother, begun, ended, fate = (
        np.asarray(x)[:count] for x in (tree.mother, tree.begun, tree.ended, tree.fate)
    )
    daughters: list[list[int]] = [[] for _ in range(count)]
    for cell in np.flatnonzero(mother >= 0):
        daughters[mother[cell]].append(int(cell))
    height, founder = np.zeros(count), np.arange(count)
    for cell in np.flatnonzero(mother >= 0):  # (a mother has a lower number)
        founder[cell] = founder[mother[cell]]
    stack, leaves = list(np.flatnonzero(mother < 0)[::-1]), 0
    order: list[int] = []
    while stack:
        cell = int(stack.pop())
        order.append(cell)
        if not daughters[cell]:
            height[cell], leaves = leaves, leaves + 1
        stack.extend(daughters[cell])
    for cell in reversed(order):
        if daughters[cell]:
            height[cell] = np.mean(height[daughters[cell]])
    until = np.minimum(ended, end)
    lines = [((begun[c], height[c]), (until[c], height[c])) for c in order]
    forks = [
        ((until[c], min(height[daughters[c]])), (until[c], max(height[daughters[c]])))
        for c in order
        if daughters[c]
    ]
    colour = lambda c: SERIES[founder[c] % len(SERIES)]
    figure, ((ax,),) = new_figure(1, 1, width=4.0, height=3.6)
    ax.add_collection(LineCollection(lines, colors=[colour(c) for c in order], linewidths=0.5))
    of_forks = [colour(c) for c in order if daughters[c]]
    ax.add_collection(LineCollection(forks, colors=of_forks, linewidths=0.5))
    dead = fate == 2
    ax.plot(until[dead], height[dead], "x", ms=3, color=INK)
    ax.set(xlabel="time", ylabel="cells", xlim=(0, end), ylim=(-1, max(leaves, 1)), yticks=[])
    return figure
