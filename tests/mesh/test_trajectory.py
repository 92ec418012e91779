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
from vertax.io import load, save
from vertax.mesh import Trajectory
from vertax.relax import record_relaxation
from vertax.transitions._euler_operators import flip_edges


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
def relaxation():
    """A relaxation with T1 transitions."""
    tissue, energy = random_tissue(12, 3), vx.energies.ShapeFactorEnergy(jnp.full(12, 3.9))
    return tissue, energy, *record_relaxation(tissue, energy, every=2)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "trajectory.npz"


class TestRelaxation:
    @pytest.mark.thorough
    def test_trajectory_begins_at_the_tissue_and_ends_at_its_equilibrium(self, relaxation):
        tissue, energy, equilibrium, trajectory = relaxation
        assert same_bits(trajectory[0], tissue)
        assert same_bits(trajectory[-1], equilibrium.tissue)
        assert trajectory.values["num_steps"][-1] == equilibrium.num_steps
        assert trajectory.values["num_t1"][-1] == equilibrium.num_t1
        assert trajectory.values["max_force"][-1] < 1e-9
        assert set(np.diff(trajectory.values["num_steps"][:-1])) == {2}
        # Recording changes only the rounding, because another program is compiled. (A tissue near the fluid
        # transition has soft modes, along which the equilibrium depends on rounding.)
        unrecorded = vx.equilibrate(tissue, energy)
        assert unrecorded.num_steps == equilibrium.num_steps
        assert same_bits(unrecorded.tissue.topology, equilibrium.tissue.topology)
        assert unrecorded.energy == pytest.approx(float(equilibrium.energy), rel=1e-4)
        np.testing.assert_allclose(
            unrecorded.tissue.vertices, equilibrium.tissue.vertices, rtol=0, atol=1e-2
        )

    @pytest.mark.thorough
    def test_values_agree_with_the_frames(self, relaxation):
        _, energy, equilibrium, trajectory = relaxation
        assert equilibrium.num_t1 > 0
        assert not eqx.tree_equal(trajectory[0].topology, trajectory[-1].topology)
        slope = eqx.filter_jit(jax.grad(lambda v, t: energy(t.with_vertices(v))))
        for k, frame in enumerate(trajectory):
            frame.topology.validate()
            value, force = energy(frame), jnp.abs(slope(frame.vertices, frame)).max()
            np.testing.assert_allclose(value, trajectory.values["energy"][k], rtol=1e-9, atol=1e-15)
            np.testing.assert_allclose(
                force, trajectory.values["max_force"][k], rtol=1e-5, atol=1e-10
            )
        flips = np.diff(trajectory.values["num_t1"])
        changed = [not eqx.tree_equal(a.topology, b.topology) for a, b in pairwise(trajectory)]
        np.testing.assert_array_equal(flips > 0, changed)

    @pytest.mark.thorough
    def test_frames_do_not_depend_on_the_interval(self, relaxation):
        tissue, energy, _, trajectory = relaxation
        _, sparse = record_relaxation(tissue, energy, every=4)
        numbers = trajectory.values["num_steps"].tolist()
        for k, frame in zip(sparse.values["num_steps"].tolist(), sparse, strict=True):
            assert same_bits(frame, trajectory[numbers.index(k)])

    @pytest.mark.thorough
    def test_frames_of_a_free_cluster_have_no_drift(self):
        tissue = cluster(5)
        equilibrium, trajectory = record_relaxation(tissue, tension(tissue), NO_CONTACT, every=5)
        assert same_bits(trajectory[-1], equilibrium.tissue)
        assert len(trajectory) > 2
        for frame in trajectory:
            drift = frame.boundary.drift(frame.vertices, tissue.vertices)
            np.testing.assert_allclose(drift, 0, atol=1e-12)

    @pytest.mark.thorough
    def test_an_energy_of_positions_may_translate_the_tissue(self):
        class Trap(vx.AbstractEnergy):
            stiffness: float = 1.0

            def __call__(self, tissue):
                return 0.5 * self.stiffness * jnp.sum((tissue.vertices - 9.0) ** 2)

        tissue = cluster(3)
        energy = tension(tissue) + Trap()
        equilibrium, trajectory = record_relaxation(
            tissue, energy, vx.Relaxation(vx.solvers.FIRE(), None, contact_range=None)
        )
        np.testing.assert_allclose(equilibrium.tissue.vertices.mean(axis=0), 9.0, atol=1e-6)
        steps = np.diff([np.asarray(frame.vertices.mean(axis=0)) for frame in trajectory], axis=0)
        assert np.abs(steps).max() < 0.2

    @pytest.mark.thorough
    def test_relaxation_of_an_equilibrium_has_one_frame(self, relaxation):
        _, energy, equilibrium, _ = relaxation
        # (The default tolerance is in units of the stiffness at the start.)
        relax = vx.Relaxation(tolerance=1e-9)
        again, trajectory = record_relaxation(equilibrium.tissue, energy, relax)
        assert again.converged
        assert len(trajectory) == 1

    @pytest.mark.thorough
    def test_options_are_those_of_the_relaxation(self):
        tissue = single(random_tissue(4))
        equilibrium, trajectory = record_relaxation(
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
        assert equilibrium.converged
        assert equilibrium.max_force < 1e-2
        assert trajectory.values["num_t1"].max() == 0
        assert trajectory[1].vertices.dtype == jnp.float32
        assert same_bits(trajectory[0].topology, trajectory[-1].topology)

    @pytest.mark.thorough
    def test_refusals(self):
        tissue, energy = random_tissue(4), vx.energies.ShapeFactorEnergy(3.7)
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            record_relaxation(tissue, energy, every=0)
        with pytest.raises(ValueError, match="single tissue"):
            record_relaxation(jax.tree.map(lambda x: jnp.stack([x, x]), tissue), energy)
        with pytest.raises(ValueError, match="`tolerance` must be positive"):
            record_relaxation(tissue, energy, vx.Relaxation(tolerance=0.0))
        few = dataclasses.replace(FIXED_TOPOLOGY, max_steps=3)
        with pytest.raises(RuntimeError, match=r"no equilibrium.*throw=False.*after 3 steps"):
            record_relaxation(tissue, energy, few, every=2)
        equilibrium, trajectory = record_relaxation(tissue, energy, few, every=2, throw=False)
        assert not equilibrium.converged
        assert trajectory.values["num_steps"].tolist() == [0, 2, 3]


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
        trajectory = Trajectory(every=2)
        fit = vx.fit(problem, ADAM, 5, callback=trajectory)
        assert trajectory.values["epoch"].tolist() == [0, 2, 4]
        np.testing.assert_array_equal(trajectory.values["cost"], fit.history.cost[::2])
        np.testing.assert_array_equal(trajectory.values["num_t1"], fit.history.num_t1[::2])
        cost = problem.cost(trajectory[1], problem.energy)
        np.testing.assert_allclose(cost, trajectory.values["cost"][1], rtol=1e-12)


class TestSequence:
    def test_items_slices_and_iteration(self, relaxation):
        *_, trajectory = relaxation
        assert [same_bits(trajectory[i], frame) for i, frame in enumerate(trajectory)] == [
            True
        ] * len(trajectory)
        part = trajectory[1::2]
        assert isinstance(part, Trajectory)
        assert same_bits(part[0], trajectory[1])
        np.testing.assert_array_equal(part.values["energy"], trajectory.values["energy"][1::2])
        with pytest.raises(IndexError):
            trajectory[len(trajectory)]

    def test_refusals(self):
        trajectory = Trajectory()
        trajectory.append(random_tissue(4), time=0.0)
        with pytest.raises(ValueError, match=r"\(4 cells.*\(5 cells, 10 vertices, Periodic"):
            trajectory.append(random_tissue(5), time=1.0)
        with pytest.raises(ValueError, match=r"4 cells.*float64.*4 cells.*float32"):
            trajectory.append(single(random_tissue(4)), time=1.0)
        with pytest.raises(ValueError, match=r"values of those before it \(time\).*has: cost"):
            trajectory.append(random_tissue(4), cost=1.0)
        with pytest.raises(ValueError, match="Value `time` must hold numbers"):
            trajectory.append(random_tissue(4), time=True)
        with pytest.raises(ValueError, match=r"`time` must have the shape .*\(\), but has \(2,\)"):
            trajectory.append(random_tissue(4), time=jnp.ones(2))
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), random_tissue(4))
        with pytest.raises(ValueError, match="single tissue"):
            trajectory.append(batch, time=1.0)
        assert len(trajectory) == len(trajectory.values["time"]) == 1
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            Trajectory(every=0)


class TestFile:
    def test_round_trip_across_transitions(self, relaxation, path):
        *_, trajectory = relaxation
        save(path, trajectory)
        loaded = load(path, vx.mesh.Trajectory)
        assert same(loaded, trajectory)
        for name, values in trajectory.values.items():
            np.testing.assert_array_equal(loaded.values[name], values)
            assert loaded.values[name].dtype == values.dtype
        with np.load(path) as archive:
            parts = [x for name, x in archive.items() if name.endswith(".vertices")]
        assert 1 < len(parts) < sum(map(len, parts)) == len(trajectory)

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
        trajectory = Trajectory()
        # An edge between cells that can spare a side.
        spare = np.min(np.asarray(tissue.neighbour_counts)[tissue.topology.edge_cells % 9], axis=1)
        edge = np.argmax(np.where(tissue.topology.on_outline, 0, spare))
        for k in range(4):
            flip = jnp.arange(tissue.n_edges) == edge
            topology = flip_edges(tissue.topology, flip) if k == 2 else tissue.topology
            tissue = tissue.with_vertices(tissue.vertices + 0.1).with_topology(topology)
            trajectory.append(tissue)
        save(path, trajectory)
        assert same(load(path, vx.mesh.Trajectory), trajectory)
        with jax.enable_x64(precision == "float64"):
            assert same(load(path, vx.mesh.Trajectory), trajectory)

    def test_frames_with_different_boxes(self, path):
        tissue, trajectory = random_tissue(3), Trajectory()
        for k in range(3):
            box = vx.Periodic(tissue.boundary.lattice * (1 + 0.1 * k))
            trajectory.append(eqx.tree_at(lambda t: t.boundary, tissue, box), stretch=0.1 * k)
        save(path, trajectory)
        assert same(load(path, vx.mesh.Trajectory), trajectory)

    def test_empty_trajectories_are_not_saved(self, path):
        with pytest.raises(ValueError, match="at least one frame"):
            save(path, Trajectory())
        assert os.listdir(path.parent) == []

    def test_other_files_are_rejected(self, relaxation, path):
        with pytest.raises(FileNotFoundError):
            load(path, vx.mesh.Trajectory)
        vx.save(path, relaxation[0])
        with pytest.raises(ValueError, match=r"`kind` must be .*trajectory\.npz, Tissue, or"):
            load(path, vx.mesh.Trajectory)
        save(path, relaxation[-1])
        with pytest.raises(ValueError, match=r"`kind` must be .*trajectory\.npz, Trajectory, or"):
            vx.load(path, vx.Tissue)
        with jax.enable_x64(False), pytest.raises(ValueError, match=r"trajectory.*jax_enable_x64"):
            load(path, vx.mesh.Trajectory)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"version": 2}, "has version 2 of the data format.*Update vertax"),
            ({"data.parts.0.vertices": np.zeros((2, 24, 2))}, "is broken"),
            ({"data.values.0": np.zeros(2)}, "is broken"),
            ({"data.parts.0.topology.twin": None}, "no array `data.parts.0.topology.twin`"),
        ],
    )
    def test_inconsistent_arrays_are_rejected(self, relaxation, path, changes, message):
        save(path, relaxation[-1])
        rewritten(path, **changes)
        with pytest.raises(ValueError, match=rf"trajectory\.npz.*{message}"):
            load(path, vx.mesh.Trajectory)

    def test_invalid_frames_are_rejected(self, relaxation, path):
        *_, trajectory = relaxation
        save(path, trajectory)
        with np.load(path) as archive:
            names = ("vertices", "topology.twin", "boundary.lattice")
            vertices, twin, lattice = (archive[f"data.parts.0.{name}"].copy() for name in names)
        vertices[-1, 3], twin[-1], lattice[-1] = np.nan, 0, -lattice[-1, ::-1]
        reasons = ("must be finite", "involution", "right-handed")
        for name, array, reason in zip(names, (vertices, twin, lattice), reasons, strict=True):
            save(path, trajectory)
            rewritten(path, **{f"data.parts.0.{name}": array})
            with pytest.raises(ValueError, match=rf"trajectory\.npz is broken: .*{reason}"):
                load(path, vx.mesh.Trajectory)
