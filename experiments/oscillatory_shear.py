r"""Storage and loss modulus of tissues under oscillatory shear, against frequency.

The box is sheared by a small oscillating strain, and vertices move against friction. The component of the
stress in phase with the strain is the storage modulus $G'$, the one a quarter of a period ahead the loss
modulus $G''$. The hexagonal lattice is a standard linear solid with the plateaus $2\sqrt3 K_P (1 - p_0/c)$
and $3\sqrt3 K_P (1 - p_0/c)$, $c = \sqrt{8\sqrt3}$ (Tong et al. 2022, doi:10.1371/journal.pcbi.1010135); a
lattice of irregular hexagons is a Maxwell fluid; $G^*$ of a disordered tissue follows from its Hessian.
"""

import time
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from pydantic import Field, field_validator

import vertax as vx
from experiments._shared import HEXAGON, scan
from vertax import mechanics, plotting, runs
from vertax.dissipations import SubstrateFriction
from vertax.energies import AreaElasticity, PerimeterElasticity

Sample = tuple[vx.Tissue, vx.AbstractEnergy, Any]
"""A tissue at equilibrium, its energy, and the expected complex moduli."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    frequencies: list[float] = Field(
        default_factory=lambda: [round(float(w), 3) for w in np.geomspace(0.1, 100, 13)], min_length=2
    )
    """Angular frequencies."""
    shape_factor: float = Field(default=3.4, gt=0, lt=HEXAGON)
    """Target perimeter of cells of area 1; the lattice is solid below 3.722."""
    fluid_shape_factor: float = Field(default=3.9, gt=HEXAGON, lt=5)
    """Target perimeter of the cells of the fluid lattice."""
    stiffness: float = Field(default=0.7, gt=0)
    """Stiffness of perimeters; that of areas is 1."""
    friction: float = Field(default=1.3, gt=0)
    """Friction of a vertex with the substrate."""
    strain: float = Field(default=1e-4, gt=0)
    """Amplitude of the shear strain."""
    steps: int = Field(default=64, ge=8)
    """Steps of second order per period."""
    cycles: int = Field(default=4, ge=1)
    """Periods; the last one is measured."""
    n_cells: int = Field(default=25, ge=0)
    """Cells of the disordered tissue; 0 skips it."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(
        transitions=False, contacts=False, tolerance=1e-10
    )
    """Relaxation of each step."""

    @field_validator("frequencies")
    @classmethod
    def _positive(cls, value: list[float]) -> list[float]:
        if min(value) <= 0:
            raise ValueError(f"must all be positive, but the least is {min(value)}")
        return value


class OscillatingBox(eqx.Module):
    """A periodic boundary under pure shear, at fixed area, as a function of time."""

    lattice: jax.Array
    strain: jax.Array
    frequency: jax.Array

    def __call__(self, time: jax.Array) -> vx.Periodic:
        return pure_shear(self.lattice, self.strain * jnp.sin(self.frequency * time))


def pure_shear(lattice: jax.Array, strain: jax.Array) -> vx.Periodic:
    """The boundary after a pure shear strain."""
    cosh, sinh = jnp.cosh(0.5 * strain), jnp.sinh(0.5 * strain)
    return vx.Periodic(lattice @ jnp.array([[cosh, sinh], [sinh, cosh]]))


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The largest errors of G' and G'' of each tissue, relative to themselves and to |G*|."""
    began, frequencies = time.perf_counter(), np.asarray(config.frequencies)
    samples = make_samples(config, frequencies)
    measured: dict[str, Any] = {}
    table: dict[str, Any] = {"frequency": frequencies}
    metrics: dict[str, Any] = {}
    for name, (tissue, energy, expected) in samples.items():
        compute = partial(measure, config, tissue, energy)
        values: Any = scan(folder, name, config.frequencies, compute, progress=progress)["modulus"]
        measured[name] = values
        for label, moduli in (("measured", values), ("expected", expected)):
            table |= {f"{name}_storage_{label}": moduli.real, f"{name}_loss_{label}": moduli.imag}
        metrics[name] = {
            "storage_error": np.max(np.abs(values.real / expected.real - 1)),
            "loss_error": np.max(np.abs(values.imag / expected.imag - 1)),
            "error": np.max(np.abs(values - expected) / np.abs(expected)),
        }
    folder.save_table("moduli", table)
    expected = {name: moduli for name, (_, _, moduli) in samples.items()}
    folder.save_figure("moduli", plot_moduli(frequencies, measured, expected))
    return metrics | {"seconds": time.perf_counter() - began}


def make_samples(config: Config, frequencies: np.ndarray) -> dict[str, Sample]:
    """The solid lattice, the fluid lattice and the disordered tissue."""
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(config.stiffness, config.shape_factor)
    lattice = vx.initialise.hexagonal(2, 2, softening=0.0)  # the plateaus hold without softening
    unit = config.stiffness * (1 - config.shape_factor / HEXAGON)
    low, high = 2 * 3**0.5 * unit, 3 * 3**0.5 * unit
    # Shear forces act along one mode; its eigenvalue follows from the difference of the plateaus.
    area = lattice.areas.sum()
    tension = lambda vertices: mechanics.stress(lattice.with_vertices(vertices), energy)[0, 1]
    force = jax.grad(tension)(lattice.vertices) * area
    relaxation_time = config.friction * (high - low) * area / jnp.sum(force**2)
    x = 1j * frequencies * float(relaxation_time)
    samples = {
        "lattice": (lattice, energy, low + (high - low) * x / (1 + x)),
        "fluid lattice": fluid_lattice(config, lattice, frequencies),
    }
    if config.n_cells:
        key, friction = jax.random.key(config.seed), SubstrateFriction(config.friction)
        first = vx.initialise.periodic_voronoi(config.n_cells, key=key, lloyd_steps=2)
        tissue = runs.RelaxationSection(contacts=False).build()(first, energy).tissue
        moduli = mechanics.complex_modulus(tissue, energy, friction, jnp.asarray(frequencies), angle=0.0)
        samples["disordered"] = (tissue, energy, np.asarray(moduli))
    return samples


def fluid_lattice(config: Config, lattice: Any, frequencies: np.ndarray) -> Sample:
    r"""Irregular hexagons with their target areas and perimeters, which are a Maxwell fluid.

    One of the two sublattices of vertices is shifted by $u$: areas stay and perimeters grow. A shear strain
    and a further shift change perimeters by $a \gamma + b \cdot u$. Each cell has two vertices, which move by
    half the shift, so the modulus is $K_P a^2$ and relaxes at the rate $2 K_P b^2 / \zeta$.
    """
    # Colour vertices 0 and 1 so that neighbours differ; the graph is bipartite.
    ends, kinds = np.asarray(lattice.topology.edge_vertices), {0: 0}
    while len(kinds) < lattice.n_vertices:
        kinds |= {b: 1 - kinds[a] for a, b in np.r_[ends, ends[:, ::-1]].tolist() if a in kinds}
    sublattice = np.array([[kinds[k]] for k in range(lattice.n_vertices)], float)

    @jax.jit
    def perimeter(strain: jax.Array, shift: jax.Array) -> jax.Array:
        shifted = lattice.with_vertices(lattice.vertices + sublattice * shift)
        return shifted.carried(pure_shear(lattice.boundary.lattice, strain)).perimeters[0]

    target, zero = config.fluid_shape_factor, jnp.zeros(())
    direction = jnp.array([np.cos(0.4), np.sin(0.4)])
    excess = lambda length: float(perimeter(zero, length * direction)) - target
    shift = scipy.optimize.root_scalar(excess, bracket=(0.0, 2.0)).root * direction
    a, b = jax.grad(perimeter, argnums=(0, 1))(zero, shift)
    rate = 2 * config.stiffness * float(b @ b) / config.friction
    tissue = lattice.with_vertices(lattice.vertices + sublattice * shift)
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(config.stiffness, target)
    x = 1j * frequencies / rate
    return tissue, energy, config.stiffness * float(a) ** 2 * x / (1 + x)


def measure(config: Config, tissue: Any, energy: Any, frequency: float) -> dict[str, np.ndarray]:
    """The complex modulus of the last period."""
    steps = config.steps
    times = 2 * np.pi / frequency * np.arange(config.cycles * steps + 1) / steps
    box = OscillatingBox(tissue.boundary.lattice, jnp.asarray(config.strain), jnp.asarray(frequency))
    options: Any = {"order": 2, "boundary": box, "relaxation": config.relaxation.build()}
    movie = vx.Evolution(SubstrateFriction(config.friction), times, **options)(tissue, energy)
    stresses = all_stresses(movie.frames, energy) - mechanics.stress(tissue, energy)
    stress, phase = np.asarray(stresses)[-steps:, 0, 1], frequency * times[-steps:]
    modulus = 2 * np.mean(stress * (np.sin(phase) + 1j * np.cos(phase))) / config.strain
    return {"modulus": np.asarray(modulus)}


@eqx.filter_jit
def all_stresses(frames: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
    """The stress of each frame."""
    return eqx.filter_vmap(lambda frame: mechanics.stress(frame, energy))(frames)


@plotting.house_style()
def plot_moduli(frequencies: np.ndarray, measured: Any, expected: Any) -> Any:
    """Measured (points) and expected (lines) moduli against frequency, a panel per tissue."""
    figure, (axes,) = plotting.new_figure(1, len(measured), width=2.6)
    parts = (("storage $G'$", np.real), ("loss $G''$", np.imag))
    for ax, (name, moduli) in zip(axes, measured.items(), strict=True):
        for colour, (label, part) in zip(plotting.SERIES, parts, strict=False):
            ax.plot(frequencies, part(moduli), "o", ms=3.5, color=colour, label=label)
            ax.plot(frequencies, part(expected[name]), color=colour, lw=0.9)
        ax.set(xscale="log", xlabel=r"frequency $\omega$", ylabel="modulus", title=name)
        ax.set_ylim(0, None)
    axes[0].legend()
    return figure
