r"""Fit moduli and viscosities of a tissue to stress in strain cycles of two periods, and predict a third.

The box is sheared in cycles $\gamma(t) = \gamma_0 \sin(2 \pi t / T)$. The measured stress is the force on the
box, $\sigma = \frac1A\,\partial (E + \Delta t\,R) / \partial F$, with the energy $E$ and the dissipation
$R$. Stresses of cycles of two periods, with noise, determine the stiffness of areas and of perimeters, the
viscosity of perimeters and the friction; the fitted material then predicts the stress at a third period.
The data are computed with finer time steps than the fit.
"""

import time
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from pydantic import Field

import vertax as vx
from experiments.oscillatory_shear import pure_shear
from vertax import plotting, runs
from vertax.dissipations import PerimeterViscosity, SubstrateFriction
from vertax.dynamics import Material
from vertax.energies import AreaElasticity, PerimeterElasticity

NAMES = ("stiffness of areas", "stiffness of perimeters", "viscosity of perimeters", "friction")


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: int = Field(default=16, ge=4)
    """Cells of the tissue."""
    truth: list[Annotated[float, Field(gt=0)]] = Field(
        default=[1.5, 0.6, 0.4, 0.8], min_length=4, max_length=4
    )
    """Stiffness of areas and of perimeters, viscosity of perimeters, and friction of a vertex."""
    target_perimeter: float = Field(default=3.5, gt=0)
    """Target perimeter of cells of area 1."""
    amplitude: float = Field(default=0.1, gt=0, lt=0.5)
    """Amplitude of the shear strain."""
    periods: list[Annotated[float, Field(gt=0)]] = Field(default=[1.0, 8.0], min_length=2, max_length=2)
    """The periods of the fitted cycles."""
    predicted: float = Field(default=3.0, gt=0)
    """The period of the predicted cycles."""
    steps: int = Field(default=24, ge=8)
    """Measurements, and time steps of the fit, per cycle."""
    refinement: int = Field(default=4, ge=1)
    """Time steps of the data for each step of the fit."""
    noise: float = Field(default=0.02, ge=0)
    """Standard deviation of the noise, in units of that of the stress."""
    epochs: int = Field(default=30, ge=1)
    """Iterations of Levenberg and Marquardt."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(transitions=False, tolerance=1e-8)
    """Relaxation of each step."""


class Cycles(eqx.Module):
    """The box of a run, two cycles at each period, as a function of time."""

    lattice: jax.Array
    amplitude: float
    periods: tuple[float, ...]

    def strain(self, time: jax.Array) -> jax.Array:
        """The shear strain at a time."""
        ends = 2 * np.cumsum([0.0, *self.periods])
        part = jnp.clip(jnp.searchsorted(ends, time, side="right") - 1, 0, len(self.periods) - 1)
        phase = (time - jnp.asarray(ends)[part]) / jnp.asarray(self.periods)[part]
        return self.amplitude * jnp.sin(2 * jnp.pi * phase)

    def __call__(self, time: jax.Array) -> vx.Periodic:
        return pure_shear(self.lattice, self.strain(time))

    def times(self, steps: int) -> np.ndarray:
        """Times of the steps of all cycles."""
        steps_of_period = [np.full(2 * steps, period / steps) for period in self.periods]
        return np.cumsum([0.0, *np.concatenate(steps_of_period)])


class StepPotential(vx.AbstractEnergy):
    """The energy and the dissipation of a step."""

    material: Any
    before: vx.Tissue
    dt: jax.Array

    def __call__(self, tissue: vx.Tissue) -> jax.Array:
        return self.material(tissue) + self.material.dissipation(tissue, self.before, self.dt)


class BoxForce(vx.costs.AbstractLeastSquaresCost):
    """Half the squared differences of the shear stress of each step and the measured one."""

    times: jax.Array
    measured: jax.Array

    @property
    def of_frames(self) -> bool:
        return True

    def residuals(self, tissue: vx.Tissue, energy: Any) -> jax.Array:
        return shear_stresses(tissue, energy, self.times) - self.measured


@eqx.filter_jit
def shear_stresses(frames: vx.Tissue, material: Material, times: jax.Array) -> jax.Array:
    """The shear stress at the end of each step between frames."""
    arrays, static = eqx.partition(frames, eqx.is_array)
    pick = lambda part: eqx.combine(jax.tree.map(lambda x: x[part], arrays), static)

    def one(now: vx.Tissue, before: vx.Tissue, dt: jax.Array) -> jax.Array:
        return vx.mechanics.stress(now, StepPotential(material, before, dt))[0, 1]

    return eqx.filter_vmap(one)(pick(slice(1, None)), pick(slice(None, -1)), jnp.diff(times))


def make_material(config: Config, values: Any) -> Material:
    """The material of four parameters."""
    areas, perimeters, viscosity, friction = jnp.asarray(values)
    energy = AreaElasticity(areas, 1.0) + PerimeterElasticity(perimeters, config.target_perimeter)
    return Material(energy, PerimeterViscosity(viscosity) + SubstrateFriction(friction))


def parameters(material: Any) -> np.ndarray:
    """The four parameters of a material."""
    (areas, perimeters), (viscosity, friction) = material.energy.terms, material.dissipation.terms
    parts = areas.stiffness, perimeters.stiffness, viscosity.viscosity, friction.coefficient
    return np.array([float(x) for x in parts])


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Relative errors of the parameters, and of the predicted stress."""
    began, relaxation = time.perf_counter(), config.relaxation.build()
    truth: Any = make_material(config, config.truth)
    first = vx.initialise.periodic_voronoi(config.n_cells, key=jax.random.key(config.seed), lloyd_steps=2)
    rest: Any = runs.RelaxationSection(tolerance=1e-10).build()(first, truth.energy).tissue
    fitted = Cycles(rest.boundary.lattice, config.amplitude, tuple(config.periods))
    unseen = Cycles(rest.boundary.lattice, config.amplitude, (config.predicted,))
    friction = SubstrateFriction(1.0)  # replaced by that of the material
    respond = lambda cycles, steps: vx.Evolution(
        friction, cycles.times(steps), boundary=cycles, relaxation=relaxation
    )

    def stress_of(cycles: Cycles, material: Material, refinement: int) -> np.ndarray:
        response = respond(cycles, refinement * config.steps)
        frames = response(rest, material).frames
        return np.asarray(shear_stresses(frames, material, response.times))[refinement - 1 :: refinement]

    exact = stress_of(fitted, truth, config.refinement)
    noise = config.noise * exact.std() * np.random.default_rng(config.seed).normal(size=exact.shape)
    response = respond(fitted, config.steps)
    cost = BoxForce(response.times, jnp.asarray(exact + noise))
    guess = make_material(config, 1.0 + 0.0 * jnp.asarray(config.truth))
    problem = vx.InverseProblem(rest, guess, cost, response=response)
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    fit = folder.fit("material", problem, solver, config.epochs, partial=True, progress=progress)
    values, true = parameters(fit.energy), np.asarray(config.truth)
    curves = {}
    for name, cycles in (("fitted", fitted), ("predicted", unseen)):
        times = cycles.times(config.steps)[1:]
        strain = np.asarray(cycles.strain(jnp.asarray(times)))
        stresses = {"true": exact if cycles is fitted else stress_of(cycles, truth, config.refinement)}
        stresses["model"] = stress_of(cycles, fit.energy, 1)
        stresses |= {"measured": exact + noise} if cycles is fitted else {}
        curves[name] = {"time": times, "strain": strain} | stresses
        folder.save_table(name, curves[name])
    folder.save_table("parameters", {"parameter": list(NAMES), "fitted": values, "true": true})
    folder.save_figure("cycles", plot_cycles(curves, config))
    errors = {
        name: np.sqrt(np.mean((c["model"] - c["true"]) ** 2)) / c["true"].std() for name, c in curves.items()
    }
    return {
        "relative_error": dict(zip(NAMES, values / true - 1, strict=True)),
        "stress_error": errors,
        "seconds": time.perf_counter() - began,
    }


@plotting.house_style()
def plot_cycles(curves: dict[str, Any], config: Config) -> Any:
    """Stress over strain in the last cycle of each period: data, fit and prediction."""
    figure, (axes,) = plotting.new_figure(1, 3, width=2.3)
    n = config.steps
    first, last = slice(n, 2 * n), slice(3 * n, 4 * n)
    parts = [("fitted", first, config.periods[0]), ("fitted", last, config.periods[1])]
    for ax, (name, part, period) in zip(axes, [*parts, ("predicted", first, config.predicted)], strict=True):
        strain, curve = curves[name]["strain"][part], curves[name]
        closed = lambda x, part=part: np.append(x[part], x[part][0])
        ax.plot(closed(curve["strain"]), closed(curve["true"]), color=plotting.INK, lw=0.8, label="true")
        if "measured" in curve:
            ax.plot(strain, curve["measured"][part], ".", color=plotting.SERIES[1], ms=3, label="measured")
        ax.plot(closed(curve["strain"]), closed(curve["model"]), "--", color=plotting.SERIES[0], label=name)
        ax.set(xlabel="shear strain", ylabel="shear stress", title=f"period {period:g}")
        ax.legend()
    return figure
