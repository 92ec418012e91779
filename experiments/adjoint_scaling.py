"""Time and memory of an epoch against the number of cells, by adjoint (paper, Figure 2).

An epoch is a relaxation and a gradient, compiled as one function. It is timed after small changes of the
parameters, as an optimiser makes them; memory is the temporary memory that XLA allocates for the function.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments import benchmark_adjoints as benchmark
from experiments._replicates import same_limits
from experiments._shared import columns
from vertax import plotting, runs


class Config(benchmark.Scenes):
    """Configuration of this experiment."""

    sizes: list[int] = Field(default=[20, 50, 100, 200, 500, 1000], min_length=1)
    """Numbers of cells."""
    epochs: int = Field(default=5, ge=1)
    """Epochs that are timed, each after a small change of the parameters; the result is the median."""
    largest_unrolled: int = Field(default=200, ge=0)
    """Largest number of cells for AD; its relaxations take ever more steps."""
    largest_sensitivity: int = Field(default=200, ge=0)
    """Largest number of cells for Sen-ID, which solves one linear system per cell."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Time and memory by protocol and method."""
    del progress
    rows: list[dict[str, Any]] = []
    limits = {"AD": config.largest_unrolled, "Sen-ID": config.largest_sensitivity}
    for name in ("equilibrium", "paper"):
        protocol: benchmark.Protocol = getattr(config, name)
        for n_cells in config.sizes:
            key, response = jax.random.key(config.seed), protocol.relaxation.build()
            scene = benchmark.make_scene(config, key, response, n_cells)
            for method in (m for m in config.methods if n_cells <= limits.get(m, n_cells)):
                measured = measure(benchmark.make_problem(scene, protocol, method), config.epochs)
                rows.append({"protocol": name, "cells": n_cells, "method": method} | measured)
    folder.save_table("scaling", columns(rows))
    folder.save_figure("scaling", plot_scaling(rows))
    memory = {(row["protocol"], row["cells"], row["method"]): row["memory_kB"] for row in rows}
    metrics: dict[str, dict[str, Any]] = {}
    for row in rows:
        cells, memory_of_ep = row["cells"], memory.get((row["protocol"], row["cells"], "EP"))
        group = metrics.setdefault(f"{row['protocol']} {row['method']}", {})
        group[f"{cells} cells, ms per epoch"] = row["ms_per_epoch"]
        group[f"{cells} cells, gradient over forward"] = row["gradient_over_forward"]
        group[f"{cells} cells, memory kB"] = row["memory_kB"]
        if memory_of_ep is not None:
            group[f"{cells} cells, memory over that of EP"] = row["memory_kB"] / memory_of_ep
    return metrics


def measure(problem: vx.InverseProblem, epochs: int) -> dict[str, Any]:
    """Milliseconds of an epoch and of its relaxation alone, and the memory that XLA allocates."""
    arguments = (problem.energy, problem.tissue)

    @jax.jit
    def relaxed(energy: Any, tissue: Any) -> Any:
        cost, equilibrium = problem(energy, tissue, throw=False)
        return cost, equilibrium.tissue

    @jax.jit
    def epoch(energy: Any, tissue: Any) -> Any:
        result = problem.value_and_gradient(energy, tissue, throw=False)
        return result.cost, result.equilibrium.tissue, result.gradient

    forward, backward = (step.lower(*arguments).compile() for step in (relaxed, epoch))
    seconds: dict[str, list[float]] = {"forward": [], "epoch": []}
    tissue, p = problem.tissue, jnp.asarray(problem.energy.target_shape_factor)
    for key in jax.random.split(jax.random.key(1), epochs + 1):
        # A change of the size of an ADAM update.
        p = p + 1e-3 * jax.random.normal(key, p.shape, p.dtype)
        energy = eqx.tree_at(lambda e: e.target_shape_factor, problem.energy, p)
        for name, function in (("forward", forward), ("epoch", backward)):
            began = time.perf_counter()
            result = jax.block_until_ready(function(energy, tissue))
            seconds[name].append(time.perf_counter() - began)
        tissue = result[1]
    memory = backward.memory_analysis()
    # The first epoch is a warm-up.
    ms = {name: 1e3 * float(np.median(times[1:])) for name, times in seconds.items()}
    return {
        "ms_per_epoch": ms["epoch"],
        "ms_forward": ms["forward"],
        "gradient_over_forward": (ms["epoch"] - ms["forward"]) / ms["forward"],
        "memory_kB": memory.temp_size_in_bytes / 1e3 if memory is not None else np.nan,
    }


@plotting.house_style()
def plot_scaling(rows: list[dict[str, Any]]) -> Any:
    """Time and memory of an epoch against the number of cells."""
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    sizes = sorted({row["cells"] for row in rows})
    figure, (axes,) = plotting.new_figure(1, 2 * len(protocols), width=2.2, height=2.4)
    for k, protocol in enumerate(protocols):
        time_axes, memory_axes = axes[2 * k : 2 * k + 2]
        column = lambda method, key, p=protocol: [
            row[key] for row in rows if (row["protocol"], row["method"]) == (p, method)
        ]
        for method in dict.fromkeys(row["method"] for row in rows):
            style = {"marker": benchmark.MARKERS[method], "color": benchmark.COLOURS[method], "ms": 3.5}
            cells = column(method, "cells")
            time_axes.plot(cells, column(method, "ms_per_epoch"), label=method, **style)
            memory_axes.plot(cells, column(method, "memory_kB"), label=method, **style)
        if forward := column("Adj-ID", "ms_forward"):
            style = {"ls": ":", "color": plotting.INK, "label": "relaxation alone"}
            time_axes.plot(column("Adj-ID", "cells"), forward, **style)
        for ax in (time_axes, memory_axes):
            ax.set(xscale="log", yscale="log", xlabel="cells", title=benchmark.TITLES[protocol])
            ax.set_xticks(sizes, list(map(str, sizes)), rotation=45)
            ax.minorticks_off()
        time_axes.set_ylabel("time of an epoch (ms)")
        memory_axes.set_ylabel("working memory (kB)")
    same_limits(axes[::2])
    same_limits(axes[1::2])
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1, 1))
    return figure
