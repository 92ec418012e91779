"""Runs that are interrupted, and go on."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import vertax as vx
from experiments._shared import scan
from vertax.fitting._descent import Descent
from vertax.runs import RunFolder
from vertax.runs.command_line import app

TINY = """
experiment = "infer_shape_factors"
data = "both"
tissue.n_cells = 6
image.pixels = 16
fit.epochs = 4
relaxation = { contacts = false, transitions = false }  # which compiles less
"""


def vertax(*arguments):
    return CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with tiny.toml and a run of it that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "tiny.toml").write_text(TINY)
    outcome = vertax("run", folder / "tiny.toml", "--output", folder / "run")
    assert outcome.exit_code == 0, outcome.output
    return folder


@pytest.fixture
def interrupt(monkeypatch):
    """Interrupts the n-th epoch of all, counted over fits."""

    def at(n):
        advance, count = Descent.advance, iter(range(10_000))

        def interrupted(self, state, epoch):
            if next(count) == n:
                raise KeyboardInterrupt
            return advance(self, state, epoch)

        monkeypatch.setattr(Descent, "advance", interrupted)

    return at


def tables(run):
    """All tables of a run, without times; and its metrics."""
    tables_by_file = {}
    for file in sorted(Path(run).glob("*.csv")):
        rows = list(csv.DictReader(file.read_text().splitlines()))
        tables_by_file[file.name] = [
            {k: v for k, v in row.items() if k != "seconds"} for row in rows
        ]
    metrics = json.loads((Path(run) / "metrics.json").read_text())
    for group in (metrics, metrics["vertices"], metrics["image"]):
        group.pop("seconds_per_epoch")
    return tables_by_file, metrics


# In the first fit, and in the second one, when the first is kept.
@pytest.mark.parametrize("epoch", [pytest.param(2, marks=pytest.mark.slow), 5])
@pytest.mark.thorough
def test_a_resumed_run_has_the_same_numbers(finished, interrupt, tmp_path, epoch):
    run = tmp_path / "run"
    interrupt(epoch)
    stopped = vertax("run", finished / "tiny.toml", "--output", run)
    assert stopped.exit_code == 130
    assert f"To continue: vertax run {finished / 'tiny.toml'} --resume {run}" in stopped.stderr
    assert (run / "history.csv").is_file()
    assert list((run / "figures").iterdir())
    assert not (run / "metrics.json").exists()
    shown = vertax("show", run)
    assert shown.exit_code == 1
    assert f"--resume {run}" in shown.stderr
    resumed = vertax("run", finished / "tiny.toml", "--resume", run)
    assert resumed.exit_code == 0, resumed.output
    assert "kept so far: " in resumed.output
    assert tables(run) == tables(finished / "run")
    fitted, expected = (
        vx.load(f / "fitted_image.npz", vx.Tissue).vertices for f in (run, finished / "run")
    )
    np.testing.assert_array_equal(fitted, expected)
    assert not (run / "unfinished").exists()


@pytest.mark.thorough
def test_an_interrupt_before_the_first_epoch_keeps_the_folder(finished, interrupt, tmp_path):
    interrupt(0)
    stopped = vertax("run", finished / "tiny.toml", "--output", tmp_path / "run", "--set", "seed=1")
    assert stopped.exit_code == 130
    assert "--set seed=1 --resume" in stopped.stderr
    assert (tmp_path / "run/config.toml").is_file()


@pytest.fixture
def stopped(finished, tmp_path):
    """What an interrupt left."""
    shutil.copytree(finished / "run", tmp_path / "run")
    (tmp_path / "run/metrics.json").unlink()
    return tmp_path / "run"


@pytest.mark.thorough
def test_a_run_of_another_configuration_is_not_resumed(finished, stopped):
    outcome = vertax(
        "run",
        finished / "tiny.toml",
        "--resume",
        stopped,
        "--set",
        "fit.epochs=9",
        "--set",
        "seed=1",
    )
    assert outcome.exit_code == 2
    assert "has another configuration: `seed` was 0 and is 1; `fit.epochs` was 4 and is 9" in (
        outcome.stderr
    )
    (finished / "other.toml").write_text('experiment = "salt_and_pepper"\n')
    outcome = vertax("run", finished / "other.toml", "--resume", stopped)
    assert outcome.exit_code == 2
    assert (
        "is of the experiment 'infer_shape_factors' and not 'salt_and_pepper'. Give its own"
        in outcome.stderr
    )


@pytest.mark.thorough
def test_a_finished_run_is_not_resumed(finished):
    outcome = vertax("run", finished / "tiny.toml", "--resume", finished / "run")
    assert outcome.exit_code == 2
    assert "is finished: there is nothing to resume" in outcome.stderr


@pytest.mark.thorough
def test_resume_goes_with_no_other_folder(finished, stopped):
    for other in (["--overwrite"], ["--output", "x"]):
        outcome = vertax("run", finished / "tiny.toml", "--resume", stopped, *other)
        assert outcome.exit_code == 2
        assert "--resume goes with neither" in outcome.stderr
    outcome = vertax("run", finished / "tiny.toml", "--resume", stopped / "none")
    assert outcome.exit_code == 2
    assert "is not the folder of a run" in outcome.stderr


def test_a_broken_checkpoint_is_named(finished, stopped):
    (stopped / "unfinished").mkdir()
    (stopped / "unfinished/vertices.npz").write_bytes(b"PK")
    outcome = vertax("run", finished / "tiny.toml", "--output", stopped)
    assert outcome.exit_code == 2
    assert f"--resume {stopped} to continue it" in outcome.stderr.replace("\n", " ")
    outcome = vertax("run", finished / "tiny.toml", "--resume", stopped)
    assert outcome.exit_code == 1
    assert "vertices.npz is truncated or damaged" in outcome.stderr
    assert "Delete the file to start this fit anew" in outcome.stderr


def test_parts_are_computed_once(tmp_path):
    folder = RunFolder(tmp_path)
    for _ in range(2):
        part = folder.part("p0 3.8", lambda: {"energy": np.arange(3.0)})
        np.testing.assert_array_equal(part["energy"], [0.0, 1.0, 2.0])
        folder = RunFolder(tmp_path)
    again = folder.part("p0 3.8", lambda: pytest.fail("computed twice"))
    np.testing.assert_array_equal(again["energy"], [0.0, 1.0, 2.0])


def test_values_of_a_scan_are_told_apart_in_all_digits(tmp_path):
    values = [3.8, 3.8 + 1e-9]
    compute = lambda p0: {"p0": np.array(p0)}
    scanned = scan(RunFolder(tmp_path), "p0", values, compute, progress=False)
    np.testing.assert_array_equal(scanned["p0"], values)
