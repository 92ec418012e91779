"""T2 transitions in relaxations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx

BOTH = vx.T1() + vx.T2()


def shrinking(capacity, cells, tension=0.1):
    areas = jnp.full(capacity, 1.2).at[jnp.asarray(cells)].set(0.0)
    return vx.energies.AreaElasticity(1.0, areas) + vx.energies.LineTension(tension)


@pytest.mark.thorough
def test_a_shrinking_cell_is_extruded():
    tissue = random_tissue(9, 1, lloyd_steps=2).with_capacity(10)
    energy = shrinking(10, [3])
    relaxed = vx.equilibrate(tissue, energy, transitions=BOTH, contact_range=None)
    relaxed.tissue.topology.validate()
    assert relaxed.converged
    assert not relaxed.tissue.alive[3]
    assert relaxed.tissue.alive.sum() == 8
    assert relaxed.tissue.areas.sum() == pytest.approx(float(tissue.areas.sum()))
    # The tissue without spare slots is in equilibrium.
    alone = relaxed.tissue.without_spare()
    energy = vx.energies.AreaElasticity(1.0, 1.2) + vx.energies.LineTension(0.1)
    force = jax.grad(lambda y: energy(alone.with_configuration(y)))(alone.vertices)
    np.testing.assert_allclose(force, 0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("inner_arcs", [False, True])
def test_cells_on_the_outline_are_extruded(inner_arcs):
    cluster = vx.initialise.free_voronoi(9, key=2, lloyd_steps=3, inner_arcs=inner_arcs)
    tissue = cluster.with_capacity(9)
    relaxed = vx.equilibrate(tissue, shrinking(9, [0, 1]), transitions=BOTH)
    relaxed.tissue.topology.validate()
    assert relaxed.converged
    np.testing.assert_array_equal(relaxed.tissue.alive, [False] * 2 + [True] * 7)


@pytest.mark.slow
def test_a_cell_loses_sides_by_t1_before_it_vanishes():
    tissue = random_tissue(9, 1, lloyd_steps=2).with_capacity(9)
    cell = int(jnp.argmax(tissue.neighbour_counts))
    assert tissue.neighbour_counts[cell] >= 6
    energy = shrinking(9, [cell])

    def evolve(rule, throw):
        return vx.evolve(
            tissue,
            energy,
            vx.dissipations.SubstrateFriction(1.0),
            jnp.linspace(0, 20, 41),
            relaxation=vx.Relaxation(transitions=rule, contact_range=None),
            throw=throw,
        )

    # A cell with six sides cannot collapse to a vertex.
    assert evolve(vx.T2(), throw=False).tissue.alive[cell]
    moved = evolve(BOTH, throw=True)
    assert not moved.tissue.alive[cell]
    assert moved.tissue.alive.sum() == 8
    sides = [int(frame.neighbour_counts[cell]) for frame in moved.trajectory]
    end = sides.index(0)
    assert (np.diff(sides[: end + 1]) <= 0).all(), sides
    assert moved.transitions.sum() >= sides[0] - 3 + 1  # T1s, and the T2


@pytest.mark.slow
def test_gradients_do_not_depend_on_spare_slots():
    tissue = random_tissue(9, 1, lloyd_steps=2)
    energy = lambda a, n: (
        vx.energies.AreaElasticity(1.0, a[:n]) + vx.energies.PerimeterElasticity(0.1, 3.6)
    )
    areas = jnp.linspace(0.8, 1.2, 12)

    def cost(a, start, n):
        relaxed = vx.equilibrate(start, energy(a, n), transitions=None)
        return jnp.sum(relaxed.tissue.perimeters**3)

    plain = jax.grad(cost)(areas, tissue, 9)
    roomy = jax.grad(cost)(areas, tissue.with_capacity(12), 12)
    np.testing.assert_allclose(roomy, plain, atol=1e-8)


def test_t2_without_spare_slots_is_rejected():
    with pytest.raises(ValueError, match="with_capacity"):
        vx.equilibrate(random_tissue(6), shrinking(6, [0]), transitions=vx.T2())
    with pytest.raises(ValueError, match="threshold"):
        vx.T2(threshold=0.0)
    assert len((BOTH + vx.T2()).rules) == 3  # pyright: ignore[reportAttributeAccessIssue]
