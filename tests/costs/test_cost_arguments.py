# pyright: reportArgumentType=false, reportOperatorIssue=false
"""Arguments that costs reject."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax import costs

CELLS = 6
NAN, INF = float("nan"), float("inf")
pytestmark = pytest.mark.usefixtures("without_type_checks")


@pytest.fixture(scope="module")
def tissue():
    return random_tissue(CELLS)


@pytest.fixture(scope="module")
def free():
    return vx.initialise.free_voronoi(CELLS, key=0)


@pytest.fixture(scope="module")
def batch(tissue):
    return jax.tree.map(lambda x: jnp.stack([x, x]), tissue)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: costs.MeanShapeFactor("a"),
            TypeError,
            "`target` must hold real numbers, but is 'a'",
        ),
        (lambda: costs.MeanShapeFactor(None), TypeError, "`target` must hold real numbers"),
        (lambda: costs.MeanShapeFactor(NAN), ValueError, "`target` must be finite"),
        (lambda: costs.CellAreas(-1.0), ValueError, "`target` must be positive, but is -1.0"),
        (lambda: costs.CellAreas([1.0, 0.0]), ValueError, "positive, but is from 0.0 to 1.0"),
        (lambda: costs.CellAreas(1j), TypeError, "`target` must hold real numbers"),
        (lambda: costs.AspectRatio(0.5), ValueError, "`target` must be at least 1, but is 0.5"),
        (
            lambda: costs.AspectRatio(2.0, measure="x"),
            ValueError,
            "`measure` must be one of .* 'x'",
        ),
        (
            lambda: costs.VertexDistance(np.ones((4, 2))),
            TypeError,
            "VertexDistance must be a Tissue",
        ),
        (lambda: costs.CentroidDistance(None), TypeError, "CentroidDistance must be a Tissue"),
        (
            lambda: costs.EdgeDistance(3),
            TypeError,
            "EdgeDistance must be a Tissue, but is 3",
        ),
        (lambda: costs.IndexAwareStructural("t"), TypeError, "must be a Tissue"),
        (
            lambda: costs.HomotypicLength(["a", "b"]),
            TypeError,
            "`cell_types` must hold real numbers",
        ),
        (lambda: costs.HomotypicLength([0.5, 1]), ValueError, "whole numbers.*return_inverse"),
        (lambda: costs.HomotypicLength([NAN, 1]), ValueError, "`cell_types` must be finite"),
        (lambda: NAN * costs.MeanShapeFactor(3.8), ValueError, "`weight .*` must be finite"),
        (
            lambda: "2" * costs.MeanShapeFactor(3.8),
            TypeError,
            "`weight .*` must be one real number",
        ),
        (
            lambda: jnp.ones(3) * costs.MeanShapeFactor(3.8),
            ValueError,
            "`weight .*` must be one number",
        ),
        (
            lambda: np.ones(3) * costs.MeanShapeFactor(3.8),
            ValueError,
            "`weight .*` must be one number",
        ),
        (lambda: costs.MeshImage(np.eye(9) * 1j, 0.1), TypeError, "`image` must hold real numbers"),
        (
            lambda: costs.MeshImage("a.tif", 0.1),
            TypeError,
            "`image` must hold real numbers, but is 'a",
        ),
        (
            lambda: costs.MeshImage(np.eye(9), INF),
            ValueError,
            "`psf_width` must be positive and finite",
        ),
        (lambda: costs.MeshImage(np.eye(9), "a"), TypeError, "`psf_width` must be one real number"),
        (
            lambda: costs.MeshImage(np.eye(9), np.ones(2)),
            ValueError,
            "`psf_width` must be one number",
        ),
        (
            lambda: costs.MeshImage(np.eye(9), 0.1, points_per_edge=1.5),
            TypeError,
            "`points_per_edge` must be at least 1 .a Python integer., but is 1.5",
        ),
        (
            lambda: costs.MeshImage(np.eye(9), 0.1, weight=np.full((9, 9), INF)),
            ValueError,
            "`weight` must be finite",
        ),
        (
            lambda: costs.MeshImage(np.eye(9), 0.1, pixel_size=INF),
            ValueError,
            "`pixel_size` must be positive and finite",
        ),
        (lambda: costs.mirror(np.ones((3, 4, 5))), ValueError, "`image` must have shape"),
        (lambda: costs.mirror(np.ones(3)), ValueError, "`image` must have shape"),
    ],
)
def test_invalid_arguments_of_costs_are_rejected(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("make", [costs.VertexDistance, costs.EdgeDistance, costs.CentroidDistance])
def test_batches_and_targets_of_another_boundary_are_rejected(make, tissue, free, batch):
    energy = vx.energies.ShapeFactorEnergy(3.7)
    with pytest.raises(ValueError, match="`target` must be a single tissue"):
        make(batch)(tissue, energy)
    with pytest.raises(ValueError, match="`tissue` must be a single tissue"):
        make(tissue)(batch, energy)
    if make is costs.CentroidDistance:
        with pytest.raises(ValueError, match="boundary of the tissue, Periodic, but has Free"):
            make(free)(tissue, energy)
    # The remedy of the message works.
    values = eqx.filter_jit(eqx.filter_vmap(lambda target: make(target)(tissue, energy)))(batch)
    np.testing.assert_allclose(values, 0, atol=1e-20)


def test_invalid_settings_of_the_structural_cost_are_rejected(tissue):
    for name in ("interface_length", "epsilon", "softening"):
        for value, error in (
            (0.0, ValueError),
            (INF, ValueError),
            (NAN, ValueError),
            ("a", TypeError),
        ):
            with pytest.raises(error, match=f"`{name}` must"):
                costs.IndexAwareStructural(tissue, **{name: value})
    for value in (0.0, -1.0):
        with pytest.raises(ValueError, match="`interface_length` must be positive"):
            costs.adjacency(tissue, value)
    with pytest.raises(TypeError, match="must be a Tissue, but is None"):
        costs.mismatched_neighbours(tissue, None)


@pytest.mark.parametrize("cost", [costs.MeanShapeFactor, costs.AspectRatio])
def test_array_as_scalar_target_is_rejected(cost, tissue, free):
    with pytest.raises(ValueError, match="`target` must be one number"):
        cost(jnp.full(2, 3.0))(free, vx.energies.ShapeFactorEnergy(3.7))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"shape": (9,)}, ValueError, r"`shape` must be \(rows, columns\)"),
        ({"shape": 9}, ValueError, r"`shape` must be \(rows, columns\), but is 9"),
        ({"shape": (9.5, 9)}, TypeError, "`shape` must be a whole number"),
        ({"psf_width": 0.0}, ValueError, "`psf_width` must be positive"),
        ({"psf_width": -1.0}, ValueError, "`psf_width` must be positive"),
        ({"points_per_edge": 0}, ValueError, "`points_per_edge` must be at least 1"),
        ({"pixel_size": -1.0}, ValueError, "`pixel_size` must be positive"),
    ],
)
def test_invalid_arguments_of_render_are_rejected(tissue, arguments, error, message):
    with pytest.raises(error, match=message):
        costs.render(tissue, **{"shape": (9, 9), "psf_width": 0.2} | arguments)


def test_batch_is_rendered_under_vmap(tissue, batch):
    with pytest.raises(ValueError, match=r"must be a single tissue.*filter_vmap"):
        costs.render(batch, (9, 9), 0.3)
    render = eqx.filter_jit(lambda one: costs.render(one, (9, 9), 0.3))
    images = eqx.filter_vmap(render)(batch)
    np.testing.assert_allclose(np.asarray(images)[1], render(tissue), rtol=1e-9)


def test_image_costs_can_be_constructed_under_vmap(tissue):
    images = np.random.default_rng(0).random((2, 9, 9))
    energy = vx.energies.ShapeFactorEnergy(3.7)
    make = lambda image: costs.MeshImage(image, 0.3)
    cost = eqx.filter_jit(lambda image: make(image)(tissue, energy))
    batched = eqx.filter_vmap(cost)(jnp.asarray(images))
    one_by_one = [cost(image) for image in images]
    np.testing.assert_allclose(batched, one_by_one, rtol=1e-9)


def test_builtin_sum_adds_costs_and_energies(tissue):
    energy = vx.energies.ShapeFactorEnergy(3.7)
    terms = [costs.MeanShapeFactor(3.8), costs.CellAreas(2.0)]
    total: Any = sum(terms)
    assert total(tissue, energy) == pytest.approx(float((terms[0] + terms[1])(tissue, energy)))
    assert (np.float64(2) * terms[0])(tissue, energy) == 2 * terms[0](tissue, energy)
    twice: Any = sum([energy, energy])
    assert twice(tissue) == pytest.approx(2 * float(energy(tissue)))
    with pytest.raises(TypeError, match="unsupported operand"):
        sum(terms, 1)
