r"""Sorting, engulfment and mixing of two types of cells, the benchmark of the OpenVT workshop 2026.

A free honeycomb with the energy $\tfrac12 \sum_c (A_c - 1)^2 + \sum_e \gamma_e \ell_e$ and adhesions
that depend on the types of the two cells relaxes against friction and noise. The length of contacts between
unlike cells is compared with the series of Chaste, and the time per step is measured against the number of
cells.
"""

import time
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import columns
from experiments._sorting import PUBLISHED, Model, honeycomb, unlike_length
from vertax import plotting, runs


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    tests: list[Literal["sorting", "engulfment", "mixing"]] = Field(
        default=["sorting", "engulfment", "mixing"], min_length=1
    )
    """The tests: a checkerboard that sorts, and two blocks."""
    duration: float = Field(default=1000.0, gt=0)
    """Duration of each run."""
    interval: float = Field(default=10.0, gt=0)
    """Time between frames."""
    replicates: int = Field(default=10, ge=1)
    """Runs of each test with other noise."""
    sizes: list[int] = Field(default=[5, 10, 20], min_length=1)
    """Cells across of the tissues for the time per step."""
    timed_steps: int = Field(default=200, ge=1)
    """Steps that are timed."""
    vtk: bool = False
    """Write the frames of the first run of each test for ParaView; needs the extra [files]."""
    model: Model = Model()
    """The vertex model."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Of each test mean and scatter of the unlike length beside the published ones; milliseconds per step."""
    times = config.interval * np.arange(round(config.duration / config.interval) + 1)
    series: dict[str, np.ndarray] = {}
    panels: dict[str, Any] = {}
    metrics: dict[str, Any] = {}
    for number, test in enumerate(config.tests):
        tasks = {
            f"{test} {k}": (
                config.seed + k + 1000 * number,
                folder.path / f"{test}.pvd" if config.vtk and k == 0 else None,
            )
            for k in range(config.replicates)
        }
        compute = partial(simulate, config, test, times)
        parts = [*folder.map_parts(compute, tasks, progress=progress, unit="run").values()]
        series[test] = np.stack([part["unlike"] for part in parts])
        folder.save_table(test, {"time": times} | {f"seed {k}": x for k, x in enumerate(series[test])})
        rows = [
            {"simulation": f"{test} {k}", **row}
            for k, part in enumerate(parts)
            for row in as_rows(part, times)
        ]
        folder.save_table(f"{test}_cells", columns(rows))
        panels[test] = parts[0]["outlines"]
        metrics[test] = compare(times, series[test], PUBLISHED[test])
        metrics[test] |= {"t1": [int(part["t1"]) for part in parts]}
        metrics[test] |= {"converged": float(np.mean([part["converged"] for part in parts]))}
    sizes = {n**2: time_per_step(config, n) for n in config.sizes}
    folder.save_table("time_per_step", {"n_cells": list(sizes), "milliseconds": list(sizes.values())})
    folder.save_figure("unlike_length", plot_series(times, series, config))
    return metrics | {"milliseconds_per_step": {str(n): value for n, value in sizes.items()}}


def simulate(
    config: Config, test: str, times: np.ndarray, task: tuple[int, Path | None]
) -> dict[str, np.ndarray]:
    """The unlike length, centroids, the last outlines, and the number of transitions of a run."""
    (key, vtk), model = task, config.model
    start = honeycomb(model.across)
    movie = model.evolution(times, key=key)(start, model.energy(test), throw=False)
    frames = movie.trajectory
    if vtk is not None:
        types = np.tile(model.types(test), (len(frames), 1))
        vx.io.write_vtk_series(vtk, frames, cells={"type": types})
    outlines, _ = vx.plotting.cell_polygons(movie.tissue)
    return {
        "unlike": np.asarray(unlike_length(movie.frames, model.types(test))),
        "places": np.stack([np.asarray(frame.centroids) for frame in frames]),
        "types": model.types(test),
        "outlines": outlines,
        "t1": np.asarray(movie.num_t1),
        "converged": np.asarray(movie.converged),
    }


def as_rows(part: dict[str, np.ndarray], times: np.ndarray) -> list[dict[str, Any]]:
    """The rows of a run in the schema of OpenVT."""
    return [
        {"time": t, "cell": cell, "type": kind, "x": x, "y": y}
        for t, places in zip(times, part["places"], strict=True)
        for cell, (kind, (x, y)) in enumerate(zip(part["types"], places, strict=True))
    ]


def compare(times: np.ndarray, series: np.ndarray, published: dict[int, float]) -> dict[str, Any]:
    """Mean and standard deviation over seeds at the published times that were simulated."""
    shown = [t for t in published if t <= times[-1]]
    values = series[:, [int(np.argmin(np.abs(times - t))) for t in shown]]
    deviation = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(len(shown), np.nan)
    rows = zip(shown, values.mean(axis=0), deviation, strict=True)
    return {f"t = {t}": {"mean": m, "deviation": d, "published": published[t]} for t, m, d in rows}


def time_per_step(config: Config, across: int) -> float:
    """Milliseconds per step of a sorting tissue, without compilation."""
    model = config.model.model_copy(update={"across": across})
    tissue, energy = honeycomb(across), model.energy("sorting")
    evolution = model.evolution(config.model.dt * np.array([0, config.timed_steps]), key=config.seed)
    wait = lambda: np.asarray(evolution(tissue, energy, throw=False).tissue.vertices)
    wait()  # compiles
    began = time.perf_counter()
    wait()
    return 1e3 * (time.perf_counter() - began) / config.timed_steps


@plotting.house_style()
def plot_series(times: np.ndarray, series: dict[str, np.ndarray], config: Config) -> Any:
    """The unlike length of all seeds against time, a panel per test, with the published points."""
    figure, (axes,) = plotting.new_figure(1, len(series), width=2.7)
    for ax, (test, values) in zip(axes, series.items(), strict=True):
        ax.plot(times, values.T, color=plotting.SERIES[0], lw=0.5, alpha=0.5)
        ax.plot(times, values.mean(axis=0), color=plotting.SERIES[0], label=f"{len(values)} seeds, mean")
        points = {t: length for t, length in PUBLISHED[test].items() if t <= times[-1]}
        if config.model.across == 10:
            ax.plot(list(points), list(points.values()), "o", ms=4, color=plotting.SERIES[1], label="Chaste")
        ax.set(xlabel="time", ylabel="length of unlike contacts", title=test)
    axes[0].legend()
    return figure
