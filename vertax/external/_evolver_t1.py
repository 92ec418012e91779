"""T1 transitions by Surface Evolver."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.external._evolver_strings import Strings
from vertax.external._simulator import Edges, SimulatorError
from vertax.mesh import Tissue, Topology


def swapped(
    tissue: Tissue, edge: int, length: float, ask: Callable[[str, str], str]
) -> Tissue | None:
    """A tissue with an edge flipped by the program's `t1_edgeswap`; None if it does not flip this one.

    **Arguments:**

    - `tissue`: the tissue, in NumPy arrays.
    - `edge`: which one.
    - `length`: how long it is then, at least.
    - `ask`: what the program writes, given a datafile and commands.
    """
    commands = [
        f"t1_edgeswap edge[{edge + 1}];",
        'foreach edge ee do printf "%d %d %d\\n", ee.id, ee.vertex[1].id, ee.vertex[2].id >> "result";',
        'printf "end\\n" >> "result";',
        "quit",
        "quit",
        "",
    ]
    rows = [line.split() for line in ask(_mesh(tissue), "\n".join(commands)).splitlines()]
    if rows[-1:] != [["end"]]:
        raise SimulatorError("evolver did not come to the end of a T1 transition.")
    said = np.array(rows[:-1], int)
    ends = np.sort(said[np.argsort(said[:, 0]), 1:] - 1, axis=1)
    before = Edges.of(tissue)
    if np.array_equal(ends, np.sort(before.ends, axis=1)):
        return None
    topology = flipped(tissue.topology, edge)
    v, w = before.ends[edge]
    # The edge turns by a quarter, clockwise by our rule; the program may turn it the other way.
    after = Edges.of(eqx.tree_at(lambda t: t.topology, tissue, topology)).ends
    turned = after.copy()
    turned[after == v], turned[after == w] = w, v
    if np.array_equal(ends, np.sort(after, axis=1)) or np.array_equal(
        ends, np.sort(turned, axis=1)
    ):
        return _turned(tissue, topology, before, edge, length)
    raise SimulatorError(f"evolver flipped edge {edge} in a way that is no T1 transition.")


def _turned(tissue: Tissue, topology: Topology, edges: Edges, edge: int, length: float) -> Tissue:
    """The tissue in its new topology, the flipped edge turned by a quarter about its middle."""
    vertices = np.array(tissue.vertices)
    v, w = edges.ends[edge]
    along = edges.vectors(vertices)[edge]
    middle = vertices[v] + 0.5 * along
    size = max(float(np.hypot(*along)), length)
    way = along / max(float(np.hypot(*along)), 1e-300)
    half = 0.5 * size * np.array([-way[1], way[0]])
    vertices[v], vertices[w] = middle + half, middle - half - edges.across[edge]
    return eqx.tree_at(lambda t: (t.topology, t.vertices), tissue, (topology, vertices))


def can_flip(topology: Topology) -> Bool[np.ndarray, " edges"]:
    """Which edges may flip: no cell is left with two sides, and none is at an outline."""
    h, t, *_ = _around(topology, np.asarray(topology.half_edge))
    cell = np.asarray(topology.cell)
    # On the left, on the right, and (one slot on) at both ends.
    left, right = cell[h], cell[t]
    first, last = cell[_counter_clockwise(h)], cell[_counter_clockwise(t)]
    sides = np.bincount(cell, minlength=topology.n_cells + 2)
    inner = np.max([left, right, first, last], axis=0) < topology.n_cells
    # (A cell at both ends would be on both sides.)
    return inner & (sides[left] > 3) & (sides[right] > 3) & (first != last)


def flipped(topology: Topology, edge: int) -> Topology:
    """A topology with one edge flipped, by NumPy: within a call to a program nothing can be computed by JAX.

    See `vertax.mesh._topology.flip_edges`, which this follows.
    """
    twin, cell, frame, number, half_edge = (
        np.array(x)
        for x in (topology.twin, topology.cell, topology.frame, topology.edge, topology.half_edge)
    )
    h, t, a, b, c, d = (int(x[0]) for x in _around(topology, half_edge[[edge]]))
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


def _around(topology: Topology, h: Int[np.ndarray, " edges"]) -> tuple[np.ndarray, ...]:
    """Half-edges, their twins, and the four others at their ends, counter-clockwise."""
    t = np.asarray(topology.twin)[h]
    return h, t, _counter_clockwise(h), _clockwise(h), _counter_clockwise(t), _clockwise(t)


def _clockwise(h: Int[np.ndarray, " edges"]) -> Int[np.ndarray, " edges"]:
    return np.where(h % 3 == 0, h + 2, h - 1)


def _counter_clockwise(h: Int[np.ndarray, " edges"]) -> Int[np.ndarray, " edges"]:
    return np.where(h % 3 == 2, h - 2, h + 1)


def _mesh(tissue: Tissue) -> str:
    """Vertices, edges and faces of a tissue, which the program's T1 transitions look at."""
    strings, topology = Strings.of(tissue), tissue.topology
    lines = ["STRING", "SPACE_DIMENSION 2"]
    if strings.periodic:
        lines += ["TORUS", "PERIODS", *(f"{a:.17g} {b:.17g}" for a, b in strings.lattice)]
    fixed = set(strings.fixed.tolist())
    lines.append("vertices")
    lines += [
        f"{i + 1} {x:.17g} {y:.17g}{' fixed' if i in fixed else ''}"
        for i, (x, y) in enumerate(strings.points)
    ]
    lines.append("edges")
    sign = {0: "*", 1: "+", -1: "-"}
    for i, ((a, b), wrap) in enumerate(zip(strings.pieces.ends, strings.wraps, strict=True)):
        around = " " + " ".join(sign[int(w)] for w in wrap) if strings.periodic else ""
        lines.append(f"{i + 1} {a + 1} {b + 1}{around}")
    lines.append("faces")
    twin, cell, number = (np.asarray(x) for x in (topology.twin, topology.cell, topology.edge))
    way = np.where(np.asarray(topology.half_edge)[number] == np.arange(len(twin)), 1, -1)
    following = _clockwise(twin)
    for face in range(topology.n_cells):
        first = int(np.flatnonzero(cell == face)[0])
        loop, h = [], first
        while not loop or h != first:
            loop.append(f"{way[h] * (number[h] + 1)}")
            h = int(following[h])
        lines.append(f"{face + 1} {' '.join(loop)}")
    return "\n".join([*lines, "read", ""])


def shortest(
    lengths: Float[np.ndarray, " edges"], below: float, allowed: Bool[np.ndarray, " edges"]
) -> int | None:
    """The shortest edge below a length of those that are allowed; None if there is none."""
    lengths = np.where(allowed, lengths, np.inf)
    edge = int(np.argmin(lengths))
    return edge if lengths[edge] < below else None
