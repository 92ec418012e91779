"""The benchmark of adjoints, small: that it runs, and that what it reports is consistent."""

import csv
import json

import numpy as np
import pytest

from vertax.runs import RunFolder
from vertax.runs._config import validate
from vertax.runs._execution import new_folder
from vertax.runs._registry import find_experiment

pytestmark = pytest.mark.experiments


def run(tmp_path, name="benchmark_adjoints", **changes):
    experiment = find_experiment(name)
    small = {"replicates": 2, "tissue": {"n_cells": 8}}
    config = validate(experiment.config, small | changes)
    folder = RunFolder(new_folder(tmp_path / name))
    folder.save_metrics(experiment.run(config, folder, progress=False))
    return folder, json.loads((folder.path / "metrics.json").read_text())


def table(folder, name):
    with open(folder.path / f"{name}.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def test_inference_with_one_method(tmp_path):
    fit = {"epochs": 5}
    relaxation = {"tolerance": 1e-3, "max_steps": 200, "contacts": False}
    folder, metrics = run(
        tmp_path,
        methods=["Adj-ID"],
        least_squares_steps=0,
        paper={"fit": fit, "relaxation": relaxation, "gradient": {"strict": False}},
        equilibrium={"fit": fit, "relaxation": {"contacts": False}},
    )
    assert set(metrics) == {"paper Adj-ID", "equilibrium Adj-ID", "warnings"}
    # Five epochs are not enough, and two hundred steps of the paper's relaxation neither.
    assert any("still falling" in warning for warning in metrics["warnings"])
    cells = table(folder, "shape_factors_equilibrium")
    true, inferred = (cells[name].astype(float).reshape(2, 8) for name in ("true", "Adj-ID"))
    error = np.mean(np.abs(inferred - true) / true, axis=1)
    np.testing.assert_allclose(metrics["equilibrium Adj-ID"]["relative_error"], error)
    history = table(folder, "history_equilibrium")
    assert len(history["epoch"]) == 2 * 5
    assert sorted(set(history["replicate"])) == ["0", "1"]


SOLVER = {"solver": "gradient_descent", "tolerance": 1e-3, "max_steps": 300}
PAPER = {
    "fit": {"epochs": 40},
    "relaxation": SOLVER,
    "unrolled": SOLVER,
    "gradient": {"strict": False, "nudge": "cost", "beta": 1.0},
}


@pytest.mark.slow
def test_all_adjoints_and_least_squares_agree(tmp_path):
    _, metrics = run(tmp_path, paper=PAPER, equilibrium={"fit": {"epochs": 40}})
    errors = [metrics[f"equilibrium {m}"]["relative_error_max"] for m in ("AD", "Adj-ID", "EP")]
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)
    assert metrics["equilibrium LM"]["relative_error_max"] < 1e-8


@pytest.mark.slow
def test_hypergradients_are_accurate_at_equilibrium_only(tmp_path):
    scans = {"tolerances": [1e-8, 1e-3], "betas": [1e-5], "cost_betas": [1e-2]}
    _, metrics = run(tmp_path, "hypergradient_accuracy", paper=PAPER, fitted_betas=[1.0], **scans)
    assert metrics["hypergradient"]["Adj-ID at tolerance 1e-08"] < 1e-5
    assert metrics["hypergradient"]["Adj-ID at tolerance 1e-03"] > 1e-4
    assert metrics["beta"]["linear, centred, smallest error"] < 1e-4


@pytest.mark.slow
def test_time_and_memory_are_measured_for_each_adjoint(tmp_path):
    _, metrics = run(tmp_path, "adjoint_scaling", paper=PAPER, sizes=[8])
    assert len(metrics) == 8
    assert all(group["8 cells, ms per epoch"] > 0 for group in metrics.values())
    assert metrics["paper EP"]["8 cells, memory over that of EP"] == 1
