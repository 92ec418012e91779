"""Many tasks on executors: order, failures, bounded memory, dead processes, cancellation."""

import contextlib
import os
import threading
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial

import pytest

import vertax as vx
from vertax._base.processes import LocalProcesses, ProcessDied


def square_except_three(number):
    if number == 3:
        raise ValueError("three")
    return number**2


def die_at(path, number):
    """Kill the process of task 1, each time or, with a path, the first time only."""
    if number == 1 and not (path and os.path.exists(path)):
        if path:
            open(path, "w").close()
        os._exit(1)
    return number


def test_a_failure_is_an_outcome():
    with ThreadPoolExecutor(2) as pool:
        outcomes = sorted(vx.map_tasks(square_except_three, range(5), executor=pool))
    assert [o.value for o in outcomes] == [0, 1, 4, None, 16]
    assert [str(o.error) for o in outcomes if o.error] == ["three"]


def test_few_tasks_are_drawn_ahead():
    drawn = []
    tasks = (drawn.append(i) or i for i in range(100))
    with ThreadPoolExecutor(1) as pool:
        outcomes = vx.map_tasks(int, tasks, executor=pool, at_once=4)
        for done, _ in enumerate(outcomes, start=1):
            assert len(drawn) <= done + 4
    assert len(drawn) == 100


def test_waiting_tasks_are_cancelled_when_the_caller_stops():
    begun, go = [], threading.Event()

    def work(number):
        begun.append(number)
        go.wait(5)

    with ThreadPoolExecutor(1) as pool:
        with contextlib.closing(vx.map_tasks(work, range(50), executor=pool)) as outcomes:
            go.set()
            next(outcomes)
            go.clear()
        go.set()
    assert len(begun) <= 3


class Dead(Executor):
    """An executor with a scheduler that died: its futures are cancelled."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.cancel()
        future.set_running_or_notify_cancel()
        return future


def test_a_dead_scheduler_is_named():
    with pytest.raises(
        RuntimeError, match=r"runs no more tasks .CancelledError.*make a new executor"
    ):
        list(vx.map_tasks(int, range(3), executor=Dead()))


@pytest.mark.parametrize("recovers", [pytest.param(True, marks=pytest.mark.thorough), False])
def test_a_task_with_a_dead_process_is_repeated_once(tmp_path, recovers):
    path = str(tmp_path / "died") if recovers else ""
    with LocalProcesses(2) as pool:
        outcomes = sorted(vx.map_tasks(partial(die_at, path), range(4), executor=pool))
    assert [o.value for o in outcomes] == [0, 1 if recovers else None, 2, 3]
    assert [type(o.error) for o in outcomes if o.error] == ([] if recovers else [ProcessDied])


def test_a_process_works_in_the_folder_of_its_caller(tmp_path, monkeypatch):
    with LocalProcesses(1) as pool:
        pool.submit(int).result()  # the process begins in another folder
        monkeypatch.chdir(tmp_path)
        assert pool.submit(os.getcwd).result() == str(tmp_path)


def test_what_cannot_be_pickled_is_named():
    with LocalProcesses(1) as pool:
        ((_, _, error),) = vx.map_tasks(int, [lambda: 0], executor=pool)
    assert "pickle" in str(error)
