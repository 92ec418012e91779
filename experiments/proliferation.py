"""Polygon classes of a tissue that grows from a few cells to hundreds.

The target area of each cell of a free cluster grows at a constant rate. A cell divides when it reaches a size
drawn for it, by an edge through its centroid across its long axis (or a random one), and between events the
tissue relaxes with T1 transitions. The neighbours of inner cells are counted. About 45 % of the cells of
epithelia are hexagons, 25 % pentagons and 20 % heptagons (Gibson et al. 2006, doi:10.1038/nature05014), and
that paper derives fractions from divisions alone, without mechanics.
"""

import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from matplotlib.collections import LineCollection
from matplotlib.ticker import NullFormatter
from pydantic import Field
from scipy.optimize import minimize

import vertax as vx
from experiments._shared import comparison, processor_time
from vertax import energies, plotting, runs
from vertax.plotting import INK, SERIES

SIDES = np.arange(3, 11)
EPITHELIA = {5: 0.25, 6: 0.45, 7: 0.20}
"""Approximate fractions in many epithelia (Gibson et al. 2006)."""
COLOURS: dict[str, Any] = {"cmap": "RdYlBu", "vmin": 3.5, "vmax": 8.5, "label": "sides"}


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    founders: int = Field(default=4, ge=4)
    """Cells at the start, of mean area 1."""
    room: int = Field(default=640, ge=8)
    """Largest number of cells at a time."""
    duration: float = Field(default=52.0, gt=0)
    """Duration of growth."""
    frames: int = Field(default=104, ge=2)
    """Frames after the first one."""
    substeps: int = Field(default=2, ge=1)
    """Steps per frame."""
    divisions: int = Field(default=24, ge=1)
    """Largest number of divisions per step."""
    growth_rate: float = Field(default=0.1, gt=0)
    """Rate of growth of target areas."""
    division_area: float = Field(default=1.5, gt=0)
    """Mean target area at division."""
    variation: float = Field(default=0.1, ge=0)
    """Its standard deviation over its mean."""
    death_rate: float = Field(default=0.0, ge=0)
    """Probability per unit time that the death of a cell begins."""
    orientation: Literal["long", "random"] = "long"
    """Axis of division."""
    perimeter_stiffness: float = Field(default=0.1, ge=0)
    """Stiffness of perimeters; that of areas is 1."""
    shape_factor: float = Field(default=3.5, ge=0)
    """Target perimeter over the root of the target area."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(contacts=True)
    """Relaxation of each step."""
    animation: bool = True
    """Draw an animation."""
    monolayer: bool = False
    """Report the quantities of OpenVT's reference model, recover the growth rate, and time the steps."""


class Energy(eqx.Module):
    """The energy of a growing tissue as a function of its cells."""

    stiffness: Any
    shape_factor: Any

    def __call__(self, cells: vx.growth.Cells) -> vx.AbstractEnergy:
        perimeter = self.shape_factor * jnp.sqrt(cells.target_area)
        areas = energies.AreaElasticity(1.0, cells.target_area)
        return areas + energies.PerimeterElasticity(self.stiffness, perimeter)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The number of cells and the fraction of each polygon class; growth is one compiled function."""
    began, worked = time.perf_counter(), time.process_time()
    first = vx.initialise.free_voronoi(config.founders, key=config.seed, lloyd_steps=2)
    straight = vx.Tissue(first.vertices, first.topology, first.boundary)
    settings: Any = {name: getattr(config, name) for name in ("variation", "death_rate", "orientation")}
    cycle = vx.growth.GrowAndDivide(config.growth_rate, config.division_area, **settings)
    energy = Energy(jnp.asarray(config.perimeter_stiffness), jnp.asarray(config.shape_factor))
    transitions = vx.T1(config.relaxation.t1_threshold) + vx.T2()
    relaxation = eqx.tree_at(lambda r: r.transitions, config.relaxation.build(), transitions)
    options: Any = {name: getattr(config, name) for name in ("substeps", "divisions")}
    options |= {"key": config.seed, "relaxation": relaxation, "throw": False}
    times = jnp.linspace(0, config.duration, config.frames + 1)
    grow = lambda: vx.growth.grow(straight.with_capacity(config.room), energy, cycle, times, **options)
    grown = grow()
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - worked
    monolayer = {}
    if config.monolayer:
        _, again = processor_time(lambda: np.asarray(grow().n_alive))
        monolayer["seconds_per_step"] = again / config.frames / config.substeps
    full = bool(grown.result == vx.RESULTS.capacity_reached)
    if full:
        folder.warn(f"There was no room for more than {config.room} cells: raise `room`.")
    elif not grown.converged:
        folder.warn(f"A step failed, see the column `converged`: {vx.RESULTS[grown.result]}")
    frames, times, n_cells = list(grown.trajectory), np.asarray(grown.times), np.asarray(grown.n_alive)
    counts = np.stack([polygon_classes(frame) for frame in frames])
    table = {"time": times, "cells": n_cells, "inner_cells": counts.sum(axis=1)}
    converged = np.asarray(grown.results == vx.RESULTS.successful)
    table |= {"converged": converged} | {f"sides_{n}": counts[:, k] for k, n in enumerate(SIDES)}
    folder.save_table("classes", table)
    count = min(int(grown.lineage.count), grown.lineage.mother.shape[0])
    names = ("mother", "begun", "ended", "fate")
    lineage = {name: np.asarray(getattr(grown.lineage, name))[:count] for name in names}
    folder.save_table("lineage", {"cell": np.arange(count)} | lineage)
    folder.save_tissue("grown", grown.tissue)
    chain = division_chain()
    folder.save_figure("classes", plot_classes(counts, n_cells, chain))
    folder.save_figure("growth", plot_growth(frames, times))
    folder.save_figure("lineage", plot_lineage(lineage, float(times[-1])))
    if config.animation:
        (folder.path / "figures").mkdir(exist_ok=True)
        file, sides = folder.path / "figures" / "growth.gif", np.stack([sides_of(f) for f in frames])
        captions = [f"{n} cells" for n in n_cells]
        vx.animate(grown.trajectory, file, sides, captions=captions, mark_t1=0, dpi=90, **COLOURS)
    last, inner = counts[-1], max(int(counts[-1].sum()), 1)
    classes = {int(n): float(count / inner) for n, count in zip(SIDES, last, strict=True)}
    if config.monolayer:
        monolayer |= monolayer_of(config, folder, frames, times, n_cells, lineage)
    return monolayer | {
        "cells": int(n_cells[-1]),
        "inner_cells": int(last.sum()),
        "pentagons": classes[5],
        "hexagons": classes[6],
        "heptagons": classes[7],
        "classes": classes,
        "classes_of_divisions_alone": {int(n): float(x) for n, x in zip(SIDES, chain, strict=True)},
        "mean_sides": float(SIDES @ last / inner),
        "died": int(np.sum(np.asarray(grown.lineage.fate) == 2)),
        "converged": bool(grown.converged),
        "full": full,
        "growth_seconds": seconds,
        "growth_cpu_seconds": cpu_seconds,
        "seconds": time.perf_counter() - began,
    }


def monolayer_of(config: Config, folder: runs.RunFolder, *movie: Any) -> dict[str, Any]:
    """Doublings per cycle, radius and roughness of the outline, and the growth rate with its true value.

    A cycle is the time in which a cell grows from half of the division area to the division area. The unit of
    the radius is that of a disc with the division area.
    """
    frames, times, n_cells, lineage = movie
    cycles = times * config.growth_rate / (config.division_area / 2)
    lengths = [float(jnp.sum(jnp.where(f.topology.on_outline, f.edge_lengths, 0))) for f in frames]
    areas = np.array([float(jnp.sum(jnp.where(f.alive, f.areas, 0))) for f in frames])
    radius, roughness = np.sqrt(areas / config.division_area), lengths / (2 * np.sqrt(np.pi * areas))
    table = {"cycles": cycles, "cells": n_cells, "radius": radius, "roughness": roughness}
    folder.save_table("monolayer", table)
    folder.save_figure("monolayer", plot_monolayer(table))
    doublings = np.polyfit(cycles, np.log2(n_cells), 1)[0]
    fitted, error = recover_growth_rate(config, lineage, times[-1])
    return {
        "cycles": float(cycles[-1]),
        "doublings_per_cycle": float(doublings),
        "radius": float(radius[-1]),
        "roughness": float(roughness[-1]),
        "growth_rate": comparison(fitted, error, config.growth_rate),
    }


def recover_growth_rate(config: Config, lineage: dict[str, np.ndarray], end: float) -> tuple[float, float]:
    """The growth rate of greatest likelihood from the times of divisions, and its standard error.

    A cell divides at a normally distributed size, and daughters have half the size of their mother. The sizes
    of the founders at division are parameters too. On average a division is found half a step late.
    """
    half_step = config.duration / config.frames / config.substeps / 2
    mother, divided = lineage["mother"], lineage["fate"] == 1
    spans = np.where(divided, lineage["ended"] - half_step, end) - lineage["begun"]
    founders = np.flatnonzero((mother < 0) & divided)
    width = max(config.variation, 0.01) * config.division_area
    depth = np.zeros(len(mother), int)
    for cell in np.flatnonzero(mother >= 0):  # a mother has a lower index
        depth[cell] = depth[mother[cell]] + 1
    generations = [np.flatnonzero(depth == k) for k in range(1, depth.max() + 1)]

    def loss(parameters: Any) -> Any:
        rate, sizes = parameters[0], jnp.zeros(len(mother)).at[founders].set(parameters[1:])
        total = jnp.sum(norm.logpdf(parameters[1:], config.division_area, width))
        for cells in generations:
            size = (sizes[mother[cells]] + rate * half_step) / 2 + rate * spans[cells]
            density, survival = (f(size, config.division_area, width) for f in (norm.logpdf, norm.logsf))
            total += jnp.sum(jnp.where(divided[cells], jnp.log(rate) + density, survival))
            sizes = sizes.at[cells].set(size)
        return -total

    start = np.append(0.9 * config.growth_rate, np.full(len(founders), config.division_area))
    fit = minimize(jax.jit(loss), start, jac=jax.jit(jax.grad(loss)), method="BFGS")
    covariance = np.linalg.inv(jax.hessian(loss)(jnp.asarray(fit.x)))
    return float(fit.x[0]), float(np.sqrt(covariance[0, 0]))


def polygon_classes(tissue: vx.Tissue) -> np.ndarray:
    """The numbers of cells with 3, 4, … sides that do not touch the outline of a free tissue."""
    cell, twin = np.asarray(tissue.topology.cell), np.asarray(tissue.topology.twin)
    inner = np.array(tissue.alive)
    at_outline = cell[cell[twin] == tissue.topology.n_cells]
    inner[at_outline[at_outline < tissue.topology.n_cells]] = False
    sides = np.asarray(tissue.neighbour_counts)[inner]
    return np.array([np.sum(sides == n) for n in SIDES])


def division_chain() -> np.ndarray:
    """Fractions by divisions alone: the fixed point of a Markov chain (Gibson et al. 2006).

    A mother of i sides gives a daughter of j sides with the probability of j - 4 heads in i - 4 throws of a
    coin, and in each generation each cell gains one side by divisions of its neighbours.
    """
    n = 60
    heads = np.zeros((n, n))
    heads[0, 0] = 1
    for i in range(1, n):
        heads[i] = 0.5 * (heads[i - 1] + np.append(0, heads[i - 1, :-1]))
    fractions = np.full(n, 1 / n)
    for _ in range(200):
        fractions = np.append(0, (fractions @ heads)[:-1])  # from four sides on
        fractions /= fractions.sum()
    return np.append(0, fractions)[: len(SIDES)]


def sides_of(tissue: vx.Tissue) -> np.ndarray:
    """The number of sides of each cell; NaN for spare slots."""
    return np.where(np.asarray(tissue.alive), np.asarray(tissue.neighbour_counts), np.nan)


@plotting.house_style()
def plot_classes(counts: np.ndarray, n_cells: np.ndarray, chain: np.ndarray) -> Any:
    """Polygon classes at the end, and against the number of cells."""
    figure, ((left, right),) = plotting.new_figure(1, 2, width=[3.2, 2.8])
    inner = counts.sum(axis=1)
    fraction = counts[-1] / max(inner[-1], 1)
    error = np.sqrt(fraction * (1 - fraction) / max(inner[-1], 1))
    label = f"grown ({inner[-1]} inner cells)"
    left.bar(SIDES - 0.2, fraction, 0.4, yerr=error, color=SERIES[0], label=label)
    left.bar(SIDES + 0.2, chain, 0.4, color=SERIES[4], label="divisions alone")
    left.plot(list(EPITHELIA), list(EPITHELIA.values()), "D", color=INK, label="epithelia, about")
    left.set(xlabel="sides", ylabel="share of cells", xticks=SIDES, ylim=(0, 0.75))
    left.legend(loc="upper right")
    enough = inner >= 10
    for k, (n, expected) in enumerate(EPITHELIA.items()):
        curve = counts[enough, n - SIDES[0]] / inner[enough]
        right.plot(n_cells[enough], curve, color=SERIES[k], label=f"{n} sides")
        right.axhline(expected, color=SERIES[k], lw=0.7, ls=":")
    right.set_xlim(n_cells[0], n_cells[-1] + 1)  # a short run has no curve
    right.set(xlabel="cells", ylabel="share of inner cells", ylim=(0, 0.75), xscale="log")
    right.xaxis.set_minor_formatter(NullFormatter())
    right.legend(loc="upper left")
    return figure


@plotting.house_style()
def plot_monolayer(table: dict[str, np.ndarray]) -> Any:
    """The number of cells, and the radius and the roughness of the outline, against time in cycles."""
    figure, ((left, middle, right),) = plotting.new_figure(1, 3, width=2.4)
    cycles, cells = table["cycles"], table["cells"]
    left.semilogy(cycles, cells, color=SERIES[0], base=2, label="grown")
    left.semilogy(cycles, cells[0] * 2**cycles, ":", color=INK, lw=0.9, base=2, label="2× per cycle")
    left.set(xlabel="time in cycles", ylabel="cells")
    left.legend()
    middle.plot(cycles, table["radius"], color=SERIES[0])
    middle.set(xlabel="time in cycles", ylabel="radius in cell radii", ylim=(0, None))
    right.plot(cycles, table["roughness"], color=SERIES[0])
    right.set(xlabel="time in cycles", ylabel="roughness", ylim=(1, None))
    return figure


@plotting.house_style()
def plot_growth(frames: list[vx.Tissue], times: np.ndarray) -> Any:
    """Four frames, coloured by the number of sides."""
    figure, (axes,) = plotting.new_figure(1, 4, width=2.2, room=0.6)
    chosen = np.unique(np.linspace(0, len(frames) - 1, 4).round().astype(int))
    tissues, values = {f"time {times[k]:g}": frames[k] for k in chosen}, [sides_of(frames[k]) for k in chosen]
    plotting.plot_tissues(tissues, values, axes=axes[: len(chosen)], linewidth=0.4, **COLOURS)
    return figure


@plotting.house_style()
def plot_lineage(lineage: dict[str, np.ndarray], end: float) -> Any:
    """A tree of cells: a line from birth to end of each, in the colour of its founder; crosses are deaths."""
    mother, begun, ended = (lineage[name] for name in ("mother", "begun", "ended"))
    daughters = [np.flatnonzero(mother == cell) for cell in range(len(mother))]
    height, founder = np.zeros(len(mother)), np.arange(len(mother))
    for cell in np.flatnonzero(mother >= 0):  # a mother has a lower index
        founder[cell] = founder[mother[cell]]
    stack, order, leaves = list(np.flatnonzero(mother < 0)[::-1]), [], 0
    while stack:
        order.append(cell := int(stack.pop()))
        if not daughters[cell].size:
            height[cell], leaves = leaves, leaves + 1
        stack.extend(daughters[cell])
    forks = [cell for cell in order if daughters[cell].size]
    for cell in reversed(forks):
        height[cell] = np.mean(height[daughters[cell]])
    last = np.minimum(ended, end)
    lines = [((begun[c], height[c]), (last[c], height[c])) for c in order]
    spans = [[(last[c], f(height[daughters[c]])) for f in (np.min, np.max)] for c in forks]
    figure, ((ax,),) = plotting.new_figure(1, 1, width=4.0, height=3.6)
    for cells, segments in ((order, lines), (forks, spans)):
        colours = [SERIES[founder[c] % len(SERIES)] for c in cells]
        ax.add_collection(LineCollection(segments, colors=colours, linewidths=0.5))
    dead = lineage["fate"] == 2
    ax.plot(last[dead], height[dead], "x", ms=3, color=INK)
    ax.set(xlabel="time", ylabel="cells", xlim=(0, end), ylim=(-1, max(leaves, 1)), yticks=[])
    return figure
