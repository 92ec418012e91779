"""Random sequences of operations on small tissues, checked in NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue
from mesh_checks import check_tissue

import vertax as vx
from vertax.io import load, save
from vertax.transitions import ablate, divide, remove

# One capacity, so that tissues of the same kind share compiled functions.
CAPACITY = 12
ENERGY = (
    vx.energies.AreaElasticity(1.0, 1.0)
    + vx.energies.PerimeterElasticity(0.05, 2.0)
    + vx.energies.LineTension(0.02)
)
FRICTION = vx.dissipations.SubstrateFriction(1.0)


def straight(n, seed):
    """A free tissue with straight edges and at least three sides per cell."""
    tissue = cluster(max(n, 5), seed, lloyd_steps=4)
    tissue = vx.Tissue(tissue.vertices, tissue.topology, vx.Free())
    valid = (tissue.topology.neighbour_counts > 2).all() and not tissue.overlaps.any
    return tissue if valid else straight(n, seed + 1000)


KINDS = {
    "periodic": lambda n, seed: random_tissue(n, seed, lloyd_steps=3),
    "straight": straight,
    "arcs": lambda n, seed: cluster(max(n, 2), seed, lloyd_steps=3),
    "foam": lambda n, seed: cluster(max(n, 2), seed, lloyd_steps=3, inner_arcs=True),
}


@eqx.filter_jit
def swept(tissue, rule):
    """The tissue after transitions, without those that cause overlaps."""
    search = vx.Relaxation(transitions=rule, tolerance=1e-30).search(tissue, ENERGY)
    state, true = search.begin(tissue, ENERGY), jnp.array(True)
    start = search.feasibility.start(tissue, state.contacts, state.counts)
    return search.feasibility(start, tissue, ENERGY, active=true, guarded=true, first=~true).tissue


@eqx.filter_jit
def smoothed(tissue):
    """Move vertices towards the mean of their neighbours, unless cells overlap then."""
    m = tissue.topology
    vector = jnp.where(m.forward[:, None], 1, -1) * tissue.edge_vectors[m.edge]
    pull = jnp.mean(vector.reshape(-1, 3, 2), axis=1)
    vertices = tissue.vertices + 0.3 * jnp.where(m.alive_vertices[:, None], pull, 0)
    moved = tissue.with_vertices(vertices.astype(tissue.vertices.dtype))
    if m.exterior:
        # Rescale a free tissue, which would shrink to a point. (Vertices of spare slots are at its centre.)
        vertices = moved.gathered(moved.vertices)
        middle = jnp.mean(vertices, axis=0)
        scale = jnp.sqrt(jnp.sum(moved.alive) / jnp.sum(moved.areas)).astype(vertices.dtype)
        moved = moved.with_vertices((vertices - middle) * scale)
    worse = moved.overlaps.any
    return jax.tree.map(lambda a, b: jnp.where(worse, a, b), tissue, moved)


class Player:
    """Applies random operations to a tissue, one after another."""

    def __init__(self, kind, seed, folder, dtype=jnp.float64):
        self.rng, self.folder, self.kind, self.dtype = (
            np.random.default_rng(seed),
            folder,
            kind,
            dtype,
        )
        self.counts: dict[str, int] = {}
        self.rtol = 1e-9 if dtype == jnp.float64 else 1e-4
        self.restart()

    def restart(self):
        n = int(self.rng.integers(1, CAPACITY + 1))
        tissue = KINDS[self.kind](n, int(self.rng.integers(1000))).with_capacity(CAPACITY)
        floats = lambda x: x.astype(self.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
        self.tissue = jax.tree.map(floats, tissue)
        check_tissue(self.tissue, self.rtol)

    def cell(self):
        return int(self.rng.choice(np.flatnonzero(self.tissue.alive)))

    def divide(self):
        angle = self.rng.uniform(0, np.pi)
        axis = jnp.asarray([np.cos(angle), np.sin(angle)], self.dtype)
        change = divide(self.tissue, self.cell(), axis, throw=False)
        assert change.tissue.alive.sum() == self.tissue.alive.sum() + change.converged
        return change.tissue

    def remove(self):
        change = remove(self.tissue, self.cell(), throw=False)
        assert change.tissue.alive.sum() == self.tissue.alive.sum() - change.converged
        return change.tissue

    def ablate(self):
        pairs = np.asarray(self.tissue.topology.edge_cells)
        pairs = pairs[(pairs < CAPACITY).all(axis=1)]
        pair = pairs[self.rng.integers(len(pairs))]
        try:
            return ablate(self.tissue, ENERGY, cells=np.isin(np.arange(CAPACITY), pair))[0]
        except RuntimeError as error:
            if "become one hole" not in str(error):
                raise
            return None

    def t1(self):
        return swept(
            self.tissue, vx.T1(threshold=jnp.asarray(self.rng.uniform(0.05, 0.6), self.dtype))
        )

    def t2(self):
        return swept(self.tissue, vx.transitions.T2(threshold=0.5))

    def save(self):
        path = self.folder / "tissue.npz"
        save(path, self.tissue)
        loaded = load(path, vx.Tissue)
        assert eqx.tree_equal(loaded, self.tissue)
        return loaded

    def renumber(self):
        dense = self.tissue.without_spare()
        check_tissue(dense, self.rtol)
        return dense.with_capacity(CAPACITY)

    def relax(self):
        equilibrium = vx.equilibrate(
            self.tissue, ENERGY, transitions=vx.T1() + vx.transitions.T2(), throw=False
        )
        assert equilibrium.result != vx.RESULTS.overlap
        return equilibrium.tissue

    def evolve(self):
        times = jnp.asarray([0.0, 0.05], self.dtype)
        return vx.evolve(self.tissue, ENERGY, FRICTION, times, throw=False).tissue

    def play(self, steps, frequencies):
        names = list(frequencies)
        weights = np.array([frequencies[name] for name in names], float)
        for step in range(steps):
            name = str(self.rng.choice(names, p=weights / weights.sum()))
            new = getattr(self, name)()
            if new is not None:
                same = eqx.tree_equal(new.topology, self.tissue.topology)
                self.counts[name] = self.counts.get(name, 0) + (not bool(same))
                self.tissue = new
            try:
                check_tissue(self.tissue, self.rtol)
                assert not self.tissue.overlaps.any, self.tissue.overlaps.describe()
            except AssertionError as error:
                raise AssertionError(f"after step {step}, {name}: {error}") from error
            self.tissue = smoothed(self.tissue)
            if step % 40 == 39:
                self.restart()


QUICK = {"divide": 5, "remove": 3, "t1": 3, "t2": 1, "ablate": 1, "save": 0.3, "renumber": 0.1}
ALL = QUICK | {"relax": 0.4, "evolve": 0.3}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["periodic", "arcs"])
def test_random_operations_give_valid_tissues(kind, tmp_path):
    player = Player(kind, 0, tmp_path)
    player.play(150, QUICK)
    assert min(player.counts[name] for name in ("divide", "remove", "t1")) >= 3, player.counts


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("kind", list(KINDS))
def test_many_random_operations_give_valid_tissues(kind, dtype, tmp_path):
    player = Player(kind, 1, tmp_path, dtype)
    player.play(250, ALL)
    assert min(player.counts[name] for name in ("divide", "remove", "t1")) >= 3, player.counts
