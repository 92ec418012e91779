"""Tensions and pressures from the geometry of a cluster."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import STILL

import vertax as vx
from vertax.energies import AreaElasticity, LineTension
from vertax.inference import foam_energy, foam_terms, force_balance, tension_problem


@pytest.fixture(scope="module")
def foam():
    """A cluster in equilibrium, with its tensions and pressures, relative to the mean tension."""
    tissue = cluster(9, 3, lloyd_steps=3, inner_arcs=True)
    tension = jax.random.uniform(jax.random.key(1), (tissue.n_edges,), minval=0.7, maxval=1.3)
    tension = tension / jnp.mean(tension)
    areas = jax.random.uniform(jax.random.key(2), (9,), minval=0.9, maxval=1.3)
    area = AreaElasticity(20.0, areas)
    relax = vx.Relaxation(tolerance=1e-11, contact_range=None)
    relaxed = relax(tissue, area + LineTension(tension)).tissue
    return relaxed, tension, area.pressures(relaxed)


def test_pressures_balance_tensions_across_every_arc(foam):
    tissue, tension, pressure = foam
    left, right = jnp.append(pressure, 0.0)[tissue.topology.edge_cells].T  # 0 outside
    np.testing.assert_allclose(tension * tissue.edge_curvatures, left - right, atol=1e-5)


def test_a_balance_of_forces_gives_back_tensions_and_pressures(foam):
    tissue, tension, pressure = foam
    area, tensions = foam_terms(force_balance(tissue, prior=1e6))
    np.testing.assert_allclose(tensions.tension, tension, atol=1e-6)
    np.testing.assert_allclose(area.pressures(tissue), pressure, atol=1e-5)


@pytest.mark.thorough
def test_a_shape_that_no_tensions_hold_is_met_as_well_as_can_be(foam):
    tissue, *_ = foam
    noise = 0.02 * jax.random.normal(jax.random.key(5), tissue.vertices.shape)
    seen = tissue.with_vertices(tissue.vertices + noise)
    found = vx.initialise.Segmentation(
        seen, np.arange(1, 10), np.ones(9, bool), np.zeros(0, int), np.zeros(0, int), 0.01, (9, 9)
    )
    made = tension_problem(found, response=STILL)
    problem, guess = made.problem, made.balanced
    evaluate = eqx.filter_jit(lambda e: problem.value_and_gradient(e, seen, jnp.zeros(2)))
    before = evaluate(guess)
    slope = before.gradient
    size = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(slope)))
    downhill = jax.tree.map(lambda x: -0.02 * x / size, slope)
    assert evaluate(eqx.apply_updates(guess, downhill)).cost < 0.95 * before.cost


def test_the_energy_of_a_foam_is_read_again(foam):
    tissue, tension, _ = foam
    energy = foam_energy(tension, 1.1, stiffness=2.0, low=0.1, high=2.0)
    area, tensions = foam_terms(energy)
    np.testing.assert_allclose(tensions.tension, tension)
    assert float(area(tissue)) == pytest.approx(float(jnp.sum((tissue.areas - 1.1) ** 2)))
    with pytest.raises(TypeError, match="sum of AreaElasticity and BoundedTension"):
        foam_terms(LineTension(1.0))


def test_bad_settings_are_refused(foam):
    tissue, *_ = foam
    with pytest.raises(ValueError, match="both sides of 1"):
        force_balance(tissue, low=1.2)
    with pytest.raises(ValueError, match="`stiffness` and `prior` must be positive"):
        force_balance(tissue, prior=0.0)
    labels = vx.inference.label_image(tissue, 200)
    found = vx.initialise.from_labels(labels, boundary="free", inner_arcs=True)
    with pytest.raises(ValueError, match="`response` must have no transitions"):
        tension_problem(found, response=vx.responses.Relaxation())
    with pytest.raises(ValueError, match="`noise` must be positive"):
        tension_problem(found, noise=0.0)
