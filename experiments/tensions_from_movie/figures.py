"""Pictures of tensions that were found from a movie."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.inference import MovingTensions
from vertax.mesh import Tissue
from vertax.plotting import house_style, new_figure, plot_recovery, plot_tissue


@house_style()
def tensions(tissue: Tissue, true: Float[np.ndarray, " edges"], found: MovingTensions) -> Figure:
    """The cluster with the tensions of its inner edges, and those against the true ones.

    **Arguments:**

    - `tissue`: the first frame.
    - `true`: the true tensions, relative to their mean.
    - `found`: what two frames tell.

    **Returns:** the figure.
    """
    figure, ((left, right),) = new_figure(1, 2, width=3.3, height=2.9)
    plot_tissue(tissue, None, found.tension, ax=left, edge_label=r"tension $\gamma / \bar\gamma$")
    left.set_title("from the first two frames")
    inner = np.isfinite(found.tension)
    deviation = found.deviation[inner]
    name = r"tension $\gamma / \bar\gamma$"
    plot_recovery(true[inner], found.tension[inner], deviation=deviation, ax=right, name=name)
    return figure


@house_style()
def frames(table: Mapping[str, np.ndarray], course: Mapping[str, np.ndarray]) -> Figure:
    """Errors by number of frames, and what is left over in each interval.

    **Arguments:**

    - `table`: the errors for each number of frames.
    - `course`: displacements and misfits at the end of each interval.

    **Returns:** the figure.
    """
    figure, ((left, right),) = new_figure(1, 2, width=2.9, height=2.5)
    number = np.arange(2, 2 + len(table["relative_error"]))
    left.semilogy(number, 100 * table["relative_error"], "o-", label="mean relative error")
    left.semilogy(number, 100 * table["deviation_median"], "s--", label="median deviation")
    left.set(xlabel="frames used", ylabel="percent", xticks=number)
    left.legend()
    time = course["time"]
    right.semilogy(time, course["moved"], "o-", label="points moved")
    right.semilogy(time, course["misfit_2_frames"], "s--", label="misfit, two frames")
    right.semilogy(time, course["misfit_all_frames"], "^:", label="misfit, all frames")
    right.set(xlabel="time", ylabel="root mean square")
    right.legend()
    return figure
