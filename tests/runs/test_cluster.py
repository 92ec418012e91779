"""Sweeps, masks, posteriors and fits on Dask clusters of two processes, and their failures."""

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import jax
import numpy as np
import pytest
from bayes_helpers import PRIOR, noisy_problem
from typer.testing import CliRunner

import vertax as vx
from vertax._base.processes import LocalProcesses, ProcessDied
from vertax.runs import Fitting, RunFolder
from vertax.runs._cluster import chosen_executor
from vertax.runs._sweep import sweep, sweep_runs
from vertax.runs.command_line import app

dask = pytest.importorskip("dask", reason="needs the extra [cluster]")
distributed = pytest.importorskip("distributed", reason="needs the extra [cluster]")
NAME = "target_shape_factor"
pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings("ignore")]

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 2
relaxation = { contacts = false, transitions = false }
"""
CLUSTER = """
class = "distributed.LocalCluster"
workers = 2
arguments = { n_workers = 0, threads_per_worker = 1, dashboard_address = ":0" }
"""


@pytest.fixture(scope="module")
def client():
    options = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": "1.5GB"}
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),  # ends sooner
        distributed.LocalCluster(**options, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    (tmp_path / "cluster.toml").write_text(CLUSTER)
    return tmp_path


def vertax(*arguments):
    outcome = CliRunner().invoke(app, list(map(str, arguments)))
    return outcome.exit_code, " ".join(outcome.output.split())


def free_tissue(seed):
    return vx.initialise.free_voronoi(9, key=jax.random.key(seed))


def misbehave(task):
    """Kill the worker once, fill its memory, return too much, or fail with an error without a pickle."""
    kind, file = task
    if kind == "killed" and not os.path.exists(file):
        open(file, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "memory":
        filled = []
        while True:
            filled.append(np.ones(2**22))
    if kind == "large":
        return np.ones(2**20)
    if kind == "fails":
        raise type("Odd", (ValueError,), {"__reduce__": lambda self: (int, ("x",))})("odd")
    return kind


def test_tasks_that_misbehave_are_outcomes_and_end_no_other(client, tmp_path):
    kinds = ["killed", "memory", "large", "fails", *(f"good {k}" for k in range(16))]
    tasks = [(kind, str(tmp_path / "killed")) for kind in kinds]
    options = {"executor": client.get_executor(), "result_limit": 2**20}
    outcomes = dict(zip(kinds, sorted(vx.map_tasks(misbehave, tasks, **options)), strict=True))
    for kind in ("killed", *kinds[4:]):
        assert outcomes[kind].value == kind
    assert isinstance(outcomes["memory"].error, ProcessDied)
    assert "The result has 8 MiB, more than 1 MiB." in str(outcomes["large"].error)
    assert str(outcomes["fails"].error) == "Odd: odd"
    client.wait_for_workers(2, timeout=60)  # for the next test


def test_equal_tasks_run_separately(client):
    outcomes = list(vx.map_tasks(os.urandom, [8, 8, 8], executor=client.get_executor()))
    assert len({o.value for o in outcomes}) == 3


def test_a_sweep_on_a_cluster(client, tiny):
    arguments = ["sweep", "tiny.toml", "--grid", "seed=0:12", "--output", "out"]
    code, output = vertax(*arguments, "--scheduler", client.scheduler.address)
    assert (code, "12 of 12 runs are finished" in output) == (0, True), output
    runs = sweep_runs(["tiny.toml"], {"seed": [str(k) for k in range(12)]}, "out")
    assert all(run.is_finished for run in runs)
    # The files are those of a local run.
    local = sweep_runs(["tiny.toml"], {"seed": ["0"]}, "local")
    assert sweep(local, tiny / "local", executor=LocalProcesses(1), progress=False) == {}
    names = lambda run: sorted(p.relative_to(run.folder) for p in run.folder.rglob("*"))
    assert names(local[0]) == names(runs[0])


def test_masks_on_a_cluster(client, tmp_path):
    masks = [vx.inference.label_image(free_tissue(seed), 200) for seed in range(20)]
    masks.append(np.zeros((20, 20), int))
    options = {"executor": client.get_executor(), "cache": tmp_path}
    elsewhere = vx.tensions.infer_tensions_of_masks(masks, **options)
    assert list(elsewhere.results) == list(range(20))
    assert list(elsewhere.failures) == [20]
    for number in (0, 7):
        local = vx.tensions.infer_tensions(masks[number])
        np.testing.assert_allclose(elsewhere.results[number].tensions, local.tensions, rtol=1e-8)


@pytest.mark.parametrize("option", [["--workers", 2], ["--cluster", "cluster.toml"]])
def test_the_job_of_masks_starts_its_workers(tiny, option):
    (tiny / "masks").mkdir()
    for seed in range(2):
        np.save(tiny / f"masks/{seed}.npy", vx.inference.label_image(free_tissue(seed), 200))
    options = ["--set", f"image.path={tiny / 'masks'}", "--output", "out"]
    code, output = vertax("run", "infer_tensions", *options, *option)
    assert code == 0, output
    assert (tiny / "out" / "frames.csv").read_text().count("\n") == 3


def test_a_scheduler_that_does_not_answer_is_named(tiny):
    (tiny / "out").mkdir()  # of an earlier run, which is not removed
    (tiny / "out" / "notes.txt").write_text("mine")
    options = ["--output", "out", "--overwrite", "--scheduler", "tcp://127.0.0.1:9"]
    for command in (["sweep", "tiny.toml", *options[3:]], ["run", "tiny.toml", *options]):
        code, output = vertax(*command)
        assert code == 2
        assert "No Dask scheduler answers at tcp://127.0.0.1:9 within 10 seconds" in output
    assert (tiny / "out" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("workers", "jobs", "has no key `jobs`; its keys are class, workers, arguments"),
        ("LocalCluster", "Nothing", "`distributed.Nothing` of cluster.toml does not start"),
        ("distributed", "nowhere", "No module named 'nowhere'"),
    ],
)
def test_a_file_that_describes_no_cluster_is_named(tiny, old, new, message):
    (tiny / "cluster.toml").write_text(CLUSTER.replace(old, new))
    code, output = vertax("sweep", "tiny.toml", "--cluster", "cluster.toml")
    assert (code, message in output) == (2, True), output
    code, output = vertax("run", "tiny.toml", "--cluster", "x", "--workers", 2)
    assert (code, "--workers and --cluster exclude each other" in output) == (2, True)


def slow(number):
    time.sleep(0.2)
    return {"number": np.full(5, number)}


def test_what_arrived_before_the_death_of_a_scheduler_is_kept(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    start = lambda *words: subprocess.Popen(
        [sys.executable, "-m", *words, "--no-dashboard"], stderr=subprocess.DEVNULL, env=environment
    )
    file, folder = str(tmp_path / "scheduler.json"), RunFolder(tmp_path)
    scheduler = start("distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", file)
    words = ("--scheduler-file", file, "--nworkers", "2", "--nthreads", "1")
    worker = start("distributed.cli.dask_worker", *words)
    tasks = {f"task {k}": k for k in range(40)}
    parts = lambda: {part: part.stat().st_mtime_ns for part in folder.parts.glob("*.npz")}

    def kill():
        while len(parts()) < 10:
            time.sleep(0.05)
        scheduler.kill()

    try:
        while not os.path.exists(file):
            time.sleep(0.1)
        distributed.Client(scheduler_file=file, timeout=60).wait_for_workers(2, timeout=60)
        with chosen_executor(None, file, None) as folder.executor:
            threading.Thread(target=kill, daemon=True).start()
            with pytest.raises(RuntimeError, match=r"'tcp://.*runs no more tasks .CancelledError"):
                folder.map_parts(slow, tasks, progress=False)
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    kept = parts()
    assert 10 <= len(kept) < 40
    folder.executor = LocalProcesses(2)
    results = folder.map_parts(slow, tasks, progress=False)
    assert [result["number"][0] for result in results.values()] == list(range(40))
    assert kept.items() <= parts().items()


def test_posteriors_on_a_cluster(client):
    densities = [
        vx.bayes.LogPosterior(noisy_problem(1e-3, seed)[0], {NAME: PRIOR[NAME].expand([6])}, 1e-3)
        for seed in range(4)
    ]
    options = {"draws": 20, "warmup": 20, "chains": 1, "progress": False}
    sample = partial(vx.bayes.sample, key=0, **options)
    outcomes = sorted(vx.map_tasks(sample, densities, executor=client.get_executor()))
    assert [outcome.error for outcome in outcomes] == [None] * 4
    means = [outcome.value.draws(NAME).mean(axis=(0, 1)) for outcome in outcomes]
    for density, mean in zip(densities, means, strict=True):
        mode = density.parameters_at(vx.bayes.Laplace(density).mode)[NAME]
        np.testing.assert_allclose(mean, mode, atol=0.1)


def test_fits_on_a_cluster_are_those_of_threads(client, tmp_path):
    problems, fitting = [noisy_problem(1e-3, seed)[0] for seed in range(3)], Fitting(epochs=3)
    folders = [RunFolder(tmp_path / name) for name in ("threads", "cluster")]
    folders[1].executor = client.get_executor()
    for folder in folders:
        folder.path.mkdir()
    local, elsewhere = (f.fit_in_threads("x", problems, fitting, progress=False) for f in folders)
    np.testing.assert_allclose(elsewhere.history.cost, local.history.cost, rtol=1e-9)
    # Fits of different sizes are tasks.
    problems = [noisy_problem(1e-3, 0, n)[0] for n in (6, 8)]
    fit = partial(vx.fit, optimiser=fitting.build(), epochs=3, progress=False)
    outcomes = sorted(vx.map_tasks(fit, problems, executor=client.get_executor()))
    assert [outcome.value.tissue.n_cells for outcome in outcomes] == [6, 8]
