import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, random_like, random_tissue, relaxed, value_of
from jaxtyping import Array, Float
from scipy.special import erf

import vertax as vx
from vertax.costs import MeshImage, VertexDistance, mirror, render

energy = vx.energies.ShapeFactorEnergy(3.7)


class TotalPerimeter(vx.AbstractCost):
    def __call__(self, tissue, energy):
        return jnp.sum(tissue.perimeters)


def exact_image(tissue, shape, width):
    """Sum of the blurred segments and their periodic images, in closed form."""
    lattice = np.asarray(tissue.boundary.lattice)
    rows, columns = shape
    fx, fy = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
    pixels = fx[None, :, None] * lattice[0] + fy[:, None, None] * lattice[1]
    image = np.zeros(shape)
    starts, vectors = (np.asarray(x) for x in tissue.edge_segments)
    for start, vector in zip(starts, vectors, strict=True):
        length = np.linalg.norm(vector)
        u = vector / length
        for i in range(-2, 3):
            for j in range(-2, 3):
                q = pixels - start - np.array([i, j]) @ lattice
                s, t = q @ u, q @ np.array([u[1], -u[0]])
                along = erf(s / width / 2**0.5) - erf((s - length) / width / 2**0.5)
                image += np.exp(-(t**2) / 2 / width**2) / np.sqrt(8 * np.pi) / width * along
    return image


@pytest.mark.parametrize(
    ("lattice", "shape"),
    [
        (np.diag([3.0, 3.0]), (64, 64)),
        (np.diag([4.0, 2.25]), (54, 96)),
        (np.array([[3.0, 0.0], [1.0, 3.0]]), (60, 66)),
    ],
    ids=["square", "rectangle", "sheared"],
)
@pytest.mark.parametrize(("pixels", "accuracy"), [(1.5, 1e-3), (2.5, 1e-5)])
def test_rendered_image_is_the_blurred_mesh(lattice, shape, pixels, accuracy):
    tissue = random_tissue(9, 2, lattice=lattice, softening=0.0)
    width = pixels * lattice[0, 0] / shape[1]
    exact = exact_image(tissue, shape, width)
    image = render(tissue, shape, width, points_per_edge=48)
    assert np.abs(image - exact).max() < accuracy * exact.max()


def test_integral_of_image_is_total_edge_length():
    tissue = random_tissue(9, 2)
    image = render(tissue, (64, 64), 0.15)
    assert image.mean() * 9 == pytest.approx(float(tissue.edge_lengths.sum()), rel=1e-9)


def test_image_is_equivariant_under_periodic_translation():
    tissue = random_tissue(9, 2)
    moved = tissue.with_configuration(tissue.vertices + jnp.array([3.0 * 5 / 60, -3.0 * 70 / 60]))
    shifted = np.roll(render(tissue, (60, 60), 0.15), (-70, 5), axis=(0, 1))
    np.testing.assert_allclose(render(moved, (60, 60), 0.15), shifted, atol=1e-9)


def test_cost_of_true_image_is_zero_for_any_brightness_and_contrast():
    tissue = random_tissue(9, 2)
    image = np.asarray(render(tissue, (64, 64), 0.12))
    for scale, background in ((1.0, 0.0), (250.0, 31.0), (1e-3, -5.0)):
        cost = MeshImage(scale * image + background, 0.12)
        assert value_of(cost, tissue, energy) == pytest.approx(0, abs=1e-12)
    exact = lambda image: MeshImage(image, 0.12, fit_intensity=False)
    assert value_of(exact(image), tissue, energy) == pytest.approx(0, abs=1e-12)
    assert value_of(exact(2 * image), tissue, energy) > 0.01
    assert value_of(MeshImage(-image, 0.12), tissue, energy) == pytest.approx(0.5)


@pytest.mark.thorough
def test_image_cost_is_minimal_at_the_true_tissue():
    tissue, _ = relaxed(12, 1)
    cost = MeshImage(render(tissue, (64, 64), 0.1), 0.1)
    noise = random_like(tissue.vertices)
    values = [
        float(value_of(cost, tissue.with_configuration(tissue.vertices + s * noise), energy))
        for s in (0, 0.01, 0.05)
    ]
    assert values[0] < values[1] < values[2]


def test_pixels_of_weight_zero_are_ignored():
    tissue = random_tissue(9, 2)
    image = np.array(render(tissue, (64, 64), 0.12))
    weight = np.ones_like(image)
    weight[:20] = 0
    image[:20] = 1e3
    assert MeshImage(image, 0.12, weight=weight)(tissue, energy) == pytest.approx(0, abs=1e-12)
    assert MeshImage(image, 0.12)(tissue, energy) > 0.1


@pytest.mark.thorough
@pytest.mark.parametrize("fit_intensity", [True, False])
def test_image_cost_derivatives_match_finite_differences(fit_intensity):
    target, _ = relaxed(12, 1)
    image = 3 * render(target, (48, 48), 0.15) + 2 + 0.3 * random_like(jnp.zeros((48, 48)))
    tissue = target.with_configuration(target.vertices + 0.02 * random_like(target.vertices, 1))

    def f(inputs):
        x, width, lattice = inputs
        moved = eqx.tree_at(lambda t: (t.vertices, t.boundary.lattice), tissue, (x, lattice))
        return MeshImage(image, width, fit_intensity=fit_intensity)(moved, energy)

    inputs = (tissue.vertices, jnp.array(0.15), tissue.boundary.lattice)
    direction = random_like(inputs)
    evaluate = jax.jit(jax.value_and_grad(f))
    _, gradient = evaluate(inputs)
    slope = sum(np.sum(np.asarray(g * d)) for g, d in zip(gradient, direction, strict=True))
    difference = central_difference(lambda x: evaluate(x)[0], inputs, direction, 1e-6)
    assert slope == pytest.approx(float(difference), rel=1e-6)


def test_vertex_distance_uses_the_minimum_image():
    tissue = random_tissue(9, 2)
    cost = VertexDistance(tissue)
    far = tissue.with_configuration(tissue.vertices + jnp.array([3.0 + 0.1, -6.0]))
    assert cost(far, energy) == pytest.approx(0.5 * 0.01, rel=1e-9)
    assert cost(tissue, energy) == 0


def test_vertex_distance_and_gradient_match_their_formulas():
    tissue, _ = relaxed(12, 1)
    noise = 0.05 * random_like(tissue.vertices)
    moved = tissue.with_configuration(tissue.vertices + noise)
    cost = VertexDistance(tissue)
    assert cost(moved, energy) == pytest.approx(
        float(0.5 * jnp.mean(jnp.sum(noise**2, 1))), rel=1e-9
    )
    gradient = jax.jit(jax.grad(lambda x: cost(moved.with_configuration(x), energy)))(
        moved.vertices
    )
    np.testing.assert_allclose(gradient, noise / 24, rtol=1e-9)


def test_weighted_sum_is_the_sum_of_weighted_costs():
    tissue = random_tissue(9, 2)
    other = tissue.with_configuration(tissue.vertices + 0.1)
    a, b = VertexDistance(other), TotalPerimeter()
    total = 0.99 * a + 0.01 * b
    expected = 0.99 * a(tissue, energy) + 0.01 * b(tissue, energy)
    assert total(tissue, energy) == pytest.approx(float(expected))
    assert (2 * total + b)(tissue, energy) == pytest.approx(float(2 * expected + b(tissue, energy)))
    with pytest.raises(TypeError):
        a * b  # pyright: ignore
    with pytest.raises(TypeError):
        a + 1.0  # pyright: ignore


def test_residuals_reject_a_negative_weight():
    tissue = random_tissue(5)
    moved = tissue.with_vertices(tissue.vertices + 0.1)
    cost = VertexDistance(tissue) + -0.1 * VertexDistance(moved)
    assert cost(moved, energy) == pytest.approx(0.01)  # 0.02 / 2 - 0
    with pytest.raises(RuntimeError, match=r"must be a sum of squares .* has a negative weight"):
        cost.residuals(moved, energy)


def test_cost_can_depend_on_parameters():
    class Regularised(vx.AbstractCost):
        weight: Float[Array, ""]

        def __call__(self, tissue, energy):
            return self.weight * jnp.sum(energy.target_shape_factor**2)

    assert Regularised(jnp.array(2.0))(random_tissue(5), energy) == pytest.approx(2 * 3.7**2)


def test_mirrored_images_are_periodic():
    image = np.arange(12.0).reshape(3, 4)
    both = mirror(image)
    assert both.shape == (6, 8)
    np.testing.assert_array_equal(both[:3, :4], image)
    np.testing.assert_array_equal(both, both[::-1])
    np.testing.assert_array_equal(both, both[:, ::-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.ones((64, 64)), 0.1), "constant"),
        ((np.full((64, 64), np.nan), 0.1), "finite"),
        ((np.ones(64), 0.1), "two-dimensional"),
        ((np.ones((3, 64)), 0.1), "6 × 6"),
        ((np.eye(64), 0.0), "`psf_width`"),
        ((np.eye(64), -1.0), "`psf_width`"),
    ],
)
def test_invalid_images_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        MeshImage(*arguments)


def test_invalid_options_of_image_costs_are_rejected():
    with pytest.raises(ValueError, match="`weight` must have shape"):
        MeshImage(np.eye(64), 0.1, weight=np.ones((3, 3)))
    with pytest.raises(ValueError, match="`weight` must be at least 0"):
        MeshImage(np.eye(64), 0.1, weight=-np.ones((64, 64)))
    with pytest.raises(ValueError, match="`points_per_edge`"):
        MeshImage(np.eye(64), 0.1, points_per_edge=0)
    with pytest.raises(ValueError, match="must have 10 vertices"):
        VertexDistance(random_tissue(6))(random_tissue(5), energy)
    with pytest.raises(ValueError, match="6 × 6"):
        render(random_tissue(5), (5, 64), 0.1)


@pytest.mark.thorough
def test_least_squares_costs_are_half_their_squared_residuals():
    tissue, energy = relaxed(12, 1)
    target = tissue.with_configuration(tissue.vertices + 0.05 * random_like(tissue.vertices))
    image = MeshImage(render(target, (32, 32), 0.2), 0.2)
    plain = MeshImage(np.asarray(render(target, (32, 32), 0.2)), 0.2, fit_intensity=False)
    for cost in (VertexDistance(target), image, plain, 0.9 * VertexDistance(target) + 0.1 * image):
        residuals = eqx.filter_jit(lambda c: c.residuals(tissue, energy))(cost)
        value = 0.5 * np.sum(np.asarray(residuals) ** 2)
        assert value == pytest.approx(float(value_of(cost, tissue, energy)), rel=1e-12)
