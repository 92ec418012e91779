"""Edges that a relaxation puts upright again and again are held, and four cells rest around a point."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import fine_difference, random_tissue

import vertax as vx
from vertax._base.indexing import take
from vertax.mesh._topology import edge_neighbourhood
from vertax.relax._barrier import profile
from vertax.relax._contacts import Contacts, no_contacts
from vertax.relax._inversion_barrier import _FADE, _LONG, _OFTEN, REACH, InversionBarrier
from vertax.transitions._edge_frames import EdgeFrames, edge_axis

pytestmark = pytest.mark.thorough

NUMBER = 4


def with_edge(tissue: vx.Tissue, length: float, across: float = 0.0) -> vx.Tissue:
    """The tissue with one edge of that length, turned from the way it ought to point by `across`."""
    corner = EdgeFrames(tissue)
    which = jnp.arange(tissue.n_edges) == NUMBER
    way = corner.along + across * corner.across
    return corner.place(tissue, which, way, jnp.full(tissue.n_edges, length))


def edge_axes(tissue: vx.Tissue) -> jax.Array:
    """Which way each edge ought to point."""
    m = tissue.topology
    outward = take(tissue.edge_vectors, m.edge)
    outward = jnp.where(m.forward[:, None], outward, -outward)
    _, *neighbours = edge_neighbourhood(m)
    return edge_axis(tissue.edge_vectors, *(take(outward, h) for h in neighbours))


def held(tissue: vx.Tissue, times: int = _OFTEN) -> InversionBarrier:
    """Its edge of that number put upright so often."""
    inversion = InversionBarrier.empty(tissue, jnp.asarray(REACH), jnp.asarray(2.0))
    for _ in range(times):
        inversion = updated(inversion, tissue, jnp.arange(tissue.n_edges) == NUMBER)
    return inversion


def holding(tissue: vx.Tissue, inversion: InversionBarrier) -> Contacts:
    """No contacts, but these edges are held."""
    contacts = no_contacts(0.01, jnp.asarray(1.0), tissue)
    return contacts.holding(tissue.topology, inversion)


def updated(inversion: InversionBarrier, tissue: vx.Tissue, turned) -> InversionBarrier:
    """After a step to that tissue, in which some edges were put upright."""
    return inversion.updated(turned, jnp.sum(tissue.edge_vectors**2, axis=1))


def numbers(inversion: InversionBarrier, tissue: vx.Tissue) -> list[int]:
    """The edges that are held."""
    return [e for e in inversion.edges.tolist() if e < tissue.n_edges]


@pytest.mark.thorough
def test_the_barrier_of_an_edge_turns_on_by_counts_and_off_by_length():
    short = with_edge(random_tissue(12, 3), REACH)
    assert numbers(held(short, _OFTEN - 1), short) == []
    inversion = held(short)
    assert numbers(inversion, short) == [NUMBER]
    nothing = jnp.zeros(short.n_edges, bool)
    assert numbers(updated(inversion, short, nothing), short) == [NUMBER]
    # One step may turn it again from where the barrier has ended.
    longer = with_edge(short, 1.01 * _FADE * REACH)
    assert holding(longer, inversion)(longer) == 0
    assert numbers(updated(inversion, longer, nothing), longer) == [NUMBER]
    grown = with_edge(short, 1.01 * _LONG * REACH)
    let_go = updated(inversion, grown, nothing)
    assert numbers(let_go, grown) == []
    # It is known of old, and held at once when it turns again.
    again = updated(let_go, short, jnp.arange(short.n_edges) == NUMBER)
    assert numbers(again, short) == [NUMBER]


def test_more_edges_than_rows_keep_some_barriers():
    tissue = random_tissue(12, 3)
    inversion = InversionBarrier.empty(tissue, jnp.asarray(REACH), jnp.asarray(2.0))
    for _ in range(_OFTEN):
        inversion = updated(inversion, tissue, jnp.ones(tissue.n_edges, bool))
    assert len(numbers(inversion, tissue)) == len(inversion.edges) < tissue.n_edges
    assert np.isfinite(holding(tissue, inversion)(tissue))


@pytest.mark.parametrize(
    "arcs",
    [pytest.param(False, id="straight"), pytest.param(True, id="arcs", marks=pytest.mark.thorough)],
)
@pytest.mark.parametrize("across", [0.0, 0.5])
def test_derivatives_agree_with_finite_differences(across, arcs):
    tissue = cluster(12, 3, inner_arcs=True) if arcs else random_tissue(12, 3)
    nearly = with_edge(tissue, 0.4 * REACH, across)
    inversion = held(nearly)
    assert numbers(inversion, nearly) == [NUMBER]
    way = np.random.default_rng(0).normal(size=nearly.vertices.shape)

    def plain(x):
        tissue = nearly.with_vertices(x)
        edge, axis = tissue.edge_vectors[NUMBER], edge_axes(tissue)[NUMBER]
        squared = edge @ edge
        length = jnp.sqrt(squared + (1e-4 * REACH) ** 2)
        upright = (length + edge @ axis / jnp.linalg.norm(axis)) / (2 * REACH)
        fade = (1 - squared / (_FADE * REACH) ** 2) ** 3
        return 2.0 * REACH * fade * profile(upright).value

    contacts = holding(nearly, inversion)
    energy = lambda x: contacts(nearly.with_vertices(x))
    assert energy(nearly.vertices) > 0
    both = lambda f: jax.jvp(jax.value_and_grad(f), (nearly.vertices,), (jnp.asarray(way),))
    for one, other in zip(*map(jax.tree.leaves, (both(energy), both(plain))), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * float(jnp.abs(other).max()))
    at = lambda x: energy(jnp.asarray(x))
    scale = REACH * way
    slope = jnp.sum(jax.grad(energy)(nearly.vertices) * scale)
    np.testing.assert_allclose(slope, fine_difference(at, nearly.vertices, scale), rtol=1e-6)


@pytest.mark.parametrize("times", [0, _OFTEN], ids=["free", "held"])
def test_a_step_across_a_barrier_is_shortened(times):
    """Otherwise the edge would be inverted and corrected again and again."""
    tissue = with_edge(random_tissue(20, 0), 2 * _FADE * REACH)
    energy = vx.energies.ShapeFactorEnergy(jnp.full(20, 3.7))
    search = vx.Relaxation().search(tissue, energy)
    state = search.begin(tissue, energy)
    assert state.contacts is not None
    contacts = state.contacts.holding(tissue.topology, held(tissue, times))
    start, true = search.feasibility.start(tissue, contacts, state.counts), jnp.array(True)
    ends = tissue.topology.edge_vertices[NUMBER]
    edge = tissue.edge_vectors[NUMBER]
    # A little beyond its middle, both from one end and from the other.
    goal = tissue.with_vertices(tissue.vertices.at[ends].add(0.6 * jnp.stack([edge, -edge])))
    arrived = search.feasibility(start, goal, energy, active=true, guarded=true, first=~true)
    assert not arrived.overlapping.any()
    other = jnp.ones(tissue.n_vertices, bool).at[ends].set(False)
    assert (arrived.fraction[other] == 1).all()
    assert (arrived.fraction[ends] == (0.25 if times else 1)).all()
    way = arrived.tissue.edge_vectors[NUMBER] @ edge_axes(arrived.tissue)[NUMBER]
    assert way > 0


class Turning(vx.AbstractEnergy):
    """A force that inverts an edge whether it has flipped or not."""

    force: jax.Array

    def __call__(self, tissue):
        edge, axis = tissue.edge_vectors[NUMBER], edge_axes(tissue)[NUMBER]
        return self.force * jnp.dot(edge, axis) / jnp.linalg.norm(axis)


@pytest.mark.thorough
def test_a_compressed_edge_relaxes():
    tissue = random_tissue(20, 0)
    energy = vx.energies.ShapeFactorEnergy(jnp.full(20, 3.7)) + Turning(jnp.asarray(1.0))
    equilibrium = vx.equilibrate(tissue, energy, tolerance=1e-8, max_steps=150)
    assert not equilibrium.tissue.overlaps.any
    edge, axis = equilibrium.tissue.edge_vectors[NUMBER], edge_axes(equilibrium.tissue)[NUMBER]
    length = jnp.linalg.norm(edge)
    share = (length + edge @ axis / jnp.linalg.norm(axis)) / 2
    assert length < _FADE * REACH
    assert 0 < share < REACH


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [35, 170])
def test_a_fluid_tissue_with_fourfold_vertices_relaxes(seed):
    tissue = vx.initialise.periodic_voronoi(100, key=seed)
    noise = jax.random.normal(jax.random.key(1 + seed), (100,))
    energy = vx.energies.ShapeFactorEnergy(3.9 + 0.1 * noise)
    assert vx.equilibrate(tissue, energy, tolerance=1e-8, max_steps=300).converged


@pytest.mark.thorough
def test_edges_of_a_large_tissue_stop_turning():
    """A step turned one, the sweep put it upright, and so on with period two."""
    relax = eqx.filter_jit(vx.Relaxation(tolerance=1e-8, max_steps=150))
    for seed in range(4):
        tissue = vx.initialise.periodic_voronoi(1000, key=jax.random.key(seed))
        noise = jax.random.normal(jax.random.key(1 + seed), (1000,))
        energy = vx.energies.ShapeFactorEnergy(3.9 + 0.1 * noise)
        assert relax(tissue, energy, throw=False).converged
