"""What edges see of their ends: as plain indexing sees it, with every derivative and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.mesh._edge_ends import gather_at_ends

TISSUES = {
    "periodic": vx.initialise.periodic_voronoi(12, key=0),
    "free": vx.initialise.free_voronoi(9, key=1),
    "spare slots": vx.initialise.periodic_voronoi(12, key=2).with_capacity(15),
}
of_each_tissue = pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)


def looked_up(topology: vx.mesh.Topology, values: jax.Array) -> jax.Array:
    return jnp.stack(gather_at_ends(topology, values))


def indexed(tissue: vx.Tissue, values: jax.Array) -> jax.Array:
    return jnp.concatenate([values[ends].T for ends in tissue.topology.edge_vertices.T])


def random(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


@of_each_tissue
def test_it_is_indexing(tissue):
    values = random(0, tissue.n_vertices, 2)
    np.testing.assert_array_equal(looked_up(tissue.topology, values), indexed(tissue, values))


@of_each_tissue
def test_its_transpose_is_that_of_indexing_and_is_no_scatter(tissue):
    values, parts = random(0, tissue.n_vertices, 2), random(1, 4, tissue.n_edges)
    look = lambda x: looked_up(tissue.topology, x)
    (back,) = jax.linear_transpose(look, values)(parts)
    (expected,) = jax.linear_transpose(lambda x: indexed(tissue, x), values)(parts)
    np.testing.assert_allclose(back, expected, atol=1e-14)
    transposed = jax.jit(lambda p: jax.linear_transpose(look, values)(p))
    assert "scatter" not in transposed.lower(parts).as_text()
    # The transpose of the transpose is where it began.
    again = jax.linear_transpose(lambda p: jax.linear_transpose(look, values)(p)[0], parts)(values)
    np.testing.assert_array_equal(again[0], look(values))


@of_each_tissue
def test_derivatives_of_every_kind_are_those_of_indexing(tissue):
    x, v = random(2, tissue.n_vertices, 2), random(3, tissue.n_vertices, 2)
    bent = lambda look: lambda x: jnp.sum(jnp.sin(look(x)) * jnp.cos(look(x)[::-1]))
    ours, plain = bent(lambda x: looked_up(tissue.topology, x)), bent(lambda x: indexed(tissue, x))
    for derivative in (
        jax.grad,
        jax.jacfwd,
        lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (v,))[1],
        lambda f: lambda x: jax.grad(lambda x: jnp.vdot(jax.grad(f)(x), v))(x),
        lambda f: lambda x: jax.grad(lambda x: jax.jvp(f, (x,), (v,))[1])(x),
    ):
        np.testing.assert_allclose(derivative(ours)(x), derivative(plain)(x), atol=1e-12)


def test_batches_of_values_and_of_tissues():
    tissues = [vx.initialise.periodic_voronoi(12, key=k) for k in range(3)]
    topologies = vx.fitting.stack([t.topology for t in tissues])
    values = random(4, 3, tissues[0].n_vertices, 2)
    forces = jax.grad(lambda x, m: jnp.sum(looked_up(m, x) ** 3))
    together = jax.vmap(forces)(values, topologies)
    for k, tissue in enumerate(tissues):
        np.testing.assert_allclose(together[k], forces(values[k], tissue.topology), rtol=1e-12)
    shared = jax.vmap(forces, in_axes=(0, None))(values, tissues[0].topology)
    np.testing.assert_allclose(shared[1], forces(values[1], tissues[0].topology), rtol=1e-12)
    # The derivative of a batch, too.
    total = lambda x: jnp.sum(
        jax.vmap(lambda x: jnp.sum(looked_up(tissues[0].topology, x) ** 3))(x)
    )
    np.testing.assert_allclose(jax.grad(total)(values), shared, rtol=1e-12)


def test_what_uses_one_part_alone_has_derivatives_as_well():
    tissue = TISSUES["periodic"]
    x, v = random(6, tissue.n_vertices, 2), random(7, tissue.n_vertices, 2)
    first = lambda look: lambda x: jnp.sum(look(x)[0] ** 3)
    ours = first(lambda x: gather_at_ends(tissue.topology, x))
    plain = first(lambda x: indexed(tissue, x))
    for derivative in (
        jax.grad,
        lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (v,))[1],
        lambda f: lambda x: jax.grad(lambda x: jnp.vdot(jax.grad(f)(x), v))(x),
    ):
        np.testing.assert_allclose(derivative(ours)(x), derivative(plain)(x), atol=1e-12)


def test_single_precision_stays():
    tissue = TISSUES["periodic"]
    values = random(5, tissue.n_vertices, 2).astype(jnp.float32)
    gradient = jax.grad(lambda x: jnp.sum(looked_up(tissue.topology, x) ** 2))(values)
    assert gradient.dtype == jnp.float32
