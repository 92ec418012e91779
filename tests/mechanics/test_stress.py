"""Stress of tissues and cells, pressures and tensions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax import mechanics
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity, ShapeFactorEnergy

N = 9
ENERGY = (
    AreaElasticity(jnp.linspace(1.0, 2.0, N), jnp.array(1.1))
    + PerimeterElasticity(jnp.array(1.4), jnp.linspace(3.5, 3.7, N))
    + LineTension(jnp.linspace(0.1, 0.3, 3 * N))
)
tissue = random_tissue(N, 2)


def test_pressures_and_tensions_are_sums_over_terms():
    area, perimeter, tension = ENERGY.terms
    np.testing.assert_allclose(mechanics.pressures(tissue, ENERGY), area.pressures(tissue))
    pull = perimeter.stiffness * (tissue.perimeters - perimeter.target_perimeter)
    expected = tension.tension + np.sum(np.asarray(pull)[tissue.topology.edge_cells], axis=1)
    np.testing.assert_allclose(mechanics.tensions(tissue, ENERGY), expected)


def test_pressures_and_tensions_determine_all_forces():
    # The energy of shape factors as another class, because shape factors mix areas and lengths.
    class Shapes(vx.AbstractEnergy):
        target: float

        def __call__(self, tissue):
            return jnp.sum((tissue.shape_factors - self.target) ** 2 + (tissue.areas - 1) ** 2)

    energy = Shapes(3.6)
    pressure, tension = mechanics.pressures(tissue, energy), mechanics.tensions(tissue, energy)

    def forces(f):
        return np.asarray(jax.grad(lambda x: f(tissue.with_vertices(x)))(tissue.vertices))

    rebuilt = forces(lambda t: jnp.sum(tension * t.edge_lengths) - jnp.sum(pressure * t.areas))
    np.testing.assert_allclose(rebuilt, forces(energy), atol=1e-12)


@eqx.filter_jit
def energy_of(tissue, energy, gradient):
    return energy(mechanics.deformed(tissue, gradient))


def stress_by_differences(tissue, energy, step=1e-6):
    slope = np.zeros((2, 2))
    for index in np.ndindex(2, 2):
        move = np.zeros((2, 2))
        move[index] = step
        at = lambda sign: energy_of(tissue, energy, jnp.asarray(np.eye(2) + sign * move))  # noqa: B023
        slope[index] = (at(1) - at(-1)) / (2 * step)
    return slope


def test_stress_against_differences_of_the_box():
    expected = stress_by_differences(tissue, ENERGY) / tissue.boundary.area
    np.testing.assert_allclose(mechanics.stress(tissue, ENERGY), expected, atol=1e-8)


@settings(max_examples=5, deadline=None)
@given(turn=st.floats(-3, 3), shift=st.floats(-2, 2))
def test_stress_is_symmetric_and_rotates_with_the_tissue(turn, shift):
    c, s = np.cos(turn), np.sin(turn)
    rotation = jnp.array([[c, -s], [s, c]])
    turned = mechanics.deformed(tissue.with_vertices(tissue.vertices + shift), rotation)
    stress = mechanics.stress(tissue, ENERGY)
    turned_stress = mechanics.stress(turned, ENERGY)
    np.testing.assert_allclose(turned_stress, turned_stress.T, atol=1e-12)
    np.testing.assert_allclose(turned_stress, rotation @ stress @ rotation.T, atol=1e-12)


def test_area_weighted_mean_of_cell_stresses_is_the_stress():
    cells = mechanics.cell_stress(tissue, ENERGY)
    mean = np.tensordot(tissue.areas, cells, 1) / tissue.boundary.area
    np.testing.assert_allclose(mean, mechanics.stress(tissue, ENERGY), atol=1e-12)
    np.testing.assert_allclose(cells, np.swapaxes(cells, 1, 2), atol=1e-14)


@pytest.mark.slow
def test_stress_of_a_free_cluster_at_rest_is_zero():
    start = cluster(7, 1)
    energy = AreaElasticity(20.0, 1.0) + LineTension(jnp.linspace(0.8, 1.2, start.n_edges))
    free = vx.equilibrate(start, energy, transitions=None, contact_range=None).tissue
    cells = np.asarray(mechanics.cell_stress(free, energy))
    assert np.abs(cells).max() > 0.1
    np.testing.assert_allclose(mechanics.stress(free, energy), 0, atol=1e-8)
    # Zero up to the softening of lengths, which areas do not have.
    np.testing.assert_allclose(np.tensordot(free.areas, cells, 1), 0, atol=1e-6)


@pytest.mark.slow
def test_cell_stress_of_arcs_against_sums_over_points():
    # The reference sums over 4000 segments of each arc. The tissue is not at rest; some arcs bulge inward.
    start = cluster(5, 3)
    free = start.with_angles(jnp.linspace(-1.2, 1.3, start.n_edges))
    one = LineTension(jnp.zeros(start.n_edges).at[:].set(1.0))
    points = np.asarray(free.edge_points(jnp.linspace(0, 1, 4001)))
    steps = np.diff(points, axis=1)
    lengths = np.linalg.norm(steps, axis=-1, keepdims=True)
    tangents = np.einsum("eni,enj->eij", steps / np.where(lengths > 0, lengths, 1), steps)
    cells = np.asarray(free.topology.edge_cells)
    expected = np.zeros((free.n_cells, 2, 2))
    for e, pair in enumerate(cells):
        inside = pair[pair < free.n_cells]
        expected[inside] += tangents[e] / inside.size
    moments = np.asarray(mechanics.cell_stress(free, one)) * np.asarray(free.areas)[:, None, None]
    np.testing.assert_allclose(moments, expected, atol=2e-5)


def test_principal_stresses():
    cells = mechanics.cell_stress(tissue, ENERGY)
    values, directions = mechanics.principal(cells)
    assert (values[:, 0] >= values[:, 1]).all()
    rebuilt = np.einsum("ca,cai,caj->cij", values, directions, directions)
    np.testing.assert_allclose(rebuilt, cells, atol=1e-12)


def test_gradient_of_the_stress_against_differences():
    p0 = jnp.linspace(3.5, 3.8, N)
    largest = lambda p: mechanics.principal(mechanics.cell_stress(tissue, ShapeFactorEnergy(p)))[0]
    f = jax.jit(lambda p: jnp.sum(largest(p)[:, 0]))
    slope, h = jax.grad(f)(p0), 1e-6
    direction = np.cos(np.arange(N))
    difference = (f(p0 + h * direction) - f(p0 - h * direction)) / (2 * h)
    np.testing.assert_allclose(np.sum(slope * direction), difference, rtol=1e-7)
