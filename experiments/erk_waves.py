"""Waves of ERK activity and contraction in a periodic tissue, against linear theory.

Stretch activates ERK, and ERK decreases the target area of a cell, both with a delay (Boocock et al. 2021,
doi:10.1038/s41567-020-01037-7). Small waves of all wavelengths start together and travel to the right; the
fastest growing one dominates. Its growth rate and frequency are compared with the eigenvalues of

ζ ∂θ/∂t = ∂²(C θ - K a)/∂x²,  ∂e/∂t = β θ - e + D ∂²e/∂x²,  ∂a/∂t = -α e - a

for the area strain θ and the deviations e of the activity and a of the target area, in units of the delay.
"""

import time
from typing import Any

import numpy as np
from pydantic import Field

import vertax as vx
from vertax import plotting, runs
from vertax.energies import AreaElasticity, PerimeterElasticity
from vertax.plotting import INK, SERIES


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    columns: int = Field(default=40, ge=6)
    """Number of cells along the wave; there are two rows."""
    duration: float = Field(default=30.0, gt=0)
    """Duration, in units of the delay."""
    frames: int = Field(default=120, ge=12)
    """Frames after the first one."""
    substeps: int = Field(default=10, ge=1)
    """Steps per frame."""
    activation: float = Field(default=60.0, ge=0)
    """Activity per area strain, β."""
    contraction: float = Field(default=0.3, ge=0)
    """Decrease of the target area per activity, α."""
    saturation: float = Field(default=20.0, ge=0)
    """Coefficient of the cubic term that limits the activity."""
    diffusion: float = Field(default=0.1, ge=0)
    """Exchange of ERK between cells, D."""
    stiffness: float = Field(default=20.0, gt=0)
    """Stiffness of areas, K; that of perimeters is 1."""
    friction: float = Field(default=12.0, gt=0)
    """Friction per area, ζ."""
    amplitude: float = Field(default=1e-3, gt=0)
    """Amplitude of each wave at the start."""


class Erk(vx.signals.AbstractReaction):
    """Activity and target area, both 1 at rest."""

    activation: float
    contraction: float
    saturation: float

    def __call__(self, concentrations: Any, cells: Any, time: Any) -> Any:
        """The rates of change of both."""
        erk, target = concentrations - 1
        stretch = self.activation * (cells.areas - 1)
        rates = stretch - erk - self.saturation * erk**3, -self.contraction * erk - target
        return concentrations.at[0].set(rates[0]).at[1].set(rates[1])


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The growth rate and frequency of each mode in the first third, and those of linear theory."""
    began, n = time.perf_counter(), config.columns
    tissue = vx.initialise.hexagonal(n, 2)
    width = float(np.asarray(tissue.boundary.lattice)[0, 0])  # pyright: ignore[reportAttributeAccessIssue]
    passive, friction = PerimeterElasticity(1.0, 3.4), config.friction
    total = AreaElasticity(config.stiffness, 1.0) + passive
    modulus = float(vx.mechanics.elastic_tensor(tissue, total)[0, 0])
    x, corners = (np.asarray(p)[:, 0] for p in (tissue.centroids, tissue.vertices))
    numbers, rng = np.arange(1, n // 2), np.random.default_rng(config.seed)
    waves, start, shift = [], np.ones((2, 2 * n)), np.zeros(len(corners))
    for q in 2 * np.pi * numbers / width:
        value, (strain, *fields) = right_going(config, modulus, q)
        waves.append(value)
        amplitude = config.amplitude * (rng.normal() + 1j * rng.normal())
        start += np.real(amplitude * np.array(fields)[:, None] * np.exp(1j * q * x))
        shift += np.real(amplitude * strain / (1j * q) * np.exp(1j * q * corners))
    signals = vx.signals.Signals(
        Erk(config.activation, config.contraction, config.saturation),
        [config.diffusion, 0.0],
        initial=start,
        couple=lambda concentrations, tissue: AreaElasticity(config.stiffness, concentrations[1]),
        diluted=False,
    )
    movie = vx.evolve(
        tissue.with_vertices(tissue.vertices.at[:, 0].add(shift)),
        passive,
        vx.dissipations.SubstrateFriction(friction, per="area"),
        np.linspace(0, config.duration, config.frames + 1),
        substeps=config.substeps,
        activity=signals,
        relaxation=vx.Relaxation(transitions=None),
    )
    times, erk = np.asarray(movie.times), np.asarray(movie.signals)[:, 0] - 1
    amplitudes = np.exp(-2j * np.pi * numbers[:, None] * x / width) @ erk.T / n
    early = times <= config.duration / 3
    logarithms = np.unwrap(np.angle(amplitudes[:, early])), np.log(np.abs(amplitudes[:, early]))
    frequency, growth = (np.polyfit(times[early], y.T, 1)[0] for y in logarithms)
    theory: Any = np.array(waves)
    table = {"mode": numbers, "wavelength": width / numbers, "growth": growth, "frequency": -frequency}
    table |= {"growth_of_theory": theory.real, "frequency_of_theory": -theory.imag}
    folder.save_table("modes", table)
    folder.save_figure("waves", plot_waves(table, times, erk[:, np.argsort(x)], width))
    top = int(np.argmax(growth))
    return {
        "wavelength": float(width / numbers[top]),
        "wavelength_of_theory": float(width / numbers[np.argmax(theory.real)]),
        "speed": float(-frequency[top] * width / (2 * np.pi * numbers[top])),
        "speed_of_theory": float(-theory.imag[top] * width / (2 * np.pi * numbers[top])),
        "seconds": time.perf_counter() - began,
    }


def right_going(config: Config, modulus: float, q: float) -> tuple[complex, np.ndarray]:
    """The eigenvalue and the mode (θ, e, a) of the wave to the right that grows fastest, with e = 1."""
    elastic, active = -(q**2) * modulus / config.friction, q**2 * config.stiffness / config.friction
    decay = -1 - config.diffusion * q**2
    rows = [[elastic, 0, active], [config.activation, decay, 0], [0, -config.contraction, -1]]
    values: Any
    values, vectors = np.linalg.eig(np.array(rows))
    best = np.argmax(np.where(values.imag <= 0, values.real, -np.inf))
    return values[best], vectors[:, best] / vectors[1, best]


@plotting.house_style()
def plot_waves(table: dict[str, Any], times: np.ndarray, erk: np.ndarray, width: float) -> Any:
    """The growth rate and the frequency of the modes, and the activity in space and time."""
    figure, ((left, right),) = plotting.new_figure(1, 2, width=[3.0, 3.2])
    for k, name in enumerate(("growth", "frequency")):
        left.plot(table["mode"], table[f"{name}_of_theory"], color=SERIES[k])
        left.plot(table["mode"], table[name], "o", color=SERIES[k], label=name)
    left.axhline(0, color=INK, lw=0.6)
    shown = table["growth_of_theory"] > -0.5
    left.set(xlabel="wavelengths in the box", ylabel="rate × delay", xlim=(0, 1 + np.sum(shown)))
    left.set_ylim(-0.6, 1.3 * np.max(table["frequency_of_theory"][shown]))
    left.legend()
    image = right.imshow(
        erk, origin="lower", aspect="auto", cmap="RdBu_r", extent=(0, width, times[0], times[-1])
    )
    right.set(xlabel="position", ylabel="time / delay")
    figure.colorbar(image, ax=right, label="ERK activity, deviation")
    return figure
