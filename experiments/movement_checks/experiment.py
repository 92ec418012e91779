r"""What must hold of movement in time, measured.

1. A small deviation from rest decays, mode by mode, at the rate $\lambda / \zeta$; how wrong that is goes as
   the length of the step, or as its square for steps of second order.
2. In a quench the energy falls, whatever the step.
3. T1 transitions of a quench, and when they take place, do not depend on the step once it is short (Kursawe
   et al. 2017 find that other programs suppress transitions by long steps).
4. With noise at a temperature $T$ each mode of a solid has $\lambda \langle q^2 \rangle = T$.
5. Gradients through time agree with differences.
6. The error of controlled steps follows their tolerance.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray
from pydantic import Field

from vertax.activities import ThermalNoise
from vertax.adjoints import EquilibriumPropagation, ImplicitDifferentiation
from vertax.dissipations import SubstrateFriction
from vertax.dynamics import StepControl, evolve
from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.mechanics import modes
from vertax.mesh import Tissue
from vertax.relax import Relaxation
from vertax.runs import ExperimentConfig, RunFolder, TissueSection

from . import figures

STILL = Relaxation(transitions=None, contact_range=None, tolerance=1e-12)


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    tissue: TissueSection = TissueSection(n_cells=16)
    """The tissue."""
    shape_factor: float = Field(default=3.5, gt=0, lt=3.7)
    """Mean target shape factor, of a solid tissue."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    quenched: TissueSection = TissueSection(n_cells=36)
    """A random tissue that is watched on its way to rest."""
    quench: float = Field(default=1.0, gt=0)
    """How long it is watched."""
    halvings: int = Field(default=6, ge=2)
    """How often the step of the quench is halved; the first is a tenth of its time."""
    noise_steps: int = Field(default=4000, ge=100)
    """Steps with noise, each of 0.4 units of time."""
    tolerances: list[float] = Field(default=[1e-2, 1e-3, 1e-4, 1e-5], min_length=2)
    """Tolerances of controlled steps, in units of the size of a cell."""


class Findings(NamedTuple):
    """What was measured, for the figure and the metrics."""

    decay_steps: np.ndarray
    decay_errors: np.ndarray
    quench_times: list[np.ndarray]
    quench_energies: list[np.ndarray]
    events: list[np.ndarray]
    eigenvalues: np.ndarray
    mode_energies: np.ndarray
    differences: np.ndarray
    gradient_errors: np.ndarray
    control_errors: np.ndarray
    control_steps: np.ndarray


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: say what is being measured.

    **Returns:** the metrics: the orders of decay, the largest rise of an energy, how many transitions a
    quench has with each step and how much they are early or late, the mean energy of modes over the
    temperature, the error of gradients, and the power by which errors follow the tolerance.
    """
    began = time.perf_counter()
    key = jax.random.key(config.seed)
    first, energy = _random(config, config.tissue, key)
    wild = _random(config, config.quenched, jax.random.fold_in(key, 2))
    rest = Relaxation(contact_range=None)(first, energy).tissue
    solid = STILL(rest, energy, throw=False).tissue
    decay = folder.part("decay", lambda: _decay(config, solid, energy))
    quenches = [
        folder.part(f"quench {n}", lambda n=n: _quench(config, *wild, n))
        for n in (10 * 2 ** np.arange(config.halvings + 1)).tolist()
    ]
    found = Findings(
        decay["steps"],
        decay["errors"],
        [quench["times"] for quench in quenches],
        [quench["energies"] for quench in quenches],
        [quench["events"] for quench in quenches],
        **folder.part("noise", lambda: _equipartition(config, solid, energy)),
        **folder.part("gradients", lambda: _gradients(config, solid, energy)),
        **folder.part("control", lambda: _controlled(config, solid, energy)),
    )
    folder.save_figure("checks", figures.checks(config, found))
    folder.save_table(
        "quench",
        {
            "step": [t[1] - t[0] for t in found.quench_times],
            "num_t1": [len(e) for e in found.events],
            "latest": [_latest(e, found.events[-1]) for e in found.events],
        },
    )
    return _metrics(config, found) | {"seconds": time.perf_counter() - began}


def _random(
    config: Config, section: TissueSection, key: PRNGKeyArray
) -> tuple[Tissue, ShapeFactorEnergy]:
    """A random tissue and its energy."""
    tissue = periodic_voronoi(section.n_cells, key=key, lloyd_steps=section.lloyd_steps)
    spread = 0.1 * jax.random.normal(jax.random.fold_in(key, 1), (section.n_cells,))
    return tissue, ShapeFactorEnergy(config.shape_factor + spread)


def _metrics(config: Config, found: Findings) -> dict[str, Any]:
    power = lambda x, y: float(np.polyfit(np.log(x), np.log(y), 1)[0])
    rises = [np.max(np.diff(e) / np.ptp(e)) for e in found.quench_energies]
    same = [
        np.array_equal(e[:, 0], found.events[-1][:, 0]) if len(e) else False for e in found.events
    ]
    firm = next((i for i in range(len(same)) if all(same[i:])), len(same) - 1)
    implicit, propagation = found.gradient_errors
    weights = -np.expm1(-found.eigenvalues * 0.4 / config.friction)
    return {
        "decay_order": [power(found.decay_steps[1:], e[1:]) for e in found.decay_errors],
        "largest_rise": float(max(rises)),
        "num_t1": [len(e) for e in found.events],
        "same_order_from_step": float(np.diff(found.quench_times[firm][:2])[0]),
        "t1_times_off": [_latest(e, found.events[-1]) for e in found.events],
        "mode_energy": float(np.average(found.mode_energies, weights=weights)),
        "gradient_error": {"implicit": implicit.min(), "propagation": propagation.min()},
        "control_power": [power(config.tolerances, e) for e in found.control_errors],
    }


def _decay(config: Config, solid: Tissue, energy: ShapeFactorEnergy) -> dict[str, np.ndarray]:
    """Steps in units of the time of decay, and the error after that time for both orders."""
    number = solid.n_vertices  # in the middle
    found = modes(solid, energy, number + 1)
    value, mode = float(found.values[-1]), np.asarray(found.displacements[-1])
    size, lasts = 1e-5, config.friction / value
    start = solid.with_vertices(solid.vertices + size * mode)
    counts = 4 * 2 ** np.arange(5)
    errors = np.zeros((2, len(counts)))
    for order in (1, 2):
        for i, n in enumerate(counts):
            movie = _by_frames(
                config, start, energy, np.linspace(0, lasts, n + 1), order=order, relaxation=STILL
            )
            left = np.sum(np.asarray(movie.tissue.vertices - solid.vertices) * mode) / size
            errors[order - 1, i] = abs(left / np.exp(-1) - 1)
    return {"steps": 1 / counts, "errors": errors}


def _by_frames(
    config: Config, tissue: Tissue, energy: Any, times: np.ndarray, **settings: Any
) -> Any:
    """A movement of which each step is a frame: one program for any number of steps."""
    friction = SubstrateFriction(config.friction)
    return evolve(tissue, energy, friction, times, progress=True, throw=False, **settings)


def _quench(
    config: Config, first: Tissue, energy: ShapeFactorEnergy, n: int
) -> dict[str, np.ndarray]:
    """Times and energies with so many steps, and edges and times of the transitions in their order."""
    times = config.quench * np.arange(n + 1) / n
    movie = _by_frames(config, first, energy, times, relaxation=Relaxation(contact_range=None))
    frames, edges = np.nonzero(np.asarray(movie.flipped))
    events = np.stack([edges, times[frames]], axis=1).reshape(-1, 2)
    return {"times": times, "energies": np.asarray(movie.energies), "events": events}


def _latest(events: np.ndarray, reference: np.ndarray) -> float:
    """How far the first transition of an edge is at most from that of the same edge in another run."""
    there, here = (dict(reversed(x.tolist())) for x in (reference, events))
    return max((abs(here[edge] - there[edge]) for edge in here if edge in there), default=0.0)


def _equipartition(
    config: Config, solid: Tissue, energy: ShapeFactorEnergy
) -> dict[str, np.ndarray]:
    """Eigenvalues, and the energy of each mode over the temperature."""
    found = modes(solid, energy, 2 * solid.n_vertices)
    values = np.asarray(found.values)[2:]
    vectors = np.asarray(found.displacements)[2:].reshape(len(values), -1)
    temperature, dt = 1e-6, 0.4
    movie = evolve(
        solid,
        energy,
        SubstrateFriction(config.friction),
        dt * np.arange(config.noise_steps + 1),
        activity=ThermalNoise(temperature),
        key=config.seed,
        relaxation=Relaxation(transitions=None, contact_range=None),
    )
    moved = np.asarray(movie.frames.vertices - solid.vertices)[config.noise_steps // 10 :]
    amplitudes = moved.reshape(len(moved), -1) @ vectors.T
    # Of implicit Euler steps each mode has λ <q²> = T / (1 + λ dt / 2 ζ).
    damped = 1 + values * dt / (2 * config.friction)
    energies = values * (amplitudes**2).mean(axis=0) * damped / temperature
    return {"eigenvalues": values, "mode_energies": energies}


def _gradients(config: Config, solid: Tissue, energy: ShapeFactorEnergy) -> dict[str, np.ndarray]:
    """Widths of central differences, and the relative error of the slope by each adjoint."""
    key = jax.random.key(config.seed + 1)
    start = solid.with_vertices(
        solid.vertices + 0.02 * jax.random.normal(key, solid.vertices.shape)
    )
    weights, along = (
        jax.random.normal(jax.random.fold_in(key, i), shape)
        for i, shape in enumerate((solid.vertices.shape, (solid.n_cells,)))
    )
    targets = jnp.asarray(energy.target_shape_factor)

    @eqx.filter_jit
    def cost(by: Array, adjoint: Any = None) -> Array:
        friction = SubstrateFriction(config.friction * (1 + by))
        movie = evolve(
            start,
            ShapeFactorEnergy(targets + by * along),
            friction,
            [0.0, 0.1, 0.4],
            relaxation=STILL,
            adjoint=adjoint,
            throw=False,
        )
        return jnp.sum(weights * movie.tissue.vertices**2)

    zero = jnp.array(0.0)
    slopes = [
        float(eqx.filter_jit(jax.grad(lambda by, a=adjoint: cost(by, a)))(zero))
        for adjoint in (ImplicitDifferentiation(), EquilibriumPropagation(beta=1e-5))
    ]
    widths = 10.0 ** np.arange(-7, -1.5, 0.5)
    differences = np.array([float(cost(zero + h) - cost(zero - h)) / (2 * h) for h in widths])
    errors = [np.abs(differences / slope - 1) for slope in slopes]
    return {"differences": widths, "gradient_errors": np.stack(errors)}


def _controlled(config: Config, solid: Tissue, energy: ShapeFactorEnergy) -> dict[str, np.ndarray]:
    """Errors at the end for both orders and all tolerances, and how many steps that took."""
    key = jax.random.key(config.seed + 2)
    bend = 0.02 * jax.random.normal(key, solid.vertices.shape)
    start = solid.with_vertices(solid.vertices + bend)
    times = np.linspace(0, 1, 3)
    # (In very short steps no force gets below that of STILL, for rounding.)
    plain = Relaxation(transitions=None, contact_range=None)
    fine = np.linspace(0, 1, 1001)
    exact = _by_frames(config, start, energy, fine, order=2, relaxation=plain).tissue.vertices
    errors = np.zeros((2, len(config.tolerances)))
    counts = np.zeros_like(errors)
    for order in (1, 2):
        for i, tolerance in enumerate(config.tolerances):
            control = StepControl(tolerance, most=400)
            movie = evolve(
                start,
                energy,
                SubstrateFriction(config.friction),
                times,
                control=control,
                order=order,
                relaxation=plain,
                throw=False,
            )
            errors[order - 1, i] = jnp.max(jnp.abs(movie.tissue.vertices - exact))
            counts[order - 1, i] = (movie.steps > 0).sum()
    return {"control_errors": errors, "control_steps": counts}
