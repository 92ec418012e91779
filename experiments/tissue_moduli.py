"""Shear and bulk modulus of disordered tissues against the target shape factor.

Random tissues with one target shape factor in all cells are relaxed in a square box. Measured are the relaxed
and the affine shear modulus, the bulk modulus and the tension. The relaxed shear modulus vanishes where the
tissue becomes fluid (Bi et al. 2015, doi:10.1038/nphys3471; Merkel & Manning 2018,
doi:10.1088/1367-2630/aaaa13); the affine one, without displacements of the vertices, does not.
"""

import time
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import FLUID, HEXAGON, scan
from vertax import mechanics, plotting, runs
from vertax.plotting import INK, SERIES

NAMES = ("shear", "affine", "bulk", "tension")


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.3 + 0.05 * k, 2) for k in range(15)], min_length=2
    )
    """Target shape factors of all cells."""
    replicates: int = Field(default=20, ge=2)
    """Independent tissues for each of them."""
    solid: float = Field(default=1e-3, gt=0)
    """Smallest shear modulus of a solid tissue, relative to the affine one."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=64)
    """The tissues."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=1000, contacts=False)
    """Relaxation of the tissues; moduli do not include forces of contacts."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Mean moduli, the fraction of solid tissues, and the shape factor at which half of them are solid."""
    began, shape_factors = time.perf_counter(), np.asarray(config.shape_factors)
    compute = partial(measure_replicates, config)
    measured = scan(folder, "p0", config.shape_factors, compute, progress=progress)
    valid = measured["converged"] & np.isfinite(measured["shear"])
    values = {name: np.where(valid, measured[name], np.nan) for name in NAMES}
    means = {name: mean(value) for name, value in values.items()}
    is_solid = measured["shear"] > config.solid * measured["affine"]
    solid = mean(np.where(valid, is_solid, np.nan))
    table = {"p0": shape_factors, **means, "solid": solid, "known": valid.mean(axis=1)}
    folder.save_table("moduli", table)
    folder.save_array("shear", values["shear"])
    folder.save_figure("moduli", plot_moduli(shape_factors, values["shear"], means, solid))
    return {
        "shear": means["shear"].tolist(),
        "affine": means["affine"].tolist(),
        "bulk": means["bulk"].tolist(),
        "solid": solid.tolist(),
        "half_solid_at": crossing(shape_factors, solid),
        "known_fraction": float(valid.mean()),
        "seconds": time.perf_counter() - began,
    }


def measure_replicates(config: Config, p0: float) -> dict[str, np.ndarray]:
    """The moduli of all replicates, from the same first tissues at each shape factor."""
    first = config.tissue.draw(jax.random.split(jax.random.key(config.seed), config.replicates))
    measured = measure(first, jnp.asarray(p0), config.relaxation.build())
    return {name: np.asarray(value) for name, value in measured.items()}


@eqx.filter_jit
def measure(first: vx.Tissue, p0: Any, response: vx.Relaxation) -> dict[str, Any]:
    """Moduli and tension of each tissue of a batch after relaxation."""
    energy = vx.energies.ShapeFactorEnergy(p0)

    def one(start: vx.Tissue) -> dict[str, Any]:
        equilibrium = response(start, energy, throw=False)
        tissue = equilibrium.tissue
        return {
            "shear": mechanics.shear_modulus(tissue, energy, throw=False),
            "affine": mechanics.shear_modulus(tissue, energy, affine=True, throw=False),
            "bulk": mechanics.bulk_modulus(tissue, energy, throw=False),
            "tension": 0.5 * jnp.trace(mechanics.stress(tissue, energy)),
            "converged": equilibrium.converged,
        }

    return jax.lax.map(one, first)


def mean(values: np.ndarray) -> np.ndarray:
    """The mean over tissues without NaN; NaN of no tissues."""
    counts = np.isfinite(values).sum(axis=1)
    return np.where(counts > 0, np.nansum(values, axis=1) / np.maximum(counts, 1), np.nan)


def crossing(shape_factors: np.ndarray, solid: np.ndarray) -> float | None:
    """The shape factor at which the fraction of solid tissues falls below a half, by interpolation."""
    below = np.flatnonzero((solid[:-1] >= 0.5) & (solid[1:] < 0.5))
    if below.size == 0:
        return None
    i = below[0]
    part = (solid[i] - 0.5) / (solid[i] - solid[i + 1])
    return float(shape_factors[i] + part * (shape_factors[i + 1] - shape_factors[i]))


@plotting.house_style()
def plot_moduli(shape_factors: np.ndarray, shear: np.ndarray, means: Any, solid: np.ndarray) -> Any:
    """Moduli, tension and fraction of solid tissues against the target shape factor."""
    figure, ((left, middle, right),) = plotting.new_figure(1, 3, width=2.3)
    each = np.repeat(shape_factors, shear.shape[1])
    left.plot(each, shear.ravel(), ".", ms=2, color=SERIES[0], alpha=0.4)
    left.plot(shape_factors, means["shear"], color=SERIES[0], label="relaxed")
    left.plot(shape_factors, means["affine"], color=SERIES[1], label="affine")
    # With E = (A - 1)² + (P - p0)² the stiffness K_P is 2.
    lattice = np.maximum(2 * HEXAGON * (HEXAGON - shape_factors) / 4, 0)
    left.plot(shape_factors, lattice, "--", color=INK, lw=0.8, label="hexagons")
    left.set(ylabel="shear modulus", ylim=(0, None))
    left.legend()
    middle.plot(shape_factors, means["bulk"], color=SERIES[2], label="bulk modulus")
    middle.plot(shape_factors, means["tension"], color=SERIES[3], label="tension")
    middle.set(ylabel="energy per area", ylim=(0, None))
    middle.legend()
    right.plot(shape_factors, solid, "o-", ms=3, color=SERIES[0])
    right.set(ylabel="share of solid tissues", ylim=(-0.03, 1.03))
    for ax in (left, middle, right):
        ax.axvline(FLUID, color=INK, lw=0.7, ls=":")
        ax.set_xlabel("target shape factor $p_0$")
    return figure
