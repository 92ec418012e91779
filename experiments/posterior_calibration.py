"""Calibration and cost of posteriors of target shape factors.

Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788): parameters drawn from the prior, and data
from them. The rank of a parameter among the draws of its posterior is then uniform. Beside the sampler the
Laplace approximation. The cost is that of one effective draw, against random-walk Metropolis.
"""

import time
import warnings
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy import stats

import vertax as vx
from experiments._shared import fitted_noise, scan
from vertax import bayes, plotting, runs
from vertax.energies import ShapeFactorEnergy

P0, NOISE = "target_shape_factor", "noise"


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    replicates: int = Field(default=200, ge=2)
    """Synthetic tissues with vertex data."""
    image_replicates: int = Field(default=200, ge=2)
    """Synthetic tissues with image data."""
    n_cells: int = Field(default=20, ge=2)
    """Cells of each tissue."""
    mean: float = 3.65
    """Mean of the prior of the target shape factors."""
    deviation: float = Field(default=0.1, gt=0)
    """Its standard deviation."""
    vertex_noise: float = Field(default=0.01, gt=0)
    """Median of the noise of a coordinate; its logarithm has a standard deviation of 0.5."""
    image_noise: float = Field(default=0.5, gt=0)
    """Median of the noise of a pixel, length of edge per area."""
    pixels: int = Field(default=48, ge=16)
    """Side of the image."""
    draws: int = Field(default=63, ge=7)
    """Draws of a posterior for the ranks, every second one of the chain."""
    warmup: int = Field(default=60, ge=20)
    """Steps of the adaptation."""
    bins: int = Field(default=8, ge=2)
    """Bins of the ranks for the χ² test; they should divide the number of draws + 1."""
    cost_sizes: list[int] = Field(default=[20, 100], min_length=1)
    """Numbers of cells for the cost."""
    cost_draws: int = Field(default=300, ge=20)
    """Draws for the cost."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """P values of uniform ranks, and the cost of an effective draw."""
    metrics, ranks = {}, {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the metrics count what they state
        for kind, n in (("vertices", config.replicates), ("image", config.image_replicates)):
            compute = partial(calibrate, config, kind)
            ranks[kind] = scan(folder, kind, range(n), compute, progress=progress)
        rows = [cost(config, n) for n in config.cost_sizes]
    for kind, groups in ranks.items():
        for key in ("rejected trajectories", "draws with a short edge"):
            metrics[f"{kind}, {key}"] = int(groups.pop(key).sum())
        metrics |= {f"{kind}, {key}, p": uniformity(values, config) for key, values in groups.items()}
    folder.save_table("cost", {key: np.array([row[key] for row in rows]) for key in rows[0]})
    folder.save_figure("calibration", plot_ranks(ranks, config))
    return metrics | {f"cost at {row['cells']} cells": row for row in rows}


def uniformity(ranks: np.ndarray, config: Config) -> float:
    """P value of the χ² tests of uniform ranks of each cell, with Bonferroni's correction.

    (Ranks of the cells of one tissue depend on each other, so a test of all together is not valid.)
    """
    edges = np.linspace(0, config.draws + 1, config.bins + 1)
    cells = np.reshape(ranks, (len(ranks), -1)).T
    return min(1.0, len(cells) * min(stats.chisquare(np.histogram(r, edges)[0]).pvalue for r in cells))


def density(config: Config, kind: Literal["vertices", "image"], n: int, seed: int) -> tuple[Any, Any]:
    """The posterior of a synthetic tissue, and the parameters behind its data."""
    import numpyro.distributions as dist  # (Of an extra: `bayes` names it if it is missing.)

    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), seed), 4)
    mean = ShapeFactorEnergy(jnp.full(n, config.mean))
    first = vx.initialise.periodic_voronoi(n, key=keys[0], lloyd_steps=2)
    start = vx.equilibrate(first, mean).tissue
    median = config.vertex_noise if kind == "vertices" else config.image_noise
    prior = {P0: dist.Normal(config.mean, config.deviation), NOISE: dist.LogNormal(np.log(median), 0.5)}
    response = vx.Relaxation(transitions=None, contact_range=None)
    # Parameters without equilibrium have posterior density 0: the prior leaves them out too.
    attempts = iter(range(1000))
    draw = lambda: jnp.asarray(prior[P0].sample(jax.random.fold_in(keys[1], next(attempts)), (n,)))
    p0 = draw()
    while not (relaxed := response(start, ShapeFactorEnergy(p0), throw=False)).converged:
        p0 = draw()
    truth = {P0: p0, NOISE: prior[NOISE].sample(keys[2])}
    target, noise = relaxed.tissue, lambda x: x + truth[NOISE] * jax.random.normal(keys[3], x.shape)
    if kind == "vertices":
        data = target.with_vertices(noise(target.vertices))
        cost = n * 2.0 * vx.costs.VertexDistance(data)
    else:
        shape, width = (config.pixels, config.pixels), 1.5 * float(np.sqrt(n)) / config.pixels
        image = noise(eqx.filter_jit(vx.costs.render)(target, shape, width, points_per_edge=16))
        options: Any = {"points_per_edge": 16, "fit_intensity": False}
        cost = float(config.pixels**2) * vx.costs.MeshImage(image, width, **options)
    problem = vx.InverseProblem(start, mean, cost, response=response)
    return bayes.LogPosterior(problem, prior, fitted_noise), truth


def calibrate(config: Config, kind: Any, number: float) -> dict[str, np.ndarray]:
    """Ranks of the true parameters among draws of the sampler and of the Laplace approximation."""
    seed = int(number)
    posterior_density, truth = density(config, kind, config.n_cells, seed)
    options: Any = {"draws": 2 * config.draws, "warmup": config.warmup, "chains": 1, "progress": False}
    posterior = bayes.sample(posterior_density, seed, **options)
    approximate = posterior.laplace.draw(seed, config.draws)
    rank = lambda draws, name: np.sum(np.asarray(draws) < np.asarray(truth[name]), axis=0)
    ranks = {f"{name}, NUTS": rank(posterior.draws(name)[0, 1::2], name) for name in truth}
    ranks |= {f"{name}, Laplace": rank(approximate[name], name) for name in truth}
    values = {name: posterior.data["sample_stats"][name].values for name in ("rejected", "shortest_edge")}
    short = np.sum(values["shortest_edge"] < 0.02)
    return ranks | {"rejected trajectories": np.sum(values["rejected"]), "draws with a short edge": short}


def cost(config: Config, n: int) -> dict[str, Any]:
    """Gradients, relaxations and seconds of one effective draw of the worst determined parameter."""
    import arviz

    posterior_density, _ = density(config, "vertices", n, 0)
    options: Any = {"draws": config.cost_draws, "warmup": config.warmup, "chains": 1, "progress": False}
    bayes.sample(posterior_density, 0, **options)  # compiles
    start = time.perf_counter()
    posterior = bayes.sample(posterior_density, 1, **options)
    seconds, ess = time.perf_counter() - start, float(posterior.table()["ess"].min())
    chain = eqx.filter_jit(random_walk)
    jax.block_until_ready(chain(posterior.laplace, jax.random.key(0), posterior.num_gradients))
    start = time.perf_counter()
    u = np.asarray(chain(posterior.laplace, jax.random.key(1), posterior.num_gradients))
    walk_seconds = time.perf_counter() - start
    walk_ess = min(float(arviz.ess(values[None])) for values in u[len(u) // 5 :].T)
    return {
        "cells": n,
        "gradients per effective draw": posterior.num_gradients / ess,
        "seconds per effective draw": seconds / ess,
        "relaxations per effective draw, random walk": posterior.num_gradients / walk_ess,
        "seconds per effective draw, random walk": walk_seconds / walk_ess,
        "smallest effective size": ess,
        "smallest effective size, random walk": walk_ess,
    }


def random_walk(laplace: bayes.Laplace, key: jax.Array, steps: int) -> jax.Array:
    """Random-walk Metropolis with the covariance of the Laplace approximation and the optimal scale."""

    import blackjax

    walks: Any = blackjax.additive_step_random_walk

    log_density = lambda u: laplace.log_posterior.log_density(laplace.mode + laplace.factor @ u)
    size = len(laplace.mode)
    walk = walks.normal_random_walk(log_density, jnp.full(size, 2.38 / size**0.5))
    step = lambda state, key: (walk.step(key, state)[0],) * 2
    _, states = jax.lax.scan(step, walk.init(jnp.zeros(size)), jax.random.split(key, steps))
    return states.position


@plotting.house_style()
def plot_ranks(ranks: dict[str, Any], config: Config) -> Any:
    """Histograms of the ranks of sampler and Laplace approximation, with their errors over tissues."""
    figure, axes = plotting.new_figure(2, 2, height=2.0)
    edges = np.linspace(0, 1, config.bins + 1)
    for row, (kind, groups) in zip(axes, ranks.items(), strict=True):
        for ax, name in zip(row, (P0, NOISE), strict=True):
            for method, shift in (("NUTS", -0.01), ("Laplace", 0.01)):
                values = (groups[f"{name}, {method}"] + 0.5) / (config.draws + 1)
                counts = np.array([np.histogram(tissue, edges)[0] for tissue in values])
                heights = counts * config.bins / values[0].size
                error = heights.std(0) / len(heights) ** 0.5
                middles = edges[:-1] + 0.5 / config.bins + shift
                ax.errorbar(middles, heights.mean(0), error, fmt="o", ms=3, label=method)
            ax.axhline(1.0, color=plotting.INK, lw=0.8, zorder=0)
            ax.set(title=f"{kind}: {name.replace('_', ' ')}", ylim=(0, None), xlim=(0, 1))
        row[0].set_ylabel("density of ranks")
    for ax in axes[-1]:
        ax.set_xlabel("rank of the truth / draws")
    axes[0][0].legend()
    return figure
