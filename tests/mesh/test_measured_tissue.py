"""The cached geometry of a `MeasuredTissue` agrees with that of its tissue."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster

import vertax as vx
from vertax.mesh._measured_tissue import MeasuredTissue

pytestmark = pytest.mark.thorough

TISSUES = {
    "periodic": lambda: vx.initialise.periodic_voronoi(12, key=0),
    "spare slots": lambda: vx.initialise.periodic_voronoi(12, key=0).with_capacity(14),
    "free": lambda: cluster(n_cells=9, seed=1),
    "foam": lambda: cluster(n_cells=9, seed=1, inner_arcs=True),
}
PROPERTIES = ("edge_lengths", "areas", "perimeters", "shape_factors")


@pytest.mark.parametrize("kind", TISSUES)
def test_properties_and_derivatives_agree_with_the_tissue(kind):
    tissue = TISSUES[kind]()
    start = tissue.configuration
    direction = jax.tree.map(lambda x: jax.random.normal(jax.random.key(1), x.shape), start)

    def energy(t):
        return sum(jnp.sum(jnp.sin((k + 2) * getattr(t, p))) for k, p in enumerate(PROPERTIES))

    def values(wrap):
        at = lambda x: energy(wrap(tissue.with_configuration(x)))
        return jax.jit(lambda x: (at(x), *jax.jvp(jax.grad(at), (x,), (direction,))))(start)

    cached, plain = values(MeasuredTissue), values(lambda t: t)
    for one, other in zip(jax.tree.leaves(cached), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10 * np.abs(other).max())


def test_cache_is_valid_for_the_same_arrays_only():
    tissue = TISSUES["periodic"]()
    moved = 1.1 * tissue.vertices
    wide = vx.Periodic(1.1 * tissue.boundary.lattice)
    both = lambda t: (t.vertices, t.boundary)
    grown, measured = eqx.tree_at(both, tissue, (moved, wide)), MeasuredTissue(tissue)
    elsewhere = {
        "method": eqx.tree_at(lambda t: t.boundary, measured.with_vertices(moved), wide),
        "tree_at": eqx.tree_at(both, measured, (moved, wide)),
    }
    for name, other in elsewhere.items():
        for p in PROPERTIES:
            expected = getattr(grown, p)
            np.testing.assert_allclose(getattr(other, p), expected, rtol=1e-12, err_msg=name)
    softer = eqx.tree_at(lambda t: t.softening, measured, jnp.asarray(0.5))
    assert jnp.all(softer.edge_lengths > measured.edge_lengths)
    inside = eqx.filter_jit(lambda t, x: t.with_vertices(x).areas)
    np.testing.assert_array_equal(inside(measured, moved), tissue.with_vertices(moved).areas)
