"""The experiment with Surface Evolver as the only forward model."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from run_helpers import run, table

from vertax.runs import ConfigError

pytestmark = pytest.mark.experiments
CONFIG = Path(__file__).parents[2] / "configs" / "external_tensions.toml"


def test_it_says_how_to_install_the_program(tmp_path):
    with pytest.raises(ConfigError, match="apt-get install evolver-nox"):
        run(CONFIG, tmp_path / "run", "program.command=no-such-evolver")


@pytest.mark.slow  # compiles for a minute
@pytest.mark.skipif(
    shutil.which("evolver") is None,
    reason="Surface Evolver is not installed: apt-get install evolver-nox",
)
def test_both_forward_models_lead_the_same_way(tmp_path):
    small = ("tissue.n_cells=6", "fit.epochs=2")
    folder, metrics = run(CONFIG, tmp_path / "run", *small)
    # Each epoch relaxes the foam once, and twice for each of 24 coordinates.
    assert metrics["runs_of_the_program"] >= 2 * 49
    assert metrics["relative_error_evolver"] < 0.7 * metrics["relative_error_initial_evolver"]
    edges = table(folder / "edges.csv")
    found = [np.array(edges[f"found_{name}"], float) for name in ("evolver", "vertax")]
    np.testing.assert_allclose(*found, rtol=1e-6)
