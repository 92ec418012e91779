"""Costs do not depend on spare slots."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax._base.batch import stack
from vertax.costs import (
    AbstractLeastSquaresCost,
    AspectRatio,
    CellAreas,
    CellStress,
    CentroidDistance,
    EdgeDistance,
    Frames,
    HomotypicLength,
    IndexAwareStructural,
    MeanShapeFactor,
    MeshImage,
    Stress,
    VertexDistance,
    mismatched_neighbours,
)

ENERGY = vx.energies.ShapeFactorEnergy(3.7)
CELLS = 6
CAPACITY = 9
TYPES = np.arange(CAPACITY) % 2

# Functions of a target and its number of cell slots that return a cost.
COSTS = {
    "vertices": lambda target, n: VertexDistance(target),
    "vertices by cells": lambda target, n: VertexDistance(target, match="cells"),
    "edges": lambda target, n: EdgeDistance(target),
    "centroids": lambda target, n: CentroidDistance(target),
    "structure": lambda target, n: IndexAwareStructural(target),
    "shape factor": lambda target, n: MeanShapeFactor(3.9),
    "areas": lambda target, n: CellAreas(jnp.linspace(0.5, 1.5, CAPACITY)[:n]),
    "interfaces": lambda target, n: HomotypicLength(TYPES[:n]),
    "relative interfaces": lambda target, n: HomotypicLength(TYPES[:n], relative=True),
    "image": lambda target, n: MeshImage(np.eye(8), 1.5),
    "stress": lambda target, n: Stress(jnp.eye(2)),
    "cell stress": lambda target, n: CellStress(jnp.eye(2), cells=[0, 2]),
    "all cell stresses": lambda target, n: CellStress(jnp.eye(2)),
    "moments": lambda target, n: AspectRatio(1.2),
    "farthest": lambda target, n: AspectRatio(1.2, "farthest"),
}
QUICK = ("structure", "areas", "vertices by cells", "moments", "all cell stresses")
each_cost = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else (pytest.mark.slow,)) for name in COSTS],
)


def pair(name):
    """A tissue and a target."""
    if name in ("moments", "farthest"):
        return (vx.initialise.free_voronoi(CELLS, key=k, lloyd_steps=2) for k in (1, 2))
    return (random_tissue(CELLS, 3, lloyd_steps=k) for k in (2, 3))


def value_and_slope(cost, tissue):
    @eqx.filter_jit
    def run(cost, tissue):
        value = lambda vertices: cost(tissue.with_vertices(vertices), ENERGY)
        return jax.value_and_grad(value)(tissue.vertices)

    return run(cost, tissue)


@each_cost
def test_costs_do_not_depend_on_spare_slots(name):
    tissue, target = pair(name)
    value, slope = value_and_slope(COSTS[name](target, CELLS), tissue)
    target_with_spare_slots = target.with_capacity(CAPACITY)
    other, other_slope = value_and_slope(
        COSTS[name](target_with_spare_slots, CAPACITY), tissue.with_capacity(CAPACITY)
    )
    assert value > 1e-6
    assert other == pytest.approx(float(value), rel=1e-9)
    np.testing.assert_allclose(other_slope[: len(slope)], slope, atol=1e-9)
    np.testing.assert_allclose(other_slope[len(slope) :], 0, atol=1e-15)


@pytest.mark.thorough
def test_measurements_are_the_residuals_without_spare_slots():
    tissue, target = pair("areas")
    weight = np.arange(64.0).reshape(8, 8) % 4

    @eqx.filter_jit
    def evaluate(cost, tissue):
        return cost.residuals(tissue, ENERGY), cost.is_measurement(tissue, ENERGY)

    def measured(tissue, target):
        n = tissue.n_cells
        costs = {name: make(target, n) for name, make in COSTS.items()}
        costs: dict[str, vx.AbstractCost] = {
            name: cost
            for name, cost in costs.items()
            if isinstance(cost, AbstractLeastSquaresCost) and not isinstance(cost, AspectRatio)
        }
        costs["weighted image"] = MeshImage(np.eye(8), 1.5, weight=weight)
        costs["sum"] = costs["areas"] + 0.0 * costs["edges"] + 2.0 * costs["centroids"]
        return {name: evaluate(cost, tissue) for name, cost in costs.items()}

    plain = measured(tissue, target)
    padded = measured(*(t.with_capacity(CAPACITY) for t in (tissue, target)))
    for name, (residuals, mask) in padded.items():
        others, of_others = plain[name]
        assert mask.shape == residuals.shape, name
        np.testing.assert_array_equal(residuals[~mask], 0, err_msg=name)
        np.testing.assert_allclose(residuals[mask], others[of_others], atol=1e-12, err_msg=name)
    n = CELLS
    counts = {name: int(jnp.sum(mask)) for name, (_, mask) in padded.items()}
    expected = {"areas": n, "vertices": 4 * n, "edges": 30 * n, "all cell stresses": 3 * n}
    expected |= {"stress": 3, "weighted image": np.sum(weight > 0), "sum": 3 * n}
    assert {name: counts[name] for name in expected} == expected


def test_measurements_of_frames_are_those_of_each_frame():
    tissue, target = (t.with_capacity(CAPACITY) for t in pair("areas"))
    frames = stack([tissue, target, tissue])
    cost = Frames([CentroidDistance(target)] * 2)
    mask = eqx.filter_jit(cost.is_measurement)(frames, ENERGY)
    assert mask.shape == (4 * CAPACITY,)
    assert int(jnp.sum(mask)) == 4 * CELLS


@pytest.mark.thorough
def test_structural_cost_compares_tissues_with_different_cell_numbers():
    target = random_tissue(CELLS, 3, lloyd_steps=2).with_capacity(CAPACITY)
    cost = IndexAwareStructural(target)
    divided = vx.transitions.divide(target, 1).tissue
    same, different = (float(eqx.filter_jit(cost)(t, ENERGY)) for t in (target, divided))
    assert same == pytest.approx(0, abs=1e-3)
    assert different > 0.1
    # Exchanging tissue and target changes little.
    reverse = float(
        eqx.filter_jit(IndexAwareStructural(divided, cost.interface_length))(target, ENERGY)
    )
    assert reverse == pytest.approx(different, rel=0.1)
    assert mismatched_neighbours(target, target) == 0
    assert mismatched_neighbours(divided, target) > 2
