"""The distance between edges."""

import jax
import jax.numpy as jnp
import pytest
from free_helpers import angles_of, cluster, with_angles
from helpers import central_difference, random_tissue, value_of

from vertax.costs import EdgeDistance, VertexDistance
from vertax.energies import ShapeFactorEnergy


class TestEdgeDistance:
    def test_distance_of_translated_tissue_is_half_the_squared_shift(self):
        for tissue in (random_tissue(8, 0), cluster(5, inner_arcs=True)):
            moved = tissue.with_vertices(tissue.vertices + jnp.array([0.3, 0.4]))
            distance = value_of(EdgeDistance(tissue), moved, ShapeFactorEnergy(3.8))
            assert distance == pytest.approx(0.125)

    def test_distance_depends_on_edge_curvature(self):
        tissue = cluster(5, inner_arcs=True)
        bent = with_angles(tissue, angles_of(tissue) + 0.1)
        energy = ShapeFactorEnergy(3.8)
        assert value_of(VertexDistance(tissue), bent, energy) == 0
        # An arc of half-angle a and chord c has the height c a / 4 at its middle, 2/3 of that on average.
        assert 1e-5 < value_of(EdgeDistance(tissue), bent, energy) < 1e-2

    def test_distance_converges_with_the_number_of_points(self):
        target = cluster(5, inner_arcs=True)
        tissue = with_angles(target, angles_of(target) + 0.2)
        energy = ShapeFactorEnergy(3.8)
        values = [value_of(EdgeDistance(target, n), tissue, energy) for n in (40, 80)]
        assert values[0] == pytest.approx(float(values[1]), rel=1e-3)

    def test_gradient_matches_finite_differences(self):
        target = cluster(5, inner_arcs=True)
        energy = ShapeFactorEnergy(3.8)
        y, unravel = jax.flatten_util.ravel_pytree(target.configuration)
        y = y + 0.05 * jax.random.normal(jax.random.key(0), y.shape)
        cost = lambda y: EdgeDistance(target)(target.with_configuration(unravel(y)), energy)
        evaluate = jax.jit(jax.value_and_grad(cost))
        direction = jax.random.normal(jax.random.key(1), y.shape)
        difference = central_difference(lambda y: evaluate(y)[0], y, direction)
        assert evaluate(y)[1] @ direction == pytest.approx(float(difference), rel=1e-7)

    def test_invalid_input_is_rejected(self):
        with pytest.raises(ValueError, match="`points_per_edge` must be at least 2"):
            EdgeDistance(random_tissue(6), 1)
        with pytest.raises(ValueError, match="must have 15 edges"):
            EdgeDistance(random_tissue(6))(random_tissue(5), ShapeFactorEnergy(3.8))
