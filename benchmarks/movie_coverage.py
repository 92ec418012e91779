"""Coverage of the standard errors of `fit_movie`, on movies of known tensions.

    python benchmarks/movie_coverage.py [--movies 20]

Two programs make the movies, of 16 cells and 41 frames:

- `implicit`: `vertax.evolve` with ten steps between frames, a periodic tissue with T1 transitions;
- `chains`: explicit Euler steps of a cluster without transitions, in which each outer side is a chain of
  four straight pieces. Its nodes have the friction of a vertex, as in Chaste, and equal distances in each
  frame.

A row for each program, tracking noise and kind of tension: the root mean square error, the mean standard
error, and the share of errors within 1 and 1.96 standard errors (68 and 95 % if these are right).
"""

from __future__ import annotations

import argparse
import itertools
import warnings
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _arguments import count

import vertax as vx
from vertax.energies import AreaElasticity, by_type
from vertax.inference import Movie, fit_movie, movie_from_table

jax.config.update("jax_enable_x64", True)

N_CELLS, N_FRAMES, FRICTION = 16, 41, 0.7
TYPES = np.arange(N_CELLS) % 2
TABLE = np.array([[0.28, 0.22], [0.22, 0.12]])
OUTLINE = 0.2
# Of the tissue at rest from which a movie begins.
TABLE_BEFORE, OUTLINE_BEFORE = np.array([[0.16, 0.3], [0.3, 0.2]]), 0.16
PIECES, STEP, STEPS_PER_FRAME = 4, 0.01, 10
SHORTEST = 0.05
"""Of the inner edges: a shorter edge would need a transition."""


def energy_of(table: np.ndarray, outline: jax.Array | None) -> vx.AbstractEnergy:
    """The energy of both programs."""
    return AreaElasticity(1.0, 1.0) + by_type(jnp.asarray(table), TYPES, outline=outline)


def implicit(seed: int) -> list[vx.Tissue]:
    """Frames of a periodic tissue."""
    tissue = vx.initialise.periodic_voronoi(N_CELLS, key=seed)
    energy = energy_of(2 * TABLE, None)
    times = jnp.linspace(0, 6, N_FRAMES)
    friction = vx.dissipations.SubstrateFriction(FRICTION)
    return list(vx.evolve(tissue, energy, friction, times, substeps=10).trajectory)


def cluster_of_chains(seed: int) -> tuple[np.ndarray, list[list[Any]], np.ndarray, np.ndarray]:
    """Nodes of a free tissue, the nodes of each cell, and the nodes and the kind of each straight piece.

    Pieces of a chain follow one another.
    """
    tissue = vx.initialise.free_voronoi(N_CELLS, key=seed, lloyd_steps=3)
    tissue = vx.equilibrate(tissue, energy_of(TABLE_BEFORE, jnp.array(OUTLINE_BEFORE))).tissue
    m, lines = tissue.topology, vx.mesh.Drawing(tissue, PIECES).lines
    nodes = list(np.asarray(tissue.vertices))
    corners: list[list[Any]] = [[] for _ in range(N_CELLS)]
    pieces, kinds, cell = [], [], np.asarray(m.cell)
    source, following, twin = (np.asarray(x) for x in (m.source, m.next, m.twin))
    for first in np.unique(cell, return_index=True)[1]:
        h, outside = first, cell[first] == N_CELLS
        while not outside and (h != first or not corners[cell[h]]):
            start, end, other = source[h], source[following[h]], cell[twin[h]]
            chain: list[Any] = [start]
            if other == N_CELLS:
                for k in range(1, PIECES):
                    chain.append(len(nodes))
                    nodes.append(lines[h][k])
            if other > cell[h]:  # each edge once; the exterior has the largest number
                kind = 3 if other == N_CELLS else TYPES[cell[h]] + TYPES[other]
                pieces += zip(chain, [*chain[1:], end], strict=True)
                kinds += [kind] * len(chain)
            corners[cell[h]] += chain
            h = following[h]
    return np.array(nodes), corners, np.array(pieces), np.array(kinds)


@partial(jax.jit, static_argnames="n")
def explicit_steps(nodes, cells, pieces, tensions, n):
    """Explicit Euler steps; `cells` repeats the last node of a cell."""

    def energy(x):
        polygons = x[cells]
        a, b = polygons, jnp.roll(polygons, -1, axis=1)
        areas = 0.5 * jnp.sum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], axis=1)
        lengths = jnp.linalg.norm(x[pieces[:, 0]] - x[pieces[:, 1]], axis=-1)
        return 0.5 * jnp.sum((areas - 1) ** 2) + jnp.sum(tensions * lengths)

    step = lambda x, _: (x - STEP / FRICTION * jax.grad(energy)(x), None)
    return jax.lax.scan(step, nodes, None, length=n)[0]


def spaced(nodes: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Nodes with those of each chain at equal distances along it; `ends` are the nodes of all pieces."""
    nodes = nodes.copy()
    for pieces in ends.reshape(-1, PIECES, 2):
        chain = [*pieces[:, 0], pieces[-1, 1]]
        way = np.append(0, np.cumsum(np.linalg.norm(np.diff(nodes[chain], axis=0), axis=1)))
        at = np.linspace(0, way[-1], PIECES + 1)
        nodes[chain] = np.stack([np.interp(at, way, x) for x in nodes[chain].T], axis=1)
    return nodes


def chains(seed: int) -> dict[str, np.ndarray] | None:
    """A table of the corners of a cluster, with the nodes of its outline; None if an edge becomes short."""
    nodes, corners, pieces, kinds = cluster_of_chains(seed)
    longest = max(map(len, corners))
    cells = np.array([c + [c[-1]] * (longest - len(c)) for c in corners])
    tensions = np.array([*TABLE[np.triu_indices(2)], OUTLINE])[kinds]
    inner, rows = pieces[kinds < 3], []
    for frame in range(N_FRAMES):
        if frame:
            nodes = explicit_steps(nodes, cells, pieces, tensions, STEPS_PER_FRAME)
        nodes = places = spaced(np.asarray(nodes), pieces[kinds == 3])
        if np.linalg.norm(places[inner[:, 0]] - places[inner[:, 1]], axis=1).min() < SHORTEST:
            return None
        rows += [
            (frame, frame * STEPS_PER_FRAME * STEP, number, TYPES[number], *places[node])
            for number, polygon in enumerate(corners)
            for node in polygon
        ]
    return dict(zip(("frame", "time", "cell", "type", "x", "y"), np.array(rows).T, strict=True))


def noisy(movie: Movie, noise: float, seed: int) -> Movie:
    """The movie with noise in the positions of vertices."""
    rng = np.random.default_rng(seed)
    moved = movie.tissue.vertices + noise * rng.normal(size=movie.tissue.vertices.shape)
    return eqx.tree_at(lambda m: m.tissue.vertices, movie, moved)


def errors_of(
    movies: list[Movie], true: np.ndarray, noise: float, *, outline: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the tensions of each movie and their standard errors, that of the outline last."""
    guess = energy_of(np.full((2, 2), 0.2), jnp.array(0.15) if outline else None)
    results = []
    for number, movie in enumerate(movies):
        tracked = noisy(movie, noise, number)
        fit = fit_movie(tracked, guess, friction=FRICTION, noise=noise, node_friction=outline)
        energies: list[Any] = [fit.energy, fit.deviation]
        parts = [energy.terms[1] for energy in energies]
        results.append([np.append(x.tension, x.outline if outline else []) for x in parts])
    values, deviations = np.swapaxes(results, 0, 1)
    return values - true, deviations


def print_row(name: str, errors: np.ndarray, deviations: np.ndarray) -> None:
    """Print errors and coverage."""
    ratio, rms = np.abs(errors / deviations), np.sqrt(np.mean(errors**2))
    within = [np.mean(ratio < width) for width in (1, 1.96)]
    print(
        f"{name:34} {rms:8.5f} {np.mean(deviations):8.5f} {within[0]:7.0%} {within[1]:7.0%}",
        flush=True,
    )


def main() -> None:
    """Print all rows."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--movies", type=count, default=20)
    n_movies = parser.parse_args().movies
    warnings.simplefilter("ignore", UserWarning)
    print(f"{'':34} {'error':>8} {'s.e.':>8} {'1 s.e.':>7} {'1.96':>7}")
    times = jnp.linspace(0, 6, N_FRAMES)
    first = [Movie(implicit(seed), times) for seed in range(n_movies)]
    tables = filter(None, map(chains, itertools.count()))
    second = [movie_from_table(table) for table in itertools.islice(tables, n_movies)]
    true = TABLE[np.triu_indices(2)]
    for noise in (0.0, 0.005):
        errors, deviations = errors_of(first, 2 * true, noise, outline=False)
        print_row(f"implicit, noise {noise}", errors, deviations)
        errors, deviations = errors_of(second, np.append(true, OUTLINE), noise, outline=True)
        print_row(f"chains, noise {noise}", errors[:, :-1], deviations[:, :-1])
        print_row(f"chains, noise {noise}, outline", errors[:, -1], deviations[:, -1])


if __name__ == "__main__":
    main()
