"""Inverse design: tiny runs of each experiment, and what they leave."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from run_helpers import run, table

import vertax as vx
from experiments._shared import TensionRange
from vertax.costs import HomotypicLength, aspect_ratio

pytestmark = pytest.mark.experiments

MECHANICS = """
experiment = "design_mechanics"
tissue = { n_cells = 6, lloyd_steps = 2 }
target = 3.95
accuracy = 5e-3
relaxation = { contacts = false, transitions = false }  # which compiles less
fit = { learning_rate = 1e-2, epochs = 12 }
"""
ELONGATION = """
experiment = "convergent_extension"
n_cells = [6]
targets = [1.6]
start_ratio = 1.3
replicates = 2
accuracy = 0.05
relaxation = { contacts = false, transitions = false }
start = { learning_rate = 0.2, epochs = 8 }
fit = { learning_rate = 0.2, epochs = 15 }
"""
PATTERN = """
experiment = "salt_and_pepper"
boundaries = ["free"]
n_types = [2]
replicates = 2
tissue = { n_cells = 7, lloyd_steps = 3 }
relaxation = { contacts = false }  # which compiles less
fit = { learning_rate = 0.3, epochs = 8 }
"""


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "method", ["implicit", pytest.param("propagation", marks=pytest.mark.slow)]
)
def test_mechanics_reaches_its_target(tmp_path, method):
    (tmp_path / "tiny.toml").write_text(MECHANICS)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out", f"gradient.method={method}")
    assert metrics["mean_parameter_initial"] == pytest.approx(3.91)
    assert metrics["distance_final"] < 5e-3
    assert metrics["limited_by"] == "reached"
    assert metrics["max_force"] < 1e-9
    tissue = vx.load(folder / "designed.npz", vx.Tissue)
    assert float(jnp.mean(tissue.shape_factors)) == pytest.approx(metrics["mean_final"])
    observed = np.array(table(folder / "cells.csv")["observed_final"], float)
    np.testing.assert_allclose(observed, tissue.shape_factors)
    assert len(table(folder / "history.csv")["mean_observed"]) == 12
    assert len(table(folder / "cells_by_epoch.csv")["target"]) == 12 * 6
    assert {"figures/design.png", "figures/convergence.png"} <= files(folder)


@pytest.mark.parametrize(
    "method", ["implicit", pytest.param("propagation", marks=pytest.mark.slow)]
)
def test_a_cluster_elongates(tmp_path, method):
    (tmp_path / "tiny.toml").write_text(ELONGATION)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out", f"gradient.method={method}")
    six = metrics["6 cells"]
    ratios = six["targets"]["1.6"]["ratios"]
    assert np.allclose(ratios, 1.6, atol=0.1)
    rows = table(folder / "aspect_ratios.csv")
    np.testing.assert_allclose(np.array(rows["aspect_ratio"], float), ratios)
    first = vx.load(folder / "designed.npz", vx.Tissue)
    assert float(aspect_ratio(first)) == pytest.approx(ratios[0])
    assert six["max_force"] < 1e-9
    curve = np.array(table(folder / "history.csv")["aspect_ratio"], float).reshape(2, 15)
    best = six["targets"]["1.6"]["best_epoch"]
    np.testing.assert_allclose(curve[[0, 1], best], ratios)
    assert "figures/design.png" in files(folder)


@pytest.mark.parametrize(
    "method", ["implicit", pytest.param("propagation", marks=pytest.mark.slow)]
)
def test_interfaces_between_cells_of_one_type_shrink(tmp_path, method):
    (tmp_path / "tiny.toml").write_text(PATTERN)
    nudge = ("gradient.nudge=cost", "gradient.nudged_rtol=1e-3") if method != "implicit" else ()
    folder, metrics = run(
        tmp_path / "tiny.toml", tmp_path / "out", f"gradient.method={method}", *nudge
    )
    kind = metrics["free, 2 types"]
    assert kind["share_best"]["mean"] > kind["share_initial"]["mean"] + 0.1
    types = jnp.asarray(np.array(table(folder / "cell_types.csv")["type"], int))
    tissue = vx.load(folder / "designed.npz", vx.Tissue)
    shares = np.array(table(folder / "history.csv")["heterotypic_share"], float).reshape(2, 8)
    left = HomotypicLength(types, relative=True)(tissue, vx.energies.LineTension(1.0))
    assert 1 - float(left) == pytest.approx(shares[0, kind["best_epoch"][0]])
    assert json.loads((folder / "metrics.json").read_text()) == metrics


def test_bounds_of_tensions_are_ordered():
    with pytest.raises(ValueError, match="low must be below high"):
        TensionRange(low=0.3, high=0.2)


def test_tensions_are_drawn_about_the_middle_of_their_range():
    import jax

    tissue = vx.initialise.free_voronoi(8, key=jax.random.key(0))
    equal = TensionRange(low=0.1, high=0.3).draw(tissue, 0.0, jax.random.key(1)).terms[1]
    assert isinstance(equal, vx.energies.BoundedTension)
    np.testing.assert_allclose(equal.tension, 0.2)
    varied = TensionRange(low=0.1, high=0.3).draw(tissue, 0.5, jax.random.key(1)).terms[1]
    assert isinstance(varied, vx.energies.BoundedTension)
    assert np.ptp(varied.tension) > 0.05
    assert ((varied.tension > 0.15) & (varied.tension < 0.25)).all()
