"""Time and memory of an epoch against the number of cells."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vertax.energies import ShapeFactorEnergy
from vertax.fitting import InverseProblem
from vertax.mesh import Tissue
from vertax.runs import RunFolder

from . import figures
from .problems import Config, Method, problem_of, protocol_of, scene_of


def scaling(config: Config, folder: RunFolder) -> dict[str, dict[str, Any]]:
    """Time and memory of an epoch against the number of cells."""
    rows: list[dict[str, Any]] = []
    for name in ("equilibrium", "paper"):
        protocol = protocol_of(config, name)
        for n_cells in config.scaling.sizes:
            key = jax.random.key(config.seed)
            scene = scene_of(config, key, protocol.relaxation.build(), n_cells)
            for method in _measurable(config, n_cells):
                problem = problem_of(scene, protocol, method)
                rows.append(
                    {"protocol": name, "cells": n_cells, "method": method}
                    | _measure(problem, config.scaling.epochs)
                )
    folder.save_table("scaling", {key: [row[key] for row in rows] for key in rows[0]})
    folder.save_figure("scaling", figures.scaling(rows))
    return _by_method(rows)


def _measurable(config: Config, n_cells: int) -> Iterable[Method]:
    limits = {"AD": config.scaling.largest_unrolled, "Sen-ID": config.scaling.largest_sensitivity}
    return (m for m in config.methods if n_cells <= limits.get(m, n_cells))


def _measure(problem: InverseProblem[ShapeFactorEnergy], epochs: int) -> dict[str, Any]:
    """Milliseconds of an epoch and of its relaxation alone, and the memory that XLA sets aside."""
    arguments = (problem.energy, problem.tissue)

    @jax.jit
    def relaxed(energy: ShapeFactorEnergy, tissue: Tissue) -> tuple[Array, Tissue]:
        cost, equilibrium = problem(energy, tissue, throw=False)
        return cost, equilibrium.tissue

    @jax.jit
    def epoch(energy: ShapeFactorEnergy, tissue: Tissue) -> tuple[Array, Tissue, ShapeFactorEnergy]:
        found = problem.value_and_gradient(energy, tissue, throw=False)
        return found.cost, found.equilibrium.tissue, found.gradient

    forward, backward = (step.lower(*arguments).compile() for step in (relaxed, epoch))
    seconds: dict[str, list[float]] = {"forward": [], "epoch": []}
    tissue, p = problem.tissue, jnp.asarray(problem.energy.target_shape_factor)
    for key in jax.random.split(jax.random.key(1), epochs + 1):
        # A change as large as that of an update by ADAM.
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


def _by_method(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The measurements of each protocol and method."""
    memory = {(row["protocol"], row["cells"], row["method"]): row["memory_kB"] for row in rows}
    metrics: dict[str, dict[str, Any]] = {}
    for row in rows:
        protocol, cells, method = row["protocol"], row["cells"], row["method"]
        group = metrics.setdefault(f"{protocol} {method}", {})
        group[f"{cells} cells, ms per epoch"] = row["ms_per_epoch"]
        group[f"{cells} cells, gradient over forward"] = row["gradient_over_forward"]
        group[f"{cells} cells, memory kB"] = row["memory_kB"]
        if (protocol, cells, "EP") in memory:
            share = row["memory_kB"] / memory[protocol, cells, "EP"]
            group[f"{cells} cells, memory over that of EP"] = share
    return metrics
