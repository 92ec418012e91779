"""Independent runs in threads: their order, their errors, and Ctrl-C."""

import contextlib
import dataclasses
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue

import vertax as vx
from vertax.runs import Fitting, RunFolder, _folder


def test_results_come_in_order(tmp_path):
    def late_first(index):
        time.sleep(0.02 * (5 - index))
        return index**2

    folder = RunFolder(tmp_path)
    assert folder.map_in_threads(late_first, 5, progress=False) == [0, 1, 4, 9, 16]
    assert folder.map_in_threads(late_first, 0, progress=False) == []


def test_no_call_begins_after_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    begun = []

    def fail_at_two(index):
        begun.append(index)
        if index == 2:
            raise ValueError("two")
        time.sleep(0.05)

    folder = RunFolder(tmp_path)
    with pytest.raises(ValueError, match="two"):
        folder.map_in_threads(fail_at_two, 50, progress=False)
    assert len(begun) < 10
    assert not folder.interrupted


def test_no_call_begins_after_an_interrupt(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    folder, begun = RunFolder(tmp_path), []

    def interrupted_at_two(index):
        begun.append(index)
        if index == 2:
            raise KeyboardInterrupt
        time.sleep(0.05)

    with pytest.raises(KeyboardInterrupt):
        folder.map_in_threads(interrupted_at_two, 50, progress=False)
    assert folder.interrupted
    assert len(begun) < 10
    with pytest.raises(KeyboardInterrupt):
        folder.map_in_threads(interrupted_at_two, 50, progress=False)
    assert len(begun) < 10


def problem(p0):
    tissue = random_tissue(6)
    energy = vx.energies.ShapeFactorEnergy(jnp.full(6, p0))
    return vx.InverseProblem(
        tissue, energy, vx.costs.VertexDistance(tissue), response=FIXED_TOPOLOGY
    )


def outcome(problem, interrupted):
    """A fit of three epochs."""
    curves = {field.name: np.ones(3) for field in dataclasses.fields(vx.History)}
    counts = {
        "converged": np.ones(3, bool),
        "num_steps": np.ones(3, int),
        "num_t1": np.zeros(3, int),
    }
    history = vx.History(**curves | counts)
    best = (jnp.array(1.0), jnp.array(0.0), np.array(0))
    result = vx.RESULTS.interrupted if interrupted else vx.RESULTS.successful
    return vx.Fit(problem.energy, problem.tissue, *best, history, result=result)


def test_a_finished_fit_keeps_the_interrupt_flag(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path)
    long, short = problem(3.6), problem(3.7)
    long_goes, short_is_done = threading.Event(), threading.Event()

    def fit(fitted, *_, **options):
        if fitted is long:
            long_goes.set()
            assert short_is_done.wait(10)
        else:
            assert long_goes.wait(10)
        return outcome(fitted, interrupted=fitted is short)

    monkeypatch.setattr(_folder, "fit", fit)
    thread = threading.Thread(target=lambda: folder.fit("a", long, None, 3))
    thread.start()
    folder.fit("b", short, None, 3)
    short_is_done.set()
    thread.join()
    assert folder.interrupted
    with pytest.raises(KeyboardInterrupt):
        folder.fit("c", short, None, 3)


@pytest.mark.thorough
def test_an_interrupt_ends_fits_in_other_threads_after_their_epoch(tmp_path):
    """Ctrl-C reaches one thread; here it comes while the second of three fits is at its third epoch."""
    problems = [problem(p0) for p0 in (3.6, 3.65, 3.7)]
    folder = RunFolder(tmp_path)
    epochs = {index: [] for index in range(3)}

    def notes(problem, record):
        index = next(k for k, p in enumerate(problems) if p is problem)
        epochs[index].append(record)
        if index > 0 and len(epochs[index]) == 3:
            folder.interrupted = True
        return {"cost": record.cost}

    # On more than one core both had begun, and the run has what there is of all three.
    with contextlib.suppress(KeyboardInterrupt):
        folder.fit_in_threads("x", problems, Fitting(epochs=20), notes=notes, progress=False)
    assert len(epochs[0]) == 20
    assert 3 <= max(len(epochs[k]) for k in (1, 2)) <= 4
    # What was done is kept.
    assert {part.stem for part in (tmp_path / "unfinished").iterdir()} >= {"x_0"}


@pytest.mark.thorough
def test_concurrent_fits_equal_sequential_fits(tmp_path):
    problems = [problem(3.6), problem(3.7)]
    notes = lambda problem, record: {"twice": 2 * record.cost}
    fitting = Fitting(epochs=4)
    batch = RunFolder(tmp_path).fit_in_threads("x", problems, fitting, notes=notes, progress=False)
    assert batch.history.cost.shape == (4, 2)
    np.testing.assert_array_equal(batch.notes["twice"], 2 * batch.history.cost)
    for k, one in enumerate(problems):
        alone = vx.fit(one, fitting.build(), 4, progress=False)
        np.testing.assert_array_equal(alone.history.cost, batch.history.cost[:, k])
        assert alone.best_epoch == batch.best_epoch[k]
