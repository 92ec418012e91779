"""Patterns and waves against linear theory, and rates recovered from a movie."""

import importlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, NO_CONTACT, random_tissue

import vertax as vx
from vertax.dissipations import SubstrateFriction
from vertax.energies import AreaElasticity, PerimeterElasticity
from vertax.signals import AbstractReaction, Signals

KEY = jax.random.key(0)


class Schnakenberg(AbstractReaction):
    """Its fixed point is (1, 0.9), with the Jacobian `JACOBIAN`."""

    def __call__(self, concentrations, cells, time):
        u, v = concentrations
        return jnp.stack([0.1 - u + u**2 * v, 0.9 - u**2 * v])


JACOBIAN = np.array([[0.8, 1.0], [-1.8, -1.0]])
DIFFUSION = 0.3 * np.array([1.0, 9.0])  # the pattern appears above a ratio of 8.6


def spectrum(values, tissue, largest):
    """Wave numbers up to a largest one, and the power of values of cells."""
    lattice, n = np.asarray(tissue.boundary.lattice), 15
    numbers = np.stack(np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1)), -1).reshape(-1, 2)
    vectors = 2 * np.pi * numbers @ np.linalg.inv(lattice).T
    wave_numbers = np.linalg.norm(vectors, axis=1)
    vectors = vectors[(wave_numbers > 0) & (wave_numbers < largest)]
    phases = np.exp(-1j * vectors @ np.asarray(tissue.centroids).T)
    return np.linalg.norm(vectors, axis=1), np.abs(phases @ (values - np.mean(values))) ** 2


def perturbed(n_cells):
    noise = jax.random.normal(KEY, (2, n_cells))
    return np.array([1.0, 0.9])[:, None] * (1 + 0.01 * np.asarray(noise))


@pytest.mark.thorough
def test_the_wavelength_of_a_turing_pattern_is_that_of_the_fastest_mode():
    tissue = vx.initialise.hexagonal(24, 24)
    spacing = float(tissue.boundary.lattice[0, 0]) / 24
    # Eigenvalues of the exchange on the hexagonal lattice, averaged over the directions of the wave vector.
    angles = np.arange(6) * np.pi / 3
    steps = spacing * np.stack([np.cos(angles), np.sin(angles)])
    wave_numbers = np.linspace(0.1, np.pi / spacing, 2000)
    directions = np.linspace(0, np.pi / 3, 7)[:-1]
    directions = np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    projections = wave_numbers[:, None, None] * (directions @ steps)
    decay = 2 / (3 * spacing**2) * np.sum(1 - np.cos(projections), axis=-1).mean(axis=-1)
    growth = [np.linalg.eigvals(JACOBIAN - x * np.diag(DIFFUSION)).real.max() for x in decay]
    fastest = wave_numbers[np.argmax(growth)]
    assert 0.01 < max(growth) < 0.03

    signals = Signals(Schnakenberg(), DIFFUSION, initial=perturbed(576), max_steps=20_000)

    @eqx.filter_jit
    def run(signals, dt):
        _, state = signals.drive(signals.init(tissue, KEY), tissue, None, 0 * dt, dt, KEY)
        return signals.record(state, tissue)[0]

    activator = np.asarray(run(signals, jnp.array(400.0)))
    assert np.std(activator) > 0.1  # saturated
    k, power = spectrum(activator, tissue, 1.5 * fastest)
    assert np.sum(k * power) / np.sum(power) == pytest.approx(fastest, rel=0.05)


@pytest.mark.slow
def test_a_turing_pattern_survives_flow():
    tissue = random_tissue(80, 0)
    lattice = tissue.boundary.lattice
    movie = vx.evolve(
        tissue,
        vx.energies.ShapeFactorEnergy(3.7),
        SubstrateFriction(1.0),
        np.linspace(0, 200, 81),
        activity=Signals(
            Schnakenberg(), DIFFUSION * [1, 1.5], initial=perturbed(80), max_steps=2000
        ),
        boundary=lambda time: vx.Periodic(lattice.at[1].add(0.01 * time * lattice[0])),
        relaxation=NO_CONTACT,
    )
    assert movie.num_t1 > 50
    assert np.std(movie.signals[-1, 0]) > 0.2


class Erk(AbstractReaction):
    """Deviations of ERK activity and target area from 1: area activates ERK, ERK decreases the target."""

    activation: float
    contraction: float

    def __call__(self, concentrations, cells, time):
        erk, target = concentrations - 1
        rates = [
            self.activation * (cells.areas - 1) - erk - 20 * erk**3,
            -self.contraction * erk - target,
        ]
        return jnp.stack(rates)


@pytest.mark.slow
def test_erk_waves_have_the_wavelength_and_the_speed_of_linear_theory():
    # Linear theory (Boocock et al. 2021, doi:10.1038/s41567-020-01037-7) of the area strain θ, the activity e
    # and the target area a, with the longitudinal modulus C: ζ ∂θ/∂t = ∂²(C θ - K a)/∂x².
    n, stiffness, friction, diffusion, reaction = 40, 20.0, 12.0, 0.1, Erk(60.0, 0.3)
    tissue = vx.initialise.hexagonal(n, 2)
    width = float(tissue.boundary.lattice[0, 0])
    energy = PerimeterElasticity(1.0, 3.4)
    modulus = vx.mechanics.elastic_tensor(tissue, AreaElasticity(stiffness, 1.0) + energy)[0, 0]

    def matrix(q):
        return np.array(
            [
                [-(q**2) * modulus / friction, 0, q**2 * stiffness / friction],
                [reaction.activation, -1 - diffusion * q**2, 0],
                [0, -reaction.contraction, -1],
            ]
        )

    # Waves that travel to the right, of all wavelengths, with random amplitudes.
    rng, x, corners = (
        np.random.default_rng(0),
        *(np.asarray(positions)[:, 0] for positions in (tissue.centroids, tissue.vertices)),
    )
    numbers = np.arange(1, n // 2)
    waves, start, shift = [], np.ones((2, 2 * n)), np.zeros(len(corners))
    for q in 2 * np.pi * numbers / width:
        values, vectors = np.linalg.eig(matrix(q))
        at = np.argmax(np.where(values.imag < 0, values.real, -np.inf))
        waves.append(values[at])
        strain, erk, target = (
            1e-3 * (rng.normal() + 1j * rng.normal()) * vectors[:, at] / vectors[1, at]
        )
        start += np.real(np.stack([erk, target])[:, None] * np.exp(1j * q * x))
        shift += np.real(strain / (1j * q) * np.exp(1j * q * corners))
    fastest = numbers[np.argmax(np.real(waves))]

    signals = Signals(
        reaction,
        [diffusion, 0.0],
        initial=start,
        couple=lambda c, tissue: AreaElasticity(stiffness, c[1]),
        diluted=False,
    )
    movie = vx.evolve(
        tissue.with_vertices(tissue.vertices.at[:, 0].add(shift)),
        energy,
        SubstrateFriction(friction, per="area"),
        np.linspace(0, 12, 49),
        substeps=10,
        activity=signals,
        relaxation=FIXED_TOPOLOGY,
    )
    phases = np.exp(-2j * np.pi * numbers[:, None] * x / width)
    amplitudes = phases @ (np.asarray(movie.signals[:, 0]) - 1).T
    power = np.abs(amplitudes[:, -1]) ** 2
    assert np.sum(numbers * power) / np.sum(power) == pytest.approx(fastest, rel=0.1)
    strongest = np.argmax(power)
    phase = np.unwrap(np.angle(amplitudes[strongest, 24:]))
    frequency = np.polyfit(movie.times[24:], phase, 1)[0]
    assert frequency == pytest.approx(
        waves[strongest].imag, rel=0.1
    )  # speed = frequency / wave number
    growth = np.polyfit(movie.times[24:], np.log(np.abs(amplitudes[strongest, 24:])), 1)[0]
    assert growth == pytest.approx(waves[strongest].real, abs=0.05)


@pytest.mark.thorough
def test_rates_are_recovered_from_a_movie_of_shapes_and_signals(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    recovered = importlib.import_module("signal_rates").recover()
    for seed in (0, 1):
        errors, deviations = recovered(seed)
        assert (deviations < 0.3).all()
        assert (np.abs(errors) < 3 * deviations).all()
