"""Saving and loading a tissue, and writing files atomically."""

import os
import stat
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue, rewritten

import vertax as vx
from vertax._base.atomic import atomic_write
from vertax.io import load, save
from vertax.transitions._euler_operators import flip_edges


def zeros(shape):
    return np.zeros(shape, np.int32)


@pytest.fixture(scope="module")
def tissue():
    lattice = np.array([[4.0, 0.1], [1.3, 3.7]])
    return vx.initialise.periodic_voronoi(11, key=jax.random.key(5), lattice=lattice)


@pytest.fixture
def saved(tissue, tmp_path):
    path = tmp_path / "tissue.npz"
    save(path, tissue)
    return path


def same_bits(a, b):
    bits = lambda x: (x.dtype, x.shape, np.asarray(x).tobytes())
    return jax.tree.structure(a) == jax.tree.structure(b) and (
        [bits(x) for x in jax.tree.leaves(a)] == [bits(x) for x in jax.tree.leaves(b)]
    )


class TestRoundTrip:
    def test_every_bit(self, tissue, saved):
        assert same_bits(load(saved, vx.Tissue), tissue)

    def test_float32(self, tissue, tmp_path):
        single = jax.tree.map(
            lambda x: x.astype(np.float32) if eqx.is_inexact_array(x) else x, tissue
        )
        save(tmp_path / "single", single)
        loaded = load(tmp_path / "single", vx.Tissue)
        assert loaded.vertices.dtype == jnp.float32
        assert same_bits(loaded, single)
        with jax.enable_x64(False):
            assert same_bits(load(tmp_path / "single", vx.Tissue), single)

    def test_after_a_transition(self, tissue, tmp_path):
        # After a flip the labels and directions of edges do not follow from their order.
        flipped = tissue
        for edge in (0, 7, 20):
            flip = jnp.arange(tissue.n_edges) == edge
            flipped = flipped.with_topology(flip_edges(flipped.topology, flip))
        plain = vx.Topology(*jax.tree.leaves(flipped.topology)[:4])
        assert not same_bits(plain, flipped.topology)
        save(tmp_path / "flipped.npz", flipped)
        assert same_bits(load(tmp_path / "flipped.npz", vx.Tissue), flipped)

    def test_a_batch(self, tissue, tmp_path):
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), tissue)
        save(tmp_path / "batch.npz", batch)
        assert same_bits(load(tmp_path / "batch.npz", vx.Tissue), batch)

    def test_negative_zero_and_no_softening(self, tissue, tmp_path):
        odd = vx.Tissue(tissue.vertices.at[0].set(-0.0), tissue.topology, tissue.boundary, 0.0)
        save(tmp_path / "odd.npz", odd)
        assert same_bits(load(tmp_path / "odd.npz", vx.Tissue), odd)

    def test_saving_again_replaces(self, tissue, saved):
        moved = tissue.with_configuration(tissue.vertices + 1)
        save(saved, moved)
        assert same_bits(load(saved, vx.Tissue), moved)
        assert os.listdir(saved.parent) == [saved.name]


class TestRefusedToSave:
    def test_bfloat16(self, tissue, tmp_path):
        half = tissue.with_configuration(tissue.vertices.astype(jnp.bfloat16))
        with pytest.raises(ValueError, match="`vertices` is bfloat16"):
            save(tmp_path / "half.npz", half)

    def test_a_boundary_of_a_user_needs_its_class(self, tissue, tmp_path):
        class Box(vx.Periodic):
            """A box of a user."""

        odd = eqx.tree_at(lambda t: t.boundary, tissue, Box(tissue.boundary.lattice))
        save(tmp_path / "box.npz", odd)
        assert same_bits(load(tmp_path / "box.npz", vx.Tissue, classes=[Box]), odd)
        with pytest.raises(ValueError, match=r"Pass the class: classes=\[Box\]"):
            load(tmp_path / "box.npz", vx.Tissue)


class TestRefusedToLoad:
    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
            load(tmp_path / "nowhere.npz", vx.Tissue)

    def test_float64_without_x64(self, saved):
        with (
            jax.enable_x64(False),
            pytest.raises(ValueError, match=r"tissue\.npz.*jax_enable_x64"),
        ):
            load(saved, vx.Tissue)

    @pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.999])
    def test_truncated(self, saved, kept):
        content = saved.read_bytes()
        saved.write_bytes(content[: int(kept * len(content))])
        with pytest.raises(ValueError, match=r"tissue\.npz is truncated or damaged"):
            load(saved, vx.Tissue)

    def test_any_flipped_byte_is_found_or_harmless(self, tissue, saved):
        content = bytearray(saved.read_bytes())
        rng = np.random.default_rng(0)
        refused, harmless = 0, 0
        for position in rng.choice(len(content), 60, replace=False):
            damaged = content.copy()
            damaged[position] ^= rng.integers(1, 256)
            saved.write_bytes(damaged)
            try:
                loaded = load(saved, vx.Tissue)
            except ValueError as error:
                refused += str(saved) in str(error)
            else:  # a byte of the archive that is not read (of a date, for example) may change
                harmless += same_bits(loaded, tissue)
        assert refused + harmless == 60
        assert refused > 40

    def test_not_an_archive(self, tmp_path):
        (tmp_path / "notes.txt").write_text("cells and vertices")
        with pytest.raises(ValueError, match=r"notes\.txt is not a vertax data file"):
            load(tmp_path / "notes.txt", vx.Tissue)
        np.save(tmp_path / "array.npy", np.arange(3))
        with pytest.raises(ValueError, match=r"array\.npy is not a vertax data file"):
            load(tmp_path / "array.npy", vx.Tissue)

    def test_foreign_archives(self, tmp_path):
        np.savez(tmp_path / "other.npz", vertices=np.zeros((4, 2)))
        with pytest.raises(ValueError, match=r"other\.npz is not a vertax data file"):
            load(tmp_path / "other.npz", vx.Tissue)
        with zipfile.ZipFile(tmp_path / "letters.zip", "w") as archive:
            archive.writestr("a.txt", "text")
        with pytest.raises(ValueError, match=r"letters\.zip is not a vertax data file"):
            load(tmp_path / "letters.zip", vx.Tissue)

    def test_pickles(self, saved):
        rewritten(saved, format=np.array([{"an": "object"}], dtype=object))
        with pytest.raises(ValueError, match=r"tissue\.npz.*allow_pickle=False"):
            load(saved, vx.Tissue)

    def test_newer_version(self, saved):
        rewritten(saved, version=2)
        with pytest.raises(ValueError, match=r"tissue\.npz has version 2.*Update vertax"):
            load(saved, vx.Tissue)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"version": 0}, "broken header"),
            ({"version": None}, "broken header"),
            ({"topology.twin": None}, "no array `data.topology.twin`"),
            ({"boundary.lattice": None}, "no array `data.boundary.lattice`"),
            ({"vertices": np.zeros((3, 2))}, r"`vertices` must have shape \(22, 2\).*\(3, 2\)"),
            ({"topology.twin": np.zeros(66)}, "type int32"),
            ({"topology.frame": zeros((66, 3))}, "`frame` must have two entries"),
            ({"boundary.lattice": np.eye(3)}, r"`lattice`.*\(2, 2\)"),
            ({"vertices": np.zeros((22, 2), int)}, "shapes or types"),
            # The classes of mesh and box raise; the file's name precedes their message.
            ({"topology.twin": zeros(66)}, "is broken: .*`twin` must be an involution"),
            ({"topology.cell": zeros(66)}, "is broken: .*every cell must have half-edges"),
            ({"topology.half_edge": zeros(33)}, "`half_edge` must point into its edge"),
            ({"boundary.lattice": -np.eye(2)[::-1]}, "right-handed"),
            ({"vertices": np.full((22, 2), np.nan)}, "must be finite"),
            ({"softening": np.array(-1.0)}, "`softening` must be at least 0"),
        ],
    )
    def test_contradictions(self, saved, changes, message):
        header = {"version": changes["version"]} if "version" in changes else {}
        arrays = {f"data.{name}": value for name, value in changes.items() if name != "version"}
        rewritten(saved, **header, **arrays)
        with pytest.raises(ValueError, match=rf"tissue\.npz.*{message}"):
            load(saved, vx.Tissue)


class TestAtomicWrite:
    def test_text_and_bytes(self, tmp_path):
        with atomic_write(tmp_path / "a.txt") as file:
            file.write("Zellfläche µm²\n")
        assert (tmp_path / "a.txt").read_text("utf-8") == "Zellfläche µm²\n"
        with atomic_write(tmp_path / "a.bin", "wb") as file:
            file.write(b"\x00\xff")
        assert (tmp_path / "a.bin").read_bytes() == b"\x00\xff"
        with atomic_write(tmp_path / "a.csv", newline="") as file:
            file.write("1,2\r\n")
        assert (tmp_path / "a.csv").read_bytes() == b"1,2\r\n"

    @pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
    def test_failed_write_keeps_the_old_file(self, tmp_path, failure):
        path = tmp_path / "a.txt"
        path.write_text("old")

        def interrupted():
            with atomic_write(path) as file:
                file.write("half of the n")
                raise failure

        with pytest.raises(failure):
            interrupted()
        assert path.read_text() == "old"
        assert os.listdir(tmp_path) == ["a.txt"]

    def test_nothing_under_the_name_before_the_end(self, tmp_path):
        path = tmp_path / "a.txt"
        with atomic_write(path) as file:
            file.write("new")
            file.flush()
            assert not path.exists()
            # In the same folder: a rename across file systems is not atomic.
            assert len(os.listdir(tmp_path)) == 1
        assert path.read_text() == "new"

    def test_permissions_are_those_of_any_new_file(self, tmp_path):
        (tmp_path / "plain").write_text("")
        with atomic_write(tmp_path / "a.txt"):
            pass
        mode = lambda name: stat.S_IMODE((tmp_path / name).stat().st_mode)
        assert mode("a.txt") == mode("plain")
        os.chmod(tmp_path / "a.txt", 0o640)
        with atomic_write(tmp_path / "a.txt") as file:
            file.write("again")
        assert mode("a.txt") == 0o640

    def test_a_link_keeps_its_target(self, tmp_path):
        (tmp_path / "runs").mkdir()
        (tmp_path / "runs" / "a.txt").write_text("old")
        (tmp_path / "link").symlink_to(tmp_path / "runs" / "a.txt")
        with atomic_write(tmp_path / "link") as file:
            file.write("new")
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "runs" / "a.txt").read_text() == "new"

    def test_invalid_arguments_raise(self, tmp_path):
        with pytest.raises(ValueError, match="`mode`"), atomic_write(tmp_path / "a", "a"):
            pass
        with (
            pytest.raises(FileNotFoundError, match="no folder"),
            atomic_write(tmp_path / "b" / "a"),
        ):
            pass
        with pytest.raises(IsADirectoryError, match="is a folder"), atomic_write(tmp_path):
            pass
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", ["twin", "cell", "frame", "edge", "half_edge"])
@pytest.mark.parametrize("value", [-1, 10**6, 2**31, 2**32, 2**62])
def test_error_names_numbers_out_of_range(tmp_path, name, value):
    path, name = tmp_path / "tissue.npz", f"data.topology.{name}"
    vx.save(path, random_tissue(5))
    with np.load(path) as archive:
        array = archive[name].astype(np.int64)
    array.flat[7] += value
    fitting = array.astype(np.int32) if abs(array).max() < 2**31 else array
    with pytest.raises(ValueError, match=r"tissue.npz is broken: .*(half-edge|twin|edge|int32)"):
        vx.load(rewritten(path, **{name: fitting}), vx.Tissue)
