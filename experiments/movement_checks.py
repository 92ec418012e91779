r"""Check the orders, energies, transitions, noise, gradients and step control of movement in time.

1. A small displacement from equilibrium decays, mode by mode, at the rate $\lambda / \zeta$; the error is
   proportional to the time step, or to its square for steps of second order.
2. In a quench the energy decreases at each step.
3. The T1 transitions of a quench and their times converge with the step (Kursawe et al. 2017 find that long
   steps suppress transitions in other programs).
4. With noise at a temperature $T$ each mode of a solid has $\lambda \langle q^2 \rangle = T$.
5. Gradients through time agree with finite differences.
6. The error of controlled steps is proportional to a power of their tolerance.
"""

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import NullFormatter
from pydantic import Field

import vertax as vx
from vertax import plotting, runs
from vertax.dissipations import SubstrateFriction
from vertax.energies import ShapeFactorEnergy

FIXED = vx.Relaxation(transitions=None, contact_range=None)
EXACT = vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-12)


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    tissue: runs.TissueSection = runs.TissueSection(n_cells=16)
    """The tissue."""
    shape_factor: float = Field(default=3.5, gt=0, lt=3.7)
    """Mean target shape factor, of a solid tissue."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    quenched: runs.TissueSection = runs.TissueSection(n_cells=36)
    """The random tissue of the quench."""
    quench: float = Field(default=1.0, gt=0)
    """Duration of the quench."""
    halvings: int = Field(default=6, ge=2)
    """Number of times that the step of the quench is halved; the first step is a tenth of the duration."""
    noise_steps: int = Field(default=4000, ge=100)
    """Steps with noise, each of 0.4 units of time."""
    tolerances: list[float] = Field(default=[1e-2, 1e-3, 1e-4, 1e-5], min_length=2)
    """Tolerances of controlled steps, in units of the size of a cell."""


class Results(NamedTuple):
    """The measurements; rows of errors are orders 1 and 2, or the two adjoints."""

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


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Orders of decay, rises of the energy, shifts of T1 times, mode energies, errors and their powers."""
    began, key = time.perf_counter(), jax.random.key(config.seed)
    first, energy = random_tissue(config, config.tissue, key)
    unrelaxed = random_tissue(config, config.quenched, jax.random.fold_in(key, 2))
    rest = vx.Relaxation(contact_range=None)(first, energy).tissue
    solid = EXACT(rest, energy, throw=False).tissue
    decay = folder.part("decay", lambda: measure_decay(config, solid, energy))
    counts = (10 * 2 ** np.arange(config.halvings + 1)).tolist()
    quenches = [folder.part(f"quench {n}", lambda n=n: quench(config, *unrelaxed, n)) for n in counts]
    results = Results(
        decay["steps"],
        decay["errors"],
        [each["times"] for each in quenches],
        [each["energies"] for each in quenches],
        [each["events"] for each in quenches],
        **folder.part("noise", lambda: measure_noise(config, solid, energy)),
        **folder.part("gradients", lambda: measure_gradients(config, solid, energy)),
        **folder.part("control", lambda: measure_control(config, solid, energy)),
    )
    folder.save_figure("checks", plot_checks(config, results))
    steps, events = [t[1] - t[0] for t in results.quench_times], results.events
    num_t1, latest = [len(e) for e in events], [largest_shift(e, events[-1]) for e in events]
    folder.save_table("quench", {"step": steps, "num_t1": num_t1, "latest": latest})
    power = lambda x, y: float(np.polyfit(np.log(x), np.log(y), 1)[0])
    same = [len(e) > 0 and np.array_equal(e[:, 0], events[-1][:, 0]) for e in events]
    converged = next((i for i in range(len(same)) if all(same[i:])), len(same) - 1)
    implicit, propagation = results.gradient_errors
    weights = -np.expm1(-results.eigenvalues * 0.4 / config.friction)
    return {
        "decay_order": [power(results.decay_steps[1:], e[1:]) for e in results.decay_errors],
        "largest_rise": float(max(np.max(np.diff(e) / np.ptp(e)) for e in results.quench_energies)),
        "num_t1": num_t1,
        "same_order_from_step": float(steps[converged]),
        "t1_times_off": latest,
        "mode_energy": float(np.average(results.mode_energies, weights=weights)),
        "gradient_error": {"implicit": implicit.min(), "propagation": propagation.min()},
        "control_power": [power(config.tolerances, e) for e in results.control_errors],
        "seconds": time.perf_counter() - began,
    }


def random_tissue(config: Config, section: runs.TissueSection, key: Any) -> tuple[Any, Any]:
    """A random tissue and its energy."""
    tissue = vx.initialise.periodic_voronoi(section.n_cells, key=key, lloyd_steps=section.lloyd_steps)
    spread = 0.1 * jax.random.normal(jax.random.fold_in(key, 1), (section.n_cells,))
    return tissue, ShapeFactorEnergy(config.shape_factor + spread)


def bend(tissue: vx.Tissue, size: float, key: Any) -> vx.Tissue:
    """The tissue with random displacements of its vertices."""
    return tissue.with_vertices(tissue.vertices + size * jax.random.normal(key, tissue.vertices.shape))


def move(config: Config, tissue: Any, energy: Any, times: Any, **settings: Any) -> Any:
    """A movement of one step per frame, compiled once for all numbers of steps."""
    friction = SubstrateFriction(config.friction)
    return vx.evolve(tissue, energy, friction, times, progress=True, throw=False, **settings)


def measure_decay(config: Config, solid: Any, energy: Any) -> dict[str, np.ndarray]:
    """Steps in units of the decay time, and the error after that time for both orders."""
    modes = vx.mechanics.modes(solid, energy, solid.n_vertices + 1)  # the last one is half of all modes up
    value, mode = float(modes.values[-1]), np.asarray(modes.displacements[-1])
    size, duration, counts = 1e-5, config.friction / value, 4 * 2 ** np.arange(5)
    start = solid.with_vertices(solid.vertices + size * mode)
    errors = np.zeros((2, len(counts)))
    for order, i in np.ndindex(errors.shape):
        times = np.linspace(0, duration, counts[i] + 1)
        movie = move(config, start, energy, times, order=order + 1, relaxation=EXACT)
        amplitude = np.sum(np.asarray(movie.tissue.vertices - solid.vertices) * mode) / size
        errors[order, i] = abs(amplitude / np.exp(-1) - 1)
    return {"steps": 1 / counts, "errors": errors}


def quench(config: Config, first: Any, energy: Any, n: int) -> dict[str, np.ndarray]:
    """Times, energies, and edge and time of each transition, with `n` steps."""
    times = config.quench * np.arange(n + 1) / n
    movie = move(config, first, energy, times, relaxation=vx.Relaxation(contact_range=None))
    frames, edges = np.nonzero(np.asarray(movie.flipped))
    events = np.stack([edges, times[frames]], axis=1).reshape(-1, 2)
    return {"times": times, "energies": np.asarray(movie.energies), "events": events}


def largest_shift(events: np.ndarray, reference: np.ndarray) -> float:
    """The largest difference in time between the first transitions of an edge in two runs."""
    times, others = (dict(reversed(x.tolist())) for x in (events, reference))
    return max((abs(times[edge] - others[edge]) for edge in times if edge in others), default=0.0)


def measure_noise(config: Config, solid: Any, energy: Any) -> dict[str, np.ndarray]:
    """Eigenvalues, and the energy of each mode over the temperature."""
    modes = vx.mechanics.modes(solid, energy, 2 * solid.n_vertices)
    values, vectors = np.asarray(modes.values)[2:], np.asarray(modes.displacements)[2:]
    temperature, dt, friction = 1e-6, 0.4, SubstrateFriction(config.friction)
    noise: Any = {"activity": vx.activities.ThermalNoise(temperature), "key": config.seed}
    times = dt * np.arange(config.noise_steps + 1)
    movie = vx.evolve(solid, energy, friction, times, relaxation=FIXED, **noise)
    moved = np.asarray(movie.frames.vertices - solid.vertices)[config.noise_steps // 10 :]
    amplitudes = moved.reshape(len(moved), -1) @ vectors.reshape(len(values), -1).T
    # Implicit Euler steps give λ <q²> = T / (1 + λ dt / 2 ζ).
    damped = 1 + values * dt / (2 * config.friction)
    energies = values * (amplitudes**2).mean(axis=0) * damped / temperature
    return {"eigenvalues": values, "mode_energies": energies}


def measure_gradients(config: Config, solid: Any, energy: Any) -> dict[str, np.ndarray]:
    """Widths of central differences, and the relative error of the slope by each adjoint."""
    key = jax.random.key(config.seed + 1)
    start, shapes = bend(solid, 0.02, key), (solid.vertices.shape, (solid.n_cells,))
    draws = [jax.random.normal(jax.random.fold_in(key, i), shape) for i, shape in enumerate(shapes)]
    targets = jnp.asarray(energy.target_shape_factor)

    @eqx.filter_jit
    def cost(x: Any, adjoint: Any = vx.ImplicitDifferentiation()) -> Any:
        friction, changed = SubstrateFriction(config.friction * (1 + x)), targets + x * draws[1]
        options: Any = {"relaxation": EXACT, "adjoint": adjoint, "throw": False}
        movie = vx.evolve(start, ShapeFactorEnergy(changed), friction, [0.0, 0.1, 0.4], **options)
        return jnp.sum(draws[0] * movie.tissue.vertices**2)

    zero, adjoints = jnp.array(0.0), (vx.ImplicitDifferentiation(), vx.EquilibriumPropagation(beta=1e-5))
    slopes = [float(eqx.filter_jit(jax.grad(lambda x, a=a: cost(x, a)))(zero)) for a in adjoints]
    widths = 10.0 ** np.arange(-7, -1.5, 0.5)
    differences = np.array([float(cost(zero + h) - cost(zero - h)) / (2 * h) for h in widths])
    errors = [np.abs(differences / slope - 1) for slope in slopes]
    return {"differences": widths, "gradient_errors": np.stack(errors)}


def measure_control(config: Config, solid: Any, energy: Any) -> dict[str, np.ndarray]:
    """Errors at the end for both orders and all tolerances, and numbers of steps."""
    start = bend(solid, 0.02, jax.random.key(config.seed + 2))
    # In very short steps rounding keeps forces above the tolerance of EXACT.
    fine = move(config, start, energy, np.linspace(0, 1, 1001), order=2, relaxation=FIXED)
    errors = np.zeros((2, len(config.tolerances)))
    counts = np.zeros_like(errors)
    for order, i in np.ndindex(errors.shape):
        control = vx.dynamics.PIController(config.tolerances[i], max_steps=400)
        options: Any = {
            "stepsize_controller": control,
            "order": order + 1,
            "relaxation": FIXED,
            "throw": False,
        }
        friction, times = SubstrateFriction(config.friction), np.linspace(0, 1, 3)
        movie = vx.evolve(start, energy, friction, times, **options)
        errors[order, i] = jnp.max(jnp.abs(movie.tissue.vertices - fine.tissue.vertices))
        counts[order, i] = (movie.steps > 0).sum()
    return {"control_errors": errors, "control_steps": counts}


@plotting.house_style()
def plot_checks(config: Config, results: Any) -> Any:
    """One panel per check."""
    figure, ((decay, energies, events), (noise, gradients, control)) = plotting.new_figure(2, 3, width=2.6)
    colours, log = plotting.SERIES, {"xscale": "log", "yscale": "log"}
    for order, errors in enumerate(results.decay_errors, 1):
        colour, steps = colours[order - 1], results.decay_steps
        decay.plot(steps, errors, "o", ms=3, color=colour, label=f"order {order}")
        decay.plot(steps, errors[-1] * (steps / steps[-1]) ** order, color=colour, lw=0.8)
    decay.set(
        xlabel=r"$\Delta t\,\lambda / \zeta$", ylabel="relative error", title="1. decay of a mode", **log
    )
    decay.xaxis.set_minor_formatter(NullFormatter())
    last = len(results.quench_times) - 1
    for colour, i in zip(colours, dict.fromkeys((0, min(2, last), last)), strict=False):
        times, style = results.quench_times[i], {"marker": ".", "ms": 4} if i == 0 else {}
        label = f"$\\Delta t$ = {times[1]:.2g}"
        energies.plot(times, results.quench_energies[i], color=colour, label=label, **style)
    energies.set(xlabel="time", ylabel="energy", title="2. a quench")
    edges = list(dict.fromkeys(results.events[-1][:, 0].tolist()))
    runs_of_steps = list(zip([t[1] - t[0] for t in results.quench_times], results.events, strict=True))
    for k, edge in enumerate(edges):
        points = [(step, t) for step, e in runs_of_steps for t in e[e[:, 0] == edge, 1][:1]]
        events.plot(*np.array(points).T, ".-", ms=4, lw=0.8, color=colours[k % len(colours)])
    for step, each in runs_of_steps:
        others = each[~np.isin(each[:, 0], edges), 1]
        events.plot(np.full(len(others), step), others, "x", ms=3.5, color=plotting.INK)
    events.set(xscale="log", xlabel=r"$\Delta t$", ylabel="time of each T1", title="3. transitions")
    noise.plot(results.eigenvalues, results.mode_energies, "o", ms=2.5, color=colours[0])
    noise.axhline(1, color=plotting.INK, lw=0.8, ls=":")
    noise.set(xscale="log", xlabel=r"eigenvalue $\lambda$", ylim=(0, 2), title="4. equipartition")
    noise.set_ylabel(r"$\lambda \langle q^2 \rangle / T$")
    for name, errors, colour in zip(
        ("implicit", "propagation"), results.gradient_errors, colours, strict=False
    ):
        gradients.plot(results.differences, errors, "o-", ms=3, lw=0.8, color=colour, label=name)
    gradients.set(xlabel="width of the difference", ylabel="relative error", **log)
    gradients.set_title("5. gradient against differences")
    for order, (errors, counts) in enumerate(
        zip(results.control_errors, results.control_steps, strict=True), 1
    ):
        style = {"ms": 3, "lw": 0.8, "color": colours[order - 1], "label": f"order {order}"}
        control.plot(config.tolerances, errors, "o-", **style)
        for x, y, n in zip(config.tolerances, errors, counts, strict=True):
            offset: Any = {"xytext": (3, -7), "textcoords": "offset points", "fontsize": 6}
            control.annotate(f"{n:.0f}", (x, y), **offset)
    control.set(xlabel="tolerance of a step", ylabel="error at the end", title="6. controlled steps", **log)
    for ax in (decay, energies, gradients, control):
        ax.legend()
    return figure
