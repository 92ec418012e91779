"""T1 transitions by Surface Evolver."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from vertax.external._evolver_strings import Strings
from vertax.external._simulator import Edges, SimulatorError, clockwise
from vertax.mesh import Tissue, Topology


def flip_by_program(
    tissue: Tissue, edge: int, length: float, run: Callable[[str, str], tuple[str, str]]
) -> Tissue | None:
    """A tissue with an edge flipped by the program's `t1_edgeswap`; None if it rejects the flip.

    **Arguments:**

    - `tissue`: the tissue, in NumPy arrays.
    - `edge`: the index of the edge.
    - `length`: minimum length of the flipped edge.
    - `run`: a function of a datafile and commands that returns the result of the program and its log.
    """
    commands = [
        f"t1_edgeswap edge[{edge + 1}];",
        'foreach edge ee do printf "%d %d %d\\n", ee.id, ee.vertex[1].id, ee.vertex[2].id >> "result";',
        'printf "end\\n" >> "result";',
        "quit",
        "quit",
        "",
    ]
    rows = [line.split() for line in run(_mesh(tissue), "\n".join(commands))[0].splitlines()]
    if rows[-1:] != [["end"]]:
        raise SimulatorError("The output of evolver after a T1 transition is incomplete.")
    reported = np.array(rows[:-1], int)
    ends = np.sort(reported[np.argsort(reported[:, 0]), 1:] - 1, axis=1)
    before = Edges.of(tissue)
    if np.array_equal(ends, np.sort(before.ends, axis=1)):
        return None
    topology = flip_edge(tissue.topology, edge)
    v, w = before.ends[edge]
    # vertax rotates the edge clockwise by 90 degrees; the program may rotate it counter-clockwise.
    after = Edges.of(eqx.tree_at(lambda t: t.topology, tissue, topology)).ends
    swapped_ends = after.copy()
    swapped_ends[after == v], swapped_ends[after == w] = w, v
    if np.array_equal(ends, np.sort(after, axis=1)) or np.array_equal(
        ends, np.sort(swapped_ends, axis=1)
    ):
        return _with_rotated_edge(tissue, topology, before, edge, length)
    raise SimulatorError(f"The flip of edge {edge} by evolver is not a T1 transition.")


def _with_rotated_edge(
    tissue: Tissue, topology: Topology, edges: Edges, edge: int, length: float
) -> Tissue:
    """The tissue in its new topology, with the flipped edge rotated by 90 degrees about its midpoint."""
    vertices = np.array(tissue.vertices)
    v, w = edges.ends[edge]
    along = edges.vectors(vertices)[edge]
    middle = vertices[v] + 0.5 * along
    size = max(float(np.hypot(*along)), length)
    direction = along / max(float(np.hypot(*along)), 1e-300)
    half = 0.5 * size * np.array([-direction[1], direction[0]])
    vertices[v], vertices[w] = middle + half, middle - half - edges.across[edge]
    return eqx.tree_at(lambda t: (t.topology, t.vertices), tissue, (topology, vertices))


def can_flip(topology: Topology) -> Bool[np.ndarray, " edges"]:
    """Whether each edge may flip: no cell gets two sides, and no neighbour is the exterior."""
    h, t, *_ = _edge_neighbourhood(topology, np.asarray(topology.half_edge))
    cell = np.asarray(topology.cell)
    # The cells on the left, on the right, and at both ends.
    left, right = cell[h], cell[t]
    first, last = cell[counter_clockwise(h)], cell[counter_clockwise(t)]
    sides = np.bincount(cell, minlength=topology.n_cells + 2)
    inner = np.max([left, right, first, last], axis=0) < topology.n_cells
    # (After the flip the cells at the ends are on both sides of the edge, so they must differ.)
    return inner & (sides[left] > 3) & (sides[right] > 3) & (first != last)


def flip_edge(topology: Topology, edge: int) -> Topology:
    """A topology with one edge flipped, as `vertax.transitions._euler_operators.flip_edges`, in NumPy.

    (A simulator runs inside a callback, where JAX must not be called.)
    """
    twin, cell, frame, number, half_edge = (
        np.array(x)
        for x in (topology.twin, topology.cell, topology.frame, topology.edge, topology.half_edge)
    )
    h, t, a, b, c, d = (int(x[0]) for x in _edge_neighbourhood(topology, half_edge[[edge]]))
    old_cell, old_frame = cell.copy(), frame.copy()
    roll = np.arange(len(twin))
    roll[[a, b, c, d]] = [b, c, d, a]
    unroll = np.argsort(roll)
    cell = cell[unroll]
    cell[[h, t]] = old_cell[[c, a]]
    step = old_frame[d] - old_frame[h]
    for slot, value in (
        (h, old_frame[c] - step),
        (a, old_frame[h]),
        (b, old_frame[a]),
        (t, old_frame[a] + step),
        (c, old_frame[t]),
        (d, old_frame[c]),
    ):
        frame[slot] = value
    arrays = (roll[twin[unroll]], cell, frame, number[unroll], roll[half_edge])
    arrays = tuple(x.astype(np.int32) for x in arrays)
    return eqx.tree_at(lambda m: (m.twin, m.cell, m.frame, m.edge, m.half_edge), topology, arrays)


def _edge_neighbourhood(topology: Topology, h: Int[np.ndarray, " edges"]) -> tuple[np.ndarray, ...]:
    """Half-edges, their twins, and the four other half-edges at their ends, counter-clockwise."""
    t = np.asarray(topology.twin)[h]
    return h, t, counter_clockwise(h), clockwise(h), counter_clockwise(t), clockwise(t)


def counter_clockwise(h: Int[np.ndarray, " edges"]) -> Int[np.ndarray, " edges"]:
    return np.where(h % 3 == 2, h - 2, h + 1)


def _mesh(tissue: Tissue) -> str:
    """Vertices, edges and faces of a tissue as a datafile, for the program's T1 transitions."""
    topology = tissue.topology
    head, points, strings = Strings.of(tissue).lines()
    lines = [*head, "vertices", *points, "edges", *strings, "faces"]
    twin, cell, number = (np.asarray(x) for x in (topology.twin, topology.cell, topology.edge))
    direction = np.where(np.asarray(topology.half_edge)[number] == np.arange(len(twin)), 1, -1)
    following = clockwise(twin)
    for face in range(topology.n_cells):
        first = int(np.flatnonzero(cell == face)[0])
        loop, h = [], first
        while not loop or h != first:
            loop.append(f"{direction[h] * (number[h] + 1)}")
            h = int(following[h])
        lines.append(f"{face + 1} {' '.join(loop)}")
    return "\n".join([*lines, "read", ""])
