"""Gathering vertices at the ends of edges agrees with indexing, in all derivatives and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.mesh._edge_ends import gather_at_ends

pytestmark = pytest.mark.thorough

TISSUES = {
    "periodic": vx.initialise.periodic_voronoi(12, key=0),
    "free": vx.initialise.free_voronoi(9, key=1),
    "spare slots": vx.initialise.periodic_voronoi(12, key=2).with_capacity(15),
}
of_each_tissue = pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)


def gathered(topology: vx.mesh.Topology, values: jax.Array) -> jax.Array:
    return jnp.stack(gather_at_ends(topology, values))


def indexed(tissue: vx.Tissue, values: jax.Array) -> jax.Array:
    return jnp.concatenate([values[ends].T for ends in tissue.topology.edge_vertices.T])


def random(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


@of_each_tissue
def test_gather_agrees_with_indexing(tissue):
    values = random(0, tissue.n_vertices, 2)
    np.testing.assert_array_equal(gathered(tissue.topology, values), indexed(tissue, values))


@of_each_tissue
def test_transpose_agrees_with_indexing_and_has_no_scatter(tissue):
    values, parts = random(0, tissue.n_vertices, 2), random(1, 4, tissue.n_edges)
    gather = lambda x: gathered(tissue.topology, x)
    (back,) = jax.linear_transpose(gather, values)(parts)
    (expected,) = jax.linear_transpose(lambda x: indexed(tissue, x), values)(parts)
    np.testing.assert_allclose(back, expected, atol=1e-14)
    transposed = jax.jit(lambda p: jax.linear_transpose(gather, values)(p))
    assert "scatter" not in transposed.lower(parts).as_text()
    # The transpose of the transpose is the function itself.
    again = jax.linear_transpose(lambda p: jax.linear_transpose(gather, values)(p)[0], parts)(
        values
    )
    np.testing.assert_array_equal(again[0], gather(values))


@of_each_tissue
def test_derivatives_agree_with_indexing(tissue):
    x, v = random(2, tissue.n_vertices, 2), random(3, tissue.n_vertices, 2)
    nonlinear = lambda gather: lambda x: jnp.sum(jnp.sin(gather(x)) * jnp.cos(gather(x)[::-1]))
    ours = nonlinear(lambda x: gathered(tissue.topology, x))
    plain = nonlinear(lambda x: indexed(tissue, x))
    for derivative in (
        jax.grad,
        jax.jacfwd,
        lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (v,))[1],
        lambda f: lambda x: jax.grad(lambda x: jnp.vdot(jax.grad(f)(x), v))(x),
        lambda f: lambda x: jax.grad(lambda x: jax.jvp(f, (x,), (v,))[1])(x),
    ):
        np.testing.assert_allclose(derivative(ours)(x), derivative(plain)(x), atol=1e-12)


def test_vmap_over_values_and_topologies():
    tissues = [vx.initialise.periodic_voronoi(12, key=k) for k in range(3)]
    topologies = vx.fitting.stack([t.topology for t in tissues])
    values = random(4, 3, tissues[0].n_vertices, 2)
    forces = jax.grad(lambda x, m: jnp.sum(gathered(m, x) ** 3))
    together = jax.vmap(forces)(values, topologies)
    for k, tissue in enumerate(tissues):
        np.testing.assert_allclose(together[k], forces(values[k], tissue.topology), rtol=1e-12)
    shared = jax.vmap(forces, in_axes=(0, None))(values, tissues[0].topology)
    np.testing.assert_allclose(shared[1], forces(values[1], tissues[0].topology), rtol=1e-12)
    # Also the derivative of a batch.
    total = lambda x: jnp.sum(jax.vmap(lambda x: jnp.sum(gathered(tissues[0].topology, x) ** 3))(x))
    np.testing.assert_allclose(jax.grad(total)(values), shared, rtol=1e-12)


def test_derivatives_of_a_function_of_one_component():
    tissue = TISSUES["periodic"]
    x, v = random(6, tissue.n_vertices, 2), random(7, tissue.n_vertices, 2)
    first = lambda gather: lambda x: jnp.sum(gather(x)[0] ** 3)
    ours = first(lambda x: gather_at_ends(tissue.topology, x))
    plain = first(lambda x: indexed(tissue, x))
    for derivative in (
        jax.grad,
        lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (v,))[1],
        lambda f: lambda x: jax.grad(lambda x: jnp.vdot(jax.grad(f)(x), v))(x),
    ):
        np.testing.assert_allclose(derivative(ours)(x), derivative(plain)(x), atol=1e-12)


def test_gradient_of_float32_is_float32():
    tissue = TISSUES["periodic"]
    values = random(5, tissue.n_vertices, 2).astype(jnp.float32)
    gradient = jax.grad(lambda x: jnp.sum(gathered(tissue.topology, x) ** 2))(values)
    assert gradient.dtype == jnp.float32
