"""Sweeps: which runs they have, that one that fails stops no other, and that finished ones are kept."""

import csv
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from typer.testing import CliRunner

from vertax.jobs import infer_shape_factors
from vertax.runs import ConfigError, _sweep
from vertax.runs._folder import RunFolderError
from vertax.runs._sweep import parse_grid, sweep, sweep_runs, sweep_table
from vertax.runs.command_line import app

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 2
relaxation = { contacts = false, transitions = false }
"""


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The working directory holds tiny.toml."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    return tmp_path


def table(folder):
    with open(folder / "sweep.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("tissue.n_cells=50,100", ["50", "100"]),
        ("seed=0:3", ["0", "1", "2"]),
        ("seed=4:0:-2", ["4", "2"]),
        ("data=vertices,image", ["vertices", "image"]),
        ('data="vertices", "a, b"', ['"vertices"', '"a, b"']),
        ("targets=[1.5, 2],[3]", ["[1.5, 2]", "[3]"]),
        ("fit.learning_rate=1e-2", ["1e-2"]),
    ],
)
def test_values_of_a_grid(text, values):
    (parsed,) = parse_grid([text]).values()
    assert parsed == values


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["seed"], "must have the form key=value,value"),
        (["=3"], "must have the form"),
        (["seed="], "must have the form"),
        (["seed=3:3"], "has no values"),
        (["seed=0:3:0"], "step of 0"),
        (["seed=1", "seed=2"], "`seed` has two grids"),
    ],
)
def test_a_grid_of_another_form_is_refused(texts, message):
    with pytest.raises(ConfigError, match=message):
        parse_grid(texts)


def test_runs_are_all_combinations(tiny):
    grid = {"seed": ["0", "1"], "tissue.n_cells": ["6", "8", "10"]}
    runs = sweep_runs(["tiny.toml"], grid, "out", ["fit.epochs=3"])
    assert len({run.folder for run in runs}) == 6
    assert {run.config.fit.epochs for run in runs} == {3}
    assert [run.keys["tissue.n_cells"] for run in runs[:3]] == [6, 8, 10]
    assert runs[-1].folder.name == "tiny-seed_1-tissue.n_cells_10"


def test_invalid_runs_are_rejected_before_the_sweep_begins(tiny):
    with pytest.raises(ConfigError, match=r"did you mean `tissue\.n_cells`"):
        sweep_runs(["tiny.toml"], {"tissue.n_cell": ["6"]}, "out")
    with pytest.raises(ConfigError, match="Two runs of the sweep are called tiny-seed_1"):
        sweep_runs(["tiny.toml"], {"seed": ["1", "1"]}, "out")
    assert not (tiny / "out").exists()


def test_bad_folders_and_formats_are_refused(tiny):
    (tiny / "file").write_text("mine")
    for options, message in (
        (["--output", "file"], "file"),
        (["--figures", "jpg", "--output", "out"], "jpg"),
    ):
        outcome = CliRunner().invoke(app, ["sweep", "tiny.toml", *options])
        assert outcome.exit_code == 2, outcome.output
        assert message in outcome.output
    assert (tiny / "file").read_text() == "mine"
    assert not (tiny / "out").exists()


@pytest.mark.thorough
def test_a_sweep_continues_after_failures_and_keeps_finished_runs(tiny):
    # In the folder of one run lies something else, which is not overwritten.
    (tiny / "out" / "tiny-seed_1").mkdir(parents=True)
    (tiny / "out" / "tiny-seed_1" / "notes.txt").write_text("mine")
    arguments = ["sweep", "tiny.toml", "--grid", "seed=0,1", "--output", "out", "--workers", "1"]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 1, outcome.output
    assert "1 of 2 runs are finished" in outcome.output
    rows = table(tiny / "out")
    assert [(row["seed"], row["state"]) for row in rows] == [("0", "finished"), ("1", "failed")]
    assert "is not empty" in rows[1]["error"]
    file = tiny / "out" / "tiny-seed_0" / "metrics.json"
    metrics = json.loads(file.read_text())
    assert float(rows[0]["cost_final"]) == metrics["cost_final"]

    # The finished run is not repeated, also without any process.
    before = file.stat().st_mtime_ns
    (run,) = sweep_runs(["tiny.toml"], {"seed": ["0"]}, "out")
    assert sweep([run], tiny / "out", progress=False) == {}
    assert sweep_table([run], {})["cost_final"] == [metrics["cost_final"]]
    assert file.stat().st_mtime_ns == before

    # The folder of another configuration is not touched.
    with pytest.raises(RunFolderError, match="a run of another configuration"):
        sweep_runs(["tiny.toml"], {"seed": ["0"]}, "out", ["fit.epochs=5"])


@pytest.fixture
def counted(monkeypatch):
    """The keys of the runs that this process executes, which takes no time."""
    seeds = []

    def run(config, folder, *, progress):
        seeds.append(config.seed)
        folder.save_array("positions", np.ones(3))
        if config.seed == 3:
            raise ValueError("It broke.")
        return {"cost": 1.0}

    monkeypatch.setattr(infer_shape_factors, "run", run)
    return seeds


def test_failed_runs_are_repeated_and_finished_ones_kept(tiny, counted):
    runs = sweep_runs(["tiny.toml"], {"seed": ["0", "3"]}, "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_sweep, "LocalProcesses", ThreadPoolExecutor)
        assert sweep(runs, tiny / "out", executor=ThreadPoolExecutor(1), progress=False) == {
            "tiny-seed_3": "ValueError: It broke."
        }
        assert [run.is_finished for run in runs] == [True, False]
        # The table has the failure also in a process that did not execute the run.
        assert sweep_table(runs, {})["error"] == ["", "It broke."]
        sweep(runs, tiny / "out", executor=ThreadPoolExecutor(1), progress=False)
    assert counted == [0, 3, 3]


def test_two_sweeps_do_not_write_to_one_folder(tiny, counted):
    runs = sweep_runs(["tiny.toml"], {"seed": ["0"]}, "out")
    (tiny / "out").mkdir()
    with (
        FileLock(tiny / "out" / ".lock"),
        pytest.raises(RunFolderError, match="Another sweep writes to"),
    ):
        sweep(runs, tiny / "out", progress=False)
    assert counted == []


def test_files_come_back_from_other_machines(tiny, counted):
    runs = sweep_runs(["tiny.toml"], {"seed": ["0", "3"]}, "out")
    errors = sweep(runs, tiny / "out", executor=ThreadPoolExecutor(1), progress=False)
    assert errors == {"tiny-seed_3": "ValueError: It broke."}
    names = sorted(path.name for path in runs[0].folder.iterdir())
    assert names == ["config.toml", "metrics.json", "positions.npy"]
    assert not runs[1].folder.exists()
    assert [row["state"] for row in table(tiny / "out")] == ["finished", "failed"]


DIES = """
import os
from vertax.jobs import infer_shape_factors

def run(config, folder, *, progress):
    if config.seed == 1:
        os.kill(os.getpid(), 9)
    return {"cost": 1.0}

infer_shape_factors.run = run
from vertax.__main__ import main
if __name__ == "__main__":
    main()
"""


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="needs signals of Unix")
def test_a_dead_process_ends_one_run_only(tiny):
    (tiny / "program.py").write_text(DIES)
    command = [sys.executable, "program.py", "sweep", "tiny.toml", "--grid", "seed=0:4"]
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 1
    assert "its process died, perhaps for lack of memory" in done.stderr
    states = {row["seed"]: row["state"] for row in table(tiny / "runs/tiny-sweep")}
    assert states == {"0": "finished", "1": "failed", "2": "finished", "3": "finished"}
