"""Inference across topologies and the rigidity transition, on small tissues."""

import json

import numpy as np
import pytest
from run_helpers import run, table

import vertax as vx
from vertax.costs import mismatched_neighbours

pytestmark = pytest.mark.experiments

ACROSS = """
experiment = "inference_across_topologies"
seed = 3
replicates = 2
least_mismatch = 2
tissue = { n_cells = 8 }
guidance = { epochs = 50 }
relaxation = { contacts = false }  # which compiles less
fit = { learning_rate = 2e-2, epochs = 90 }

[[methods]]
name = "guided"
distance = "centroids"
guided = true
"""
RIGIDITY = """
experiment = "rigidity_transition"
shape_factors = [3.4, 4.1]
replicates = 3
modes = 2
resamples = 20
relaxation = { solver = "fire", max_steps = 5000 }  # which compiles half as much
tissue = { n_cells = 12 }
driving = { cycles = 1 }
"""


def test_guidance_crosses_topologies(tmp_path):
    (tmp_path / "tiny.toml").write_text(ACROSS)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert min(metrics["start"]["mismatched_neighbours"]) >= 2
    guided = metrics["guided"]
    assert guided["mismatched_neighbours"] == [0, 0]
    assert guided["relative_error_most"] < 1e-3
    assert guided["succeeded"] == 1
    target, fitted = (vx.load(folder / f"{n}.npz", vx.Tissue) for n in ("target", "fitted_guided"))
    assert mismatched_neighbours(fitted, target) == 0
    rows = table(folder / "shape_factors.csv")
    error = np.abs(np.array(rows["guided"], float) / np.array(rows["true"], float) - 1)
    assert np.mean(error.reshape(2, 8), axis=1) == pytest.approx(guided["relative_error"])
    assert len(table(folder / "history.csv")["cost"]) == 2 * 90
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    for name in ("inference", "tissues"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 10_000


def test_too_similar_draws_are_refused(tmp_path):
    (tmp_path / "tiny.toml").write_text(ACROSS)
    with pytest.raises(ValueError, match="choose a smaller least_mismatch"):
        run(tmp_path / "tiny.toml", tmp_path / "out", "least_mismatch=30", "replicates=1")


def test_tissues_turn_from_solid_to_fluid(tmp_path):
    (tmp_path / "tiny.toml").write_text(RIGIDITY)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    rows = {
        name: np.array(column, float) for name, column in table(folder / "transition.csv").items()
    }
    np.testing.assert_array_equal(rows["zero_after_0"], [0, 1])
    # Energy only falls under driving.
    energies = np.load(folder / "energies.npy")
    assert energies.shape == (2, 3, 2)
    assert (np.diff(energies, axis=-1) <= 0).all()
    # A rigid tissue has no soft motion; in a floppy one every cell has the shape it wants.
    assert rows["zero_modes"][0] == 0
    assert rows["zero_modes"][1] > 0
    assert rows["shape_factor"][1] == pytest.approx(4.1, abs=1e-4)
    assert 3.4 < metrics["quench"]["p0_star"] < 4.1
    assert metrics["run"]["converged_fraction"] == 1
