"""From solid to fluid: the fraction of tissues that rest at zero energy, against the shape factor.

Many independent tissues with one target shape factor in all cells are relaxed. Below the transition
cells cannot have the perimeter they want, and the tissue is rigid; above it they can, and it is floppy
(paper, Figure 3g, left; D. Bi et al. 2015, doi:10.1038/nphys3471).

A quench from a random tissue is caught wherever the way down ends, which is above the ground state.
Driving brings it further: the shape factors of all cells are shaken at random for a moment, the tissue
relaxes again, and keeps the new state if that has less energy.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field

from vertax.energies import ShapeFactorEnergy
from vertax.inference import Transition, fit_onset, fit_transition
from vertax.mesh import Tissue
from vertax.relax import Relaxation as Response
from vertax.runs import (
    ExperimentConfig,
    Relaxation,
    RunFolder,
    Section,
    TissueSection,
    scan,
)

from . import figures


class Driving(Section):
    """Random driving, which takes quenched tissues further down."""

    cycles: int = Field(default=6, ge=0)
    """Times each tissue is shaken and relaxed again; one at zero energy is left alone."""
    deviation: float = Field(default=0.2, gt=0)
    """Standard deviation of the shape factors while it is shaken."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.6 + 0.02 * k, 2) for k in range(21)], min_length=2
    )
    """Target shape factors of all cells."""
    replicates: int = Field(default=100, ge=2)
    """Independent tissues for each of them."""
    zero_energy: float = Field(default=1e-8, gt=0)
    """Energy per cell below which a tissue counts as having none."""
    tissue: TissueSection = TissueSection(n_cells=100)
    """The tissues."""
    driving: Driving = Driving()
    """Driving after the quench."""
    modes: int = Field(default=10, ge=0)
    """Tissues of each shape factor whose zero modes are counted (dense Hessian); 0 leaves it out."""
    at_once: int = Field(default=1, ge=1)
    """Tissues that are relaxed as one batch: 1 is best on CPUs, all of them on a GPU."""
    resamples: int = Field(default=500, ge=10)
    """Bootstrap samples of the interval of the transition."""
    relaxation: Relaxation = Relaxation(max_steps=500)
    """How the tissues are relaxed."""


class _Outcome(NamedTuple):
    """Of all tissues with one shape factor; the first axis is that of the tissues."""

    energy: Float[Array, "tissues cycles"]
    converged: Bool[Array, " tissues"]
    num_t1: Int[Array, " tissues"]
    tissue: Tissue


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: the shape factor at which half of the tissues have no energy, after the
    quench and after driving, with the 95 % interval of a bootstrap over tissues, and the width of the
    transition; and, likewise, the onset: where the energy of rigid tissues would vanish.
    """
    began = time.perf_counter()
    response = config.relaxation.build()

    def compute(value: float) -> dict[str, np.ndarray]:
        index = config.shape_factors.index(value)
        key = jax.random.fold_in(jax.random.key(config.seed), index)
        keys = jax.random.split(key, config.replicates + 1)
        first, p0 = config.tissue.draw(keys[1:]), jnp.asarray(value)
        outcome = jax.block_until_ready(
            _relax(first, p0, keys[0], response, config.driving, config.at_once)
        )
        shapes = np.asarray(jax.vmap(lambda t: t.shape_factors)(outcome.tissue)).mean(axis=1)
        some = jax.tree.map(lambda x: x[: config.modes], outcome.tissue)
        modes = np.asarray(_zero_modes(some, p0), float) if config.modes else np.zeros(0)
        outcomes = {name: np.asarray(getattr(outcome, name)) for name in _Outcome._fields[:-1]}
        return outcomes | {"shapes": shapes, "modes": modes}

    found = scan("p0", config.shape_factors, compute, folder, progress=progress)
    return _report(
        config,
        folder,
        found["energy"] / config.tissue.n_cells,
        found["converged"],
        found["shapes"],
        found["modes"],
        {
            "seconds": time.perf_counter() - began,
            "num_t1": int(found["num_t1"].sum()),
        },
    )


@eqx.filter_jit
def _relax(
    first: Tissue,
    p0: Float[Array, ""],
    key: PRNGKeyArray,
    response: Response,
    driving: Driving,
    at_once: int,
) -> _Outcome:
    """Quench and drive all tissues; energies after the quench and after each cycle."""
    energy = ShapeFactorEnergy(p0)

    def relax(tissue: Tissue, energy: ShapeFactorEnergy) -> Any:
        return response(tissue, energy, throw=False)

    def cycle(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, Array]:
        def shake() -> tuple:
            tissue, value, _, num_t1 = carry
            noise = jax.random.normal(key, (tissue.n_cells,))
            shaken = relax(tissue, ShapeFactorEnergy(p0 + driving.deviation * noise))
            found = relax(shaken.tissue, energy)
            better = found.energy < value
            new = (found.tissue, found.energy, found.converged, num_t1)
            kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, carry)
            return (*kept[:3], num_t1 + shaken.num_t1 + found.num_t1)

        carry = jax.lax.cond(carry[1] < 1e-12, lambda: carry, shake)
        return carry, carry[1]

    def one(arguments: tuple[Tissue, PRNGKeyArray]) -> _Outcome:
        tissue, key = arguments
        quenched = relax(tissue, energy)
        start = (quenched.tissue, quenched.energy, quenched.converged, quenched.num_t1)
        keys = jax.random.split(key, driving.cycles)
        (tissue, _, converged, num_t1), values = jax.lax.scan(cycle, start, keys)
        return _Outcome(jnp.append(quenched.energy, values), converged, num_t1, tissue)

    keys = jax.random.split(key, len(first.vertices))
    return jax.lax.map(one, (first, keys), batch_size=None if at_once == 1 else at_once)


@eqx.filter_jit
def _zero_modes(tissues: Tissue, p0: Float[Array, ""]) -> Int[Array, " tissues"]:
    """How many motions of the vertices, beside those of the whole, cost no energy."""
    energy = ShapeFactorEnergy(p0)

    def one(tissue: Tissue) -> Int[Array, ""]:
        shape = tissue.vertices.shape
        at = lambda y: energy(tissue.with_vertices(y.reshape(shape)))
        stiffness = jnp.linalg.eigvalsh(jax.hessian(at)(tissue.vertices.ravel()))
        return jnp.sum(stiffness < 1e-6 * stiffness[-1]) - 2

    return jax.lax.map(one, tissues)


def _interval(
    shape_factors: np.ndarray, zero: Bool[np.ndarray, "values tissues"], config: Config
) -> tuple[Transition, tuple[float, float]]:
    trials = zero.shape[1]
    best = fit_transition(shape_factors, zero.sum(axis=1).astype(float), trials)
    if np.isnan(best.centre):
        return best, (np.nan, np.nan)
    rng = np.random.default_rng(config.seed)
    centres = []
    for _ in range(config.resamples):
        drawn = rng.binomial(trials, zero.mean(axis=1)).astype(float)
        centres.append(fit_transition(shape_factors, drawn, trials).centre)
    low, high = np.nanpercentile(centres, [2.5, 97.5])
    return best, (float(low), float(high))


def _onset(
    shape_factors: np.ndarray, energies: Float[np.ndarray, "values tissues"], config: Config
) -> tuple[Transition | None, dict[str, float]]:
    best = fit_onset(shape_factors, energies)
    if best is None:
        return None, {}
    rng = np.random.default_rng(config.seed)
    trials = energies.shape[1]
    draws = [
        fit_onset(shape_factors, energies[:, rng.integers(trials, size=trials)])
        for _ in range(config.resamples)
    ]
    low, high = np.percentile([d.centre for d in draws if d is not None], [2.5, 97.5])
    return best, {
        "onset": best.centre,
        "onset_low": float(low),
        "onset_high": float(high),
    }


def _report(
    config: Config,
    folder: RunFolder,
    energies: Float[np.ndarray, "values tissues cycles"],
    converged: Bool[np.ndarray, "values tissues"],
    shapes: Float[np.ndarray, "values tissues"],
    modes: Float[np.ndarray, "values some"],
    facts: dict[str, Any],
) -> dict[str, Any]:
    shape_factors = np.asarray(config.shape_factors)
    zero = energies < config.zero_energy
    curves = []
    metrics: dict[str, Any] = {}
    for cycle in sorted(
        {0, *(c for c in (1, 3) if c < config.driving.cycles), config.driving.cycles}
    ):
        best, (low, high) = _interval(shape_factors, zero[..., cycle], config)
        name = "quench" if cycle == 0 else f"{cycle} cycles" if cycle > 1 else "1 cycle"
        onset, found = _onset(shape_factors, energies[..., cycle], config)
        curves.append(
            figures.Curve(
                name,
                zero[..., cycle].mean(axis=1),
                best.centre,
                best.width,
                np.sqrt(np.maximum(energies[..., cycle], 0)).mean(axis=1),
                None if onset is None else (onset.centre, onset.width),
            )
        )
        metrics[name] = found | {
            "p0_star": best.centre,
            "p0_star_low": low,
            "p0_star_high": high,
            "width": best.width,
        }
    columns: dict[str, Any] = {"p0": shape_factors}
    columns |= {f"zero_after_{c}": zero[..., c].mean(axis=1) for c in range(zero.shape[-1])}
    columns |= {
        "energy_quench": np.median(energies[..., 0], axis=1),
        "energy_driven": np.median(energies[..., -1], axis=1),
        "shape_factor": shapes.mean(axis=1),
        "converged": converged.mean(axis=1),
    }
    if config.modes:
        columns["zero_modes"] = modes.mean(axis=1)
    folder.save_table("transition", columns)
    folder.save_array("energies", energies)
    folder.save_figure("transition", figures.transition(shape_factors, curves, shapes, modes))
    totals = {
        "converged_fraction": converged.mean(),
        "least_converged": converged.mean(axis=1).min(),
    }
    return metrics | {"run": totals | facts}
