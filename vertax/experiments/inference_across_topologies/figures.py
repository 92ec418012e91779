"""Pictures of inference across topologies, in the layout of the paper's Figure 3a-e."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vertax.experiments import _figures
from vertax.fitting import Fit
from vertax.inference import Scene
from vertax.plotting import _style


class Curves(NamedTuple):
    """What happened to the replicates of a method, epoch by epoch."""

    relative_error: Float[np.ndarray, "epochs replicates"]
    pearson: Float[np.ndarray, "epochs replicates"]
    mismatched: Int[np.ndarray, "epochs replicates"]


def inference(curves: Mapping[str, Curves], metrics: Mapping[str, Any]) -> Figure:
    """How well parameters and topology were found, by epoch and at the end.

    **Arguments:**

    - `curves`: of each method.
    - `metrics`: of each method, and of the start.

    **Returns:** the figure.
    """
    colours = dict(zip(curves, (*_style.SERIES, "0.4", "0.6"), strict=False))
    with _style.house_style():
        layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
        figure = Figure(figsize=(7.4, 4.6), layout=layout)
        grid = figure.subplot_mosaic(
            [["error", "pearson", "topology"], ["last_error", "last_pearson", "last_topology"]]
        )
        for name, curve in curves.items():
            _figures.band(grid["error"], curve.relative_error, name, colours[name])
            for key, values in (("pearson", curve.pearson), ("topology", curve.mismatched)):
                epochs, ax = np.arange(len(values)), grid[key]
                ax.plot(epochs, values.mean(axis=1), color=colours[name], label=name, lw=1)
                low, high = values.min(axis=1), values.max(axis=1)
                ax.fill_between(epochs, low, high, color=colours[name], alpha=0.12, lw=0)
        grid["error"].set(yscale="log", ylabel="relative error")
        grid["error"].legend()
        grid["pearson"].set(ylabel="Pearson $r$")
        grid["topology"].set(ylabel="mismatched neighbours")
        for key in ("error", "pearson", "topology"):
            grid[key].set(xlabel="epoch")
        last = lambda key: {name: np.asarray(metrics[name][key]) for name in curves}
        _figures.boxes(grid["last_error"], last("relative_error"), colours)
        missing = {name: 1 - r for name, r in last("pearson").items()}
        _figures.boxes(grid["last_pearson"], missing, colours)
        _figures.boxes(grid["last_topology"], last("mismatched_neighbours"), colours, log=False)
        grid["last_error"].set(ylabel="relative error at the end")
        grid["last_pearson"].set(ylabel="1 − Pearson $r$ at the end")
        grid["last_topology"].set(ylabel="mismatched at the end", ylim=(-0.5, None))
        for key in ("last_error", "last_pearson", "last_topology"):
            grid[key].tick_params(axis="x", labelrotation=25)
    return figure


def tissues(scene: Scene, fits: Mapping[str, Fit]) -> Figure:
    """One replicate: the start, what each method made of it, and the target.

    **Arguments:**

    - `scene`: the replicate.
    - `fits`: of each method.

    **Returns:** the figure.
    """
    panels: dict[str, Any] = {"start": (scene.initial, scene.guess.target_shape_factor)}
    panels |= {name: (f.tissue, f.energy.target_shape_factor) for name, f in fits.items()}
    panels |= {"target": (scene.target, scene.truth.target_shape_factor)}
    return _figures.tissues(panels, label="target shape factor $p_0$")
