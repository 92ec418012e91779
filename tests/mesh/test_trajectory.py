"""Trajectories of relaxations and fits, in memory and in files."""

import dataclasses
import os
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import ADAM, FIXED_TOPOLOGY, NO_CONTACT, random_tissue, rewritten

import vertax as vx
from vertax.io import load_trajectory, save_trajectory
from vertax.mesh import Trajectory
from vertax.mesh._topology import flip_edges
from vertax.relax import record_relaxation


def single(tree):
    return jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree)


def same_bits(a, b):
    bits = lambda x: (x.dtype, x.shape, np.asarray(x).tobytes())
    return jax.tree.structure(a) == jax.tree.structure(b) and (
        [bits(x) for x in jax.tree.leaves(a)] == [bits(x) for x in jax.tree.leaves(b)]
    )


def same(a, b):
    return len(a) == len(b) and all(map(same_bits, a, b)) and a.values.keys() == b.values.keys()


def tension(tissue):
    return vx.energies.AreaElasticity(20.0, 1.0) + vx.energies.LineTension(jnp.ones(tissue.n_edges))


@pytest.fixture(scope="module")
def flowing():
    """A relaxation on whose way there are T1 transitions."""
    tissue, energy = random_tissue(12, 3), vx.energies.ShapeFactorEnergy(jnp.full(12, 3.9))
    return tissue, energy, *record_relaxation(tissue, energy, every=2)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "way.npz"


class TestRelaxation:
    def test_it_goes_from_the_tissue_to_its_equilibrium(self, flowing):
        tissue, energy, equilibrium, way = flowing
        assert same_bits(way[0], tissue)
        assert same_bits(way[-1], equilibrium.tissue)
        assert way.values["num_steps"][-1] == equilibrium.num_steps
        assert way.values["num_t1"][-1] == equilibrium.num_t1
        assert way.values["max_force"][-1] < 1e-9
        assert set(np.diff(way.values["num_steps"][:-1])) == {2}
        # Being watched changes nothing but the rounding, since another program is compiled. (Tissues that
        # are nearly fluid have soft modes, along which rounding decides where they come to rest.)
        unwatched = vx.equilibrate(tissue, energy)
        assert unwatched.num_steps == equilibrium.num_steps
        assert same_bits(unwatched.tissue.topology, equilibrium.tissue.topology)
        assert unwatched.energy == pytest.approx(float(equilibrium.energy), rel=1e-4)
        np.testing.assert_allclose(
            unwatched.tissue.vertices, equilibrium.tissue.vertices, rtol=0, atol=1e-2
        )

    def test_frames_have_their_own_topology_energy_and_force(self, flowing):
        _, energy, equilibrium, way = flowing
        assert equilibrium.num_t1 > 0
        assert not eqx.tree_equal(way[0].topology, way[-1].topology)
        slope = eqx.filter_jit(jax.grad(lambda v, t: energy(t.with_vertices(v))))
        for k, frame in enumerate(way):
            frame.topology.validate()
            value, force = energy(frame), jnp.abs(slope(frame.vertices, frame)).max()
            np.testing.assert_allclose(value, way.values["energy"][k], rtol=1e-9, atol=1e-15)
            np.testing.assert_allclose(force, way.values["max_force"][k], rtol=1e-5, atol=1e-10)
        flips = np.diff(way.values["num_t1"])
        changed = [not eqx.tree_equal(a.topology, b.topology) for a, b in pairwise(way)]
        np.testing.assert_array_equal(flips > 0, changed)

    def test_fewer_frames_are_some_of_more(self, flowing):
        tissue, energy, _, way = flowing
        _, sparse = record_relaxation(tissue, energy, every=4)
        numbers = way.values["num_steps"].tolist()
        for k, frame in zip(sparse.values["num_steps"].tolist(), sparse, strict=True):
            assert same_bits(frame, way[numbers.index(k)])

    @pytest.mark.thorough
    def test_a_free_cluster_does_not_turn(self):
        tissue = cluster(5)
        equilibrium, way = record_relaxation(tissue, tension(tissue), NO_CONTACT, every=5)
        assert same_bits(way[-1], equilibrium.tissue)
        assert len(way) > 2
        for frame in way:
            drift = frame.boundary.drift(frame.vertices, tissue.vertices)
            np.testing.assert_allclose(drift, 0, atol=1e-12)

    @pytest.mark.thorough
    def test_an_energy_that_knows_positions_may_move_the_whole(self):
        class Trap(vx.AbstractEnergy):
            stiffness: float = 1.0

            def __call__(self, tissue):
                return 0.5 * self.stiffness * jnp.sum((tissue.vertices - 9.0) ** 2)

        tissue = cluster(3)
        energy = tension(tissue) + Trap()
        found, way = record_relaxation(
            tissue, energy, vx.Relaxation(vx.solvers.FIRE(), None, contact_range=None)
        )
        np.testing.assert_allclose(found.tissue.vertices.mean(axis=0), 9.0, atol=1e-6)
        steps = np.diff([np.asarray(frame.vertices.mean(axis=0)) for frame in way], axis=0)
        assert np.abs(steps).max() < 0.2

    def test_at_rest_there_is_one_frame(self, flowing):
        _, energy, equilibrium, _ = flowing
        # (The default tolerance is in units of the stiffness where a relaxation begins.)
        relax = vx.Relaxation(tolerance=1e-9)
        again, way = record_relaxation(equilibrium.tissue, energy, relax)
        assert again.converged
        assert len(way) == 1

    def test_options(self):
        tissue = single(random_tissue(4))
        found, way = record_relaxation(
            tissue,
            vx.energies.ShapeFactorEnergy(3.7),
            vx.Relaxation(
                vx.solvers.FIRE(),
                transitions=None,
                contact_range=None,
                tolerance=1e-2,
                consecutive_steps=3,
            ),
            every=100,
        )
        assert found.converged
        assert found.max_force < 1e-2
        assert way.values["num_t1"].max() == 0
        assert way[1].vertices.dtype == jnp.float32
        assert same_bits(way[0].topology, way[-1].topology)

    def test_refusals(self):
        tissue, energy = random_tissue(4), vx.energies.ShapeFactorEnergy(3.7)
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            record_relaxation(tissue, energy, every=0)
        with pytest.raises(ValueError, match="single tissue"):
            record_relaxation(jax.tree.map(lambda x: jnp.stack([x, x]), tissue), energy)
        with pytest.raises(ValueError, match="`tolerance` must be positive"):
            record_relaxation(tissue, energy, vx.Relaxation(tolerance=0.0))
        few = dataclasses.replace(FIXED_TOPOLOGY, max_steps=3)
        with pytest.raises(RuntimeError, match=r"no equilibrium in 3 steps.*throw=False"):
            record_relaxation(tissue, energy, few, every=2)
        found, way = record_relaxation(tissue, energy, few, every=2, throw=False)
        assert not found.converged
        assert way.values["num_steps"].tolist() == [0, 2, 3]


class TestFit:
    @pytest.mark.thorough
    def test_a_trajectory_is_a_callback(self):
        target = FIXED_TOPOLOGY(random_tissue(4), vx.energies.ShapeFactorEnergy(3.6)).tissue
        problem = vx.InverseProblem(
            target,
            vx.energies.ShapeFactorEnergy(jnp.full(4, 3.7)),
            vx.costs.VertexDistance(target),
            response=FIXED_TOPOLOGY,
        )
        way = Trajectory(every=2)
        fit = vx.fit(problem, ADAM, 5, callback=way)
        assert way.values["epoch"].tolist() == [0, 2, 4]
        np.testing.assert_array_equal(way.values["cost"], fit.history.cost[::2])
        np.testing.assert_array_equal(way.values["num_t1"], fit.history.num_t1[::2])
        cost = problem.cost(way[1], problem.energy)
        np.testing.assert_allclose(cost, way.values["cost"][1], rtol=1e-12)


class TestSequence:
    def test_items_slices_and_iteration(self, flowing):
        *_, way = flowing
        assert [same_bits(way[i], frame) for i, frame in enumerate(way)] == [True] * len(way)
        part = way[1::2]
        assert isinstance(part, Trajectory)
        assert same_bits(part[0], way[1])
        np.testing.assert_array_equal(part.values["energy"], way.values["energy"][1::2])
        with pytest.raises(IndexError):
            way[len(way)]

    def test_refusals(self):
        way = Trajectory()
        way.append(random_tissue(4), time=0.0)
        with pytest.raises(ValueError, match=r"\(4 cells.*\(5 cells, 10 vertices, Periodic"):
            way.append(random_tissue(5), time=1.0)
        with pytest.raises(ValueError, match=r"4 cells.*float64.*4 cells.*float32"):
            way.append(single(random_tissue(4)), time=1.0)
        with pytest.raises(ValueError, match=r"values of those before it \(time\).*has: cost"):
            way.append(random_tissue(4), cost=1.0)
        with pytest.raises(ValueError, match="Value `time` must be one number"):
            way.append(random_tissue(4), time=jnp.ones(2))
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), random_tissue(4))
        with pytest.raises(ValueError, match="single tissue"):
            way.append(batch, time=1.0)
        assert len(way) == len(way.values["time"]) == 1
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            Trajectory(every=0)


class TestFile:
    def test_round_trip_across_transitions(self, flowing, path):
        *_, way = flowing
        save_trajectory(path, way)
        loaded = load_trajectory(path)
        assert same(loaded, way)
        for name, values in way.values.items():
            np.testing.assert_array_equal(loaded.values[name], values)
            assert loaded.values[name].dtype == values.dtype
        with np.load(path) as archive:
            assert len(archive["twin"]) < len(archive["vertices"]) == len(way)

    @pytest.mark.parametrize("precision", ["float32", "float64"])
    def test_free_tissues_with_arcs_and_pins(self, path, precision):
        tissue = cluster(9)
        tissue = vx.Tissue(
            tissue.vertices,
            tissue.topology,
            tissue.boundary,
            angles=tissue.angles,
            inner_arcs=True,
            pinned=jnp.arange(tissue.n_vertices) == 2,
        )
        tissue = tissue if precision == "float64" else single(tissue)
        way = Trajectory()
        # An edge between cells that can spare a side.
        spare = np.min(np.asarray(tissue.neighbour_counts)[tissue.topology.edge_cells % 9], axis=1)
        edge = np.argmax(np.where(tissue.topology.on_outline, 0, spare))
        for k in range(4):
            flip = jnp.arange(tissue.n_edges) == edge
            topology = flip_edges(tissue.topology, flip) if k == 2 else tissue.topology
            tissue = tissue.with_vertices(tissue.vertices + 0.1).with_topology(topology)
            way.append(tissue)
        save_trajectory(path, way)
        assert same(load_trajectory(path), way)
        with jax.enable_x64(precision == "float64"):
            assert same(load_trajectory(path), way)

    def test_a_box_that_changes(self, path):
        tissue, way = random_tissue(3), Trajectory()
        for k in range(3):
            box = vx.Periodic(tissue.boundary.lattice * (1 + 0.1 * k))
            way.append(eqx.tree_at(lambda t: t.boundary, tissue, box), stretch=0.1 * k)
        save_trajectory(path, way)
        assert same(load_trajectory(path), way)

    def test_refused_to_save(self, path):
        with pytest.raises(ValueError, match="at least one frame"):
            save_trajectory(path, Trajectory())
        assert os.listdir(path.parent) == []

    @pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.999])
    def test_truncated(self, flowing, path, kept):
        save_trajectory(path, flowing[-1])
        content = path.read_bytes()
        path.write_bytes(content[: int(kept * len(content))])
        with pytest.raises(ValueError, match=r"way\.npz is truncated or damaged"):
            load_trajectory(path)

    def test_foreign_files(self, flowing, path):
        with pytest.raises(FileNotFoundError):
            load_trajectory(path)
        vx.save_tissue(path, flowing[0])
        with pytest.raises(ValueError, match=r"way\.npz is not a vertax trajectory file"):
            load_trajectory(path)
        save_trajectory(path, flowing[-1])
        with pytest.raises(ValueError, match=r"way\.npz is not a vertax tissue file"):
            vx.load_tissue(path)
        with jax.enable_x64(False), pytest.raises(ValueError, match=r"way.*jax_enable_x64"):
            load_trajectory(path)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"version": 2}, "has version 2 of the trajectory format.*Update vertax"),
            ({"topology": None}, "`topology` must number the topologies"),
            ({"topology": np.zeros(0, int)}, "`topology` must number the topologies"),
            (
                {"vertices": np.zeros((2, 24, 2))},
                r"`vertices` has shape \(2, 24, 2\), but must have",
            ),
            ({"value_energy": np.zeros(2)}, "`value_energy` has shape"),
            ({"twin": None}, "no array `twin`"),
            ({"boundary": "sphere"}, "unknown kind"),
        ],
    )
    def test_contradictions(self, flowing, path, changes, message):
        save_trajectory(path, flowing[-1])
        rewritten(path, **changes)
        with pytest.raises(ValueError, match=rf"way\.npz.*{message}"):
            load_trajectory(path)

    def test_broken_frames(self, flowing, path):
        *_, way = flowing
        save_trajectory(path, way)
        vertices = np.stack([frame.vertices for frame in way])
        vertices[-1, 3] = np.nan
        rewritten(path, vertices=vertices)
        with pytest.raises(ValueError, match=r"way\.npz is broken: .*must be finite"):
            load_trajectory(path)
        save_trajectory(path, way)
        with np.load(path) as archive:
            twin = archive["twin"].copy()
        twin[-1] = 0
        rewritten(path, twin=twin)
        with pytest.raises(ValueError, match=r"way\.npz is broken: .*involution"):
            load_trajectory(path)
