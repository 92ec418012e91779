r"""Biased persistent random walk of a free pair of cells, a reference model of OpenVT.

The cells move with the speed $v$ in a common direction $(1 - b)\, u + b\, e_x$, normalised, where $u$ is a
random unit vector that is drawn again at the rate $1 / \tau$ (the rule of PhysiCell and Chaste). The mean of
the cosine of the angle to the x axis is a function $\mu(b)$, and velocities have the correlation

$$\langle v(0) \cdot v(t) \rangle / v^2 = \mu^2 + (1 - \mu^2)\, e^{-t / \tau}.$$

The persistence time and the bias are recovered from noisy tracks of the centre of mass.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy.optimize import brentq, curve_fit

import vertax as vx
from experiments._shared import comparison, processor_time, replicate_keys
from vertax import energies, plotting, runs

LAGS = np.arange(2, 13)
"""Lags of the fit, in frames. Errors of positions change the correlation at the lags 0 and 1 alone."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    speed: float = Field(default=0.1, gt=0)
    """Speed $v$, in units of the root of the area of a cell over time."""
    persistence: float = Field(default=0.1, gt=0)
    """Mean time $\\tau$ between changes of the direction."""
    bias: float = Field(default=0.5, ge=0, lt=1)
    """Bias $b$ towards the x axis."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    step: float = Field(default=0.02, gt=0)
    """Time step, and the time between frames."""
    frames: int = Field(default=200, ge=20)
    """Frames after the first one."""
    replicates: int = Field(default=100, ge=3)
    """Independent paths."""
    noise: float = Field(default=1e-4, ge=0)
    """Standard deviation of tracked positions."""


class BiasedWalk(vx.AbstractActivity):
    """Equal forces on all vertices, in a direction that is drawn again at a constant rate."""

    force: Any
    rate: Any
    bias: Any

    def init(self, tissue: vx.Tissue, key: Any) -> Any:
        """A random direction."""
        angle = jax.random.uniform(key, (), minval=0, maxval=2 * jnp.pi)
        return directions(self.bias, angle)

    def drive(self, state: Any, tissue: vx.Tissue, dissipation: Any, time: Any, dt: Any, key: Any) -> Any:
        """The forces on vertices, and the direction."""
        changed = jax.random.uniform(key) < -jnp.expm1(-self.rate * dt)
        state = jnp.where(changed, self.init(tissue, jax.random.fold_in(key, 1)), state)
        return vx.activities.Push(jnp.broadcast_to(self.force * state, tissue.vertices.shape)), state


def directions(bias: Any, angle: Any) -> Any:
    """The direction of a walk for the angle of the random vector."""
    x, y = (1 - bias) * jnp.cos(angle) + bias, (1 - bias) * jnp.sin(angle)
    return jnp.stack([x, y], axis=-1) / jnp.hypot(x, y)[..., None]


def mean_cosine(bias: float) -> float:
    """The mean $\\mu$ of the cosine of the angle between the direction and the x axis."""
    return float(np.mean(directions(bias, 2 * np.pi * (np.arange(4000) + 0.5) / 4000)[:, 0]))


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Drift, directionality and mean squared displacement of the paths; persistence time and bias."""
    tissue = vx.initialise.free_voronoi(2, key=config.seed, lloyd_steps=5)
    energy = energies.AreaElasticity(10.0, 1.0) + energies.PerimeterElasticity(1.0, 3.6)
    rest = vx.equilibrate(tissue, energy).tissue
    times, friction = config.step * np.arange(config.frames + 1), config.friction
    rate, force = 1 / config.persistence, friction * config.speed
    activity = BiasedWalk(*map(jnp.asarray, (force, rate, config.bias)))

    def walk(key: Any) -> np.ndarray:
        options: Any = {"activity": activity, "key": key, "throw": False}
        movie = vx.evolve(rest, energy, vx.dissipations.SubstrateFriction(friction), times, **options)
        if not movie.converged:
            folder.warn(f"A path has failed: {vx.RESULTS[movie.result]}")
        return np.asarray(movie.frames.vertices).mean(axis=1)

    keys = replicate_keys(config.seed, config.replicates)
    walk(keys[0])  # compiles
    paths, seconds = processor_time(lambda: np.stack([walk(key) for key in keys]))
    paths = paths - paths[:, :1]
    noise = np.random.default_rng(config.seed).normal(size=paths.shape)
    velocities = np.diff(paths + config.noise * noise, axis=1) / config.step
    lags = config.step * np.arange(1, config.frames // 2)
    steps = [paths[:, k:] - paths[:, :-k] for k in range(1, len(lags) + 1)]
    squared = np.array([np.mean(np.sum(step**2, axis=-1)) for step in steps])
    lengths = np.linalg.norm(steps[0], axis=-1).sum(axis=1)
    # The jackknife: the standard error by leaving out a path.
    n = config.replicates
    left_out = np.array([recover(config, np.delete(velocities, k, axis=0)) for k in range(n)])
    errors = np.sqrt((n - 1) * left_out.var(axis=0))
    persistence, bias = recover(config, velocities)
    drift = paths[:, -1, 0] / times[-1] / config.speed
    tracks = {f"{'xy'[i]}{k}": path[:, i] for k, path in enumerate(paths) for i in range(2)}
    folder.save_table("tracks", {"time": times} | tracks)
    expected = theory(config, lags)
    folder.save_table("squared_displacements", {"lag": lags, "measured": squared, "theory": expected})
    folder.save_figure("random_walk", plot_walk(config, paths, lags, squared, velocities))
    return {
        "drift_over_speed": comparison(drift.mean(), drift.std(ddof=1) / n**0.5, mean_cosine(config.bias)),
        "directionality": float(np.mean(np.linalg.norm(paths[:, -1], axis=-1) / lengths)),
        "squared_displacement_over_theory": float(squared[-1] / expected[-1]),
        "persistence": comparison(persistence, errors[0], config.persistence),
        "bias": comparison(bias, errors[1], config.bias),
        "seconds_per_step": seconds / n / config.frames,
    }


def correlation(config: Config, velocities: np.ndarray) -> np.ndarray:
    """The correlation of velocities at the lags of the fit, in units of the squared speed."""
    products = [np.mean(np.sum(velocities[:, k:] * velocities[:, :-k], axis=-1)) for k in LAGS]
    return np.array(products) / config.speed**2


def recover(config: Config, velocities: np.ndarray) -> tuple[float, float]:
    """Persistence time and bias from the velocities of the paths."""
    drift = np.clip(velocities[..., 0].mean() / config.speed, mean_cosine(0.0), 0.999)
    model = lambda lag, tau: drift**2 + (1 - drift**2) * np.exp(-lag / tau)
    (tau,), _ = curve_fit(model, config.step * LAGS, correlation(config, velocities), p0=10 * config.step)
    bias: Any = brentq(lambda b: mean_cosine(b) - drift, 0, 0.9999)
    return float(tau), float(bias)


def theory(config: Config, lags: np.ndarray) -> np.ndarray:
    """Mean squared displacements of a biased persistent walk."""
    mean, tau = mean_cosine(config.bias), config.persistence
    spread = 2 * tau**2 * (1 - mean**2) * (lags / tau + np.expm1(-lags / tau))
    return config.speed**2 * (mean**2 * lags**2 + spread)


@plotting.house_style()
def plot_walk(config: Config, paths: Any, lags: Any, squared: Any, velocities: Any) -> Any:
    """Paths, mean squared displacements and correlations of the velocity, with theory."""
    figure, ((left, middle, right),) = plotting.new_figure(1, 3, width=2.5)
    for path in paths:
        left.plot(*path.T, lw=0.5, color=plotting.SERIES[0], alpha=0.5)
    left.set(xlabel="x", ylabel="y", aspect="equal", title=f"{len(paths)} paths")
    left.set_adjustable("datalim")
    middle.loglog(lags, theory(config, lags), color=plotting.INK, lw=0.9, label="theory")
    middle.loglog(lags[::4], squared[::4], ".", color=plotting.SERIES[0], label="measured")
    middle.set(xlabel="lag", ylabel="mean squared displacement")
    middle.legend()
    times, mean = config.step * LAGS, mean_cosine(config.bias)
    curve = mean**2 + (1 - mean**2) * np.exp(-times / config.persistence)
    right.plot(times, curve, color=plotting.INK, lw=0.9, label="true")
    right.plot(times, correlation(config, velocities), ".", color=plotting.SERIES[0], label="noisy tracks")
    right.set(xlabel="lag", ylabel="correlation of velocities / $v^2$", ylim=(0, 1))
    right.legend()
    return figure
