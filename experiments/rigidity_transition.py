"""The transition from solid to fluid: tissues at zero energy against the target shape factor.

Random tissues with one target shape factor in all cells are relaxed. Below the transition cells cannot reach
their target perimeters and the tissue is rigid; above it they can, and it is floppy (paper, Figure 3g, left;
Bi et al. 2015, doi:10.1038/nphys3471). A quench stops at a local minimum. Driving lowers the energy further:
the tissue relaxes with randomly perturbed shape factors, then with the original ones, and the new state is
kept if its energy is smaller.
"""

import time
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from experiments._shared import FLUID, scan
from experiments._transition import fit_onset, fit_transition
from vertax import plotting, runs
from vertax.energies import ShapeFactorEnergy
from vertax.plotting import INK, SERIES


class Driving(runs.Section):
    """Random driving after the quench."""

    cycles: int = Field(default=6, ge=0)
    """Perturbations of each tissue; tissues at zero energy are left out."""
    deviation: float = Field(default=0.2, gt=0)
    """Standard deviation of the perturbation of a shape factor."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.6 + 0.02 * k, 2) for k in range(21)], min_length=2
    )
    """Target shape factors of all cells."""
    replicates: int = Field(default=100, ge=2)
    """Independent tissues for each of them."""
    zero_energy: float = Field(default=1e-8, gt=0)
    """Energy per cell that counts as zero."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=100)
    """The tissues."""
    driving: Driving = Driving()
    """Driving after the quench."""
    modes: int = Field(default=10, ge=0)
    """Tissues of each shape factor for the number of zero modes (dense Hessian); 0 skips it."""
    at_once: int = Field(default=1, ge=1)
    """Tissues that are relaxed as one batch: 1 is best on CPUs, all of them on a GPU."""
    resamples: int = Field(default=500, ge=10)
    """Bootstrap samples of the intervals."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=500)
    """Relaxation of the tissues."""


class Curve(NamedTuple):
    """Fractions of tissues at zero energy, mean roots of energies per cell, and fits to both."""

    name: str
    fraction: np.ndarray
    centre: float
    width: float
    """Of the logistic curve through the fractions."""
    root_energy: np.ndarray
    onset: tuple[float, float] | None
    """Zero and inverse slope of the line through the roots."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Transitions and onsets after the quench and after driving, with 95 % intervals of a bootstrap."""
    began = time.perf_counter()
    results = scan(folder, "p0", config.shape_factors, partial(measure, config), progress=progress)
    seconds, energies = time.perf_counter() - began, results["energy"] / config.tissue.n_cells
    zero, converged, x = energies < config.zero_energy, results["converged"], np.asarray(config.shape_factors)
    metrics: dict[str, Any] = {}
    curves, last = [], config.driving.cycles
    for cycle in sorted({0, *(c for c in (1, 3) if c < last), last}):
        name = "quench" if cycle == 0 else f"{cycle} cycles" if cycle > 1 else "1 cycle"
        transition, transition_metrics = fit_fractions(x, zero[..., cycle], config)
        onset, onset_metrics = fit_roots(x, energies[..., cycle], config)
        roots = np.sqrt(np.maximum(energies[..., cycle], 0)).mean(axis=1)
        fraction = zero[..., cycle].mean(axis=1)
        line = None if onset is None else (onset.centre, onset.width)
        curves.append(Curve(name, fraction, transition.centre, transition.width, roots, line))
        metrics[name] = onset_metrics | transition_metrics
    table: dict[str, Any] = {"p0": x}
    table |= {f"zero_after_{c}": zero[..., c].mean(axis=1) for c in range(zero.shape[-1])}
    table |= {"energy_quench": np.median(energies[..., 0], axis=1)}
    table |= {"energy_driven": np.median(energies[..., -1], axis=1)}
    table |= {"shape_factor": results["shapes"].mean(axis=1), "converged": converged.mean(axis=1)}
    table |= {"zero_modes": results["modes"].mean(axis=1)} if config.modes else {}
    folder.save_table("transition", table)
    folder.save_array("energies", energies)
    folder.save_figure("transition", plot_transition(x, curves, results["shapes"], results["modes"]))
    metrics["run"] = {
        "converged_fraction": converged.mean(),
        "least_converged": converged.mean(axis=1).min(),
        "seconds": seconds,
        "num_t1": int(results["num_t1"].sum()),
    }
    return metrics


def measure(config: Config, value: float) -> dict[str, np.ndarray]:
    """Energies, transitions, shapes and modes of all replicates at one target shape factor."""
    index, p0 = config.shape_factors.index(value), jnp.asarray(value)
    key = jax.random.fold_in(jax.random.key(config.seed), index)
    keys = jax.random.split(key, config.replicates + 1)
    arguments = config.relaxation.build(), config.driving, config.at_once
    results, tissues = jax.block_until_ready(relax(config.tissue.draw(keys[1:]), p0, keys[0], *arguments))
    shapes = np.asarray(jax.vmap(lambda t: t.shape_factors)(tissues)).mean(axis=1)
    some = jax.tree.map(lambda x: x[: config.modes], tissues)
    modes = np.asarray(count_zero_modes(some, p0), float) if config.modes else np.zeros(0)
    return {name: np.asarray(x) for name, x in results.items()} | {"shapes": shapes, "modes": modes}


@eqx.filter_jit
def relax(first: Any, p0: Any, key: Any, response: Any, driving: Driving, at_once: int) -> tuple:
    """Quench and drive all tissues: energies after the quench and each cycle, and the last tissues."""
    energy = ShapeFactorEnergy(p0)

    def cycle(carry: tuple, key: Any) -> tuple[tuple, Any]:
        def perturb() -> tuple:
            tissue, value, _, num_t1 = carry
            noise = jax.random.normal(key, (tissue.n_cells,))
            perturbed = response(tissue, ShapeFactorEnergy(p0 + driving.deviation * noise), throw=False)
            rest = response(perturbed.tissue, energy, throw=False)
            new = (rest.tissue, rest.energy, rest.converged, num_t1)
            kept = jax.tree.map(lambda a, b: jnp.where(rest.energy < value, a, b), new, carry)
            return (*kept[:3], num_t1 + perturbed.num_t1 + rest.num_t1)

        carry = jax.lax.cond(carry[1] < 1e-12, lambda: carry, perturb)
        return carry, carry[1]

    def one(arguments: tuple) -> tuple:
        tissue, key = arguments
        quenched = response(tissue, energy, throw=False)
        start = (quenched.tissue, quenched.energy, quenched.converged, quenched.num_t1)
        keys = jax.random.split(key, driving.cycles)
        (tissue, _, converged, num_t1), values = jax.lax.scan(cycle, start, keys)
        energies = jnp.append(quenched.energy, values)
        return {"energy": energies, "converged": converged, "num_t1": num_t1}, tissue

    keys = jax.random.split(key, len(first.vertices))
    return jax.lax.map(one, (first, keys), batch_size=None if at_once == 1 else at_once)


@eqx.filter_jit
def count_zero_modes(tissues: vx.Tissue, p0: Any) -> Any:
    """Numbers of displacements without stiffness, without the two translations."""
    energy = ShapeFactorEnergy(p0)

    def one(tissue: vx.Tissue) -> Any:
        at = lambda y: energy(tissue.with_vertices(y.reshape(tissue.vertices.shape)))
        stiffness = jnp.linalg.eigvalsh(jax.hessian(at)(tissue.vertices.ravel()))
        return jnp.sum(stiffness < 1e-6 * stiffness[-1]) - 2

    return jax.lax.map(one, tissues)


def fit_fractions(x: np.ndarray, zero: np.ndarray, config: Config) -> tuple[Any, dict[str, float]]:
    """The logistic curve through the fractions at zero energy, and its metrics."""
    trials, low, high = zero.shape[1], np.nan, np.nan
    best = fit_transition(x, zero.sum(axis=1).astype(float), trials)
    if not np.isnan(best.centre):
        rng = np.random.default_rng(config.seed)
        draw = lambda: rng.binomial(trials, zero.mean(axis=1)).astype(float)
        centres = [fit_transition(x, draw(), trials).centre for _ in range(config.resamples)]
        low, high = np.nanpercentile(centres, [2.5, 97.5])
    interval = {"p0_star_low": float(low), "p0_star_high": float(high)}
    return best, {"p0_star": best.centre, **interval, "width": best.width}


def fit_roots(x: np.ndarray, energies: np.ndarray, config: Config) -> tuple[Any, dict[str, float]]:
    """The line through the roots of the energies of rigid tissues, and the metrics of its zero."""
    best, trials, rng = fit_onset(x, energies), energies.shape[1], np.random.default_rng(config.seed)
    if best is None:
        return None, {}
    chosen = (rng.integers(trials, size=trials) for _ in range(config.resamples))
    draws = [fit_onset(x, energies[:, rows]) for rows in chosen]
    low, high = np.percentile([d.centre for d in draws if d is not None], [2.5, 97.5])
    return best, {"onset": best.centre, "onset_low": float(low), "onset_high": float(high)}


@plotting.house_style()
def plot_transition(x: np.ndarray, curves: list[Curve], shapes: np.ndarray, modes: np.ndarray) -> Any:
    """Fractions at zero energy, energies, observed shapes and zero modes against the shape factor."""
    figure, (axes,) = plotting.new_figure(1, 4 if modes.size else 3, width=2.2)
    colours = series_colours(curve.name for curve in curves)
    fine = np.linspace(x.min(), x.max(), 400)
    for curve in curves:
        style: Any = {"ms": 3, "color": colours[curve.name]}
        axes[0].plot(x, curve.fraction, "o", label=curve.name, **style)
        if np.isfinite(curve.centre):
            z = np.clip((fine - curve.centre) / curve.width, -50, 50)
            axes[0].plot(fine, 1 / (1 + np.exp(-z)), lw=1, **style)
        axes[1].plot(x, curve.root_energy, "o", **style)
        if curve.onset is not None:
            onset, width = curve.onset
            axes[1].plot([x[0], onset], [(onset - x[0]) / width, 0], lw=1, **style)
    axes[0].set(ylabel="fraction at zero energy", ylim=(-0.03, 1.03))
    axes[0].legend(loc="upper left")
    axes[1].set_ylabel("root of energy per cell")
    for ax in axes[:2]:
        ax.axvline(FLUID, color=INK, lw=0.7, ls=":")
    axes[2].plot(x[[0, -1]], x[[0, -1]], color=INK, lw=0.7, ls=":")
    panels = ((shapes, "mean observed shape factor"), (modes, "zero modes of a tissue"))
    for ax, (values, label) in zip(axes[2:], panels, strict=False):
        ax.errorbar(x, values.mean(1), values.std(1), fmt="o", ms=3, lw=0.8, color=SERIES[1])
        ax.set_ylabel(label)
    for ax in axes:
        ax.set_xlabel("target shape factor $p_0$")
    return figure
