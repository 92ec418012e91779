"""Oscillatory shear of the hexagonal lattice (Tong et al. 2022, doi:10.1371/journal.pcbi.1010135)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import hexagon_index

import vertax as vx
from vertax.energies import AreaElasticity, PerimeterElasticity

STRAIN = 1e-4


class OscillatoryShear(eqx.Module):
    """A box under oscillatory simple shear."""

    lattice: jax.Array
    frequency: jax.Array

    def __call__(self, time):
        shear = STRAIN * jnp.sin(self.frequency * time)
        return vx.Periodic(
            self.lattice + shear * self.lattice @ jnp.array([[0.0, 0.0], [1.0, 0.0]])
        )


@pytest.mark.slow  # five times 256 steps of second order
def test_hexagonal_lattice_is_a_standard_linear_solid():
    stiffness, p0, friction = 0.7, 3.4, 1.3
    tissue = vx.initialise.hexagonal(2, 2)
    tissue = eqx.tree_at(lambda t: t.softening, tissue, 0 * tissue.softening)
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(stiffness, p0)
    lattice, area = tissue.boundary.lattice, tissue.areas.sum()

    def sheared_energy(frame, shear):
        sheared_lattice = frame.boundary.lattice @ jnp.array([[1.0, 0.0], [shear, 1.0]])
        return energy(frame.carried(vx.Periodic(sheared_lattice)))

    stress = lambda frame: jax.grad(lambda shear: sheared_energy(frame, shear))(0.0) / area
    unit = stiffness * (1 - p0 / hexagon_index())
    low, high = 2 * 3**0.5 * unit, 3 * 3**0.5 * unit
    # Shear forces the vertices along one mode u; its eigenvalue λ follows from (u·f)² / λ = (high - low) A.
    force = jax.grad(lambda x: stress(tissue.with_vertices(x)))(tissue.vertices) * area
    relaxation_time = friction * (high - low) * area / jnp.sum(force**2)
    relaxation = vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-11)
    steps = 64
    for frequency in (0.3, 1.0, 3.0, 10.0, 30.0):
        times = 2 * np.pi / frequency * np.arange(4 * steps + 1) / steps
        movie = vx.evolve(
            tissue,
            energy,
            vx.dissipations.SubstrateFriction(friction),
            times,
            boundary=OscillatoryShear(lattice, jnp.array(frequency)),
            order=2,
            relaxation=relaxation,
        )
        stresses = np.asarray(eqx.filter_jit(eqx.filter_vmap(stress))(movie.frames))[-steps:]
        phase = frequency * times[-steps:]
        storage = 2 * np.mean(stresses * np.sin(phase)) / STRAIN
        loss = 2 * np.mean(stresses * np.cos(phase)) / STRAIN
        x = frequency * relaxation_time
        np.testing.assert_allclose(storage, low + (high - low) * x**2 / (1 + x**2), rtol=2e-3)
        np.testing.assert_allclose(loss, (high - low) * x / (1 + x**2), rtol=3e-3)
