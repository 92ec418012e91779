"""Functions that several experiments use."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field, model_validator

from vertax import plotting, runs
from vertax.energies import LocalSum, foam_energy
from vertax.mesh import Tissue


def columns(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The table of some rows: an array per column, in the order of the first row."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def fitted_noise(parameters: Any) -> Any:
    """The noise of a posterior is one of its parameters."""
    return parameters["noise"]


def scan(
    folder: runs.RunFolder,
    name: str,
    values: Sequence[float] | range,
    compute: Callable[[float], dict[str, np.ndarray]],
    *,
    progress: bool = True,
) -> dict[str, np.ndarray]:
    """Arrays at each of several values of a parameter, all different, with a leading axis of the values."""
    tasks = {f"{name} {float(value)}": float(value) for value in values}
    results = [*folder.map_parts(compute, tasks, progress=progress, unit="value").values()]
    return {key: np.stack([result[key] for result in results]) for key in results[0]}


FLUID = 3.81
"""Target shape factor at which disordered tissues become fluid (Bi et al. 2015, doi:10.1038/nphys3471)."""
HEXAGON = float(np.sqrt(8 * np.sqrt(3)))
"""Perimeter of a regular hexagon of area 1, and target at which the hexagonal lattice becomes fluid."""


def plot_tensions(panels: dict[str, Any], bounds: tuple[float, float], widths: Sequence[float]) -> Any:
    """A figure with tissues in the colours of their tensions, and empty axes to their right.

    `panels` has a tissue and the tensions of its edges by title, `widths` those of the empty axes in inches.
    """
    all_widths, n = [2.3] * len(panels) + list(widths), len(panels)
    figure, (axes,) = plotting.new_figure(1, len(all_widths), width=all_widths, height=2.5, room=0.7)
    tissues = {title: tissue for title, (tissue, _) in panels.items()}
    tensions = [values for _, values in panels.values()]
    options: Any = {"edge_vmin": bounds[0], "edge_vmax": bounds[1], "edge_label": r"tension $\gamma$"}
    plotting.plot_tissues(tissues, edges=tensions, axes=axes[:n], **options)
    return figure, axes[n:]


class TensionRange(runs.Section):
    """Line tensions of the edges and stiffness of the cells, where the mean rest area of a cell is 1."""

    low: float = Field(default=0.04, ge=0)
    """Smallest tension."""
    high: float = Field(default=0.28, gt=0)
    """Largest tension; above twice the smallest one, some junctions of three edges have no balance and become
    four-fold vertices."""
    stiffness: float = Field(default=1.0, gt=0)
    """Stiffness of the areas of cells."""

    @model_validator(mode="after")
    def _ordered(self) -> Any:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, but they are {self.low} and {self.high}")
        return self

    def draw(self, tissue: Tissue, spread: float, key: PRNGKeyArray) -> LocalSum:
        """The energy E2 with tensions in the fraction `spread`, below 1, of the range about its middle."""
        unit = jax.random.uniform(key, (tissue.n_edges,), minval=-1.0, maxval=1.0)
        tension = self.low + (self.high - self.low) * (0.5 + 0.5 * spread * unit)
        return foam_energy(tension, stiffness=self.stiffness, low=self.low, high=self.high)


def replicate_keys(seed: int, n: int) -> list[PRNGKeyArray]:
    """Random keys of replicates; each is independent of the number of replicates."""
    return [jax.random.fold_in(jax.random.key(seed), k) for k in range(n)]


def spread_of(values: Float[np.ndarray, " *values"]) -> dict[str, float]:
    """Mean and standard deviation, for metrics."""
    values = np.asarray(values, float)
    return {"mean": float(values.mean()), "deviation": float(values.std())}


def processor_time(compute: Callable[[], Any]) -> tuple[Any, float]:
    """The result of a function, and the processor time of all its threads in seconds."""
    began = time.process_time()
    result = compute()
    return result, time.process_time() - began


def comparison(value: Any, error: Any, true: float) -> dict[str, float]:
    """A measured value with its standard error beside the true one, for metrics."""
    return {"value": float(value), "error": float(error), "true": float(true)}
