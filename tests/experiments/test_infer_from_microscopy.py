import csv
import json

import jax
import numpy as np
import pytest
from helpers import relaxed
from PIL import Image

import vertax as vx
from vertax.runs import ConfigError, RunFolder, load_config
from vertax.runs._execution import new_folder

pytestmark = pytest.mark.experiments


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """A noisy picture of a periodic tissue; taken for one that is not, it is mirrored."""
    tissue, _ = relaxed(16, 2)
    clean = np.asarray(vx.costs.render(tissue, (160, 160), 0.07))
    noise = 0.03 * clean.max() * np.asarray(jax.random.normal(jax.random.key(0), clean.shape))
    grey = np.clip(200 * (clean + noise) / clean.max() + 20, 0, 255).astype(np.uint8)
    path = tmp_path_factory.mktemp("picture") / "membranes.png"
    Image.fromarray(grey).save(path)
    return path


CONFIG = "configs/infer_from_microscopy.toml"


def run(folder, *overrides, root):
    experiment, config = load_config(root / CONFIG, overrides)
    return experiment.run(config, RunFolder(new_folder(folder)), progress=False)


def test_the_fitted_mesh_follows_the_membranes_better(picture, tmp_path, pytestconfig):
    small = ("image.pixels=96", "fit.epochs=40", "relaxation.contacts=false")
    small = (*small, "relaxation.transitions=false", f"image.path={picture}")
    metrics = run(tmp_path / "run", *small, root=pytestconfig.rootpath)
    assert metrics["correlation_fitted"] > metrics["correlation_initial"] + 0.05
    assert metrics["membrane_contrast_fitted"] > metrics["membrane_contrast_initial"]
    assert metrics["max_force"] < 1e-7
    assert metrics["converged_fraction"] == 1
    # What is reported are the whole cells.
    with open(tmp_path / "run" / "cells.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == metrics["n_whole_cells"] >= 4
    factors = [float(row["target_shape_factor"]) for row in rows]
    assert np.mean(factors) == pytest.approx(metrics["shape_factor_mean"])
    assert all(0 < float(row["x_pixels"]) < 160 for row in rows)
    # The correlation is that of the pictures of the saved tissues with the saved image.
    fitted = vx.load(tmp_path / "run" / "fitted.npz", vx.Tissue)
    image = np.load(tmp_path / "run" / "image.npy")
    width = metrics["psf_width_pixels"] * metrics["pixel_size"]
    mirrored = vx.costs.mirror(image)
    model = np.asarray(vx.costs.render(fitted, mirrored.shape, width, points_per_edge=48))
    correlation = np.corrcoef(model.ravel(), mirrored.ravel())[0, 1]
    assert correlation == pytest.approx(metrics["correlation_fitted"], abs=1e-6)
    for name in ("overlay", "convergence", "shape_factors"):
        assert (tmp_path / "run" / "figures" / f"{name}.png").stat().st_size > 5000


def test_an_image_must_be_named(tmp_path, pytestconfig):
    with pytest.raises(ConfigError, match=r"image\.path"):
        run(tmp_path / "run", root=pytestconfig.rootpath)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.tif"):
        run(tmp_path / "run2", "image.path=nowhere.tif", root=pytestconfig.rootpath)


def test_the_defaults_of_the_file_are_those_of_the_experiment(pytestconfig):
    _, config = load_config(pytestconfig.rootpath / CONFIG)
    text = json.dumps(config.model_dump(mode="json"))
    assert '"epochs": 150' in text
    assert config.fit.learning_rate == 2e-2


CONDITIONS = """
experiment = "compare_conditions"
images = 1
tissue = { n_cells = 49, lloyd_steps = 2 }
microscope = { pixels = 240, snr = [20] }
preparation = { pixels = 160 }
fit = { learning_rate = 2e-2, epochs = 25 }
"""


@pytest.mark.slow
def test_two_conditions_go_from_pixels_to_shape_factors(tmp_path):
    (tmp_path / "tiny.toml").write_text(CONDITIONS)
    experiment, config = load_config(tmp_path / "tiny.toml", ())
    folder = RunFolder(new_folder(tmp_path / "run"))
    metrics = experiment.run(config, folder, progress=False)["SNR 20"]
    assert metrics["images"] == metrics["images_wanted"] == 2
    with open(tmp_path / "run" / "cells.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == metrics["cells"] >= 6
    true, inferred, deviation = (
        np.array([row[name] for row in rows], float) for name in ("true", "inferred", "deviation")
    )
    assert np.sqrt(np.mean((true - inferred) ** 2)) == pytest.approx(metrics["error_rms"])
    assert (deviation > 0).all()
    assert (deviation <= 0.3 * (1 + 1e-9)).all()  # the prior
    assert metrics["image_correlation"] > 0.6
    assert 0 <= metrics["fluid_is_larger"] <= 1
    for name in ("conditions", "images"):
        assert (tmp_path / "run" / "figures" / f"{name}.png").stat().st_size > 5000
