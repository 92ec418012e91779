"""Compare the ways to differentiate through an equilibrium on one inverse problem (paper, Figure 2).

Hidden shape factors of small tissues are inferred from their vertices by automatic differentiation (AD),
implicit differentiation in adjoint-state and sensitivity form (Adj-ID, Sen-ID) and equilibrium
propagation (EP): with the protocol of the paper, whose relaxations stop early, and with true equilibria.
Beside the paper's comparison of results, time and memory there are the accuracy of each gradient as
the relaxation is cut short, which explains the differences, and as the nudge of EP varies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import optimistix as optx

from vertax.fitting import Fit, stack
from vertax.runs import RunFolder, histories, joined

from . import figures
from .accuracy import accuracy, beta_scan
from .problems import Config, problem_of, protocol_of, recovery, scenes_of, shape_factors
from .scaling import scaling


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics: for each protocol and method the final Pearson correlations and relative
    errors, and the ratios of time and memory.
    """
    metrics: dict[str, Any] = {}
    for name in ("paper", "equilibrium"):
        metrics |= _inference(config, name, folder, progress)
    if config.accuracy.tolerances:
        metrics["hypergradient"] = accuracy(config, folder)
        metrics["beta"] = beta_scan(config, folder, progress)
    if config.scaling.sizes:
        for group, measured in scaling(config, folder).items():
            metrics.setdefault(group, {}).update(measured)
    return metrics


def _inference(config: Config, name: str, folder: RunFolder, progress: bool) -> dict[str, Any]:
    """Fits of all replicates by all methods, and what they found."""
    protocol = protocol_of(config, name)
    scenes = scenes_of(config, protocol.relaxation)
    batch = stack(scenes)
    fits: dict[str, Fit] = {}
    for method in config.methods:
        problem = problem_of(batch, protocol, method)
        fits[method] = folder.fit(
            f"{name} {method}",
            problem,
            protocol.fit.build(),
            protocol.fit.epochs,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
    if name == "equilibrium" and config.least_squares_steps:
        fits["LM"] = folder.fit(
            f"{name} LM",
            problem_of(batch, protocol, "Adj-ID"),
            optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12),
            config.least_squares_steps,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
    true, initial = shape_factors(batch.truth), shape_factors(batch.guess)
    inferred = {method: shape_factors(outcome.energy) for method, outcome in fits.items()}
    columns = {"replicate": np.repeat(np.arange(len(true)), true.shape[1]), "true": true.ravel()}
    columns |= {"initial": initial.ravel()} | {m: values.ravel() for m, values in inferred.items()}
    folder.save_table(f"shape_factors_{name}", columns)
    replicates = [str(k) for k in range(config.replicates)]
    tables = [
        histories(outcome, [{"method": method, "replicate": k} for k in replicates])
        for method, outcome in fits.items()
    ]
    folder.save_table(f"history_{name}", joined(tables))
    title = {"paper": "the paper's protocol", "equilibrium": "true equilibria"}[name]
    figure = figures.inference(fits, true, initial, inferred, title=title)
    folder.save_figure(f"inference_{name}", figure)
    return {
        f"{name} {method}": recovery(true, inferred[method], outcome)
        for method, outcome in fits.items()
    }
