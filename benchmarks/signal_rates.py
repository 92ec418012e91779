"""Rates of a reaction recovered from a movie of shapes and signals, with their intervals.

    python benchmarks/signal_rates.py [--seeds 5]

Each seed makes another tissue of 9 cells, simulates 8 frames, and adds normal noise of 0.02 to areas and
concentrations. Gauss–Newton steps fit the logarithms of the rate, the diffusion and the coupling; standard
errors are those of the Fisher information JᵀJ, with the Jacobian J of the residuals. A row for each seed: the
estimates over the true values with their 95 % intervals; and at the end the number of intervals that contain
the true value.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _arguments import count

import vertax as vx

jax.config.update("jax_enable_x64", True)

NAMES = ("rate", "diffusion", "coupling")
TRUE = np.array([0.8, 0.4, 0.3])
TIMES = np.linspace(0, 1.6, 9)
NOISE = 0.02


class Turnover(vx.signals.AbstractReaction):
    """Relaxation to the square of the area."""

    rate: jax.Array

    def __call__(self, concentrations: jax.Array, cells: vx.signals.CellGeometry, time: jax.Array):
        """The rate of change."""
        return self.rate * (cells.areas**2 - concentrations)


class Contraction(eqx.Module):
    """A target area that decreases with the concentration."""

    strength: jax.Array

    def __call__(self, concentrations: jax.Array, tissue: vx.Tissue) -> vx.AbstractEnergy:
        """The energy at these concentrations."""
        return vx.energies.AreaElasticity(3.0, 1 - self.strength * (concentrations[0] - 1))


def movie(logarithms: jax.Array, tissue: vx.Tissue, start: jax.Array) -> jax.Array:
    """Concentrations and areas of the later frames."""
    rate, diffusion, strength = jnp.exp(logarithms)
    signals = vx.signals.Signals(
        Turnover(rate), diffusion[None], initial=start, couple=Contraction(strength)
    )
    evolved = vx.evolve(
        tissue,
        vx.energies.PerimeterElasticity(1.0, 3.6),
        vx.dissipations.SubstrateFriction(1.0),
        TIMES,
        activity=signals,
        relaxation=vx.Relaxation(transitions=None, contact_range=None),
        throw=False,
    )
    areas = jax.vmap(lambda tissue: tissue.areas)(evolved.frames)
    return jnp.stack([evolved.signals[1:, 0], areas[1:]])


def recover() -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """A function of the seed that returns the logarithms over the true values and their standard errors."""

    @eqx.filter_jit
    def linearised(logarithms: jax.Array, data: tuple) -> tuple[jax.Array, jax.Array]:
        *setting, observed = data
        residuals = lambda x: ((movie(x, *setting) - observed) / NOISE).ravel()
        values, pullback = jax.vjp(residuals, logarithms)
        # Diffrax differentiates in reverse, so the Jacobian is computed by rows.
        return values, jax.vmap(pullback)(jnp.eye(len(values)))[0]

    predict = eqx.filter_jit(movie)

    def recovered(seed: int) -> tuple[np.ndarray, np.ndarray]:
        tissue = vx.initialise.periodic_voronoi(9, key=seed, lloyd_steps=2)
        tissue = vx.equilibrate(tissue, vx.energies.ShapeFactorEnergy(3.6)).tissue
        rng = np.random.default_rng(seed)
        start = jnp.asarray(1 + 0.5 * rng.uniform(-1, 1, (1, 9)))
        exact = predict(jnp.log(TRUE), tissue, start)
        observed = exact + NOISE * rng.normal(size=exact.shape)
        logarithms, setting = np.full(3, -0.5), (tissue, start, observed)
        jacobian = np.eye(3)
        for _ in range(20):
            residuals, jacobian = map(np.asarray, linearised(jnp.asarray(logarithms), setting))
            step = np.linalg.lstsq(jacobian, -residuals)[0]
            logarithms = logarithms + step * min(1, 1 / np.abs(step).max())
            if np.abs(step).max() < 1e-6:
                break
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        return logarithms - np.log(TRUE), np.sqrt(np.diag(covariance))

    return recovered


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=count, default=5)
    options = parser.parse_args()
    recovered, errors, deviations = recover(), [], []
    print("seed | " + " | ".join(f"{name:>20}" for name in NAMES))
    for seed in range(options.seeds):
        began = time.perf_counter()
        error, deviation = recovered(seed)
        errors.append(error)
        deviations.append(deviation)
        columns = zip(error, deviation, strict=True)
        texts = [
            f"{np.exp(e):.3f} × {np.exp(-1.96 * d):.3f}…{np.exp(1.96 * d):.3f}" for e, d in columns
        ]
        print(f"{seed:4} | {' | '.join(texts)} | {time.perf_counter() - began:.0f} s", flush=True)
    inside = np.abs(errors) < 1.96 * np.array(deviations)
    print(f"{inside.sum()} of {inside.size} intervals of 95 % contain the true value")


if __name__ == "__main__":
    main()
