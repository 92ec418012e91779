r"""Diffusion of self-propelled cells in a confluent tissue.

Cells push in directions of their own, which diffuse, and change neighbours. Measured is the mean squared
displacement of cells, without that of the whole, and from late times the diffusion coefficient
$D_\mathrm{eff} = \lim \langle \Delta r^2 \rangle / 4 t$ in units of that of a free cell, $v_0^2 / 2 D_r$.
It vanishes in a solid, and the target shape factor from which on cells diffuse falls as they push harder
(Bi et al. 2016, doi:10.1103/PhysRevX.6.021011, for Voronoi tissues, where a value of $10^{-3}$ divides
glass and fluid: to be compared in kind, not in number).
"""

from __future__ import annotations

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from vertax.activities import SelfPropulsion
from vertax.dissipations import SubstrateFriction
from vertax.dynamics import Evolution
from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.mesh import Tissue
from vertax.runs import (
    ExperimentConfig,
    Relaxation,
    RunFolder,
    TissueSection,
    replicate_keys,
    side_by_side,
)

from . import figures


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(default=[3.3, 3.5, 3.65, 3.8, 3.95], min_length=2)
    """Target shape factors of all cells."""
    speeds: list[float] = Field(default=[0.2, 0.6, 1.2], min_length=1)
    """Speeds $v_0$ at which a cell would go if nothing but friction held it back: a cell has two vertices to
    itself, so it pushes with the force $2 \\zeta v_0$."""
    rotational_diffusion: float = Field(default=1.0, gt=0)
    """$D_r$, one over the time for which a cell keeps its direction."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    duration: float = Field(default=60.0, gt=0)
    """How long the tissue is watched; before that it moves for a quarter as long."""
    interval: float = Field(default=0.5, gt=0)
    """Time from one frame to the next."""
    substeps: int = Field(default=5, ge=1)
    """Steps from one frame to the next."""
    replicates: int = Field(default=1, ge=1)
    """Independent tissues for each pair of shape factor and speed."""
    threshold: float = Field(default=1e-3, gt=0)
    """Diffusion, relative to that of a free cell, from which on a tissue counts as fluid."""
    tissue: TissueSection = TissueSection(n_cells=36)
    """The tissues."""
    relaxation: Relaxation = Relaxation(tolerance=1e-6, max_steps=500)
    """How each step is found."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: diffusion relative to that of a free cell for each speed and shape factor,
    transitions per cell and time, the shape factor from which on each speed makes the tissue fluid, and the
    share of all frames before which each step came to an end: only these count.
    """
    began = time.perf_counter()
    pairs = [
        (speed, p0, replicate)
        for speed in config.speeds
        for p0 in config.shape_factors
        for replicate in range(config.replicates)
    ]

    def one(index: int) -> dict[str, np.ndarray]:
        speed, p0, replicate = pairs[index]
        name = f"v0 {speed:g} p0 {p0:g} tissue {replicate}"
        return folder.part(name, lambda: _move(config, speed, p0, replicate))

    results = side_by_side(one, len(pairs), folder, progress=progress, unit="run")
    shape = (len(config.speeds), len(config.shape_factors), config.replicates)
    found = {
        name: np.stack([result[name] for result in results]).reshape(
            *shape, *results[0][name].shape
        )
        for name in results[0]
    }
    lags = config.interval * np.arange(1, found["squared"].shape[-1] + 1)
    squared = np.nanmean(found["squared"], axis=2)
    free = np.asarray(config.speeds)[:, None] ** 2 / (2 * config.rotational_diffusion)
    diffusion = _diffusion(lags, squared) / free
    rate = np.nanmean(found["t1_rate"], axis=2) / config.tissue.n_cells
    onset = [_onset(config, values) for values in diffusion]
    folder.save_table(
        "diffusion",
        {
            "speed": np.repeat(config.speeds, len(config.shape_factors)),
            "p0": np.tile(config.shape_factors, len(config.speeds)),
            "diffusion": diffusion.ravel(),
            "t1_rate": rate.ravel(),
            "sound": found["sound"].mean(axis=2).ravel(),
        },
    )
    folder.save_array("squared_displacements", squared)
    figure = figures.diffusion(config, lags, squared, diffusion, rate)
    folder.save_figure("diffusion", figure)
    return {
        "diffusion": diffusion.tolist(),
        "t1_rate": rate.tolist(),
        "fluid_from": onset,
        "sound_fraction": float(found["sound"].mean()),
        "seconds": time.perf_counter() - began,
    }


def _move(config: Config, speed: float, p0: float, replicate: int) -> dict[str, np.ndarray]:
    key = replicate_keys(config.seed, config.replicates)[replicate]
    first, noise = jax.random.split(key)
    tissue = periodic_voronoi(
        config.tissue.n_cells, key=first, lloyd_steps=config.tissue.lloyd_steps
    )
    n_frames = max(round(config.duration / config.interval), 4)
    warm = max(n_frames // 4, 1)
    times = config.interval * np.arange(warm + n_frames + 1)
    evolution = Evolution(
        SubstrateFriction(config.friction),
        times,
        activity=SelfPropulsion(2 * config.friction * speed, config.rotational_diffusion),
        key=noise,
        substeps=config.substeps,
        relaxation=config.relaxation.build(),
    )
    movie = evolution(tissue, ShapeFactorEnergy(jnp.asarray(p0)), throw=False)
    # A step that came to no end spoils what comes after it.
    n_sound = int(np.sum(movie.sound))
    places = np.asarray(_places(movie.frames))[warm:n_sound]
    lasted = max(n_sound - 1 - warm, 0)
    transitions = float(movie.transitions[warm + 1 : n_sound].sum())
    return {
        "squared": _squared_displacements(places, n_frames // 2),
        "t1_rate": np.asarray(transitions / (lasted * config.interval) if lasted else np.nan),
        "sound": np.asarray(lasted / n_frames),
    }


@eqx.filter_jit
def _places(frames: Tissue) -> Float[Array, "times cells 2"]:
    """Where the cells are, across the borders of the box, less the motion of the whole."""
    centroids = eqx.filter_vmap(lambda frame: frame.centroids)(frames)
    boundary = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, frames.boundary)
    steps = boundary.shortest(jnp.diff(centroids, axis=0))
    steps = steps - steps.mean(axis=1, keepdims=True)
    return jnp.concatenate([jnp.zeros_like(centroids[:1]), jnp.cumsum(steps, axis=0)])


def _squared_displacements(
    places: Float[np.ndarray, "times cells 2"], most: int
) -> Float[np.ndarray, " lags"]:
    """The mean over cells and beginnings, for lags up to so many frames; NaN of those that are not known."""
    squared = np.full(most, np.nan)
    for k in range(1, min(len(places), most + 1)):
        squared[k - 1] = np.mean(np.sum((places[k:] - places[:-k]) ** 2, axis=-1))
    return squared


def _diffusion(
    lags: Float[np.ndarray, " lags"], squared: Float[np.ndarray, "speeds values lags"]
) -> Float[np.ndarray, "speeds values"]:
    """A quarter of the slope of mean squared displacements over the later half of the lags."""
    late = np.where(lags > lags[-1] / 2, squared, np.nan)
    known = np.isfinite(late)
    count = np.maximum(known.sum(axis=-1, keepdims=True), 1)
    x = np.where(known, lags - np.sum(known * lags, axis=-1, keepdims=True) / count, 0)
    size = np.sum(x**2, axis=-1)
    slope = np.sum(x * np.where(known, late, 0), axis=-1) / np.where(size > 0, size, np.nan)
    return slope / 4


def _onset(config: Config, diffusion: Float[np.ndarray, " values"]) -> float | None:
    """The first shape factor from which on all greater ones diffuse; None if none does."""
    fluid = diffusion > config.threshold
    solid = np.flatnonzero(~fluid)
    index = 0 if solid.size == 0 else solid[-1] + 1
    return None if index == len(fluid) else config.shape_factors[index]
