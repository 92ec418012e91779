"""Costs of shapes, aspect ratio and cell types; bounded tensions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import angles_of, cluster, doublet, rotated, with_angles
from helpers import central_difference, random_like, random_tissue, relaxed, value_of

import vertax as vx
from vertax.costs import AspectRatio, CellAreas, HomotypicLength, MeanShapeFactor, aspect_ratio
from vertax.energies import AreaElasticity, BoundedTension, LineTension

energy = vx.energies.ShapeFactorEnergy(3.7)
ratio_of = eqx.filter_jit(aspect_ratio)


def two_types(n_cells):
    return jnp.arange(n_cells) % 2


def e2(tissue, seed=0):
    unit = jax.random.uniform(jax.random.key(seed), (tissue.n_edges,), minval=0.12, maxval=0.2)
    return AreaElasticity(1.0, 1.0) + BoundedTension(unit, 0.1, 0.24)


def lens(angle, chord=1.0):
    """Two cells enclosed by two symmetric arcs."""
    tissue = doublet()
    tissue = tissue.with_vertices(tissue.vertices * chord)
    return with_angles(tissue, angles_of(tissue).at[jnp.array([0, 2])].set(angle))


# --- values


def test_cell_costs_match_their_formulas():
    tissue = random_tissue(9, 2)
    mean = float(jnp.mean(tissue.perimeters / jnp.sqrt(tissue.areas)))
    cost = MeanShapeFactor(4.1)
    assert cost(tissue, energy) == pytest.approx((mean - 4.1) ** 2)
    assert 0.5 * jnp.sum(cost.residuals(tissue, energy) ** 2) == pytest.approx((mean - 4.1) ** 2)
    assert CellAreas(1.2)(tissue, energy) == pytest.approx(
        0.5 * float(jnp.mean((tissue.areas - 1.2) ** 2))
    )
    assert CellAreas(tissue.areas)(tissue, energy) == 0
    with pytest.raises(ValueError, match=r"`target` must be one number or .*\(9,\)"):
        CellAreas(jnp.ones(4))(tissue, energy)


def test_aspect_ratio_of_a_circle_is_one_with_finite_gradient():
    circle = lens(np.pi / 2)
    assert ratio_of(circle) == pytest.approx(1, abs=1e-12)
    gradient = jax.jit(jax.grad(lambda x: aspect_ratio(circle.with_vertices(x))))(circle.vertices)
    assert np.isfinite(gradient).all()


def test_box_aspect_ratio_is_ratio_of_lattice_vectors():
    stretched = vx.mechanics.deformed(random_tissue(9, 2), jnp.diag(jnp.array([0.5, 2.0])))
    assert aspect_ratio(stretched, "box") == pytest.approx(0.25)
    assert AspectRatio(0.5, "box")(stretched, energy) == pytest.approx(0.25**2)
    with pytest.raises(ValueError, match="only for a periodic tissue"):
        aspect_ratio(cluster(5, 1), "box")
    with pytest.raises(ValueError, match='pass measure="box"'):
        aspect_ratio(stretched)


def test_aspect_ratio_of_a_lens_matches_moments_on_a_grid():
    # Compare with sums over a fine grid, for angles on both sides of the limit of the series of arcs.
    for angle in (0.3, 1.0, 2.2):
        radius, depth = 1 / np.sin(angle), 1 / np.tan(angle)
        x, y = np.meshgrid(np.linspace(-3, 3, 801), np.linspace(-3, 3, 801))
        inside = (np.abs(x) + depth) ** 2 + y**2 < radius**2
        if angle > np.pi / 2:  # more than half of each circle
            inside = (np.abs(x) - abs(depth)) ** 2 + y**2 < radius**2
        moments = [np.mean(z[inside] ** 2) for z in (x, y)]
        expected = np.sqrt(max(moments) / min(moments))
        assert ratio_of(lens(angle, 2.0)) == pytest.approx(expected, rel=5e-3)


def test_stretching_multiplies_the_aspect_ratio():
    # Straight edges, because an affine map of an arc is not an arc.
    tissue = cluster(8, 3, lloyd_steps=2)
    tissue = with_angles(tissue, jnp.zeros(tissue.n_edges))
    root = jnp.linalg.cholesky(_covariance(tissue))
    vertices = tissue.vertices @ jnp.linalg.inv(root).T
    for stretch in (1.3, 3.0, 1e6):
        elongated = tissue.with_vertices(vertices * jnp.array([stretch, 1.0]))
        assert ratio_of(elongated) == pytest.approx(stretch, rel=1e-9)


def _covariance(tissue):
    from vertax.costs._aspect import _second_moments

    xx, xy, yy = _second_moments(tissue)
    return jnp.array([[xx, xy], [xy, yy]])


@pytest.mark.parametrize("measure", ["moments", "farthest"])
def test_aspect_ratio_is_invariant_under_rotation_translation_and_scaling(measure):
    tissue = cluster(8, 3)
    ratio = ratio_of(tissue, measure)
    assert ratio > 1
    assert ratio_of(rotated(tissue, 0.7, (5.0, -3.0)), measure) == pytest.approx(float(ratio))
    assert ratio_of(tissue.with_vertices(3 * tissue.vertices), measure) == pytest.approx(
        float(ratio)
    )
    assert AspectRatio(2.0, measure)(tissue, energy) == pytest.approx((float(ratio) - 2) ** 2)


def test_farthest_aspect_ratio_matches_its_definition():
    tissue = cluster(8, 3)
    points = np.asarray(tissue.vertices)
    i, j = np.unravel_index(
        np.argmax(np.linalg.norm(points[:, None] - points, axis=-1)), (len(points),) * 2
    )
    axis = points[i] - points[j]
    across = points @ np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    expected = np.linalg.norm(axis) / np.ptp(across)
    assert ratio_of(tissue, "farthest") == pytest.approx(expected)


def test_aspect_ratio_of_periodic_tissue_is_rejected():
    with pytest.raises(ValueError, match="only for a free tissue"):
        AspectRatio(2.0)(random_tissue(5), energy)


@pytest.mark.parametrize("make", [random_tissue, cluster], ids=["periodic", "free"])
@pytest.mark.parametrize("n_types", [2, 3, 8])
def test_homotypic_length_counts_each_interface_once(make, n_types):
    tissue = make(8, 1)
    types = np.arange(8) % n_types
    homotypic = total = 0.0
    for (a, b), length in zip(
        np.asarray(tissue.topology.edge_cells), np.asarray(tissue.edge_lengths), strict=True
    ):
        if max(a, b) < 8:
            total += length
            homotypic += length * (types[a] == types[b])
    cost = HomotypicLength(jnp.asarray(types))
    assert value_of(cost, tissue, energy) == pytest.approx(homotypic)
    relative = HomotypicLength(jnp.asarray(types), relative=True)
    assert value_of(relative, tissue, energy) == pytest.approx(homotypic / total)
    one_type = HomotypicLength(jnp.zeros(8, int), relative=True)
    assert value_of(one_type, tissue, energy) == pytest.approx(1)
    with pytest.raises(ValueError, match=r"\(8,\)"):
        HomotypicLength(jnp.zeros(7, int))(tissue, energy)


# --- derivatives


COSTS = {
    "shape": MeanShapeFactor(4.1),
    "areas": CellAreas(1.1),
    "homotypic": HomotypicLength(two_types(8)),
    "homotypic share": HomotypicLength(two_types(8), relative=True),
    "aspect": AspectRatio(2.0),
    "farthest": AspectRatio(2.0, "farthest"),
}


@pytest.mark.parametrize("name", COSTS)
def test_cost_gradients_match_finite_differences(name):
    cost, tissue = COSTS[name], cluster(8, 1, lloyd_steps=2)
    f = jax.jit(jax.value_and_grad(lambda y: cost(tissue.with_configuration(y), energy)))
    y = tissue.configuration
    direction = random_like(y)
    slope = sum(
        jnp.sum(g * d)
        for g, d in zip(jax.tree.leaves(f(y)[1]), jax.tree.leaves(direction), strict=True)
    )
    difference = central_difference(lambda y: f(y)[0], y, direction, 1e-6)
    assert slope == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.slow  # the partial derivatives are checked above, hypergradients in tests/adjoints
def test_hypergradient_matches_finite_differences_periodic():
    tissue, start = relaxed(12, 1)
    weights = (0.5, 0.3, 0.2)
    costs = (
        MeanShapeFactor(4.1),
        CellAreas(jnp.linspace(0.8, 1.2, 12)),
        HomotypicLength(two_types(12)),
    )
    cost = sum((w * c for w, c in zip(weights[1:], costs[1:], strict=True)), weights[0] * costs[0])
    _check_hypergradient(tissue, start, cost)


@pytest.mark.thorough
def test_hypergradient_matches_finite_differences_free():
    tissue = cluster(6, 1, lloyd_steps=2)
    start = e2(tissue)
    cost = AspectRatio(2.0) + 0.1 * HomotypicLength(two_types(6), relative=True)
    _check_hypergradient(tissue, start, cost + 0.2 * CellAreas(1.0))


def _check_hypergradient(tissue, start, cost):
    problem = vx.InverseProblem(
        tissue,
        start,
        cost,
        response=vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-11),
    )
    evaluate = eqx.filter_jit(problem.value_and_gradient)
    evaluation = evaluate(start)
    gradient, outcome = evaluation.gradient, evaluation.outcome
    assert outcome.converged
    parameters, constants = eqx.partition(start, eqx.is_inexact_array)
    direction = random_like(parameters)
    value = lambda x: evaluate(eqx.combine(x, constants)).cost
    expected = float(central_difference(value, parameters, direction, 1e-4))
    slope = sum(
        jnp.sum(g * d)
        for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    assert slope == pytest.approx(expected, rel=1e-5)


# --- bounded tension


def test_bounded_tension_stays_within_bounds():
    tissue = random_tissue(6)
    tension = jnp.linspace(0.11, 0.19, tissue.n_edges)
    bounded = BoundedTension(tension, 0.1, 0.2)
    np.testing.assert_allclose(bounded.tension, tension, rtol=1e-12)
    assert bounded(tissue) == pytest.approx(float(LineTension(tension)(tissue)))
    # The bounds hold for extreme logits, without overflow.
    for logit in (-1e4, 1e4):
        extreme = eqx.tree_at(lambda e: e.logits, bounded, jnp.full(tissue.n_edges, logit))
        assert ((extreme.tension >= 0.1) & (extreme.tension <= 0.2)).all()
        slope = eqx.filter_grad(lambda e: e(tissue))(extreme)
        assert np.isfinite(slope.logits).all()


def test_bounds_are_not_parameters():
    bounded = BoundedTension(jnp.full(3, 0.15), 0.1, 0.2)
    assert len(jax.tree.leaves(eqx.filter(bounded, eqx.is_inexact_array))) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0.1, 0.2, 0.1), "`low` must be below"), ((0.3, 0.1, 0.2), "`tension` must be between")],
)
def test_invalid_bounds_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        BoundedTension(*arguments)
