r"""Oscillatory shear of the hexagonal lattice, and of a disordered tissue.

The box is sheared to and fro by a small strain and the vertices follow against friction, step by step.
What the stress has in phase with the strain is the storage modulus $G'$, what it has a quarter of a
period ahead the loss modulus $G''$. The lattice is a standard linear solid, with the plateaus $2\sqrt3
K_P (1 - p_0/c)$ and $3\sqrt3 K_P (1 - p_0/c)$, $c = \sqrt{8\sqrt3}$ (Tong et al. 2022,
doi:10.1371/journal.pcbi.1010135); of the disordered tissue $G^*$ is known from its Hessian.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Complex, Float
from pydantic import Field, field_validator

from vertax.dissipations import SubstrateFriction
from vertax.dynamics import Evolution
from vertax.energies import AbstractEnergy, AreaElasticity, PerimeterElasticity
from vertax.initialise import hexagonal, periodic_voronoi
from vertax.mechanics import complex_modulus, stress
from vertax.mesh import Periodic, Tissue
from vertax.runs import ExperimentConfig, Relaxation, RunFolder, side_by_side

from . import figures

HEXAGON = float(np.sqrt(8 * np.sqrt(3)))
"""The perimeter of a regular hexagon of area 1."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    frequencies: list[float] = Field(
        default_factory=lambda: [round(float(w), 3) for w in np.geomspace(0.1, 100, 13)],
        min_length=2,
    )
    """Angular frequencies."""
    shape_factor: float = Field(default=3.4, gt=0, lt=HEXAGON)
    """Target perimeter of cells of area 1; the lattice is solid below 3.722."""
    fluid_shape_factor: float = Field(default=3.9, gt=HEXAGON, lt=5)
    """Target perimeter of the cells of a fluid lattice."""
    stiffness: float = Field(default=0.7, gt=0)
    """Stiffness of perimeters; that of areas is 1."""
    friction: float = Field(default=1.3, gt=0)
    """Friction of a vertex with the substrate."""
    strain: float = Field(default=1e-4, gt=0)
    """Amplitude of the shear strain."""
    steps: int = Field(default=64, ge=8)
    """Steps of second order in a period."""
    cycles: int = Field(default=4, ge=1)
    """Periods, of which the last one is measured."""
    n_cells: int = Field(default=25, ge=0)
    """Cells of the disordered tissue; 0 for none."""
    relaxation: Relaxation = Relaxation(transitions=False, contacts=False, tolerance=1e-10)
    """How each step is found."""

    @field_validator("frequencies")
    @classmethod
    def _positive(cls, value: list[float]) -> list[float]:
        if min(value) <= 0:
            raise ValueError(f"must all be positive, but the least is {min(value)}")
        return value


class _Sheared(eqx.Module):
    """A box that is sheared to and fro, at fixed area and without rotation."""

    lattice: Float[Array, "2 2"]
    strain: Float[Array, ""]
    frequency: Float[Array, ""]

    def __call__(self, time: Float[Array, ""]) -> Periodic:
        half = 0.5 * self.strain * jnp.sin(self.frequency * time)
        cosh, sinh = jnp.cosh(half), jnp.sinh(half)
        return Periodic(self.lattice @ jnp.array([[cosh, sinh], [sinh, cosh]]))


class _Sample(NamedTuple):
    """A tissue at rest, and what its moduli should be."""

    tissue: Tissue
    energy: AbstractEnergy
    expected: Complex[np.ndarray, " frequencies"]


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: for each tissue the largest error of $G'$ and $G''$, each relative to itself and
    to $|G^*|$.
    """
    began = time.perf_counter()
    frequencies = np.asarray(config.frequencies)
    samples = _samples(config, frequencies)
    measured: dict[str, np.ndarray] = {}
    for name, sample in samples.items():

        def one(index: int, name: str = name, sample: _Sample = sample) -> dict[str, np.ndarray]:
            compute = lambda: {
                "modulus": _modulus(config, sample.tissue, sample.energy, frequencies[index])
            }
            return folder.part(f"{name} {frequencies[index]:g}", compute)

        parts = side_by_side(one, len(frequencies), folder, progress=progress, unit="frequency")
        measured[name] = np.stack([part["modulus"] for part in parts])
    columns: dict[str, Any] = {"frequency": frequencies}
    metrics: dict[str, Any] = {}
    for name, sample in samples.items():
        found: Any = measured[name]
        expected: Any = sample.expected
        for what, values in (("measured", found), ("expected", expected)):
            columns |= {f"{name}_storage_{what}": values.real, f"{name}_loss_{what}": values.imag}
        metrics[name] = {
            "storage_error": np.max(np.abs(found.real / expected.real - 1)),
            "loss_error": np.max(np.abs(found.imag / expected.imag - 1)),
            "error": np.max(np.abs(found - expected) / np.abs(expected)),
        }
    folder.save_table("moduli", columns)
    known = {name: sample.expected for name, sample in samples.items()}
    folder.save_figure("moduli", figures.moduli(frequencies, measured, known))
    return metrics | {"seconds": time.perf_counter() - began}


def _samples(config: Config, frequencies: Float[np.ndarray, " frequencies"]) -> dict[str, _Sample]:
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(config.stiffness, config.shape_factor)
    friction = SubstrateFriction(config.friction)
    # (The lattice is at rest as it is. Of ever so little softening the plateaus know.)
    lattice = hexagonal(2, 2, softening=0.0)
    unit = config.stiffness * (1 - config.shape_factor / HEXAGON)
    low, high = 2 * 3**0.5 * unit, 3 * 3**0.5 * unit
    # Shear pulls at vertices along one mode, whose eigenvalue follows from the difference of the plateaus.
    area = lattice.areas.sum()
    tension = lambda vertices: stress(lattice.with_vertices(vertices), energy)[0, 1]
    pull = jax.grad(tension)(lattice.vertices) * area
    relaxing = config.friction * (high - low) * area / jnp.sum(pull**2)
    x = 1j * frequencies * float(relaxing)
    samples = {
        "lattice": _Sample(lattice, energy, low + (high - low) * x / (1 + x)),
        "fluid lattice": _fluid(config, lattice, frequencies),
    }
    if config.n_cells:
        first = periodic_voronoi(config.n_cells, key=jax.random.key(config.seed), lloyd_steps=2)
        tissue = Relaxation(contacts=False).build()(first, energy).tissue
        known = complex_modulus(tissue, energy, friction, jnp.asarray(frequencies), angle=0.0)
        samples["disordered"] = _Sample(tissue, energy, np.asarray(known))
    return samples


def _fluid(
    config: Config, lattice: Tissue, frequencies: Float[np.ndarray, " frequencies"]
) -> _Sample:
    r"""Hexagons that are not regular, and have the area and the perimeter they want; and a Maxwell fluid.

    Every other vertex is shifted, all by the same: areas stay and perimeters grow. A shear strain and more
    such shift change perimeters by $a \gamma + b \cdot u$, and each cell has two vertices, which move by
    half the shift: so all that resists is $K_P a^2$, until it has relaxed at the rate $2 K_P b^2 / \zeta$.
    """
    assert isinstance(lattice.boundary, Periodic)
    box = lattice.boundary.lattice
    other = np.zeros((lattice.n_vertices, 1))
    # (Neighbours are of different kinds, and each vertex comes after one of its neighbours or is the first.)
    ends, kinds = np.asarray(lattice.topology.edge_vertices), {0: 0}
    while len(kinds) < lattice.n_vertices:
        kinds |= {b: 1 - kinds[a] for a, b in np.r_[ends, ends[:, ::-1]].tolist() if a in kinds}
    other[[vertex for vertex, kind in kinds.items() if kind]] = 1

    @jax.jit
    def perimeter(strain: Float[Array, ""], shift: Float[Array, "2"]) -> Float[Array, ""]:
        half = 0.5 * strain
        turn = jnp.array([[jnp.cosh(half), jnp.sinh(half)], [jnp.sinh(half), jnp.cosh(half)]])
        shifted = lattice.with_vertices(lattice.vertices + other * shift)
        return shifted.carried(Periodic(box @ turn)).perimeters[0]

    aim = config.fluid_shape_factor
    along = jnp.array([np.cos(0.4), np.sin(0.4)])
    zero = jnp.zeros(())
    excess = lambda x: float(perimeter(zero, x * along)) - aim
    length = scipy.optimize.root_scalar(excess, bracket=(0.0, 2.0)).root
    shift = length * along
    a, b = jax.grad(perimeter, argnums=(0, 1))(zero, shift)
    rate = 2 * config.stiffness * float(b @ b) / config.friction
    tissue = lattice.with_vertices(lattice.vertices + other * shift)
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(config.stiffness, aim)
    x = 1j * frequencies / rate
    return _Sample(tissue, energy, config.stiffness * float(a) ** 2 * x / (1 + x))


def _modulus(
    config: Config, tissue: Tissue, energy: AbstractEnergy, frequency: float
) -> np.ndarray:
    """The complex modulus, of the last period."""
    assert isinstance(tissue.boundary, Periodic)
    steps = config.steps
    times = 2 * np.pi / frequency * np.arange(config.cycles * steps + 1) / steps
    sheared = _Sheared(tissue.boundary.lattice, jnp.asarray(config.strain), jnp.asarray(frequency))
    evolution = Evolution(
        SubstrateFriction(config.friction),
        times,
        order=2,
        boundary=sheared,
        relaxation=config.relaxation.build(),
    )
    movie = evolution(tissue, energy)
    stresses = np.asarray(_stresses(movie.frames, energy) - stress(tissue, energy))[-steps:, 0, 1]
    phase = frequency * times[-steps:]
    return np.asarray(2 * np.mean(stresses * (np.sin(phase) + 1j * np.cos(phase))) / config.strain)


@eqx.filter_jit
def _stresses(frames: Tissue, energy: AbstractEnergy) -> Float[Array, "times 2 2"]:
    return eqx.filter_vmap(lambda frame: stress(frame, energy))(frames)
