"""Sweeps and masks on a Dask cluster of two processes."""

import os
import signal

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import vertax as vx
from vertax.runs._sweep import sweep, sweep_runs
from vertax.runs.command_line import app

distributed = pytest.importorskip("distributed", reason="needs the extra [cluster]")
pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings("ignore")]

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 2
relaxation = { contacts = false, transitions = false }
"""


@pytest.fixture(scope="module")
def client():
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def free_tissue(seed):
    return vx.initialise.free_voronoi(9, key=jax.random.key(seed))


def die_once(task):
    """Kill the worker of task 3 once."""
    number, file = task
    if number == 3 and not os.path.exists(file):
        open(file, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_task_of_a_killed_worker_runs_again(client, tmp_path):
    tasks = [(number, str(tmp_path / "killed")) for number in range(20)]
    outcomes = list(vx.map_tasks(die_once, tasks, executor=client.get_executor()))
    assert sorted(o.value for o in outcomes) == list(range(20))
    client.wait_for_workers(2, timeout=60)  # for the next test


def test_a_sweep_on_a_cluster(client, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    address = client.scheduler.address
    arguments = ["sweep", "tiny.toml", "--grid", "seed=0:3", "--output", "out"]
    outcome = CliRunner().invoke(app, [*arguments, "--scheduler", address])
    assert outcome.exit_code == 0, outcome.output
    assert "3 of 3 runs are finished" in outcome.output
    runs = sweep_runs(["tiny.toml"], {"seed": ["0", "1", "2"]}, "out")
    assert all(run.is_finished for run in runs)
    # The files are those of a local run.
    local = sweep_runs(["tiny.toml"], {"seed": ["0"]}, "local")
    assert sweep(local, tmp_path / "local", workers=1, progress=False) == {}
    names = lambda run: sorted(p.relative_to(run.folder) for p in run.folder.rglob("*"))
    assert names(local[0]) == names(runs[0])


def test_masks_on_a_cluster(client):
    masks = [vx.inference.label_image(free_tissue(seed), 200) for seed in range(4)]
    masks.append(np.zeros((20, 20), int))
    elsewhere = vx.tensions.infer_tensions_of_masks(masks, executor=client.get_executor())
    local = vx.tensions.infer_tensions_of_masks(masks)
    assert list(elsewhere.results) == list(local.results) == [0, 1, 2, 3]
    assert elsewhere.failures == local.failures
    for number, result in local.results.items():
        np.testing.assert_allclose(elsewhere.results[number].tensions, result.tensions, rtol=1e-8)


def test_the_job_of_masks_on_a_cluster(client, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "masks").mkdir()
    for seed in range(2):
        np.save(tmp_path / f"masks/{seed}.npy", vx.inference.label_image(free_tissue(seed), 200))
    arguments = ["run", "infer_tensions", "--set", f"image.path={tmp_path / 'masks'}"]
    address = client.scheduler.address
    outcome = CliRunner().invoke(app, [*arguments, "--output", "out", "--scheduler", address])
    assert outcome.exit_code == 0, outcome.output
    assert (tmp_path / "out" / "frames.csv").read_text().count("\n") == 3


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    outcome = CliRunner().invoke(app, ["sweep", "tiny.toml", "--scheduler", "tcp://127.0.0.1:9"])
    assert outcome.exit_code == 2
    assert "No Dask scheduler answers at tcp://127.0.0.1:9 within 10 seconds" in outcome.output
    (tmp_path / "out").mkdir()  # of an earlier run, which is not removed
    (tmp_path / "out" / "notes.txt").write_text("mine")
    options = ["--output", "out", "--overwrite", "--scheduler", "tcp://127.0.0.1:9"]
    outcome = CliRunner().invoke(app, ["run", "tiny.toml", *options])
    assert outcome.exit_code == 2
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
