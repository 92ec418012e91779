"""Line tension by the types of the two cells of an edge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, random_like, random_tissue

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, by_type

TABLE = jnp.array([[0.14, 0.11], [0.11, 0.02]])
TYPES = jnp.arange(12) % 2
tissue = random_tissue(12, 1, lloyd_steps=5)
free = vx.initialise.free_voronoi(12, key=jax.random.key(3), lloyd_steps=3)


def tensions_by_hand(tissue, table, types, outline):
    """The tension of each edge, by a loop over edges."""
    cells = np.asarray(tissue.topology.edge_cells)
    at = lambda a, b: outline[types[a]] if b == tissue.n_cells else table[types[a]][types[b]]
    return np.array([at(a, b) for a, b in cells])


@pytest.mark.parametrize("where", [tissue, free], ids=["periodic", "free"])
def test_energy_is_the_line_tension_of_the_table(where):
    energy = by_type(TABLE, TYPES, outline=[0.16, 0.3])
    tension = tensions_by_hand(where, TABLE, TYPES, [0.16, 0.3])
    np.testing.assert_allclose(energy.edge_tensions(where), tension)
    assert energy(where) == pytest.approx(float(LineTension(jnp.asarray(tension))(where)))
    np.testing.assert_array_equal(energy.table, TABLE)


def test_table_of_three_types_is_read_row_by_row():
    table = jnp.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    energy = by_type(table, jnp.arange(12) % 3)
    np.testing.assert_array_equal(energy.tension, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(energy.table, table)


def test_derivatives_by_the_table_match_finite_differences():
    def total(parameters):
        table, outline = parameters
        return by_type(table + table.T, TYPES, outline=outline)(free) ** 2

    parameters = (TABLE, jnp.array(0.16))
    gradient = jax.grad(total)(parameters)
    direction = random_like(parameters)
    slope = sum(jnp.sum(g * d) for g, d in zip(gradient, direction, strict=True))
    difference = central_difference(jax.jit(total), parameters, direction)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)
    assert np.all(np.asarray(gradient[0]) != 0)
    assert gradient[1] != 0


def test_forces_match_finite_differences():
    energy = by_type(TABLE, TYPES, outline=0.16) + AreaElasticity(1.0, 1.0)
    total = jax.jit(lambda y: energy(free.with_configuration(y)))
    direction = random_like(free.configuration)
    gradient = jax.grad(total)(free.configuration)
    slope = sum(jnp.sum(g * d) for g, d in zip(gradient, direction, strict=True))
    difference = central_difference(total, free.configuration, direction)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_energy_is_invariant_under_exchange_of_the_types():
    swapped = by_type(TABLE[::-1, ::-1], 1 - TYPES, outline=[0.3, 0.16])
    energy = by_type(TABLE, TYPES, outline=[0.16, 0.3])
    assert swapped(free) == pytest.approx(float(energy(free)))


@pytest.mark.thorough
def test_tension_follows_the_cells_of_an_edge_through_a_t1_transition():
    energy = AreaElasticity(1.0, 1.0) + by_type(100 * TABLE, TYPES)
    end = vx.equilibrate(tissue, energy, throw=False)
    assert end.num_t1 > 0
    changed = np.any(end.tissue.topology.edge_cells != tissue.topology.edge_cells, axis=1)
    expected = tensions_by_hand(end.tissue, 100 * TABLE, TYPES, None)
    assert changed.any()
    np.testing.assert_allclose(energy.terms[1].edge_tensions(end.tissue), expected)


def test_spare_slots_have_no_tension():
    larger = free.with_capacity(14)
    energy = by_type(TABLE, jnp.append(TYPES, jnp.array([0, 1])), outline=0.16)
    alive = np.asarray(larger.topology.alive_edges)
    assert not energy.edge_tensions(larger)[~alive].any()
    assert energy(larger) == pytest.approx(float(by_type(TABLE, TYPES, outline=0.16)(free)))


def test_entries_are_the_parameters():
    energy = by_type(TABLE, TYPES, outline=0.16)
    leaves = jax.tree.leaves(eqx.filter(energy, eqx.is_inexact_array))
    assert [leaf.shape for leaf in leaves] == [(3,), ()]


@pytest.mark.parametrize(
    ("table", "types", "outline", "message"),
    [
        ([1.0, 2.0], TYPES, None, r"`table` must have shape \(types, types\)"),
        ([[1.0, 2.0], [3.0, 4.0]], TYPES, None, "`table` must be symmetric"),
        (TABLE, TYPES.astype(float), None, "`types` must hold one integer"),
        (TABLE, TYPES.at[5].set(2), None, "cell 5 has the type 2"),
        (TABLE, TYPES, [1.0, 2.0, 3.0], "`outline` must be one number"),
    ],
)
def test_wrong_arguments_are_named(table, types, outline, message):
    with pytest.raises(ValueError, match=message):
        by_type(table, types, outline=outline)


def test_wrong_tissues_are_named():
    with pytest.raises(ValueError, match="`types` must have shape"):
        by_type(TABLE, TYPES[:-1])(tissue)
    with pytest.raises(ValueError, match="`outline` must be a tension"):
        by_type(TABLE, TYPES)(free)
