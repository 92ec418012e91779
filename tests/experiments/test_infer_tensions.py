"""The experiment that infers tensions, on synthetic clusters and on images."""

import numpy as np
import pytest
from run_helpers import run, table

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
        Config.model_validate({"relaxation": {"transitions": True}})
