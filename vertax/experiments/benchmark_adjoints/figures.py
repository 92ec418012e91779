"""Pictures of the benchmark of adjoints, in the layout of the paper's Figure 2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vertax.experiments._figures import band, boxes, new_figure
from vertax.fitting import Fit
from vertax.inference import pearson
from vertax.plotting import _style

# The colours of the paper, in shades that are told apart with any colour vision.
_COLOURS = {
    "AD": "#0072b2",
    "EP": "#009e73",
    "Adj-ID": "#d55e00",
    "Sen-ID": "#cc79a7",
    "LM": "#7f7f7f",
}
_MARKERS = {"AD": "o", "EP": "s", "Adj-ID": "^", "Sen-ID": "v", "LM": "D"}


def inference(
    fits: Mapping[str, Fit],
    true: np.ndarray,
    initial: np.ndarray,
    inferred: Mapping[str, np.ndarray],
    *,
    title: str,
) -> Figure:
    """What was found: scatter plots, curves over epochs, and box plots over replicates.

    **Arguments:**

    - `fits`: of each method, a batch of replicates.
    - `true`, `initial`, `inferred`: shape factors, shape `(replicates, cells)`.
    - `title`: of the figure.

    **Returns:** the figure.
    """
    with _style.house_style():
        layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
        figure = Figure(figsize=(7.2, 4.6), layout=layout)
        figure.suptitle(title, fontsize=9)
        grid = figure.subplot_mosaic(
            [["start", "end", "cost"], ["error", "pearson", "final"]], height_ratios=[1, 1]
        )
        methods = {name: fit for name, fit in fits.items() if name != "LM"}
        _scatter(grid["start"], true, dict.fromkeys(methods, initial), "epoch 0")
        last = {name: inferred[name] for name in methods}
        epochs = max(len(f.history.cost) for f in methods.values())
        _scatter(grid["end"], true, last, f"epoch {epochs}")
        for key, name, label in (
            ("cost", "cost", "cost (v2v)"),
            ("error", "relative_error", "relative error"),
        ):
            for method, fit in fits.items():
                band(grid[key], getattr(fit.history, name), method, _COLOURS[method])
            grid[key].set(xlabel="epoch", ylabel=label, yscale="log")
        grid["cost"].legend(ncols=2, columnspacing=0.8)
        error = {m: np.mean(np.abs(p - true) / np.abs(true), axis=1) for m, p in inferred.items()}
        boxes(grid["pearson"], {m: 1 - pearson(true, p) for m, p in inferred.items()}, _COLOURS)
        grid["pearson"].set_ylabel("1 − Pearson $r$ at the end")
        boxes(grid["final"], error, _COLOURS)
        grid["final"].set_ylabel("relative error at the end")
    return figure


def accuracy(tolerances: np.ndarray, errors: Mapping[str, np.ndarray]) -> Figure:
    """Error of each hypergradient against the tolerance of the relaxation.

    **Arguments:**

    - `tolerances`: largest forces at which the relaxation stopped.
    - `errors`: relative errors of each method, shape `(tolerances, replicates)`.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, (ax,) = new_figure(1, width=4.8, height=2.8)
        for name, values in errors.items():
            method, _, variant = name.partition(",")
            style: Any = {"ls": "--", "mfc": "white"} if variant else {}
            # The two forms of ID agree to rounding: a larger marker lets both be seen.
            size = 6 if method == "Sen-ID" else 3.5
            ax.plot(
                tolerances,
                _centre(values),
                marker=_MARKERS[method],
                ms=size,
                color=_COLOURS[method],
                label=name,
                **style,
            )
        ax.set(
            xscale="log",
            yscale="log",
            xlabel="largest force at the end of the relaxation",
            ylabel="relative error of the hypergradient",
        )
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def beta_scan(
    betas: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
    fitted: Mapping[float, Mapping[str, Any]],
) -> Figure:
    """Error of EP against the strength of the nudge, and fits with it.

    **Arguments:**

    - `betas`: strengths of each nudge, `"linear"` and `"cost"`.
    - `errors`: relative errors of each estimator (`"linear, centred"`, …), shape `(betas, replicates)`.
    - `fitted`: outcome of a fit by the strength of its nudge.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, (linear, cost, right) = new_figure(3, width=2.4, height=2.5)
        for ax, nudge, label in (
            (linear, "linear", r"$\beta$, relative force"),
            (cost, "cost", r"$\beta$, energy per cost"),
        ):
            for style, estimator in (("o-", "centred"), ("s--", "one-sided")):
                values = _centre(errors[f"{nudge}, {estimator}"])
                ax.plot(betas[nudge], values, style, ms=3, color=_COLOURS["EP"], label=estimator)
            ax.set(xscale="log", yscale="log", xlabel=label, title=f"nudge: {nudge}")
        linear.set_ylabel("relative error of the hypergradient")
        linear.legend()
        strengths = list(fitted)
        for k, strength in enumerate(strengths):
            points = fitted[strength]["relative_error"]
            right.plot(np.full(len(points), k), points, "o", ms=3, color=_COLOURS["EP"])
        right.set_xticks(range(len(strengths)), [f"{s:g}" for s in strengths])
        right.set(
            yscale="log",
            xlabel=r"$\beta$, energy per cost",
            ylabel="relative error of parameters",
            title="fits, the paper's protocol",
        )
    return figure


def scaling(rows: list[dict[str, Any]]) -> Figure:
    """Time and memory of an epoch against the number of cells.

    **Arguments:**

    - `rows`: measurements with `protocol`, `cells`, `method`, `ms_per_epoch`, `ms_forward` and
        `memory_kB`.

    **Returns:** the figure.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    titles = {"paper": "the paper's protocol", "equilibrium": "true equilibria"}
    with _style.house_style():
        figure, axes = new_figure(2 * len(protocols), width=2.2, height=2.4)
        for k, protocol in enumerate(protocols):
            time, memory = axes[2 * k : 2 * k + 2]
            for method in dict.fromkeys(row["method"] for row in rows):
                own = [r for r in rows if (r["protocol"], r["method"]) == (protocol, method)]
                style = {
                    "marker": _MARKERS[method],
                    "ms": 3.5,
                    "color": _COLOURS[method],
                    "label": method,
                }
                cells = [r["cells"] for r in own]
                time.plot(cells, [r["ms_per_epoch"] for r in own], **style)
                memory.plot(cells, [r["memory_kB"] for r in own], **style)
            forward = [r for r in rows if (r["protocol"], r["method"]) == (protocol, "Adj-ID")]
            if forward:
                time.plot(
                    [r["cells"] for r in forward],
                    [r["ms_forward"] for r in forward],
                    ls=":",
                    color=_style.INK,
                    label="relaxation alone",
                )
            for ax in (time, memory):
                ax.set(xscale="log", yscale="log", xlabel="cells", title=titles[protocol])
            time.set_ylabel("time of an epoch (ms)")
            memory.set_ylabel("working memory (kB)")
        axes[-1].legend(
            *axes[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1, 1)
        )
    return figure


def _scatter(ax: Axes, true: np.ndarray, found: Mapping[str, np.ndarray], title: str) -> None:
    values = np.concatenate([true.ravel(), *(f.ravel() for f in found.values())])
    ends = np.array([values.min(), values.max()]) + np.array([-0.05, 0.05]) * np.ptp(values)
    ax.plot(ends, ends, color=_style.INK, lw=0.7, ls=(0, (4, 3)), zorder=1)
    for method, points in found.items():
        ax.scatter(
            true.ravel(),
            points.ravel(),
            s=7,
            lw=0,
            alpha=0.6,
            marker=_MARKERS[method],
            color=_COLOURS[method],
        )
    ax.set(xlim=ends, ylim=ends, xlabel=r"true $p_0$", ylabel=r"inferred $p_0$", title=title)
    ax.set_aspect("equal")


def _centre(values: np.ndarray) -> np.ndarray:
    return np.exp(np.mean(np.log(np.maximum(values, 1e-300)), axis=1))
