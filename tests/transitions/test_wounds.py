"""Recoil after ablation of an edge, and closure of wounds."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.mechanics import recoil
from vertax.transitions import ablate

FRICTION = vx.dissipations.SubstrateFriction(2.0)


@pytest.mark.slow
def test_recoil_velocity_is_proportional_to_the_tension():
    tissue = random_tissue(16, 2, lloyd_steps=3)
    truth = 0.2 + 0.08 * jnp.cos(2.4 * jnp.arange(tissue.n_edges))
    energy = vx.energies.AreaElasticity(2.0, 1.2) + vx.energies.LineTension(truth)
    rest = vx.equilibrate(tissue, energy).tissue
    fixed_topology = vx.Relaxation(transitions=None, contact_range=None)
    dt = 1e-4
    finite, linear = [], []
    for edge in range(tissue.n_edges):
        same, cut = ablate(rest, energy, edges=jnp.arange(tissue.n_edges) == edge)
        after = vx.evolve(same, cut, FRICTION, [0.0, dt], relaxation=fixed_topology).tissue
        ends = rest.topology.edge_vertices[edge]
        along = rest.edge_vectors[edge] / jnp.linalg.norm(rest.edge_vectors[edge])
        speed = lambda v, ends=ends, along=along: 0.5 * (v[ends[1]] - v[ends[0]]) @ along
        finite.append(2.0 * speed((after.vertices - rest.vertices) / dt))
        linear.append(2.0 * speed(recoil(rest, energy, FRICTION, edge)))
    # The force of very short edges is reduced by the softening.
    long = np.asarray(rest.edge_lengths > 0.05)
    assert long.sum() > 40
    true = np.asarray(truth)[long]
    np.testing.assert_allclose(np.asarray(linear)[long], true, rtol=1e-3)
    np.testing.assert_allclose(np.asarray(finite)[long], true, rtol=3e-3)


class PurseString(vx.AbstractLocalEnergy):
    """A contractile cable around holes with constant tension."""

    hole: jnp.ndarray
    tension: jnp.ndarray

    def cell_terms(self, tissue):
        return jnp.where(self.hole, self.tension * tissue.perimeters, 0)


@pytest.mark.slow
def test_a_purse_string_closes_a_wound():
    n = 25
    tissue = random_tissue(n, 1, lloyd_steps=20).with_capacity(n)
    energy = vx.energies.ShapeFactorEnergy(3.8, 1.4)  # target area above the mean area
    rest = vx.equilibrate(tissue, energy).tissue
    m = rest.topology
    neighbours = np.asarray(m.cell)[np.asarray(m.twin)][np.asarray(m.cell) == 0]
    killed = jnp.isin(jnp.arange(n), jnp.asarray([0, *neighbours]))
    wounded, left = ablate(rest, energy, cells=killed)
    hole = np.flatnonzero(np.asarray(killed & wounded.alive))
    assert hole.size == 1
    # (The outline has no corners between two ablated cells, so the area may change.)
    ablated_area = float(rest.areas[np.asarray(killed)].sum())
    assert wounded.areas[hole[0]] == pytest.approx(ablated_area, rel=0.3)
    assert wounded.areas.sum() == pytest.approx(n)
    response = vx.Relaxation(transitions=vx.T1() + vx.T2())
    times = np.linspace(0, 40, 41)
    closed = {}
    # (With a tension of 0.5 the pull of the edges that end at the hole keeps it open at rest.)
    for tension in (1.0, 3.0):
        cable = PurseString(killed, jnp.asarray(tension))
        evolved = vx.evolve(wounded, left + cable, FRICTION, times, relaxation=response)
        areas = np.asarray(eqx.filter_vmap(lambda t: t.areas)(evolved.frames))[:, hole[0]]
        assert (np.diff(areas) < 1e-9).all()
        assert not evolved.tissue.alive[hole[0]]
        assert evolved.tissue.alive.sum() == n - len(set(neighbours)) - 1
        assert evolved.tissue.areas.sum() == pytest.approx(n)
        assert not evolved.tissue.overlaps.any
        evolved.tissue.topology.validate()
        closed[tension] = times[np.argmax(areas == 0)]
        print(tension, closed[tension], areas[:12].round(2))
    assert 0 < closed[3.0] < closed[1.0]
