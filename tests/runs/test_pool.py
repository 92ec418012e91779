"""Independent runs in threads: their order, their errors, and Ctrl-C."""

import contextlib
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.runs import Fitting, RunFolder, _folder, fit_side_by_side, side_by_side


def test_results_come_in_order(tmp_path):
    def late_first(index):
        time.sleep(0.02 * (5 - index))
        return index**2

    folder = RunFolder(tmp_path)
    assert side_by_side(late_first, 5, folder, progress=False) == [0, 1, 4, 9, 16]
    assert side_by_side(late_first, 0, folder, progress=False) == []


def test_after_an_error_nothing_else_begins(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    begun = []

    def fail_at_two(index):
        begun.append(index)
        if index == 2:
            raise ValueError("two")
        time.sleep(0.05)

    folder = RunFolder(tmp_path)
    with pytest.raises(ValueError, match="two"):
        side_by_side(fail_at_two, 50, folder, progress=False)
    assert len(begun) < 10
    assert not folder.interrupted


def test_after_an_interrupt_nothing_else_begins(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    folder, begun = RunFolder(tmp_path), []

    def interrupted_at_two(index):
        begun.append(index)
        if index == 2:
            raise KeyboardInterrupt
        time.sleep(0.05)

    with pytest.raises(KeyboardInterrupt):
        side_by_side(interrupted_at_two, 50, folder, progress=False)
    assert folder.interrupted
    assert len(begun) < 10
    with pytest.raises(KeyboardInterrupt):
        side_by_side(interrupted_at_two, 50, folder, progress=False)
    assert len(begun) < 10


class Outcome:
    """What a folder reads of a fit."""

    best_epoch = np.array(0)
    tissue = energy = None

    def __init__(self, interrupted):
        self.interrupted = interrupted
        falling = np.ones(3)
        self.history = vx.History(
            **dict.fromkeys(
                ("cost", "max_force", "gradient_norm", "gradient_residual", "gradient_steps"),
                falling,
            ),
            **dict.fromkeys(("relative_error", "seconds", "guidance"), falling),
            converged=np.ones(3, bool),
            num_steps=np.ones(3, int),
            num_t1=np.zeros(3, int),
        )


def test_a_fit_that_ends_does_not_take_back_an_interrupt(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path)
    first_runs, second_is_done = threading.Event(), threading.Event()

    def fit(problem, *_, **options):
        if problem == "long":
            first_runs.set()
            assert second_is_done.wait(10)
            return Outcome(interrupted=False)
        assert first_runs.wait(10)
        return Outcome(interrupted=True)

    monkeypatch.setattr(_folder, "fit", fit)
    long = threading.Thread(target=lambda: folder.fit("a", "long", None, 3))
    long.start()
    folder.fit("b", "interrupted", None, 3)
    second_is_done.set()
    long.join()
    assert folder.interrupted
    with pytest.raises(KeyboardInterrupt):
        folder.fit("c", "another", None, 3)


def test_an_interrupt_ends_fits_in_other_threads_after_their_epoch(tmp_path):
    """Ctrl-C reaches one thread; here it comes while the second of three fits is at its third epoch."""
    tissue = random_tissue(6)
    cost = vx.costs.VertexDistance(tissue)
    problems = [
        vx.InverseProblem(tissue, vx.energies.ShapeFactorEnergy(jnp.full(6, p)), cost)
        for p in (3.6, 3.65, 3.7)
    ]
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
        fit_side_by_side(folder, "x", problems, Fitting(epochs=20), notes=notes, progress=False)
    assert len(epochs[0]) == 20
    assert 3 <= max(len(epochs[k]) for k in (1, 2)) <= 4
    # What was done is kept.
    assert {part.stem for part in folder.parts()} >= {"x_0"}


def test_fits_side_by_side_are_those_of_one_after_the_other(tmp_path):
    target = random_tissue(6, 1)
    cost = vx.costs.VertexDistance(target)
    problems = [
        vx.InverseProblem(target, vx.energies.ShapeFactorEnergy(jnp.full(6, p)), cost)
        for p in (3.6, 3.7)
    ]
    notes = lambda problem, record: {"twice": 2 * record.cost}
    fitting = Fitting(epochs=4)
    batch = fit_side_by_side(
        RunFolder(tmp_path), "x", problems, fitting, notes=notes, progress=False
    )
    assert batch.history.cost.shape == (4, 2)
    np.testing.assert_array_equal(batch.notes["twice"], 2 * batch.history.cost)
    for k, problem in enumerate(problems):
        alone = vx.fit(problem, fitting.build(), 4, progress=False)
        np.testing.assert_array_equal(alone.history.cost, batch.history.cost[:, k])
        assert alone.best_epoch == batch.best_epoch[k]
