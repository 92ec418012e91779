"""Polygon classes of a proliferating tissue.

A free cluster of straight edges grows from a few cells: the target area of each cell grows at a constant
rate, a cell divides when it comes to a size drawn for it, by an edge through its centroid across its long
axis (or a random one), and between events the tissue comes to rest, through T1 transitions. Counted are the
neighbours of the cells that do not touch the outline, as in epithelia, of which about 45 % are hexagons, 25 %
pentagons and 20 % heptagons (Gibson et al. 2006, doi:10.1038/nature05014). Beside them stands what that paper
derives from divisions alone, without any mechanics.
"""

from __future__ import annotations

import time
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import Field

from vertax import Tissue, animate
from vertax.energies import AbstractEnergy, AreaElasticity, PerimeterElasticity
from vertax.growth import Cells, GrowAndDivide, Grown, grow
from vertax.initialise import free_voronoi
from vertax.runs import ExperimentConfig, Relaxation, RunFolder
from vertax.transitions import T1, T2

from . import figures

SIDES = np.arange(3, 11)
"""The classes: polygons with so many sides."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    founders: int = Field(default=4, ge=4)
    """Cells at the beginning, with a mean area of 1."""
    room: int = Field(default=640, ge=8)
    """Most cells that there can be at a time."""
    duration: float = Field(default=52.0, gt=0)
    """How long the tissue grows."""
    frames: int = Field(default=104, ge=2)
    """Frames after the first one."""
    substeps: int = Field(default=2, ge=1)
    """Steps from one frame to the next."""
    divisions: int = Field(default=24, ge=1)
    """Most divisions in a step."""
    growth_rate: float = Field(default=0.1, gt=0)
    """How fast target areas grow."""
    division_area: float = Field(default=1.5, gt=0)
    """Mean target area at which a cell divides."""
    variation: float = Field(default=0.1, ge=0)
    """Standard deviation of that, over its mean."""
    death_rate: float = Field(default=0.0, ge=0)
    """How likely a cell begins to die in unit time."""
    orientation: Literal["long", "random"] = "long"
    """Along which axis cells divide."""
    perimeter_stiffness: float = Field(default=0.1, ge=0)
    """Stiffness of perimeters, where that of areas is 1."""
    shape_factor: float = Field(default=3.5, ge=0)
    """Target perimeter over the root of the target area."""
    relaxation: Relaxation = Relaxation(contacts=True)
    """How the tissue is relaxed in each step."""
    animation: bool = True
    """Whether to draw an animation."""


class _Energy(eqx.Module):
    """The energy of what cells know of themselves."""

    stiffness: Float[Array, ""]
    shape_factor: Float[Array, ""]

    def __call__(self, cells: Cells) -> AbstractEnergy:
        perimeter = self.shape_factor * jnp.sqrt(cells.target_area)
        return AreaElasticity(1.0, cells.target_area) + PerimeterElasticity(
            self.stiffness, perimeter
        )


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: has no effect: all of it is one compiled function.

    **Returns:** the metrics: how many cells there are, and the share of each polygon class.
    """
    began, worked = time.perf_counter(), time.process_time()
    first = free_voronoi(config.founders, key=config.seed, lloyd_steps=2)
    straight = Tissue(first.vertices, first.topology, first.boundary)
    cycle = GrowAndDivide(
        config.growth_rate,
        config.division_area,
        variation=config.variation,
        death_rate=config.death_rate,
        orientation=config.orientation,
    )
    energy = _Energy(jnp.asarray(config.perimeter_stiffness), jnp.asarray(config.shape_factor))
    response = config.relaxation.build()
    rule = T1(config.relaxation.t1_threshold) + T2()
    grown = grow(
        straight.with_capacity(config.room),
        energy,
        cycle,
        jnp.linspace(0, config.duration, config.frames + 1),
        key=config.seed,
        substeps=config.substeps,
        divisions=config.divisions,
        relaxation=eqx.tree_at(lambda r: r.transitions, response, rule),
        throw=False,
    )
    seconds, work = time.perf_counter() - began, time.process_time() - worked
    if not grown.sound[-1]:
        folder.warn("Some step came to no end, or cells overlap: see the column `sound`.")
    if grown.full:
        folder.warn(f"There was no room for more than {config.room} cells: raise `room`.")
    frames = list(grown.trajectory)
    counts = np.stack([polygon_classes(frame) for frame in frames])
    folder.save_table(
        "classes",
        {"time": np.asarray(grown.times), "cells": np.asarray(grown.n_alive)}
        | {"inner_cells": counts.sum(axis=1), "sound": np.asarray(grown.sound)}
        | {f"sides_{n}": counts[:, k] for k, n in enumerate(SIDES)},
    )
    _save_lineage(folder, grown)
    folder.save_tissue("grown", grown.tissue)
    chain = division_chain()
    folder.save_figure("classes", figures.classes(SIDES, counts, np.asarray(grown.n_alive), chain))
    folder.save_figure("growth", figures.growth(frames, np.asarray(grown.times)))
    folder.save_figure("lineage", figures.lineage(grown.lineage, float(grown.times[-1])))
    if config.animation:
        captions = [f"{n} cells" for n in np.asarray(grown.n_alive)]
        sides = [figures.sides_of(frame) for frame in frames]
        (folder.path / "figures").mkdir(exist_ok=True)
        animate(
            grown.trajectory,
            folder.path / "figures" / "growth.gif",
            np.stack(sides),
            cmap="RdYlBu",
            vmin=3.5,
            vmax=8.5,
            label="sides",
            captions=captions,
            mark_t1=0,
            dpi=90,
        )
    last, inner = counts[-1], max(int(counts[-1].sum()), 1)
    share = lambda n: float(last[n - SIDES[0]] / inner)
    return {
        "cells": int(grown.n_alive[-1]),
        "inner_cells": int(counts[-1].sum()),
        "pentagons": share(5),
        "hexagons": share(6),
        "heptagons": share(7),
        "classes": {int(n): share(n) for n in SIDES},
        "classes_of_divisions_alone": {int(n): float(x) for n, x in zip(SIDES, chain, strict=True)},
        "mean_sides": float(SIDES @ last / inner),
        "died": int(np.sum(np.asarray(grown.lineage.fate) == 2)),
        "sound": bool(grown.sound[-1]),
        "full": bool(grown.full),
        "growth_seconds": seconds,
        "growth_cpu_seconds": work,
        "seconds": time.perf_counter() - began,
    }


def polygon_classes(tissue: Tissue) -> Int[np.ndarray, " classes"]:
    """How many cells that do not touch the outline have 3, 4, … sides.

    **Arguments:**

    - `tissue`: a free tissue.

    **Returns:** a number for each of `SIDES`.
    """
    m = tissue.topology
    cell, twin = np.asarray(m.cell), np.asarray(m.twin)
    inner = np.array(tissue.alive)
    at_outline = cell[cell[twin] == m.n_cells]
    inner[at_outline[at_outline < m.n_cells]] = False
    sides = np.asarray(tissue.neighbour_counts)[inner]
    return np.array([np.sum(sides == n) for n in SIDES])


def division_chain() -> Float[np.ndarray, " classes"]:
    """Polygon classes that come of divisions alone (Gibson et al. 2006, doi:10.1038/nature05014).

    No cell has less than four sides. A mother of $i$ sides shares her corners out at random, so that a
    daughter has $j$ sides with the probability of $j - 4$ heads in $i - 4$ throws of a coin; and in each
    generation each cell gains one side by divisions of its neighbours. The shares are those that do not
    change.

    **Returns:** the share of each of `SIDES`.
    """
    n = 60
    heads = np.zeros((n, n))
    heads[0, 0] = 1
    for i in range(1, n):
        heads[i] = 0.5 * (heads[i - 1] + np.append(0, heads[i - 1, :-1]))
    shares = np.full(n, 1 / n)
    for _ in range(200):
        shares = np.append(0, (shares @ heads)[:-1])  # from four sides on
        shares /= shares.sum()
    return np.append(0, shares)[: len(SIDES)]


def _save_lineage(folder: RunFolder, grown: Grown) -> None:
    lineage = grown.lineage
    count = min(int(lineage.count), lineage.mother.shape[0])
    columns = {name: getattr(lineage, name) for name in ("mother", "begun", "ended", "fate")}
    kept = {name: np.asarray(values)[:count] for name, values in columns.items()}
    folder.save_table("lineage", {"cell": np.arange(count)} | kept)
