r"""Cells tune one of their own properties to lower the energy, while the tissue relaxes.

Each cell has a factor on its perimeter stiffness, its target perimeter or its target area. The factors
have a mean of 1 and a given spread, and are tuned until the relaxed tissue has as little energy as can be:
a second optimisation about the first (Arzash, Tah, Liu & Manning 2023, arXiv:2312.11683). A tissue is rigid
where cells cannot have the perimeters that they want, which is a matter of shapes alone: so other
stiffnesses should leave the transition where it is, and other perimeters or areas move it.
"""

from __future__ import annotations

import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from vertax import (
    AbstractCost,
    AbstractEnergy,
    AbstractLocalEnergy,
    ImplicitDifferentiation,
    Tissue,
)
from vertax.fitting import InverseProblem, member
from vertax.inference import fit_onset
from vertax.runs import (
    ConfigError,
    ExperimentConfig,
    Fitting,
    Relaxation,
    RunFolder,
    TissueSection,
    fit_side_by_side,
    replicate_keys,
)

from . import figures

Tuned = Literal["stiffness", "perimeter", "area"]


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    tuned: list[Tuned] = Field(default=["stiffness", "perimeter", "area"], min_length=1)
    """What cells tune."""
    spreads: list[float] = Field(default=[0.5, 0.03, 0.15], min_length=1)
    """Standard deviation of the logarithm of the factors, for each of them."""
    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.5 + 0.05 * k, 2) for k in range(10)], min_length=3
    )
    """Mean target shape factors."""
    replicates: int = Field(default=6, ge=2)
    """Independent tissues for each of them."""
    tissue: TissueSection = TissueSection(n_cells=36)
    """The tissues."""
    fit: Fitting = Fitting(learning_rate=0.1, epochs=60)
    """How the factors are tuned."""
    relaxation: Relaxation = Relaxation(max_steps=500, contacts=False)
    """How the tissues are relaxed."""


class TunedCells(AbstractLocalEnergy):
    r"""$\tfrac12 \sum_c (A_c - A^0_c)^2 + K_c (P_c - P^0_c)^2$ with a factor for each cell.

    It stands before one of $K$, $P^0$ and $A^0$. Factors are $e^{s z_c}$ over their mean, where the numbers
    $z$ are shifted and scaled to a mean of 0 and a variance of 1: whatever becomes of them, they stay as
    different as they are.
    """

    z: Float[Array, " cells"]
    shape_factor: Float[Array, ""]
    spread: Float[Array, ""]
    tuned: Tuned = eqx.field(static=True)

    @property
    def factors(self) -> Float[Array, " cells"]:
        """The factor of each cell; their mean is 1."""
        off = self.z - jnp.mean(self.z)
        raised = jnp.exp(self.spread * off / jnp.sqrt(jnp.mean(off**2)))
        return raised / jnp.mean(raised)

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        of = {name: self.factors if name == self.tuned else 1.0 for name in TUNED}
        too_long = tissue.perimeters - self.shape_factor * of["perimeter"]
        too_large = tissue.areas - of["area"]
        return 0.5 * too_large**2 + 0.5 * of["stiffness"] * too_long**2


TUNED: tuple[Tuned, ...] = ("stiffness", "perimeter", "area")


class EnergyPerCell(AbstractCost):
    """The energy that a relaxed tissue has left, per cell."""

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Energy over the number of cells."""
        return energy(tissue) / tissue.n_cells


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: for each tuned property the shape factor at which the energy would vanish,
    with factors as drawn and tuned, and the change of it with its standard error by a bootstrap.

    **Raises:**

    - `ConfigError` unless there is one spread for each tuned property.
    - `FitError` if a fit cannot go on.
    """
    began = time.perf_counter()
    if len(config.spreads) != len(config.tuned):
        raise ConfigError(
            f"spreads must have one number for each of tuned, but there are {len(config.spreads)} and "
            f"{len(config.tuned)}."
        )
    metrics: dict[str, Any] = {}
    energies: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    columns: dict[str, Any] = {"p0": config.shape_factors}
    for tuned, spread in zip(config.tuned, config.spreads, strict=True):
        outcome = fit_side_by_side(
            folder, tuned, _problems(config, tuned, spread), config.fit, progress=progress
        )
        shape = (len(config.shape_factors), config.replicates)
        drawn = np.asarray(outcome.history.cost)[0].reshape(shape)
        energies[tuned] = drawn, np.asarray(outcome.cost).reshape(shape)
        for name, values in zip(("drawn", "tuned"), energies[tuned], strict=True):
            columns[f"{tuned}_{name}"] = values.mean(axis=1)
        metrics[tuned] = _onsets(config, *energies[tuned])
        # The last tissue, which is at the largest shape factor, says nothing: the first does.
        folder.save_tissue(tuned, member(outcome.tissue, 0))
    folder.save_table("energies", columns)
    shape_factors = np.asarray(config.shape_factors)
    onsets = {name: (found["drawn"], found["tuned"]) for name, found in metrics.items()}
    folder.save_figure("transition", figures.transition(shape_factors, energies, onsets))
    return metrics | {"seconds": time.perf_counter() - began}


def _problems(config: Config, tuned: Tuned, spread: float) -> list[InverseProblem]:
    """One problem a shape factor and tissue; all begin with the same tissues and factors."""
    keys = [jax.random.split(key) for key in replicate_keys(config.seed, config.replicates)]
    first = config.tissue.draw(jnp.stack([pair[0] for pair in keys]))
    problems = []
    for p0 in config.shape_factors:
        for k, (_, key) in enumerate(keys):
            z = jax.random.normal(key, (config.tissue.n_cells,))
            energy = TunedCells(z, jnp.asarray(p0), jnp.asarray(spread), tuned)
            trainable = eqx.tree_at(lambda e: e.z, jax.tree.map(lambda _: False, energy), True)
            problems.append(
                InverseProblem(
                    member(first, k),
                    energy,
                    EnergyPerCell(),
                    trainable=trainable,
                    # The energy is stationary where the tissue rests, so nothing is left for the adjoint but
                    # rounding, which it cannot solve for.
                    adjoint=ImplicitDifferentiation(throw=False),
                    response=config.relaxation.build(),
                )
            )
    return problems


def _onsets(config: Config, drawn: np.ndarray, tuned: np.ndarray) -> dict[str, Any]:
    """Where the energy would vanish before and after, and how far that has moved."""

    def at(chosen: np.ndarray) -> list[float]:
        found = [fit_onset(np.asarray(config.shape_factors), e[:, chosen]) for e in (drawn, tuned)]
        return [np.nan if onset is None else onset.centre for onset in found]

    every = np.arange(config.replicates)
    before, after = at(every)
    rng = np.random.default_rng(config.seed)
    samples = [at(rng.choice(every, every.size)) for _ in range(200)]
    shifts = np.array([b - a for a, b in samples])
    return {
        "drawn": before,
        "tuned": after,
        "shift": after - before,
        "shift_error": float(np.nanstd(shifts)),
        "energy_share_left": float(np.sum(tuned) / np.sum(drawn)),
    }
