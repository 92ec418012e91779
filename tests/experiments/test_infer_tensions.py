"""Tensions and pressures from the geometry of a cluster."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import angles_of, cluster, with_angles
from helpers import random_tissue
from label_helpers import SHAPE, clear_seeds, rasterise
from run_helpers import run, table

import vertax as vx
from vertax.costs import EdgeDistance, VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy
from vertax.experiments.infer_tensions.experiment import Config, balance, problem_of, tension_of
from vertax.initialise import from_labels

TINY = """
experiment = "infer_tensions"
epochs = 2
cluster = { n_cells = 4, pixels = 200 }
"""


@pytest.fixture(scope="module")
def foam():
    """A cluster in equilibrium, with its tensions and pressures, relative to the mean tension."""
    tissue = cluster(9, 3, lloyd_steps=3, inner_arcs=True)
    tension = jax.random.uniform(jax.random.key(1), (tissue.n_edges,), minval=0.7, maxval=1.3)
    tension = tension / jnp.mean(tension)
    areas = jax.random.uniform(jax.random.key(2), (9,), minval=0.9, maxval=1.3)
    area = AreaElasticity(20.0, areas)
    relaxed = vx.equilibrate(tissue, area + LineTension(tension), tolerance=1e-11).tissue
    return relaxed, tension, area.pressures(relaxed)


class TestEdgeDistance:
    def test_of_a_displaced_tissue_is_half_the_square(self):
        for tissue in (random_tissue(8, 0), cluster(5, inner_arcs=True)):
            moved = tissue.with_vertices(tissue.vertices + jnp.array([0.3, 0.4]))
            assert EdgeDistance(tissue)(moved, ShapeFactorEnergy(3.8)) == pytest.approx(0.125)

    def test_sees_how_edges_bend(self):
        tissue = cluster(5, inner_arcs=True)
        bent = with_angles(tissue, angles_of(tissue) + 0.1)
        energy = ShapeFactorEnergy(3.8)
        assert VertexDistance(tissue)(bent, energy) == 0
        # An arc of angle a stands c a / 4 off the middle of its chord c, two thirds of that on average.
        assert 1e-5 < EdgeDistance(tissue)(bent, energy) < 1e-2

    def test_does_not_depend_on_the_number_of_points(self):
        target = cluster(5, inner_arcs=True)
        tissue = with_angles(target, angles_of(target) + 0.2)
        values = [EdgeDistance(target, n)(tissue, ShapeFactorEnergy(3.8)) for n in (40, 80)]
        assert values[0] == pytest.approx(float(values[1]), rel=1e-3)

    def test_its_gradient_is_that_of_differences(self):
        target = cluster(4, inner_arcs=True)
        energy = ShapeFactorEnergy(3.8)
        y, unravel = jax.flatten_util.ravel_pytree(target.configuration)
        y = y + 0.05 * jax.random.normal(jax.random.key(0), y.shape)
        cost = lambda y: EdgeDistance(target)(target.with_configuration(unravel(y)), energy)
        way = jax.random.normal(jax.random.key(1), y.shape)
        step = 1e-5
        difference = (cost(y + step * way) - cost(y - step * way)) / (2 * step)
        assert jax.grad(cost)(y) @ way == pytest.approx(float(difference), rel=1e-7)

    def test_bad_input_is_refused(self):
        with pytest.raises(
            ValueError, match="`points_per_edge` of EdgeDistance must be at least 2"
        ):
            EdgeDistance(random_tissue(6), 1)
        with pytest.raises(ValueError, match="must have 15 edges"):
            EdgeDistance(random_tissue(6))(random_tissue(5), ShapeFactorEnergy(3.8))


@pytest.mark.parametrize("boundary", ["free", "periodic", "mirrored"])
def test_arcs_of_all_edges_hold_the_areas_of_the_pixels(boundary):
    labels = rasterise(clear_seeds(20, SHAPE, 1), SHAPE, periodic=boundary == "periodic")
    if boundary == "free":
        rows, columns = np.indices(labels.shape)
        labels = np.where(np.hypot(rows - 60, columns - 80) < 55, labels, 0)
    found = from_labels(labels, boundary=boundary, inner_arcs=True, softening=0.0)
    assert found.tissue.inner_arcs
    pixels = np.bincount(labels.ravel())[found.labels]
    areas = np.asarray(found.tissue.areas) / found.pixel_size**2
    assert found.inflated.size == 0
    if boundary == "mirrored":
        areas, pixels = areas[found.whole], pixels[found.whole]
    # Single pixels off their cell were given to a neighbour.
    np.testing.assert_allclose(areas, pixels, rtol=0, atol=3)


def test_pressures_balance_tensions_across_every_arc(foam):
    tissue, tension, pressure = foam
    left, right = jnp.append(pressure, 0.0)[tissue.topology.edge_cells].T  # 0 outside
    np.testing.assert_allclose(tension * tissue.edge_curvatures, left - right, atol=1e-5)


def test_a_balance_of_forces_gives_back_tensions_and_pressures(foam):
    tissue, tension, pressure = foam
    model = Config().model.model_copy(update={"prior": 1e6})
    energy = balance(tissue, model)
    np.testing.assert_allclose(tension_of(energy), tension, atol=1e-6)
    area = energy.terms[0]
    assert isinstance(area, AreaElasticity)
    np.testing.assert_allclose(area.pressures(tissue), pressure, atol=1e-5)


def test_a_shape_that_no_tensions_hold_is_met_as_well_as_can_be(foam):
    tissue, *_ = foam
    noise = 0.02 * jax.random.normal(jax.random.key(5), tissue.vertices.shape)
    seen = tissue.with_vertices(tissue.vertices + noise)
    found = vx.initialise.Segmentation(
        seen, np.arange(1, 10), np.ones(9, bool), np.zeros(0, int), np.zeros(0, int), 0.01, (9, 9)
    )
    problem, guess = problem_of(Config(), found)
    value = eqx.filter_jit(lambda e: problem.value_and_gradient(e, seen, jnp.zeros(2)).cost)
    gradient = eqx.filter_jit(lambda e: problem.value_and_gradient(e, seen, jnp.zeros(2)).gradient)
    slope = gradient(guess)
    size = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(slope)))
    downhill = jax.tree.map(lambda x: -0.02 * x / size, slope)
    assert value(eqx.apply_updates(guess, downhill)) < 0.95 * value(guess)


@pytest.mark.slow  # compiles for a minute
def test_the_experiment_finds_what_it_drew(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert metrics["rms_distance_pixels_fitted"] < metrics["rms_distance_pixels_balanced"]
    assert metrics["rms_distance_pixels_balanced"] < metrics["rms_distance_pixels_equal"]
    assert metrics["pearson_tension"] > 0.8
    assert metrics["rms_error_pressure"] < 0.2
    edges = table(folder / "edges.csv")
    assert np.mean(np.array(edges["tension"], float)) == pytest.approx(1)
    assert (folder / "figures" / "recovery.png").stat().st_size > 10_000


def test_transitions_are_refused_in_the_configuration(tmp_path):
    with pytest.raises(ValueError, match=r"relaxation\.transitions must be false"):
        Config.model_validate({"relaxation": {"transitions": True}})
