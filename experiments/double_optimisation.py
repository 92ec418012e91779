r"""Cells that tune stiffness, shape factor or area to lower the energy, and the transition of the tissue.

Each cell has a factor on its perimeter stiffness, target perimeter or target area. The factors have a mean
of 1 and a fixed spread, and are fitted to minimise the energy of the relaxed tissue: an optimisation above
the relaxation (Arzash, Tah, Liu & Manning 2023, arXiv:2312.11683). A tissue is rigid where cells cannot
reach their target perimeters, which is a property of shapes alone: other stiffnesses should not move the
transition, other perimeters or areas should.
"""

import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import replicate_keys
from experiments._transition import fit_onset
from vertax import plotting, runs
from vertax.fitting import member

Tuned = Literal["stiffness", "perimeter", "area"]


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    tuned: list[Tuned] = Field(default=["stiffness", "perimeter", "area"], min_length=1)
    """Properties that cells tune."""
    spreads: list[float] = Field(default=[0.5, 0.03, 0.15], min_length=1)
    """Standard deviation of the logarithm of the factors, for each of them."""
    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.5 + 0.05 * k, 2) for k in range(10)], min_length=3
    )
    """Mean target shape factors."""
    replicates: int = Field(default=6, ge=2)
    """Independent tissues for each of them."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=36)
    """The tissues."""
    fit: runs.Fitting = runs.Fitting(learning_rate=0.1, epochs=60)
    """Fit of the factors."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=500, contacts=False)
    """Relaxation of the tissues."""


class TunedCells(vx.AbstractLocalEnergy):
    r"""$\tfrac12 \sum_c (A_c - A^0_c)^2 + K_c (P_c - P^0_c)^2$ with a factor for each cell.

    The factor multiplies $K$, $P^0$ or $A^0$. It is $e^{s z_c}$ over its mean, where the numbers $z$ are
    shifted and scaled to a mean of 0 and a variance of 1, so that the spread of the factors is constant.
    """

    z: jax.Array
    shape_factor: jax.Array
    spread: jax.Array
    tuned: Tuned = eqx.field(static=True)

    @property
    def factors(self) -> jax.Array:
        """The factor of each cell; their mean is 1."""
        centred = self.z - jnp.mean(self.z)
        powers = jnp.exp(self.spread * centred / jnp.sqrt(jnp.mean(centred**2)))
        return powers / jnp.mean(powers)

    def cell_terms(self, tissue: vx.Tissue) -> jax.Array:
        factor = lambda name: self.factors if name == self.tuned else 1.0
        excess = tissue.perimeters - self.shape_factor * factor("perimeter")
        areas = tissue.areas - factor("area")
        return 0.5 * areas**2 + 0.5 * factor("stiffness") * excess**2


class EnergyPerCell(vx.AbstractCost):
    """The energy of the relaxed tissue per cell."""

    def __call__(self, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
        return energy(tissue) / tissue.n_cells


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By property: shape factors of zero energy with random and tuned factors, and their difference."""
    began = time.perf_counter()
    if len(config.spreads) != len(config.tuned):
        raise runs.ConfigError(
            f"spreads must have one number for each of tuned, but there are {len(config.spreads)} and "
            f"{len(config.tuned)}."
        )
    metrics: dict[str, Any] = {}
    energies: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    table: dict[str, Any] = {"p0": config.shape_factors}
    for tuned, spread in zip(config.tuned, config.spreads, strict=True):
        problems = make_problems(config, tuned, spread)
        fit = folder.fit_in_threads(tuned, problems, config.fit, progress=progress)
        shape = (len(config.shape_factors), config.replicates)
        before, after = (np.asarray(x).reshape(shape) for x in (fit.history.cost[0], fit.cost))
        energies[tuned] = before, after
        table |= {f"{tuned}_drawn": before.mean(axis=1), f"{tuned}_tuned": after.mean(axis=1)}
        metrics[tuned] = measure(config, before, after)
        folder.save_tissue(tuned, member(fit.tissue, 0))  # of the smallest shape factor, a rigid tissue
    folder.save_table("energies", table)
    onsets = {name: (group["drawn"], group["tuned"]) for name, group in metrics.items()}
    figure = plot_transition(np.asarray(config.shape_factors), energies, onsets)
    folder.save_figure("transition", figure)
    return metrics | {"seconds": time.perf_counter() - began}


def make_problems(config: Config, tuned: Tuned, spread: float) -> list[vx.InverseProblem]:
    """One problem per shape factor and tissue; all shape factors have the same tissues and factors."""
    keys = [jax.random.split(key) for key in replicate_keys(config.seed, config.replicates)]
    first = config.tissue.draw(jnp.stack([pair[0] for pair in keys]))
    # The energy is stationary at equilibrium: the adjoint solves for rounding errors only, and may fail.
    levels: Any = {"adjoint": vx.ImplicitDifferentiation(throw=False), "response": config.relaxation.build()}
    problems = []
    for p0, k in ((p0, k) for p0 in config.shape_factors for k in range(config.replicates)):
        z = jax.random.normal(keys[k][1], (config.tissue.n_cells,))
        energy = TunedCells(z, jnp.asarray(p0), jnp.asarray(spread), tuned)
        trainable = eqx.tree_at(lambda e: e.z, jax.tree.map(lambda _: False, energy), True)
        tissue = member(first, k)
        problems.append(vx.InverseProblem(tissue, energy, EnergyPerCell(), trainable, **levels))
    return problems


def measure(config: Config, before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """The shape factors of zero energy, and the shift with its standard error by a bootstrap over tissues."""

    def onsets(chosen: np.ndarray) -> list[float]:
        fits = [fit_onset(np.asarray(config.shape_factors), e[:, chosen]) for e in (before, after)]
        return [np.nan if fit is None else fit.centre for fit in fits]

    every, rng = np.arange(config.replicates), np.random.default_rng(config.seed)
    drawn, tuned = onsets(every)
    samples = np.array([onsets(rng.choice(every, every.size)) for _ in range(200)])
    return {
        "drawn": drawn,
        "tuned": tuned,
        "shift": tuned - drawn,
        "shift_error": float(np.nanstd(samples[:, 1] - samples[:, 0])),
        "energy_share_left": float(np.sum(after) / np.sum(before)),
    }


@plotting.house_style()
def plot_transition(shape_factors: np.ndarray, energies: Any, onsets: Any) -> Any:
    """The root of the energy against the shape factor, with random and tuned factors."""
    figure, (axes,) = plotting.new_figure(1, len(energies), width=2.3)
    for ax, (name, pair) in zip(axes, energies.items(), strict=True):
        rows = zip(("as drawn", "tuned"), pair, onsets[name], plotting.SERIES, strict=False)
        for label, values, onset, colour in rows:
            roots = np.sqrt(np.maximum(values, 0))
            each = np.repeat(shape_factors, roots.shape[1])
            ax.plot(each, roots.ravel(), ".", ms=2, color=colour, alpha=0.4)
            ax.plot(shape_factors, roots.mean(axis=1), color=colour, label=label)
            if np.isfinite(onset):
                ax.axvline(onset, color=colour, lw=0.7, ls=":")
        ax.axhline(0, color=plotting.INK, lw=0.5)
        ax.set(title=f"tuned: {name}", xlabel="mean target shape factor")
    axes[0].set_ylabel("root of energy per cell")
    axes[0].legend()
    return figure
