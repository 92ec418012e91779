"""Pictures of the benchmark of adjoints, in the layout of the paper's Figure 2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vertax.fitting import Fit
from vertax.inference import pearson, relative_error
from vertax.plotting import (
    INK,
    house_style,
    new_figure,
    plot_band,
    plot_boxes,
    plot_recovery,
    same_limits,
)

# The colours of the paper, in shades that are told apart with any colour vision.
_COLOURS = {
    "AD": "#0072b2",
    "EP": "#009e73",
    "Adj-ID": "#d55e00",
    "Sen-ID": "#cc79a7",
    "LM": "#7f7f7f",
}
_MARKERS = {"AD": "o", "EP": "s", "Adj-ID": "^", "Sen-ID": "v", "LM": "D"}


@house_style()
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
    figure, ((start, end, cost), (error, correlation, final)) = new_figure(2, 3)
    figure.suptitle(title, fontsize=9)
    guess = np.ravel(initial)
    plot_recovery(np.ravel(true), guess, ax=start, name="$p_0$", label="guess", colour="0.6")
    for method, values in inferred.items():
        style: Any = {"label": method, "colour": _COLOURS[method], "marker": _MARKERS[method]}
        plot_recovery(np.ravel(true), np.ravel(values), ax=end, name="$p_0$", **style)
    same_limits((start, end))
    start.set_title("epoch 0")
    end.set_title("best epoch")
    for ax, name, label in (
        (cost, "cost", "cost (v2v)"),
        (error, "relative_error", "relative error"),
    ):
        for method, fit in fits.items():
            curves = getattr(fit.history, name)
            plot_band(curves, ax=ax, log=True, label=method, colour=_COLOURS[method])
        ax.set(xlabel="epoch", ylabel=label)
    cost.legend(ncols=2, columnspacing=0.8)
    # What is 0 up to rounding is not positive.
    missing = {m: np.maximum(1 - pearson(true, p), 1e-16) for m, p in inferred.items()}
    errors = {m: relative_error(true, p) for m, p in inferred.items()}
    plot_boxes(missing, ax=correlation, colours=_COLOURS, log=True)
    correlation.set_ylabel("1 − Pearson $r$ at the end")
    plot_boxes(errors, ax=final, colours=_COLOURS, log=True)
    final.set_ylabel("relative error at the end")
    return figure


@house_style()
def accuracy(tolerances: np.ndarray, errors: Mapping[str, np.ndarray]) -> Figure:
    """Error of each hypergradient against the tolerance of the relaxation.

    **Arguments:**

    - `tolerances`: largest forces at which the relaxation stopped.
    - `errors`: relative errors of each method, shape `(tolerances, replicates)`.

    **Returns:** the figure.
    """
    figure, ((ax,),) = new_figure(width=4.8, height=2.8)
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


@house_style()
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
    figure, ((linear, cost, right),) = new_figure(1, 3, height=2.5)
    for ax, nudge, label in (
        (linear, "linear", r"$\beta$, relative force"),
        (cost, "cost", r"$\beta$, energy per cost"),
    ):
        for style, estimator in (("o-", "centred"), ("s--", "one-sided")):
            values = _centre(errors[f"{nudge}, {estimator}"])
            ax.plot(betas[nudge], values, style, ms=3, color=_COLOURS["EP"], label=estimator)
        ax.set(xscale="log", yscale="log", xlabel=label, title=f"nudge: {nudge}")
    same_limits((linear, cost), x=False)
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


@house_style()
def scaling(rows: list[dict[str, Any]]) -> Figure:
    """Time and memory of an epoch against the number of cells.

    **Arguments:**

    - `rows`: measurements with `protocol`, `cells`, `method`, `ms_per_epoch`, `ms_forward` and
        `memory_kB`.

    **Returns:** the figure.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    sizes = sorted({row["cells"] for row in rows})
    titles = {"paper": "the paper's protocol", "equilibrium": "true equilibria"}
    figure, (axes,) = new_figure(1, 2 * len(protocols), width=2.2, height=2.4)
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
                color=INK,
                label="relaxation alone",
            )
        for ax in (time, memory):
            ax.set(xscale="log", yscale="log", xlabel="cells", title=titles[protocol])
            ax.set_xticks(sizes, list(map(str, sizes)))
            ax.minorticks_off()
        time.set_ylabel("time of an epoch (ms)")
        memory.set_ylabel("working memory (kB)")
    same_limits(axes[::2])
    same_limits(axes[1::2])
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _centre(values: np.ndarray) -> np.ndarray:
    return np.exp(np.mean(np.log(np.maximum(values, 1e-300)), axis=1))
