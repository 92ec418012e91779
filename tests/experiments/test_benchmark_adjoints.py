"""The benchmark of adjoints, small: that it runs, and that what it reports is consistent."""

import csv
import json

import numpy as np
import pytest

from vertax.runs import RunFolder, find_experiment, validate

pytestmark = pytest.mark.experiments


def run(tmp_path, **changes):
    experiment = find_experiment("benchmark_adjoints")
    small = {"replicates": 2, "tissue": {"n_cells": 8}}
    config = validate(experiment.config, small | changes)
    folder = RunFolder.claim("benchmark", tmp_path / "run")
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
        scaling={"sizes": []},
        accuracy={"tolerances": []},
    )
    assert set(metrics) == {"paper Adj-ID", "equilibrium Adj-ID", "warnings"}
    # Five epochs are not enough, and two hundred steps of the paper's relaxation neither.
    assert any("still falling" in warning for warning in metrics["warnings"])
    cells = table(folder, "shape_factors_equilibrium")
    true, found = (cells[name].astype(float).reshape(2, 8) for name in ("true", "Adj-ID"))
    error = np.mean(np.abs(found - true) / true, axis=1)
    np.testing.assert_allclose(metrics["equilibrium Adj-ID"]["relative_error"], error)
    history = table(folder, "history_equilibrium")
    assert len(history["epoch"]) == 2 * 5
    assert sorted(set(history["replicate"])) == ["0", "1"]


@pytest.mark.slow
def test_everything(tmp_path):
    fit = {"epochs": 40}
    _, metrics = run(
        tmp_path,
        paper={
            "fit": fit,
            "relaxation": {"solver": "gradient_descent", "tolerance": 1e-3, "max_steps": 300},
            "unrolled": {"solver": "gradient_descent", "tolerance": 1e-3, "max_steps": 300},
            "gradient": {"strict": False, "nudge": "cost", "beta": 1.0},
        },
        equilibrium={"fit": fit},
        scaling={"sizes": [8]},
        accuracy={
            "tolerances": [1e-8, 1e-3],
            "betas": [1e-5],
            "cost_betas": [1e-2],
            "fitted_betas": [1.0],
            "n_cells": 8,
        },
    )
    errors = [metrics[f"equilibrium {m}"]["relative_error_max"] for m in ("AD", "Adj-ID", "EP")]
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)
    assert metrics["equilibrium LM"]["relative_error_max"] < 1e-8
    assert metrics["hypergradient"]["Adj-ID at tolerance 1e-08"] < 1e-5
    assert metrics["hypergradient"]["Adj-ID at tolerance 1e-03"] > 1e-4
    assert metrics["beta"]["linear, centred, smallest error"] < 1e-4
