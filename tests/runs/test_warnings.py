"""What a run warns of, in its metrics and on the screen."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ADAM, FIXED_TOPOLOGY, LEAST_SQUARES, random_tissue
from typer.testing import CliRunner

import vertax as vx
from vertax.runs import RunFolder, _folder
from vertax.runs.command_line import app

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 3
relaxation = { contacts = false, transitions = false }  # which compiles less
"""


def problem(p0=3.6):
    tissue = random_tissue(6)
    energy = vx.energies.ShapeFactorEnergy(jnp.full(6, p0))
    return vx.InverseProblem(
        tissue, energy, vx.costs.VertexDistance(tissue), response=FIXED_TOPOLOGY
    )


def test_a_fit_that_has_not_converged_is_a_warning(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    arguments = ["run", str(tmp_path / "tiny.toml"), "--output", str(tmp_path / "run")]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    message = "vertices: the cost was still falling at the last epoch (raise the number of epochs)."
    assert f"Warning: {message}" in outcome.stderr
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["warnings"] == [message]
    assert message in CliRunner().invoke(app, ["show", str(tmp_path / "run")]).stderr


def test_equal_warnings_are_joined(tmp_path):
    folder = RunFolder(tmp_path)
    for k in range(5):
        folder.warn("it was cut short", f"fit {k}")
    folder.warn("the moon is full")
    assert folder.warnings == [
        "fit 0, fit 1, fit 2 and 2 more: it was cut short.",
        "The moon is full.",
    ]


def test_a_run_without_warnings_has_no_such_key(tmp_path):
    RunFolder(tmp_path).save_metrics({"cost": 1.0})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"cost": 1.0}


@pytest.mark.thorough
def test_least_squares_without_convergence_are_a_warning(tmp_path, monkeypatch):
    # What counts is the number of epochs, and those of Adam compile much less.
    monkeypatch.setattr(_folder, "fit", lambda p, _, n, **options: vx.fit(p, ADAM, n, **options))
    folder = RunFolder(tmp_path)
    folder.fit("lm", problem(), LEAST_SQUARES, 2, progress=False)
    assert any("did not end within 2 epochs" in warning for warning in folder.warnings)


@pytest.fixture
def broken(monkeypatch):
    """Fits that cannot go on after three epochs."""
    real = vx.fit

    def fit(*arguments, **options):
        raise vx.FitError("It broke.", real(*arguments, **options))

    monkeypatch.setattr(_folder, "fit", fit)


@pytest.mark.usefixtures("broken")
@pytest.mark.thorough
def test_a_failed_fit_keeps_its_epochs(tmp_path):
    folder, optimiser = RunFolder(tmp_path), ADAM
    with pytest.raises(vx.FitError):
        folder.fit("a b", problem(), optimiser, 3, progress=False)
    assert (tmp_path / "history_a_b.csv").read_text().count("\n") == 4
    assert vx.load(tmp_path / "fitted_a_b.npz", vx.Tissue).n_cells == 6
    assert folder.warnings == []
    outcome = folder.fit("c", problem(), optimiser, 3, partial=True, progress=False)
    assert len(outcome.history.cost) == 3
    assert folder.warnings == ["c: It broke."]


def test_tables_leave_empty_what_is_not_known(tmp_path):
    # One dialect with vertax.io.write_csv.
    RunFolder(tmp_path).save_table("x", {"a": np.array([1.5, np.nan]), "b": [True, False]})
    assert (tmp_path / "x.csv").read_text() == "a,b\n1.5,True\n,False\n"
