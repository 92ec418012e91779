"""Tensions and pressures of tissues with straight edges, and the mean stress."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import at_rest, cluster

from vertax.inference import pearson
from vertax.tensions import infer_tensions
from vertax.tensions._balance import angles, equations, forces
from vertax.tensions._observed_geometry import observed_geometry


@pytest.fixture(scope="module")
def straight():
    """A cluster of straight edges at rest, its tensions and pressures."""
    return at_rest(cluster(30, 5, lloyd_steps=3), largest_area=1.2, tolerance=1e-10)


def test_forces_of_straight_edges_are_the_gradient_of_the_energy():
    tissue = cluster(14, 1)
    random = np.random.default_rng(0)
    tension, pressure = random.uniform(0.5, 2, tissue.n_edges), random.normal(size=14)

    def energy(vertices):
        moved = tissue.with_vertices(vertices)
        return jnp.sum(tension * moved.edge_lengths) - jnp.sum(pressure * moved.areas)

    gradient = np.asarray(jax.grad(energy)(tissue.vertices))
    geometry = observed_geometry(tissue)
    which = equations(geometry, straight=True)
    matrix = forces(angles(geometry, which)[0], which, np.zeros(len(which.edges), bool))
    force = matrix @ np.append(tension[which.edges], pressure[which.cells])
    # Lengths are softened in the tissue.
    np.testing.assert_allclose(force.reshape(-1, 2), -gradient[which.junctions], atol=2e-3)


@pytest.mark.thorough
def test_tensions_and_pressures_of_straight_edges(straight):
    """Correlations and coverage are those of the posterior.

    Per cell there are two junctions with two equations each, and three tensions and one pressure: no equation
    is left over, and along the directions that are nearly free the prior decides. With the posterior variance
    v and the variance V of the truth, a calibrated posterior mean has r = √(1 - v / V), here 0.89 for
    pressures.
    """
    tissue, tension, pressure = straight
    result = infer_tensions(tissue)
    assert result.edges == "straight"
    sure, cells = result.determined, result.pressures_determined
    scale = tension[sure].mean()
    true = pressure[cells] / scale - np.mean(pressure[cells]) / scale
    inferred, deviation = result.pressures[cells], result.pressure_deviations[cells]
    expected = np.sqrt(1 - np.mean(deviation**2) / np.var(true))
    assert expected > 0.8
    # Fisher's transform of a correlation of n pairs has the standard deviation 1 / √(n - 3).
    r = float(pearson(true, inferred))
    assert np.arctanh(r) > np.arctanh(expected) - 2 / np.sqrt(len(true) - 3)
    assert pearson(tension[sure], result.tensions[sure]) > 0.75
    off = (result.tensions - tension / scale)[sure] / result.tension_deviations[sure]
    for scores in (off, (inferred - true) / deviation):
        for bound, share in ((1, 0.683), (2, 0.954)):
            # Within 2.5 standard errors of a share of 30.
            error = 2.5 * np.sqrt(share * (1 - share) / 30)
            assert abs(np.mean(np.abs(scores) < bound) - share) < error


def test_arcs_are_chosen_where_edges_are_arcs(foam):
    assert infer_tensions(foam[0]).edges == "arcs"
    assert infer_tensions(foam[0], edges="straight").edges == "straight"


@pytest.mark.thorough
def test_mean_stress_of_a_stretched_tissue_is_along_the_tension(straight):
    tissue = straight[0]
    pulled = tissue.with_vertices(tissue.vertices * jnp.array([1.3, 1 / 1.3]))
    result = infer_tensions(pulled)
    stress = result.mean_stress
    assert stress.n_cells > 5
    # The mean of the stresses of the cells, weighted by area, where all their tensions are determined.
    complete = np.isfinite(result.stresses).all(axis=(1, 2))
    if complete.sum() == stress.n_cells:
        mean = np.average(
            result.stresses[complete], axis=0, weights=np.asarray(result.tissue.areas)[complete]
        )
        np.testing.assert_allclose(stress.tensor, mean, rtol=1e-5, atol=1e-6)
    half = np.linalg.eigvalsh(stress.tensor)
    np.testing.assert_allclose(stress.anisotropy, 0.5 * (half[1] - half[0]), rtol=1e-6)
    turned = infer_tensions(pulled.with_vertices(pulled.vertices[:, ::-1] * jnp.array([-1.0, 1.0])))
    change = turned.mean_stress.direction - stress.direction
    np.testing.assert_allclose(np.cos(2 * change), -1, atol=1e-4)
    np.testing.assert_allclose(
        turned.mean_stress.anisotropy_deviation, stress.anisotropy_deviation, rtol=1e-3
    )
