"""The experiment that infers tensions, on synthetic clusters and on images."""

import jax
import numpy as np
import pytest
from PIL import Image
from run_helpers import run, table

import vertax as vx
from vertax.runs._config import validate
from vertax.runs._registry import find_experiment

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


def test_a_colour_image_is_read_and_there_is_a_key_for_its_channel(tmp_path):
    path, labels = colours(tmp_path)
    config = validate(
        find_experiment("infer_tensions").config,
        {"image": {"path": str(path), "kind": "labels"}},
    )
    assert len(np.unique(config.image.labels())) == len(np.unique(labels))
    chosen = config.image.model_copy(update={"channel": 1})
    np.testing.assert_array_equal(chosen.labels(), labels)


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
