"""What a planar analysis of a curved tissue gets wrong, and tensions from shapes on a tube.

Foams at rest are projected to spheres (stereographically, which keeps their tensions), and drawn as seen from
above. Areas, shape factors and tensions are measured in the image, with and without the heights of its
pixels, and compared with the exact ones. Then cells of two types lie on a tube, and their three tensions are
fitted to noisy areas and perimeters, once on the tube and once in its unrolled image.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from optimistix import LevenbergMarquardt
from pydantic import Field

import vertax as vx
from vertax import plotting, runs
from vertax.costs import AbstractLeastSquaresCost
from vertax.energies import AreaElasticity, LineTension, by_type
from vertax.inference import label_image, labels_on_sphere
from vertax.plotting import INK, SERIES
from vertax.surfaces import Cylinder
from vertax.tensions import infer_tensions

FINE = 4
"""Pixels of the planar foam along a pixel of the image."""
KINDS = {"projected": "projection alone", "lifted": "with heights"}


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    foams: int = Field(default=3, ge=1)
    """Number of foams."""
    n_cells: int = Field(default=20, ge=6)
    """Cells of a foam."""
    pixels: int = Field(default=400, ge=64)
    """Longer side of the image of a planar foam."""
    slopes: list[float] = Field(default=[0.0, 0.25, 0.5, 0.75, 1.0], min_length=1)
    """Slopes of the spheres at the rim of the foam, rise over run; 0 is the plane."""
    deviation: float = Field(default=0.2, ge=0, lt=0.3)
    """Standard deviation of the tensions of a foam, of mean 1."""
    tubes: int = Field(default=3, ge=1)
    """Number of tubes."""
    circumference: int = Field(default=6, ge=4)
    """Circumference of a tube, in cell diameters; its length is a third larger."""
    tensions: list[float] = Field(default=[0.7, 1.0, 0.5], min_length=3, max_length=3)
    """Tensions between cells of type 0, of both types, and of type 1."""
    noise: float = Field(default=0.005, gt=0)
    """Relative standard deviation of areas and perimeters on the tube."""


class CellShapes(AbstractLeastSquaresCost):
    """Differences of areas and perimeters from observed ones."""

    areas: Any
    perimeters: Any

    def residuals(self, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> Any:
        """The relative differences."""
        pairs = (tissue.areas, self.areas), (tissue.perimeters, self.perimeters)
        return jnp.concatenate([value / observed - 1 for value, observed in pairs])


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Errors of areas, shape factors and tensions by slope, and of the tensions on tubes."""
    began, cells, tensions = time.perf_counter(), [], []
    for seed in range(config.foams):
        foam, tension = make_foam(config, config.seed + seed)
        for slope in config.slopes:
            of_cells, of_edges = compare(config, foam, tension, slope)
            label = {"foam": np.array(seed), "rim_slope": np.array(slope)}
            for tables, table in ((cells, of_cells), (tensions, of_edges)):
                n = len(next(iter(table.values())))
                tables.append({k: np.full(n, v) for k, v in label.items()} | table)
    of_cells, of_edges = runs.concatenate(cells), runs.concatenate(tensions)
    folder.save_table("cells", of_cells)
    folder.save_table("tensions", of_edges)
    summary = summarise(of_cells, of_edges)
    folder.save_table("errors", summary)
    table = runs.concatenate([fit_tube(config, config.seed + k) for k in range(config.tubes)])
    folder.save_table("tubes", table)
    folder.save_figure("bias", plot_bias(of_cells, summary, table))
    last = {f"{name}_at_rim_slope_{summary['rim_slope'][-1]:g}": v[-1] for name, v in summary.items()}
    rms = lambda name: float(np.sqrt(np.mean((table[name] / table["tension"] - 1) ** 2)))
    return last | {
        "tube_error_on_surface": rms("on_surface"),
        "tube_error_unrolled": rms("unrolled"),
        "seconds": time.perf_counter() - began,
    }


def make_foam(config: Config, seed: int) -> tuple[vx.Tissue, np.ndarray]:
    """A foam at rest and the tensions of its edges."""
    keys = jax.random.split(jax.random.key(seed), 2)
    start = vx.initialise.free_voronoi(config.n_cells, key=keys[0], lloyd_steps=3, inner_arcs=True)
    tension = 1 + config.deviation * jax.random.truncated_normal(keys[1], -2, 2, (start.n_edges,))
    energy = AreaElasticity(20.0, 1.1) + LineTension(tension)
    return vx.equilibrate(start, energy, contact_range=None).tissue, np.asarray(tension)


def compare(
    config: Config, foam: vx.Tissue, tension: np.ndarray, slope: float
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Errors of areas and shape factors of cells, and of tensions, on a sphere."""
    fine = label_image(foam, FINE * config.pixels)
    course = np.asarray(foam.edge_points(jnp.linspace(0, 1, 61)))
    low, extent = (of(course.reshape(-1, 2), axis=0) for of in (np.min, np.ptp))
    course = (course - low) * 0.9 * config.pixels / extent.max()
    course = course + 0.05 * config.pixels - np.array(fine.shape[::-1]) / (2 * FINE)
    # The point at the distance 2 R tan(θ/2) from the pole has the slope tan θ.
    reach = np.linalg.norm(course, axis=-1).max()
    radius = reach / (2 * np.tan(0.5 * np.arctan(max(slope, 1e-4))))
    areas, perimeters = exact_shapes(foam, course, radius)
    image, heights = labels_on_sphere(fine, FINE * radius)
    half = slice(FINE // 2, None, FINE)
    image, heights = image[half, half], heights[half, half] / FINE
    lifted = infer_tensions(image, height=heights, pixel_size=1.0)
    projected = infer_tensions(image, pixel_size=1.0)
    assert lifted.curved is not None
    cell = lifted.labels - 1
    factors = (perimeters / np.sqrt(areas))[cell]
    flat, curved = projected.tissue, lifted.curved
    of_cells = {
        "cell": cell,
        "slope": curved.slopes,
        "area_projected": np.asarray(flat.areas) / areas[cell] - 1,
        "area_lifted": curved.areas / areas[cell] - 1,
        "shape_factor_projected": np.asarray(flat.shape_factors) / factors - 1,
        "shape_factor_lifted": curved.perimeters / np.sqrt(curved.areas) / factors - 1,
    }
    pairs = np.sort(np.asarray(foam.topology.edge_cells), axis=1).tolist()
    number = {tuple(pair): k for k, pair in enumerate(pairs) if pairs.count(pair) == 1}
    between = np.sort(np.append(cell, foam.n_cells)[np.asarray(flat.topology.edge_cells)], axis=1)
    edge = np.array([number.get(tuple(pair), -1) for pair in between.tolist()])
    use = lifted.determined & projected.determined & (edge >= 0)
    of_edges: dict[str, np.ndarray] = {"tension": tension[edge[use]] / tension[edge[use]].mean()}
    for name, result in (("projected", projected), ("lifted", lifted)):
        scale = result.tensions[use].mean()
        of_edges[name] = result.tensions[use] / scale
        of_edges[f"{name}_deviation"] = result.tension_deviations[use] / scale
    return of_cells, of_edges


def exact_shapes(foam: vx.Tissue, course: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Areas and perimeters on the sphere, from points along the edges in the plane."""
    scale = 1 / (1 + np.sum(course**2, axis=-1, keepdims=True) / (4 * radius**2))
    height = radius * (2 * scale - 1)
    lengths = np.linalg.norm(np.diff(np.concatenate([course * scale, height], -1), axis=1), axis=-1)
    # The area is the integral of scale² over the plane, ∮ scale (x dy - y dx) / 2 along the outline.
    middle, step = 0.5 * (course[:, 1:] + course[:, :-1]), np.diff(course, axis=1)
    swept = np.sum(
        0.5 / (1 + np.sum(middle**2, -1) / (4 * radius**2)) * np.linalg.det(np.stack([middle, step], -2)),
        axis=1,
    )
    areas, perimeters = np.zeros((2, foam.n_cells + 1))
    for side, sign in zip(np.asarray(foam.topology.edge_cells).T, (1, -1), strict=True):
        np.add.at(areas, side, sign * swept)
        np.add.at(perimeters, side, lengths.sum(axis=1))
    return areas[:-1], perimeters[:-1]


def summarise(cells: dict[str, Any], edges: dict[str, Any]) -> dict[str, np.ndarray]:
    """Mean errors of areas and shape factors, and of tensions, for each slope at the rim."""
    rows = []
    for slope in np.unique(cells["rim_slope"]):
        of_slope, inner = cells["rim_slope"] == slope, edges["rim_slope"] == slope
        row = {"rim_slope": slope}
        for kind in KINDS:
            for name in ("area", "shape_factor"):
                values = cells[f"{name}_{kind}"][of_slope]
                row |= {f"{name}_{kind}_mean": values.mean()}
                row |= {f"{name}_{kind}_largest": values[np.argmax(np.abs(values))]}
            error = (edges[kind] - edges["tension"])[inner]
            row[f"tension_{kind}_rms"] = np.sqrt(np.mean(error**2))
            score = np.abs(error / edges[f"{kind}_deviation"][inner])
            row[f"tension_{kind}_within_1.96"] = np.mean(score < 1.96)
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def fit_tube(config: Config, seed: int) -> dict[str, np.ndarray]:
    """The tensions by cell types from shapes on a tube, and from its unrolled image."""
    width, length = float(config.circumference), float(round(config.circumference * 4 / 3))
    keys = jax.random.split(jax.random.key(seed), 3)
    options: dict[str, Any] = {"lattice": np.diag([width, length]), "lloyd_steps": 3}
    flat = vx.initialise.periodic_voronoi(int(width * length), key=keys[0], **options)
    types = jax.random.permutation(keys[1], jnp.arange(flat.n_cells) % 2)
    energy = lambda a, b, c: AreaElasticity(20.0, 1.05) + by_type([[a, b], [b, c]], types)
    tube = flat.with_surface(Cylinder(width / (2 * np.pi)))
    rest = vx.equilibrate(tube, energy(*config.tensions)).tissue
    noise = 1 + config.noise * np.random.default_rng(seed).normal(size=(2, flat.n_cells))
    table: dict[str, np.ndarray] = {"tube": np.full(3, seed), "tension": np.array(config.tensions)}
    for name, observed in (("on_surface", rest), ("unrolled", rest.with_surface(None))):
        cost = CellShapes(observed.areas * noise[0], observed.perimeters * noise[1])
        # The neighbours are seen: at the first guess cells would change them.
        fixed = vx.Relaxation(transitions=None)
        problem = vx.InverseProblem(observed, energy(0.7, 0.7, 0.7), cost, response=fixed)
        fit: Any = vx.fit(problem, LevenbergMarquardt(rtol=1e-6, atol=1e-6), 30, progress=False)
        table[name] = np.asarray(fit.energy.terms[1].tension)
    return table


@plotting.house_style()
def plot_bias(cells: dict[str, Any], summary: dict[str, Any], tubes: dict[str, Any]) -> Any:
    """Errors of areas and shape factors against the slope of each cell, of tensions, and fits of tubes."""
    figure, ((left, middle, right, last),) = plotting.new_figure(1, 4)
    for k, (kind, label) in enumerate(KINDS.items()):
        for axes, name in ((left, "area"), (middle, "shape_factor")):
            axes.plot(cells["slope"], 100 * cells[f"{name}_{kind}"], ".", ms=3, color=SERIES[k])
        errors = 100 * summary[f"tension_{kind}_rms"]
        right.plot(summary["rim_slope"], errors, "o-", ms=4, color=SERIES[k], label=label)
    slope = np.linspace(0, cells["slope"].max())
    left.plot(slope, 100 * (1 / np.sqrt(1 + slope**2) - 1), color=INK, lw=0.8)
    left.set(xlabel="slope of the cell", ylabel="error of the area (%)")
    middle.set(xlabel="slope of the cell", ylabel="error of the shape factor (%)")
    right.set(xlabel="slope at the rim", ylabel="error of tensions (%)", ylim=(0, None))
    right.legend()
    limit = np.array([0, 1.15 * tubes["tension"].max()])
    last.plot(limit, limit, color=INK, lw=0.8)
    for k, (kind, label) in enumerate({"unrolled": "unrolled image", "on_surface": "on the tube"}.items()):
        last.plot(tubes["tension"], tubes[kind], "o", ms=4, color=SERIES[k], label=label)
    last.set(xlabel="tension", ylabel="fitted tension", xlim=limit, ylim=limit)
    last.legend()
    return figure
