"""What edge frames say of a tissue after its edges turn is what that tissue says itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue

import vertax as vx
from vertax.transitions._edge_frames import EdgeFrames, suspects

TISSUES = {
    "periodic": lambda: random_tissue(40, 3),
    "spare slots": lambda: random_tissue(40, 3).with_capacity(44),
    "free": lambda: cluster(n_cells=30, seed=1),
    "foam": lambda: cluster(n_cells=30, seed=1, inner_arcs=True),
    "soft": lambda: vx.initialise.periodic_voronoi(40, key=1, softening=0.1),
}


def bent(tissue):
    """With some angle in every arc."""
    if tissue.arcs is None:
        return tissue
    angles = 0.3 * jax.random.normal(jax.random.key(3), (tissue.n_edges,))
    return tissue.with_angles(angles)


@pytest.mark.parametrize("kind", TISSUES)
def test_some_rows_are_rows_of_all(kind):
    tissue = bent(TISSUES[kind]())
    rows = jnp.array([5, 2, 11, 2])
    some, every = jax.jit(lambda t: (EdgeFrames(t, rows), EdgeFrames(t)))(tissue)
    for one, other in zip(jax.tree.leaves(some), jax.tree.leaves(every), strict=True):
        np.testing.assert_allclose(one, other[rows], rtol=1e-14)


@pytest.mark.parametrize("kind", TISSUES)
def test_whatever_may_flip_is_a_suspect(kind):
    tissue = bent(TISSUES[kind]())
    shaken = 0.3 * jax.random.normal(jax.random.key(2), tissue.vertices.shape)
    tissue = tissue.with_vertices(tissue.vertices + shaken)
    corner, suspected = EdgeFrames(tissue), suspects(tissue, jnp.array(0.3))
    candidates = corner.inside_out | (corner.length < 0.3)
    assert corner.inside_out.any()
    assert (corner.length < 0.3).any()
    assert not np.any(candidates & ~suspected)
    assert not suspected.all()
