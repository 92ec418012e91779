"""Spare slots of tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue
from hypothesis import given, settings, strategies as st

import vertax as vx

pytestmark = pytest.mark.thorough


def free_tissue(n_cells=7, seed=1, **options):
    return vx.initialise.free_voronoi(n_cells, key=seed, lloyd_steps=2, **options)


KINDS = {
    "periodic": lambda: random_tissue(6, 3, lloyd_steps=1),
    "free": free_tissue,
    "foam": lambda: free_tissue(inner_arcs=True),
}
each_kind = pytest.mark.parametrize(
    "kind", ["periodic", pytest.param("free", marks=pytest.mark.slow), "foam"]
)


@each_kind
def test_adding_and_removing_spare_slots_is_the_identity(kind):
    tissue = KINDS[kind]()
    roomy = tissue.with_capacity(10)
    roomy.topology.validate()
    assert roomy.n_cells == 10
    assert roomy.alive.sum() == tissue.n_cells
    assert not roomy.overlaps.any
    np.testing.assert_allclose(roomy.areas[: tissue.n_cells], tissue.areas, atol=1e-14)
    for name in ("areas", "perimeters", "shape_factors", "centroids"):
        values = getattr(roomy, name)
        np.testing.assert_array_equal(values[tissue.n_cells :], 0)
    assert eqx.tree_equal(roomy.without_spare(), tissue)
    # (The position of spare vertices, a mean, is rounded differently.)
    compiled = jax.jit(lambda t: t.with_capacity(10))(tissue)
    assert eqx.tree_equal(compiled, roomy, rtol=1e-12, atol=1e-12)
    twice = tissue.with_capacity(8).with_capacity(10)
    assert eqx.tree_equal(twice.topology, roomy.topology)


@each_kind
def test_energy_and_forces_do_not_depend_on_spare_slots(kind):
    tissue = KINDS[kind]()
    roomy = tissue.with_capacity(9)
    energy = (
        vx.energies.ShapeFactorEnergy(3.7)
        + vx.energies.AreaElasticity(1.0, 1.3)
        + vx.energies.LineTension(0.2)
    )

    @eqx.filter_jit
    def value_and_force(t):
        return jax.value_and_grad(lambda y: energy(t.with_configuration(y)))(t.configuration)

    value, force = value_and_force(tissue)
    other, other_force = value_and_force(roomy)
    assert value == pytest.approx(float(other), abs=1e-12)
    for one, two in zip(jax.tree.leaves(force), jax.tree.leaves(other_force), strict=True):
        np.testing.assert_allclose(two[: len(one)], one, atol=1e-13)
        np.testing.assert_array_equal(two[len(one) :], 0)


@settings(max_examples=5, deadline=None)
@given(shift=st.floats(-3, 3), turn=st.floats(-1, 1))
def test_spare_vertices_do_not_change_rigid_motions(shift, turn):
    tissue = KINDS["free"]()
    roomy = tissue.with_capacity(9)

    def moved(t):
        rotation = jnp.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return t.with_vertices(t.vertices @ rotation.T + shift)

    back = moved(roomy).settled(roomy)
    alive = np.asarray(roomy.topology.alive_vertices)
    np.testing.assert_allclose(back.vertices[alive], roomy.vertices[alive], atol=1e-12)


def test_invalid_spare_slots_are_rejected():
    m = random_tissue(6, 3).with_capacity(8).topology
    twin = np.array(m.twin)
    a, b = twin.size - 12, twin.size - 6  # of two slots
    twin[[a, twin[a], b, twin[b]]] = twin[b], b, twin[a], a
    with pytest.raises(ValueError, match="spare slot"):
        vx.Topology(twin, m.cell, m.frame, spare=True)
    with pytest.raises(ValueError, match="cell"):
        vx.Topology(m.twin, m.cell, m.frame, m.edge)


def test_smaller_capacity_is_rejected():
    with pytest.raises(ValueError, match="capacity of the tissue"):
        random_tissue(6).with_capacity(5)
    with pytest.raises(TypeError, match=r"jax\.jit"):
        jax.jit(lambda t: t.without_spare())(random_tissue(6).with_capacity(7))


def test_pinned_vertices_stay_pinned():
    pinned = free_tissue()
    pinned = eqx.tree_at(
        lambda t: t.pinned, pinned, jnp.arange(pinned.n_vertices) < 2, is_leaf=lambda x: x is None
    )
    roomy = pinned.with_capacity(9)
    assert roomy.pinned is not None
    assert roomy.pinned.sum() == 2
    assert roomy.held is not None
    assert roomy.held.sum() == 2 + 2 * 2
    assert eqx.tree_equal(roomy.without_spare(), pinned)
