"""The loop over the frames of a simulation, on a random walk of one number."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from vertax._base.checkpoints import CheckpointFile
from vertax._base.frame_loop import AbstractSimulation, check_points, simulate
from vertax._base.results import RESULTS, AbstractOutcome, result_of


class State(eqx.Module):
    position: Float[Array, ""]
    label: str  # no array: it stays with the state
    result: RESULTS


class Walked(AbstractOutcome):
    times: Float[Array, " times"]
    positions: Float[Array, " times"]
    result: RESULTS


class Walk(AbstractSimulation):
    name: ClassVar[str] = "walk"
    points: ClassVar[str] = "times"

    drift: Float[Array, ""]
    limit: Float[Array, ""]

    def keys(self, start, n):
        return jax.random.split(start[1], n)

    def begin(self, start, points):
        start, _ = start
        return State(start, "walker", result_of(jnp.array(0))), {"positions": start}

    def advance(self, state, interval, key):
        step = jax.random.normal(key, (), interval.dtype)
        position = state.position + self.drift * (interval[1] - interval[0]) + step
        far = jnp.abs(position) > self.limit
        result = RESULTS.where(far, RESULTS.no_progress, RESULTS.successful)
        return State(position, state.label, result), {"positions": position}

    def outcome(self, points, end, frames):
        assert end.label == "walker"
        return Walked(times=points, result=end.result, **frames)

    def counts(self, state):
        return {"far": jnp.abs(state.position)}


def walk(n=6, *, drift=0.5, limit=100.0, times=None, seed=0, **settings):
    times = jnp.linspace(0.0, 1.0, 11)[:n] if times is None else jnp.asarray(times)
    simulation = Walk(jnp.asarray(drift), jnp.asarray(limit))
    return simulate(simulation, (jnp.asarray(1.0), jax.random.key(seed)), times, **settings)


def test_frames_one_by_one_are_those_of_one_function(tmp_path):
    at_once = walk()
    assert at_once.converged
    assert at_once.positions[0] == 1.0
    np.testing.assert_array_equal(walk(progress=True).positions, at_once.positions)
    np.testing.assert_array_equal(walk(checkpoint=tmp_path / "w.npz").times, at_once.times)


def test_an_interrupted_run_continues(tmp_path, monkeypatch):
    write = CheckpointFile.save_if_due

    def interrupt(file, progress):
        write(file, progress)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointFile, "save_if_due", interrupt)
        with pytest.raises(KeyboardInterrupt):
            walk(checkpoint=tmp_path / "w.npz")
    walked = walk(checkpoint=tmp_path / "w.npz")
    np.testing.assert_array_equal(walked.positions, walk().positions)
    # A longer run has the same keys at its beginning.
    longer = walk(9, checkpoint=tmp_path / "w.npz")
    np.testing.assert_array_equal(longer.positions, walk(9).positions)
    np.testing.assert_array_equal(longer.positions[:6], walked.positions)


@pytest.mark.parametrize("changed", [{"drift": 0.4}, {"seed": 1}, {"limit": 90.0}])
def test_the_checkpoint_of_another_run_is_rejected(changed, tmp_path):
    walk(checkpoint=tmp_path / "w.npz")
    with pytest.raises(ValueError, match="checkpoint of a walk with another tissue, energy or"):
        walk(checkpoint=tmp_path / "w.npz", **changed)


def test_the_checkpoint_of_other_points_is_rejected(tmp_path):
    walk(checkpoint=tmp_path / "w.npz")
    with pytest.raises(ValueError, match=r"other times \(6, from 0 to 0.5\) than this walk begins"):
        walk(4, checkpoint=tmp_path / "w.npz")
    with pytest.raises(ValueError, match="frame 1 differs first"):
        walk(times=np.linspace(0, 2, 7), checkpoint=tmp_path / "w.npz")


def test_points_are_equal_up_to_rounding():
    computed, written = np.arange(4) * 0.1, np.asarray([0, 0.1, 0.2, 0.3, 0.4])
    assert computed[3] != written[3]
    check_points(Walk, computed, written)
    check_points(Walk, np.asarray(computed, np.float32), np.asarray(written, np.float32))
    with pytest.raises(ValueError, match="frame 1 differs first"):
        check_points(Walk, np.asarray([0, 1e-3, 2e-3]), np.asarray([0, 1e-3 + 1e-11, 2e-3]))


def test_a_frame_that_fails_raises_and_leaves_the_frames_before_it(tmp_path):
    file = tmp_path / "w.npz"
    assert int(np.argmax(np.abs(walk(11, drift=40.0).positions) > 10)) > 0  # the first is valid
    with pytest.raises(RuntimeError, match="made no progress"):
        walk(11, drift=40.0, limit=10.0)
    with pytest.raises(RuntimeError, match="made no progress"):
        walk(11, drift=40.0, limit=10.0, checkpoint=file)
    walked = walk(11, drift=40.0, limit=10.0, checkpoint=file, throw=False)
    assert not walked.converged
    assert walked.positions.shape == (11,)
