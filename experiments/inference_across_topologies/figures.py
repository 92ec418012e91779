"""Pictures of inference across topologies, in the layout of the paper's Figure 3a-e."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from vertax.fitting import Fit
from vertax.inference import Scene
from vertax.plotting import (
    house_style,
    new_figure,
    plot_band,
    plot_boxes,
    plot_tissues,
    series_colours,
)


class Curves(NamedTuple):
    """What happened to the replicates of a method, epoch by epoch."""

    relative_error: Float[np.ndarray, "epochs replicates"]
    pearson: Float[np.ndarray, "epochs replicates"]
    mismatched: Int[np.ndarray, "epochs replicates"]


@house_style()
def inference(curves: Mapping[str, Curves], metrics: Mapping[str, Any]) -> Figure:
    """How well parameters and topology were found, by epoch and at the end.

    **Arguments:**

    - `curves`: of each method.
    - `metrics`: of each method, and of the start.

    **Returns:** the figure.
    """
    colours = series_colours(curves)
    figure, ((error, pearson, topology), last) = new_figure(2, 3, width=2.5)
    for name, curve in curves.items():
        style: Any = {"label": name, "colour": colours[name]}
        plot_band(curve.relative_error, ax=error, log=True, **style)
        plot_band(curve.pearson, ax=pearson, spread="range", **style)
        plot_band(curve.mismatched, ax=topology, spread="range", **style)
    error.set(ylabel="relative error")
    error.legend()
    pearson.set(ylabel="Pearson $r$")
    topology.set(ylabel="mismatched neighbours")
    for ax in (error, pearson, topology):
        ax.set_xlabel("epoch")
    final = lambda key: {name: np.asarray(metrics[name][key]) for name in curves}
    # What is 0 up to rounding is not positive.
    missing = {name: np.maximum(1 - r, 1e-16) for name, r in final("pearson").items()}
    plot_boxes(final("relative_error"), ax=last[0], colours=colours, log=True)
    plot_boxes(missing, ax=last[1], colours=colours, log=True)
    plot_boxes(final("mismatched_neighbours"), ax=last[2], colours=colours)
    last[0].set(ylabel="relative error at the end")
    last[1].set(ylabel="1 − Pearson $r$ at the end")
    last[2].set(ylabel="mismatched at the end", ylim=(-0.5, None))
    for ax in last:
        ax.tick_params(axis="x", labelrotation=25)
    return figure


def tissues(scene: Scene, fits: Mapping[str, Fit]) -> Figure:
    """One replicate: the start, what each method made of it, and the target.

    **Arguments:**

    - `scene`: the replicate.
    - `fits`: of each method.

    **Returns:** the figure.
    """
    panels = {"start": (scene.initial, scene.guess.target_shape_factor)}
    panels |= {name: (f.tissue, f.energy.target_shape_factor) for name, f in fits.items()}
    panels |= {"target": (scene.target, scene.truth.target_shape_factor)}
    figure = Figure()
    plot_tissues(
        {title: tissue for title, (tissue, _) in panels.items()},
        [np.asarray(values) for _, values in panels.values()],
        figure=figure,
        label="target shape factor $p_0$",
    )
    return figure
