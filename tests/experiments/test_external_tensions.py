"""The experiment with Surface Evolver as the only forward model."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from run_helpers import run, table

from vertax.runs import ConfigError

pytestmark = pytest.mark.experiments
CONFIG = Path(__file__).parents[2] / "configs" / "external_tensions.toml"


def test_a_missing_program_is_an_error_with_the_install_command(tmp_path):
    with pytest.raises(ConfigError, match="apt-get install evolver-nox"):
        run(CONFIG, tmp_path / "run", "program.command=no-such-evolver")


@pytest.mark.slow  # compiles for a minute
@pytest.mark.skipif(
    shutil.which("evolver") is None,
    reason="Surface Evolver is not installed: apt-get install evolver-nox",
)
def test_both_forward_models_give_the_same_tensions(tmp_path):
    small = ("tissue.n_cells=6", "fit.epochs=2")
    folder, metrics = run(CONFIG, tmp_path / "run", *small)
    # Each epoch relaxes the foam once, and twice for each of 24 coordinates.
    assert metrics["runs_of_the_program"] >= 2 * 49
    assert metrics["relative_error_evolver"] < 0.7 * metrics["relative_error_initial_evolver"]
    edges = table(folder / "edges.csv")
    inferred = [np.array(edges[f"found_{name}"], float) for name in ("evolver", "vertax")]
    np.testing.assert_allclose(*inferred, rtol=1e-6)


# Two bubbles side by side.
DOUBLET = """SPACE_DIMENSION 2
STRING
vertices
 1 0 -1
 2 0.1 0
 3 0 1
 4 1.5 0
 5 -1.5 0
edges
 1 1 2 density 1.1
 2 2 3 density 1.1
 3 1 4 density 0.9
 4 4 3 density 0.9
 5 3 5 density 1
 6 5 1 density 1
faces
 1 3 4 -2 -1
 2 1 2 5 6
bodies
 1 1 volume 1.9
 2 2 volume 2.1
read
"""


@pytest.mark.slow  # compiles for a minute
@pytest.mark.skipif(
    shutil.which("evolver") is None,
    reason="Surface Evolver is not installed: apt-get install evolver-nox",
)
def test_tensions_of_a_foam_from_a_file(tmp_path):
    (tmp_path / "doublet.dmp").write_text(DOUBLET, encoding="utf-8")
    folder, metrics = run(
        CONFIG,
        tmp_path / "run",
        f"foam.file={tmp_path / 'doublet.dmp'}",
        "fit.epochs=8",
    )
    assert metrics["relative_error_initial_evolver"] > 0.05
    assert metrics["relative_error_evolver"] < 1e-4
    true = np.array(table(folder / "edges.csv")["true"], float)
    np.testing.assert_allclose(np.sort(true), [0.9, 1.0, 1.1])
    assert 0 < metrics["moved_to_rest"] < 1
    # The program is the only forward model.
    assert "relative_error_vertax" not in metrics
