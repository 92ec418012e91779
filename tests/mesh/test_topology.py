"""The half-edge mesh: invariants, validation, edge flips."""

import copy
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue, tissues
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax._base.half_edges import clockwise, counter_clockwise
from vertax.transitions._euler_operators import flip_edges

flip = jax.jit(flip_edges)


@settings(max_examples=12, deadline=None)
@given(tissues())
def test_rotation_system_is_consistent(recipe):
    tissue = recipe()
    m = tissue.topology
    names = ("twin", "next", "previous", "source", "target", "cell", "offset")
    twin, following, previous, source, target, cell, offset = (
        np.asarray(getattr(m, n)) for n in names
    )
    h = np.arange(m.n_half_edges)
    assert (twin[twin] == h).all()
    assert (following[previous] == h).all()
    assert (previous[following] == h).all()
    assert (target == source[twin]).all()
    assert (cell[following] == cell).all()
    assert (offset[twin] == -offset).all()
    assert m.n_vertices - m.n_edges + m.n_cells == 0
    assert m.neighbour_counts.sum() == m.n_half_edges


def test_rotations_around_a_vertex():
    h = jnp.arange(30, dtype=jnp.int32)
    np.testing.assert_array_equal(clockwise(counter_clockwise(h)), h)
    np.testing.assert_array_equal(clockwise(h) // 3, h // 3)
    np.testing.assert_array_equal(clockwise(clockwise(clockwise(h))), h)
    assert counter_clockwise(jnp.int32(4)) == 5


def _break(tissue, **changes):
    m = tissue.topology
    fields = {"twin": m.twin, "cell": m.cell, "frame": m.frame, "edge": m.edge}
    fields: dict[str, Any] = {name: np.array(value) for name, value in fields.items()}
    for name, change in changes.items():
        fields[name] = change(fields[name])
    return lambda: vx.Topology(**fields)


def _swap_twins(twin):
    twin = twin.copy()
    a, b = 0, 7
    ta, tb = twin[a], twin[b]
    twin[[a, tb]], twin[[b, ta]] = [tb, a], [ta, b]
    return twin


def _set(index, value):
    def change(array):
        array = array.astype(np.int64)
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"twin": _set(0, 5)}, "involution"),
        ({"twin": lambda t: np.arange(len(t))}, "its own twin"),
        ({"twin": lambda t: t[:-1]}, "three half-edges"),
        ({"twin": _swap_twins}, "broken"),
        ({"cell": _set(0, 3)}, "broken"),
        ({"cell": lambda c: np.where(c == 4, 3, c)}, "broken"),
        ({"cell": lambda c: np.where(c == 4, 40, c)}, "every cell must have half-edges"),
        ({"cell": lambda c: c[:-1]}, "`cell` must have one entry"),
        (
            {"cell": _set(0, 2**40)},
            "fewer than half-edges, but goes from 0 to",
        ),
        ({"cell": lambda c: c - 1}, "but goes from -1 to"),
        ({"cell": lambda c: c + 0.0}, "`cell` must hold integers, but its type is float64"),
        ({"twin": lambda t: t + 0.0}, "`twin` must hold integers"),
        ({"twin": _set(0, 2**40)}, "involution"),
        ({"twin": _set(0, -1)}, "involution"),
        ({"frame": lambda f: f + 0.5}, "`frame` must hold integers"),
        ({"frame": _set((0, 1), 2**40)}, "`frame` must hold lattice images in the range of 32-bit"),
        ({"edge": _set(0, 2**40)}, "`edge` must give each half-edge a number"),
        ({"edge": lambda e: e + 0.0}, "`edge` must give each half-edge a number"),
        ({"frame": _set((0, 1), 7)}, "opposite lattice offsets"),
        ({"frame": lambda f: f[:, :1]}, "two entries"),
        ({"edge": _set(0, 3)}, "`edge`|edge number"),
        ({"edge": lambda e: e + 1}, "`edge`"),
    ],
)
def test_violated_invariants_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        _break(random_tissue(8), **changes)()


def test_disconnected_meshes_are_rejected():
    m = random_tissue(8).topology
    n = m.n_half_edges
    with pytest.raises(ValueError, match="in one piece"):
        vx.Topology(
            np.concatenate([m.twin, m.twin + n]),
            np.concatenate([m.cell, m.cell + m.n_cells]),
            np.concatenate([m.frame, m.frame]),
        )


def test_a_cell_with_two_sides_is_rejected():
    # Flip an edge of a cell with three sides, which the T1 rule would not flip.
    for seed in range(50):
        m = random_tissue(20, seed).topology
        cells = np.asarray(m.edge_cells)
        triangle = np.flatnonzero(np.asarray(m.neighbour_counts) == 3)
        if len(triangle):
            edge = np.flatnonzero((cells == triangle[0]).any(axis=1))[0]
            broken = flip(m, jnp.arange(m.n_edges) == edge)
            with pytest.raises(ValueError, match="at least three sides"):
                broken.validate()
            return
    pytest.fail("no cell with three sides among the test tissues")


def _flippable(m):
    sides = np.asarray(m.neighbour_counts)
    h, cell = np.asarray(m.half_edge), np.asarray(m.cell)
    turn = lambda x: np.where(x % 3 == 2, x - 2, x + 1)
    ends = np.stack([cell[turn(x)] for x in (h, np.asarray(m.twin)[h])], axis=-1)
    left, right = np.asarray(m.edge_cells).T
    ok = (sides[left] > 3) & (sides[right] > 3) & (left != right) & (ends[:, 0] != ends[:, 1])
    return np.flatnonzero(ok), ends


@settings(max_examples=10, deadline=None)
@given(tissues(min_cells=5), st.lists(st.integers(0, 10**6), min_size=1, max_size=8))
def test_flips_preserve_all_invariants(recipe, choices):
    tissue = recipe()
    area = float(tissue.areas.sum())
    for choice in choices:
        m = tissue.topology
        possible, ends = _flippable(m)
        edge = possible[choice % len(possible)]
        flipped = flip(m, jnp.asarray(np.arange(m.n_edges) == edge))
        flipped.validate()
        assert set(np.asarray(flipped.edge_cells)[edge]) == set(ends[edge])
        others = np.arange(m.n_edges) != edge
        before, after = np.asarray(m.edge_cells), np.asarray(flipped.edge_cells)
        # All other edges keep their cells and their numbers.
        assert (np.sort(before[others]) == np.sort(after[others])).all()
        tissue = tissue.with_topology(flipped)
        assert float(tissue.areas.sum()) == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize("edge", [0, 7, 31])
def test_four_flips_are_the_identity(edge):
    m = random_tissue(16, 3).topology
    mark = jnp.arange(m.n_edges) == edge
    twice = flip(flip(m, mark), mark)
    # Two quarter turns exchange the ends of the edge; four change nothing at all.
    assert (twice.edge_cells[edge] == m.edge_cells[edge][::-1]).all()
    again = flip(flip(twice, mark), mark)
    for name in ("twin", "cell", "frame", "edge", "half_edge"):
        assert (getattr(again, name) == getattr(m, name)).all(), name


def test_flipping_no_edge_is_the_identity():
    m = random_tissue(16, 3).topology
    same = flip(m, jnp.zeros(m.n_edges, bool))
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), m, same)))


def _same(one, other):
    assert (one.n_cells, one.exterior) == (other.n_cells, other.exterior)
    for name in ("twin", "cell", "frame", "edge", "half_edge"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("numbered", [False, True])
@pytest.mark.parametrize("free", [pytest.param(False, marks=pytest.mark.thorough), True])
def test_construction_in_jit_and_vmap_agrees(free, numbered):
    make = vx.initialise.free_voronoi if free else vx.initialise.periodic_voronoi
    topologies = [make(9, key=jax.random.key(seed)).topology for seed in (1, 2)]
    # (Free clusters with the same number of cells may differ in their number of vertices.)
    topologies = topologies if not free else topologies[:1] * 2
    arrays = lambda m: (m.twin, m.cell, m.frame) + ((m.edge,) if numbered else ())
    build = lambda *arrays: vx.Topology(*arrays, exterior=free)
    plain = [build(*arrays(m)) for m in topologies]
    _same(jax.jit(build)(*arrays(topologies[0])), plain[0])
    many = jax.vmap(build)(
        *(jnp.stack(pair) for pair in zip(*map(arrays, topologies), strict=True))
    )
    for k in range(2):
        _same(jax.tree.map(lambda x, k=k: x[k], many), plain[k])


def test_shapes_and_dtypes_are_checked_inside_jit():
    m = random_tissue(8).topology
    build = jax.jit(vx.Topology)
    with pytest.raises(ValueError, match="`twin` must list three half-edges"):
        build(m.twin[:-1], m.cell, m.frame)
    with pytest.raises(ValueError, match="`cell` must have one entry"):
        build(m.twin, m.cell[:-1], m.frame)
    with pytest.raises(ValueError, match="`frame` must have two entries"):
        build(m.twin, m.cell, m.frame[:, :1])
    with pytest.raises(ValueError, match="`cell` must hold integers"):
        build(m.twin, m.cell + 0.5, m.frame)
    with pytest.raises(ValueError, match="`edge` must give each half-edge"):
        build(m.twin, m.cell, m.frame, m.edge[:-1])


@pytest.mark.parametrize(
    ("field", "value"), [("half_edge", 2**30), ("half_edge", -1), ("twin", 2**30), ("edge", -7)]
)
def test_indices_out_of_range_are_rejected(field, value):
    m = random_tissue(8).topology
    broken = eqx.tree_at(lambda m: getattr(m, field), m, getattr(m, field).at[3].set(value))
    with pytest.raises(ValueError, match=f"`{field}` must lie in 0 … "):
        broken.validate()


def test_a_number_of_cells_out_of_range_is_rejected():
    m = copy.copy(random_tissue(8).topology)
    object.__setattr__(m, "n_cells", 10**12)  # as in a damaged file
    with pytest.raises(ValueError, match="no more than half-edges"):
        m.validate()
