"""Tensions of folders, patterns, lists and movies of masks."""

import jax
import numpy as np
import pytest
from test_damaged_masks import mask as mask

import vertax as vx
from vertax.io import read_table
from vertax.tensions import MaskFrame, find_masks, infer_tensions, infer_tensions_of_masks


def test_one_table_of_a_folder_with_a_file_that_cannot_be_read(mask, tmp_path):
    for name in ("m10", "m2"):
        np.save(tmp_path / f"{name}.npy", mask)
    (tmp_path / "m3.tif").write_text("no image")
    np.save(tmp_path / "m9.npy", np.random.default_rng(0).integers(0, 255, mask.shape))
    names = [frame.name for frame in find_masks(tmp_path)]
    assert names == ["m2.npy", "m3.tif", "m9.npy", "m10.npy"]
    tensions = infer_tensions_of_masks(tmp_path, progress=False)
    assert list(tensions.results) == ["m2.npy", "m10.npy"]
    assert "cannot be read" in tensions.failures["m3.tif"]
    assert "a picture, not a mask" in tensions.failures["m9.npy"]
    alone = infer_tensions(mask)
    table = tensions.edge_table()
    second = table["frame"] == "m10.npy"
    np.testing.assert_array_equal(table["tension"][second], alone.tensions)
    cells = tensions.cell_table()
    np.testing.assert_array_equal(cells["label"], np.tile(alone.labels, 2))
    # Columns in pixels: y grows with the row.
    for label in np.unique(mask[mask > 0])[:3]:
        row, column = np.argwhere(mask == label).mean(axis=0) + 0.5
        first = np.flatnonzero(cells["label"] == label)[0]
        assert cells["row"][first] == pytest.approx(row, abs=1)
        assert cells["column"][first] == pytest.approx(column, abs=1)
    tensions.write(tmp_path / "tables")
    columns = read_table(tmp_path / "tables" / "columns.csv")
    for name in ("cells", "edges", "frames"):
        written = read_table(tmp_path / "tables" / f"{name}.csv")
        assert set(written) == set(columns["column"][columns["table"] == name])


def test_frames_of_a_movie_need_no_plane(mask, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    movie = np.stack([mask, mask[::-1]]).astype(np.uint16)
    file = tmp_path / "movie.tif"
    metadata = {"axes": "TYX"}
    tifffile.imwrite(file, movie[:, :, ::2], imagej=True, metadata=metadata, resolution=(1, 2))
    for source in (movie, file):
        frames = find_masks(source)
        assert [frame.name for frame in frames] == [0, 1]
    tensions = infer_tensions_of_masks(file, progress=False)
    size = tensions.results[1].pixel_size
    assert isinstance(size, tuple)
    height, width = size
    assert width == pytest.approx(2 * height)
    assert [frame.name for frame in find_masks(file, plane=1)] == ["movie.tif"]


def test_finished_masks_are_read_from_the_cache(mask, tmp_path, monkeypatch):
    damaged = np.where(mask == 3, 0, mask)
    masks, cache = [damaged, mask[:, ::2]], tmp_path / "cache"
    options = {"pixel_size": (1.0, 2.0), "cache": cache, "progress": False}
    first = infer_tensions_of_masks(masks, **options)
    infer = MaskFrame.infer
    calls = []
    monkeypatch.setattr(
        MaskFrame, "infer", lambda self, **o: calls.append(self) or infer(self, **o)
    )
    second = infer_tensions_of_masks(masks, **options)
    assert calls == []
    one, two = dict(first.results), dict(second.results)
    assert jax.tree.structure(one) == jax.tree.structure(two)
    jax.tree.map(np.testing.assert_array_equal, one, two)  # NaN is equal to NaN
    for one, other in zip(first.write(tmp_path / "a"), second.write(tmp_path / "b"), strict=True):
        assert one.read_text() == other.read_text()
    assert len(first.change_table()["kind"]) > 0
    # Other pixels and other options are computed.
    infer_tensions_of_masks([mask, mask[:, ::2]], **options)
    assert len(calls) == 1
    infer_tensions_of_masks(masks, **options, holes="close")
    assert len(calls) == 3
    monkeypatch.setattr(vx, "__version__", "another", raising=False)
    infer_tensions_of_masks(masks, **options)
    assert len(calls) == 5


@pytest.mark.parametrize("format", ["csv", "parquet"])
@pytest.mark.thorough
def test_tables_in_parts_are_one_table(mask, tmp_path, monkeypatch, format):
    if format == "parquet":
        pytest.importorskip("pyarrow", reason="needs PyArrow, of the extra [cluster]")
    damaged = np.where(mask == 3, 0, mask)
    tensions = infer_tensions_of_masks(
        [mask, damaged, np.zeros_like(mask)], cache=tmp_path / "cache", progress=False
    )
    written, paths = {}, []
    for number in range(2):  # the second time another part size, which leaves no old part
        monkeypatch.setattr("vertax.tensions._tensions_of_masks._MASKS_PER_PART", 1 + number)
        paths = tensions.write(tmp_path / "tables", format=format)
    for name, path in zip(("cell", "edge", "change", "frame"), paths, strict=False):
        written, table = read_table(path), getattr(tensions, f"{name}_table")()
        assert list(written) == list(table)
        for column, values in table.items():
            np.testing.assert_array_equal(written[column], values)
    assert list(written["error"] != "") == [False, False, True]


def test_masks_in_subfolders_are_found_with_a_pattern(tmp_path):
    for name in ("a/1.npy", "a/b/1.npy", "2.npy"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    names = [frame.name for frame in find_masks(tmp_path / "**" / "*.npy")]
    assert names == [(tmp_path / name).as_posix() for name in ("2.npy", "a/1.npy", "a/b/1.npy")]
    (tmp_path / "2.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"has none \(with subfolders: .*\*\*.\*\.tif\)"):
        find_masks(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: entry[: len(entry) // 2],
        lambda entry: b"",
        lambda entry: entry[: len(entry) // 2] + b"0123456789" + entry[len(entry) // 2 + 10 :],
    ],
    ids=["truncated", "empty", "overwritten"],
)
def test_a_damaged_entry_of_the_cache_is_computed_anew(mask, tmp_path, damage):
    options = {"cache": tmp_path, "progress": False}
    first = infer_tensions_of_masks([mask], **options)
    (entry,) = tmp_path.iterdir()
    entry.write_bytes(damage(entry.read_bytes()))
    with pytest.warns(UserWarning, match=r"entry of the cache for 0 is computed anew: .* is "):
        second = infer_tensions_of_masks([mask], **options)
    np.testing.assert_array_equal(second.results[0].tensions, first.results[0].tensions)
    infer_tensions_of_masks([mask], **options)  # without a warning


def test_the_noise_of_a_mask_is_in_pixels(mask):
    one, other = (infer_tensions(mask, noise=0.3, pixel_size=size) for size in (1.0, 5.0))
    assert other.noise == pytest.approx(5 * one.noise)
    assert 0.1 < one.noise <= 0.3
    np.testing.assert_allclose(one.tension_deviations, other.tension_deviations, rtol=1e-3)


def test_wrong_options_and_empty_sources_raise(mask, tmp_path):
    with pytest.raises(TypeError, match="gap_with"):
        infer_tensions_of_masks([mask], gap_with=3)
    with pytest.raises(ValueError, match=r"^Argument `prior`"):
        infer_tensions_of_masks([mask], prior=-1.0, progress=False)
    with pytest.raises(ValueError, match=r"all 2 failed; 0: Argument `prior`"):
        infer_tensions_of_masks([mask, mask], prior=-1.0, progress=False)
    file = tmp_path / "a_file"
    file.touch()
    with pytest.raises(OSError, match="a_file"):
        infer_tensions_of_masks([mask], cache=file / "cache", progress=False)
    with pytest.raises(FileNotFoundError, match="files by the pattern"):
        find_masks(str(tmp_path / "*.tif"))


def test_masks_of_another_kind_raise(without_type_checks):
    with pytest.raises(TypeError, match=r"`masks` must be a folder, .* but is None"):
        find_masks(None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="`format` must be one of 'csv', 'parquet'"):
        vx.tensions.TensionsOfMasks({}, {}).write("x", format="xlsx")  # pyright: ignore[reportArgumentType]


def test_two_holes_are_not_mirrored_cells(mask):
    two = mask.copy()
    inner = [label for label in np.unique(mask) if label and not _touches_background(mask, label)]
    two[np.isin(mask, _apart(mask, inner))] = 0
    assert np.sum(infer_tensions(two).labels == 0) == 2


def _touches_background(mask, label):
    near = [np.roll(mask == label, step, axis) for step in (-1, 1) for axis in (0, 1)]
    return bool(np.any((mask == 0) & np.any(near, axis=0)))


def _apart(mask, labels):
    """The two labels farthest from each other."""
    centres = np.array([np.argwhere(mask == label).mean(axis=0) for label in labels])
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    return [labels[k] for k in np.unravel_index(np.argmax(distance), distance.shape)]
