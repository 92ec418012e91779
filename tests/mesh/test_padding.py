"""Padding of tissues to size classes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue
from hypothesis import given, strategies as st
from jaxtyping import Array, Float

import vertax as vx
from vertax.mesh import pad
from vertax.mesh._capacity import size_class
from vertax.mesh._geometry import geometry_of

N = 9


@given(st.integers(1, 100_000))
def test_size_class_adds_at_most_a_quarter_and_is_idempotent(n):
    size = size_class(n)
    assert n <= size <= 1.25 * n
    assert size_class(size) == size


def test_similar_sizes_share_size_classes():
    assert len({size_class(n) for n in range(90, 111)}) == 2


@pytest.mark.thorough
def test_relaxation_does_not_depend_on_padding():
    tissue, energy = random_tissue(N), vx.energies.ShapeFactorEnergy(jnp.linspace(3.6, 3.8, N))
    padded, longer = pad(tissue, energy)
    assert padded.n_cells == len(longer.target_shape_factor) == 11
    assert np.asarray(longer.target_shape_factor)[N] == 3.6
    alone, together = (
        vx.equilibrate(*pair).tissue for pair in ((tissue, energy), (padded, longer))
    )
    np.testing.assert_allclose(together.without_spare().vertices, alone.vertices, atol=1e-7)


def test_only_declared_axes_are_padded():
    class Network(eqx.Module):
        weights: Float[Array, "cells"]
        by_edge: Float[Array, "knots edges"]
        matrix: Float[Array, "inputs outputs"]
        number: float

    tissue = random_tissue(N)
    n_edges = tissue.n_edges
    network = Network(jnp.arange(N), jnp.ones((2, n_edges)), jnp.ones((N, n_edges)), 2.0)
    padded, longer = pad(tissue, network)
    assert longer.weights.tolist() == [*range(N), 0, 0]
    assert longer.by_edge.shape == (2, padded.n_edges)
    assert eqx.tree_equal(longer.matrix, network.matrix)


def test_undeclared_axes_of_matching_size_are_rejected():
    class Vague(eqx.Module):
        weights: Array

    with pytest.raises(TypeError, match="Field `weights` of Vague must declare"):
        pad(random_tissue(N), Vague(jnp.ones(N)))
    with pytest.raises(ValueError, match="one entry for each of 9 cells"):
        pad(random_tissue(N), vx.energies.ShapeFactorEnergy(jnp.ones(8)))


def test_padding_inside_jit_is_rejected():
    with pytest.raises(TypeError, match=r"does not work inside jax\.jit"):
        eqx.filter_jit(pad)(random_tissue(N))


@pytest.mark.parametrize("arcs", [None, False, True])
def test_numpy_geometry_agrees_with_the_tissue(arcs):
    if arcs is None:
        tissue = random_tissue(N)
    else:
        tissue = vx.initialise.free_voronoi(N, key=jax.random.key(0), inner_arcs=arcs)
    geometry = geometry_of(tissue)
    for name in ("edge_vectors", "edge_lengths", "edge_angles", "areas"):
        np.testing.assert_allclose(getattr(geometry, name), getattr(tissue, name), atol=1e-12)
    for name in ("edge_vertices", "edge_cells", "forward"):
        np.testing.assert_array_equal(getattr(geometry, name), getattr(tissue.topology, name))
