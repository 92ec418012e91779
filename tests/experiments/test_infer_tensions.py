"""The experiment that infers tensions, on synthetic clusters and on images."""

import jax
import numpy as np
import pytest
from PIL import Image
from run_helpers import run, table

import vertax as vx
from vertax.runs import ConfigError, find_experiment, validate

pytestmark = pytest.mark.experiments

TINY = """
experiment = "infer_tensions"
epochs = 2
cluster = { n_cells = 4, pixels = 200 }
"""


@pytest.mark.slow  # compiles for a minute
def test_the_experiment_finds_what_it_drew(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert metrics["rms_distance_pixels_fitted"] < metrics["rms_distance_pixels_balanced"]
    assert metrics["rms_distance_pixels_balanced"] < metrics["rms_distance_pixels_equal"]
    assert metrics["pearson_tension"] > 0.8
    assert metrics["rms_error_pressure"] < 0.2
    edges = table(folder / "edges.csv")
    assert np.mean(np.array(edges["tension"], float)) == pytest.approx(1)
    assert (folder / "figures" / "recovery.png").stat().st_size > 10_000


def test_transitions_are_refused_in_the_configuration(tmp_path):
    with pytest.raises(ValueError, match=r"relaxation\.transitions must be false"):
        validate(find_experiment("infer_tensions").config, {"relaxation": {"transitions": True}})


@pytest.mark.slow  # compiles for a minute
def test_a_fit_that_does_not_explain_its_image_says_so(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    _, metrics = run(tmp_path / "tiny.toml", tmp_path / "out", "model.noise=1e-3")
    assert any("do not explain the image" in warning for warning in metrics["warnings"])


def colours(folder):
    """A label image of a cluster in the green channel of a picture."""
    cluster = vx.initialise.free_voronoi(5, key=jax.random.key(0))
    labels = vx.inference.label_image(cluster, 120).astype(np.uint8)
    Image.fromarray(np.stack([0 * labels, labels, 0 * labels], axis=-1)).save(folder / "rgb.png")
    return folder / "rgb.png", labels


def test_a_colour_image_needs_a_channel_and_there_is_a_key_for_it(tmp_path):
    path, labels = colours(tmp_path)
    config = validate(
        find_experiment("infer_tensions").config,
        {"image": {"path": str(path), "kind": "labels"}},
    )
    with pytest.raises(ConfigError, match=r"holds 3 channels.*--set image\.channel=0"):
        config.image.read()
    chosen = config.image.model_copy(update={"channel": 1})
    np.testing.assert_array_equal(chosen.read(), labels)
