"""The experiment that infers tensions, on synthetic clusters and on images."""

import jax
import numpy as np
import pytest
from PIL import Image
from run_helpers import run, table

import vertax as vx
from vertax.runs import RunFolder, load_config
from vertax.runs._config import validate
from vertax.runs._execution import execute, new_folder
from vertax.runs._registry import find_experiment
from vertax.tensions import MaskFrame

pytestmark = pytest.mark.experiments

TINY = """
experiment = "infer_tensions"
cluster = { n_cells = 9, pixels = 400 }
"""


@pytest.mark.slow  # compiles for half a minute
def test_tensions_of_a_synthetic_cluster_are_recovered(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert metrics["pearson_tension"] > 0.8
    assert metrics["rms_error_pressure"] < 0.2
    assert metrics["n_tensions_determined"] > 8
    edges = table(folder / "edges.csv")
    sure = np.array(edges["determined"]) == "True"
    assert np.array(edges["tension"])[sure].astype(float).mean() == pytest.approx(1)
    assert (folder / "cells-edges.geojson").exists()
    assert (folder / "figures" / "recovery.png").stat().st_size > 10_000


@pytest.mark.slow  # compiles for half a minute
def test_few_determined_tensions_are_a_warning(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    _, metrics = run(tmp_path / "tiny.toml", tmp_path / "out", "noise=20")
    assert any("are determined" in warning for warning in metrics["warnings"])


def colours(folder):
    """A label image of a cluster in the green channel of a picture."""
    cluster = vx.initialise.free_voronoi(5, key=jax.random.key(0))
    labels = vx.inference.label_image(cluster, 120).astype(np.uint8)
    Image.fromarray(np.stack([0 * labels, labels, 0 * labels], axis=-1)).save(folder / "rgb.png")
    return folder / "rgb.png", labels


def mask_of(image):
    (frame,) = image.frames()
    return frame.mask(**image.reading())


def test_a_colour_image_is_read_and_there_is_a_key_for_its_channel(tmp_path):
    path, labels = colours(tmp_path)
    config = validate(
        find_experiment("infer_tensions").config,
        {"image": {"path": str(path), "kind": "labels"}},
    )
    assert len(np.unique(mask_of(config.image))) == len(np.unique(labels))
    chosen = config.image.model_copy(update={"channel": 1})
    np.testing.assert_array_equal(mask_of(chosen), labels)


def bricks(shift):
    """Nine cells in three rows, shifted against each other."""
    rows = [np.repeat([3 * r + 1, 3 * r + 2, 3 * r + 3, 0], 20) for r in range(3)]
    rows = np.array([np.roll(row, (10 + shift) * (r % 2)) for r, row in enumerate(rows)])
    return np.pad(np.repeat(rows, 20, axis=0), 6)


@pytest.fixture
def several(tmp_path):
    """The configuration of three masks, of which one cannot be read."""
    (tmp_path / "masks").mkdir()
    for number in (2, 10):
        np.save(tmp_path / "masks" / f"m{number}.npy", bricks(number // 5))
    (tmp_path / "masks" / "m3.npy").write_text("no mask")
    file = tmp_path / "several.toml"
    file.write_text(f'experiment = "infer_tensions"\nimage = "{tmp_path}/masks/*.npy"')
    return file


def test_several_masks_have_one_table_and_an_animation(several, tmp_path):
    folder, metrics = run(several, tmp_path / "out")
    assert (metrics["n_masks"], metrics["n_failed"], metrics["n_cells"]) == (3, 1, 18)
    assert list(metrics["failed"]) == ["m3.npy"]
    cells, frames = table(folder / "cells.csv"), table(folder / "frames.csv")
    assert cells["frame"] == ["m2.npy"] * 9 + ["m10.npy"] * 9
    assert frames["frame"] == ["m2.npy", "m10.npy", "m3.npy"]
    assert frames["error"][:2] == ["", ""]
    assert frames["error"][2] == metrics["failed"]["m3.npy"]
    assert any(text.startswith("m3.npy: no result") for text in metrics["warnings"])
    for name in ("cells", "edges", "changes", "frames"):
        columns = table(folder / "columns.csv")
        described = [
            c for t, c in zip(columns["table"], columns["column"], strict=True) if t == name
        ]
        with open(folder / f"{name}.csv") as file:
            assert file.readline().strip().split(",") == described
    pictures = {file.name for file in (folder / "figures").iterdir()}
    assert pictures == {"m2.npy.png", "m10.npy.png"}
    (several.parent / "one.toml").write_text(several.read_text() + "\nmaps = 1")
    one, metrics = run(several.parent / "one.toml", tmp_path / "one")
    assert "Maps of 1 of 2 masks (key maps)." in metrics["warnings"]
    assert [file.name for file in (one / "figures").iterdir()] == ["m2.npy.png"]
    with Image.open(folder / "tensions.gif") as movie:
        assert movie.n_frames == 2
        first = np.asarray(movie.convert("RGB")).astype(int)
        movie.seek(1)
        assert np.any(np.abs(np.asarray(movie.convert("RGB")) - first) > 50)


def test_a_resumed_run_keeps_the_masks_that_are_done(several, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    experiment, config = load_config(several)
    folder = RunFolder(new_folder(tmp_path / "out"))
    with monkeypatch.context() as patch:
        patch.setattr(vx.plotting, "animate_figures", interrupt)
        with pytest.raises(KeyboardInterrupt):
            execute(experiment, config, folder, progress=False)
    edges = (folder.path / "edges.csv").read_text()
    assert len(list(folder.parts.iterdir())) == 2
    monkeypatch.setattr(MaskFrame, "infer", interrupt)
    np.save(tmp_path / "masks" / "m3.npy", bricks(1))
    with pytest.raises(KeyboardInterrupt):  # this mask can be read now, and is not done
        execute(experiment, config, folder, progress=False)
    (tmp_path / "masks" / "m3.npy").unlink()
    metrics = execute(experiment, config, folder, progress=False)
    assert metrics["n_masks"] == 2
    assert (folder.path / "edges.csv").read_text() == edges
    assert not folder.parts.exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"path": "none.tif"}, "none.tif does not exist"),
        ({"path": "*.tif"}, "there are none"),
        ({"path": "stack.npy", "plane": 5}, "`plane` must lie in 0 … 1"),
    ],
)
def test_a_run_of_a_wrong_image_leaves_no_folder(values, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("stack.npy", np.stack([bricks(0), bricks(1)]))
    experiment = find_experiment("infer_tensions")
    config = validate(experiment.config, {"experiment": "infer_tensions", "image": values})
    folder = RunFolder(new_folder(tmp_path / "out"))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        execute(experiment, config, folder, progress=False)
    assert not folder.path.exists()


@pytest.mark.slow  # compiles for half a minute
def test_damage_of_a_mask_is_in_metrics_and_tables(tmp_path):
    cluster = vx.initialise.free_voronoi(14, key=jax.random.key(3), lloyd_steps=3)
    labels = vx.inference.label_image(cluster, 300)
    centres = np.asarray(cluster.centroids)
    inner = np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1)) + 1
    np.save(tmp_path / "mask.npy", np.where(labels == inner, 0, labels))
    (tmp_path / "mask.toml").write_text(
        'experiment = "infer_tensions"\nimage = { path = "mask.npy" }'
    )
    folder, metrics = run(
        tmp_path / "mask.toml", tmp_path / "out", f"image.path={tmp_path / 'mask.npy'}"
    )
    assert metrics["n_cells"] == 13
    assert metrics["n_holes"] == 1
    assert metrics["mask_n_hole"] == 1
    assert metrics["mask_n_new_cell"] == 0
    (hole,) = metrics["mask_largest_changes"]
    assert hole["pixels"] == pytest.approx(np.sum(labels == inner), rel=0.002)
    assert table(folder / "changes.csv")["kind"] == ["hole"]
    assert table(folder / "cells.csv")["hole"].count("True") == 1
    assert "contact_closed" in table(folder / "edges.csv")
    assert any("holes" in warning for warning in metrics["warnings"])
