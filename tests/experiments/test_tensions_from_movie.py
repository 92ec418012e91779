"""The experiment that infers tensions from a movie."""

import pytest
from run_helpers import run, table

pytestmark = pytest.mark.experiments

TINY = """
experiment = "tensions_from_movie"
substeps = 10
cluster = { n_cells = 7, pieces = 4, frames = 3, interval = 0.01, noise = 1e-6 }
"""


def test_tensions_of_a_synthetic_movie_are_recovered(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert metrics["n_frames"] == 3
    assert metrics["pearson_2_frames"] > 0.99
    assert metrics["relative_error_all_frames"] < 0.03
    rows = table(folder / "misfit.csv")
    assert all(
        float(misfit) < 0.1 * float(moved)
        for misfit, moved in zip(rows["misfit_2_frames"], rows["moved"], strict=True)
    )
    assert (folder / "figures" / "tensions.png").stat().st_size > 10_000
