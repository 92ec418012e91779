"""Pictures of tensions found through Surface Evolver."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import INK, house_style, new_figure, plot_tissues, series_colours


@house_style()
def recovery(
    target: Tissue,
    true: Float[np.ndarray, " edges"],
    found: Mapping[str, Float[np.ndarray, " edges"]],
    errors: Mapping[str, Float[np.ndarray, " epochs"]],
) -> Figure:
    """The foam, tensions against the true ones, and errors against epochs, by forward model.

    **Arguments:**

    - `target`: the foam whose shape is known.
    - `true`: its tensions.
    - `found`: tensions by the name of the forward model.
    - `errors`: mean relative error of each epoch, by the same names.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 3, width=[2.3, 2.3, 2.7], height=2.4, room=0.7)
    plot_tissues({"the foam": target}, axes=axes[:1], edges=[true], edge_label="true tension")
    colours = series_colours(found)
    axes[1].axline((true.mean(), true.mean()), slope=1, color=INK, lw=0.7)
    marks = dict(zip(found, ("o", "x"), strict=False))
    for name, values in found.items():
        filled = {"mfc": "none"} if marks[name] == "o" else {}
        axes[1].plot(
            true, values, marks[name], ms=4, mew=0.8, color=colours[name], label=name, **filled
        )
    axes[1].set(xlabel="true tension", ylabel="tension found")
    for name, values in errors.items():
        solid = "-" if marks[name] == "o" else (0, (3, 3))
        axes[2].semilogy(values, color=colours[name], ls=solid, label=name)
    axes[2].set(xlabel="epoch", ylabel="mean relative error")
    axes[2].legend()
    return figure
