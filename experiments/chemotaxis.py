"""Chemotaxis of a free cluster in fixed fields of an attractant: linear, half-normal and exponential.

Each cell holds the concentration that it senses, and pulls outward on its free edges with a traction
proportional to it. No cell compares its two ends, but the cluster moves up the gradient (Camley et al. 2016,
doi:10.1103/PhysRevLett.116.098101). On a substrate with the friction ζ per area the centre of mass obeys

dX/dt = (χ / ζ) m dc/dx,  m = Σ ℓ n_x d_x / A

with the traction χ per concentration, and the geometry m of the contacts between cells: length ℓ, unit normal
n, vector d between the two centroids, and the area A of the cluster; m → 1 for large clusters.

Self-propulsion in random directions adds noise. The chemotactic index is the displacement of the centre of
mass along the gradient, divided by the length of its path, with one point for each frame. The traction is
recovered from the tracks of the runs with noise and the geometry of the contacts in their frames.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy.integrate import odeint

import vertax as vx
from experiments._shared import comparison
from vertax import energies, plotting, runs
from vertax.plotting import INK, SERIES


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: int = Field(default=19, ge=2)
    """Cells of the cluster, of mean area 1."""
    duration: float = Field(default=40.0, gt=0)
    """Duration of each run."""
    frames: int = Field(default=40, ge=3)
    """Frames after the first one."""
    substeps: int = Field(default=2, ge=1)
    """Steps per frame."""
    gradient: float = Field(default=0.05, gt=0)
    """Gradient at the start, concentration per length; the concentration there is 1."""
    factors: list[float] = Field(default=[0.0, 0.5, 1.0, 2.0], min_length=2)
    """The gradients of the runs with noise, in units of that one."""
    replicates: int = Field(default=3, ge=1)
    """Runs with noise for each gradient."""
    traction: float = Field(default=0.5, gt=0)
    """Traction of free edges per concentration, χ."""
    friction: float = Field(default=0.1, gt=0)
    """Friction per area, ζ."""
    sensing_rate: float = Field(default=2.0, gt=0)
    """Rate at which a cell follows the concentration at its centroid."""
    propulsion: float = Field(default=0.1, ge=0)
    """Self-propulsion of each cell in the runs with noise."""
    rotational_diffusion: float = Field(default=0.5, ge=0)
    """Rotational diffusion of the directions of propulsion."""
    animation: bool = True
    """Draw an animation."""


PROFILES = ("linear", "half-normal", "exponential")


class Sensing(vx.signals.AbstractReaction):
    """A cell follows the concentration of the field at its centroid."""

    rate: Any
    gradient: Any
    profile: Any

    def sense(self, tissue: vx.Tissue) -> Any:
        """The concentrations of the field at the centroids."""
        return field(self.profile, self.gradient, tissue.centroids[:, 0])

    def __call__(self, concentrations: Any, cells: Any, time: Any) -> Any:
        """The rate of change."""
        return self.rate * (cells - concentrations)


def field(profile: Any, gradient: Any, x: Any) -> Any:
    """The concentration at x: 1 at x = 0, with this gradient there; the half-normal has its peak at 20."""
    linear, half_normal = 1 + gradient * x, jnp.exp(gradient * (x - x**2 / 40))
    return jnp.stack([linear, half_normal, jnp.exp(gradient * x)])[profile]


class Pull(eqx.Module):
    """Outward traction on free edges, proportional to the concentration in their cell, and propulsion."""

    traction: Any
    propulsion: Any
    rotational_diffusion: Any

    def __call__(self, concentrations: Any, tissue: vx.Tissue) -> vx.dynamics.Material:
        """The forces on vertices."""
        m, vectors = tissue.topology, tissue.edge_vectors
        left, right = concentrations[0].at[m.edge_cells].get(mode="fill", fill_value=0).T
        normals = jnp.stack([vectors[:, 1], -vectors[:, 0]], axis=-1)  # from left to right
        traction = jnp.where(m.on_outline, self.traction * (left - right), 0)[:, None] * normals
        forces = jnp.zeros_like(tissue.vertices)
        for end in (0, 1):
            forces = forces.at[m.edge_vertices[:, end]].add(traction / 2)
        noise = vx.activities.SelfPropulsion(self.propulsion, self.rotational_diffusion)
        return vx.dynamics.Material(vx.activities.Push(forces), None, noise)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Positions of the centre of mass in each field, and speeds and chemotactic indices with noise."""
    began = time.perf_counter()
    tissue = vx.initialise.free_voronoi(config.n_cells, key=config.seed, lloyd_steps=5)
    tissue = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary)
    energy = energies.AreaElasticity(10.0, 1.0) + energies.PerimeterElasticity(1.0, 3.6)
    rest = vx.equilibrate(tissue, energy).tissue
    rest = rest.with_vertices(rest.vertices - centre(rest))
    times, spent = np.linspace(0, config.duration, config.frames + 1), []

    def evolve(profile: int, gradient: float, propulsion: float, key: int) -> tuple[Any, np.ndarray]:
        sensing = Sensing(jnp.asarray(config.sensing_rate), jnp.asarray(gradient), jnp.asarray(profile))
        parameters = config.traction, propulsion, config.rotational_diffusion
        signals = vx.signals.Signals(
            sensing,
            [0.0],
            initial=field(profile, gradient, rest.centroids[:, 0])[None],
            couple=Pull(*map(jnp.asarray, parameters)),
            diluted=False,
            deterministic=False,
        )
        worked = time.process_time()
        movie = vx.evolve(
            rest,
            energy,
            vx.dissipations.SubstrateFriction(config.friction, per="area"),
            times,
            substeps=config.substeps,
            activity=signals,
            key=key,
            throw=False,
        )
        if not movie.converged:
            folder.warn(f"{PROFILES[profile]}, gradient {gradient:g}: {vx.RESULTS[movie.result]}")
        spent.append(time.process_time() - worked)
        return movie, np.array([centre(frame) for frame in movie.trajectory])

    mobility = config.traction / config.friction * contact_geometry(rest)
    fields: dict[str, Any] = {"time": times}
    for k, profile in enumerate(PROFILES):
        slope = jax.jit(jax.grad(lambda x, k=k: field(k, config.gradient, x)))
        fields[profile] = evolve(k, config.gradient, 0.0, 0)[1][:, 0]
        fields[f"{profile}_theory"] = odeint(
            lambda x, _, slope=slope: mobility * slope(x[0])[None], [0.0], times
        )[:, 0]
    movie: Any
    rows, geometries, movie, path = [], [], None, np.zeros((1, 2))
    for factor in config.factors:
        for key in range(config.replicates):
            gradient = factor * config.gradient
            movie, path = evolve(0, gradient, config.propulsion, config.seed + len(rows))
            length = np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1))
            moved = path[-1, 0] - path[0, 0]
            net = np.linalg.norm(path[-1] - path[0])
            rows.append((gradient, key, moved / config.duration, moved / length, net / length))
            geometries.append(np.mean([contact_geometry(frame) for frame in movie.trajectory]))
    names = ("gradient", "replicate", "speed", "index", "directionality")
    columns = map(np.array, zip(*rows, strict=True))
    noisy: dict[str, Any] = dict(zip(names, columns, strict=True))
    noisy["speed_theory"] = mobility * noisy["gradient"]
    folder.save_table("fields", fields)
    folder.save_table("noise", noisy)
    folder.save_figure("chemotaxis", plot_chemotaxis(movie, path, fields, noisy))
    if config.animation:
        (folder.path / "figures").mkdir(exist_ok=True)
        file, values = folder.path / "figures" / "cluster.gif", np.asarray(movie.signals)[:, 0]
        vx.animate(movie.trajectory, file, values, mark_t1=0, dpi=90, label="concentration sensed")
    steepest = noisy["gradient"] == noisy["gradient"].max()
    linear = np.polyfit(times, fields["linear"], 1)[0]
    # Least squares through the origin: speed = χ q with q = m dc/dx / ζ.
    q = np.array(geometries) * noisy["gradient"] / config.friction
    traction = np.sum(q * noisy["speed"]) / np.sum(q**2)
    scatter = np.sum((noisy["speed"] - traction * q) ** 2) / max(len(q) - 1, 1)
    return {
        "speed": float(linear),
        "speed_of_theory": float(mobility * config.gradient),
        "displacements": {name: float(fields[name][-1]) for name in PROFILES},
        "displacements_of_theory": {name: float(fields[f"{name}_theory"][-1]) for name in PROFILES},
        "index_in_the_steepest_gradient": float(np.mean(noisy["index"][steepest])),
        "index_without_gradient": float(np.mean(noisy["index"][noisy["gradient"] == 0])),
        "directionality_in_the_steepest_gradient": float(np.mean(noisy["directionality"][steepest])),
        "traction": comparison(traction, np.sqrt(scatter / np.sum(q**2)), config.traction),
        "seconds_per_step": float(np.median(spent)) / config.frames / config.substeps,
        "seconds": time.perf_counter() - began,
    }


def centre(tissue: vx.Tissue) -> np.ndarray:
    """The centre of mass of a cluster."""
    return np.average(np.asarray(tissue.centroids), axis=0, weights=np.asarray(tissue.areas))


def contact_geometry(tissue: vx.Tissue) -> float:
    """The geometry m of the contacts along x."""
    cells = np.asarray(tissue.topology.edge_cells)
    inside = (cells < tissue.n_cells).all(axis=1)
    ends = np.asarray(tissue.centroids)[cells[inside]]
    normals = np.asarray(tissue.edge_vectors)[inside] @ [[0, -1], [1, 0]]  # from left to right
    return float(np.sum(normals[:, 0] * (ends[:, 1] - ends[:, 0])[:, 0]) / np.sum(tissue.areas))


@plotting.house_style()
def plot_chemotaxis(movie: Any, path: np.ndarray, fields: dict[str, Any], noisy: dict[str, Any]) -> Any:
    """The end of the last run with its path, positions in each field, and speeds and indices with noise."""
    figure, (axes,) = plotting.new_figure(1, 4, width=[2.6, 2.2, 2.2, 2.2], height=2.2, room=0.6)
    frames = list(movie.trajectory)
    vx.plot_tissue(frames[-1], np.asarray(movie.signals)[-1, 0], ax=axes[0], label="concentration sensed")
    axes[0].plot(*path.T, color=INK, lw=1)
    corners = np.concatenate([np.asarray(frames[k].vertices) for k in (0, -1)])
    (left, bottom), (right, top) = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
    axes[0].set(xlim=(left, right), ylim=(bottom, top))
    for k, profile in enumerate(PROFILES):
        axes[1].plot(fields["time"], fields[f"{profile}_theory"], color=SERIES[k], lw=1)
        axes[1].plot(fields["time"][::4], fields[profile][::4], ".", color=SERIES[k], label=profile)
    axes[1].set(xlabel="time", ylabel="position")
    axes[1].legend()
    axes[2].plot(noisy["gradient"], noisy["speed_theory"], "-", color=INK, label="theory")
    axes[2].plot(noisy["gradient"], noisy["speed"], ".", color=SERIES[0], label="with noise")
    axes[2].set(xlabel="gradient", ylabel="speed")
    axes[2].legend()
    axes[3].plot(noisy["gradient"], noisy["index"], ".", color=SERIES[0])
    axes[3].set(xlabel="gradient", ylabel="chemotactic index", ylim=(None, 1.02))
    return figure
