"""Moduli of disordered tissues against the target shape factor.

Independent random tissues with one target shape factor in all cells are relaxed in a square box.
Measured are the relaxed and the affine shear modulus and the bulk modulus, and the tension that the
tissue has. The shear modulus vanishes where the tissue becomes fluid (Bi et al. 2015,
doi:10.1038/nphys3471; Merkel & Manning 2018, doi:10.1088/1367-2630/aaaa13); the affine one does not,
since what vanishes is the resistance to motions of the vertices.

Fluid tissues are then sheared until they become solid, for a prediction without a free parameter
(Merkel et al. 2019, doi:10.1073/pnas.1815436116): beyond the critical strain the excess of the shear
modulus is three times the shear stress over that strain.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from pydantic import Field

from vertax.energies import ShapeFactorEnergy
from vertax.mechanics import bulk_modulus, shear_modulus, stress
from vertax.mesh import Tissue
from vertax.relax import Relaxation as Response
from vertax.runs import ExperimentConfig, Relaxation, RunFolder, TissueSection, scan

from . import figures
from .stiffening import Stiffening, stiffen


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(
        default_factory=lambda: [round(3.3 + 0.05 * k, 2) for k in range(15)], min_length=2
    )
    """Target shape factors of all cells."""
    replicates: int = Field(default=20, ge=2)
    """Independent tissues for each of them."""
    solid: float = Field(default=1e-3, gt=0)
    """Shear modulus, relative to the affine one, from which on a tissue counts as solid."""
    tissue: TissueSection = TissueSection(n_cells=64)
    """The tissues."""
    relaxation: Relaxation = Relaxation(max_steps=1000, contacts=False)
    """How the tissues are relaxed. Contacts would add forces that the moduli do not know."""
    stiffening: Stiffening = Stiffening()
    """Fluid tissues that a strain makes solid."""


class _Outcome(NamedTuple):
    """Of all tissues with one shape factor."""

    shear: Float[Array, " tissues"]
    affine: Float[Array, " tissues"]
    bulk: Float[Array, " tissues"]
    tension: Float[Array, " tissues"]
    converged: Bool[Array, " tissues"]


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: mean moduli at each shape factor, the share of solid tissues, and the shape
    factor at which half of them are; and of fluid tissues that are sheared the critical strains, and the
    factor between excess modulus and stress.
    """
    began = time.perf_counter()
    response = config.relaxation.build()
    shape_factors = np.asarray(config.shape_factors)

    def compute(p0: float) -> dict[str, np.ndarray]:
        # The same first tissues at each shape factor.
        first = config.tissue.draw(jax.random.split(jax.random.key(config.seed), config.replicates))
        outcome = _measure(first, jnp.asarray(p0), response)
        return {name: np.asarray(value) for name, value in outcome._asdict().items()}

    found = scan("p0", config.shape_factors, compute, folder, progress=progress)
    # Of what did not come to rest no modulus is known.
    known = found["converged"] & np.isfinite(found["shear"])
    means = {
        name: _mean(np.where(known, found[name], np.nan))
        for name in ("shear", "affine", "bulk", "tension")
    }
    solid = _mean(np.where(known, found["shear"] > config.solid * found["affine"], np.nan))
    columns: dict[str, Any] = {"p0": shape_factors} | means | {"solid": solid}
    folder.save_table("moduli", columns | {"known": known.mean(axis=1)})
    folder.save_array("shear", np.where(known, found["shear"], np.nan))
    shear = np.where(known, found["shear"], np.nan)
    folder.save_figure("moduli", figures.moduli(shape_factors, shear, means, solid))
    stiffened = stiffen(config.stiffening, config.seed, response, folder, progress=progress)
    return stiffened | {
        "shear": means["shear"].tolist(),
        "affine": means["affine"].tolist(),
        "bulk": means["bulk"].tolist(),
        "solid": solid.tolist(),
        "half_solid_at": _crossing(shape_factors, solid),
        "known_fraction": float(known.mean()),
        "seconds": time.perf_counter() - began,
    }


@eqx.filter_jit
def _measure(first: Tissue, p0: Float[Array, ""], response: Response) -> _Outcome:
    energy = ShapeFactorEnergy(p0)

    def one(start: Tissue) -> _Outcome:
        found = response(start, energy, throw=False)
        tissue = found.tissue
        return _Outcome(
            shear_modulus(tissue, energy, throw=False),
            shear_modulus(tissue, energy, affine=True, throw=False),
            bulk_modulus(tissue, energy, throw=False),
            0.5 * jnp.trace(stress(tissue, energy)),
            found.converged,
        )

    return jax.lax.map(one, first)


def _mean(values: Float[np.ndarray, "values tissues"]) -> Float[np.ndarray, " values"]:
    counts = np.isfinite(values).sum(axis=1)
    return np.where(counts > 0, np.nansum(values, axis=1) / np.maximum(counts, 1), np.nan)


def _crossing(
    shape_factors: Float[np.ndarray, " values"], solid: Float[np.ndarray, " values"]
) -> float | None:
    """Where the share of solid tissues falls through a half, between two shape factors."""
    below = np.flatnonzero((solid[:-1] >= 0.5) & (solid[1:] < 0.5))
    if below.size == 0:
        return None
    i = below[0]
    part = (solid[i] - 0.5) / (solid[i] - solid[i + 1])
    return float(shape_factors[i] + part * (shape_factors[i + 1] - shape_factors[i]))
