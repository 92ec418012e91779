"""Interrupted fits that are resumed from checkpoints."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import ADAM, FIXED_TOPOLOGY, LEAST_SQUARES, random_like, relaxed, rewritten

import vertax as vx
from vertax._base.fingerprint import fingerprint
from vertax.costs import VertexDistance
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import stack

EPOCHS = 6


def problem_of(seed=0, response=FIXED_TOPOLOGY):
    target, truth = relaxed(10, 1)
    guess = ShapeFactorEnergy(jnp.full(10, 3.7) + 0.05 * random_like(jnp.zeros(10), seed))
    cost = VertexDistance(target)
    return vx.InverseProblem(target, guess, cost, response=response), truth


PROBLEM, TRUTH = problem_of()
BATCH = stack([PROBLEM, problem_of(1)[0]])
TRUTHS = stack([TRUTH, TRUTH])


def kappa(epoch):
    return 10.0 * 0.5**epoch


CASES = {
    "adam": (PROBLEM, TRUTH, ADAM, {}),
    "guided": (PROBLEM, TRUTH, ADAM, {"guidance": kappa}),
    "position": (dataclasses.replace(PROBLEM, fit_position=True), TRUTH, ADAM, {}),
    "noisy": (PROBLEM, TRUTH, optax.chain(optax.add_noise(1e-3, 0.5, 3), ADAM), {}),
    "batch": (BATCH, TRUTHS, ADAM, {"batched": True}),
    "least squares": (PROBLEM, TRUTH, LEAST_SQUARES, {}),
    "least squares, batch": (BATCH, TRUTHS, LEAST_SQUARES, {"batched": True}),
}


def run(case, epochs=EPOCHS, **changes):
    problem, truth, optimiser, options = CASES[case]
    return vx.fit(
        problem, optimiser, epochs, truth=truth, progress=False, **(dict(options) | changes)
    )


def bits(outcome):
    """The bytes of all numbers of a fit, except the seconds."""
    timeless = dataclasses.replace(outcome.history, seconds=np.zeros_like(outcome.history.seconds))
    leaves = jax.tree.leaves(dataclasses.replace(outcome, history=timeless))
    return [(np.shape(x), np.asarray(x).tobytes()) for x in leaves]


def interrupt_at(epoch):
    def callback(number, record):
        if number == epoch:
            raise KeyboardInterrupt
        return {"cost": record.cost}

    return callback


@pytest.fixture
def path(tmp_path):
    return tmp_path / "fit.npz"


MARKS: dict[str, Any] = dict.fromkeys(
    ("least squares, batch", "batch", "guided", "noisy"), pytest.mark.slow
)
MARKS |= dict.fromkeys(("least squares", "position"), pytest.mark.thorough)


@pytest.mark.thorough
@pytest.mark.parametrize("case", [pytest.param(c, marks=MARKS.get(c, ())) for c in CASES])
def test_resumed_fit_matches_uninterrupted_fit(case, path):
    uninterrupted = run(case, callback=interrupt_at(None))
    stopped = run(case, callback=interrupt_at(3), checkpoint=path)
    assert np.all(stopped.result == vx.RESULTS.interrupted)
    assert len(stopped.history.cost) == 3
    epochs_run = []
    callback = lambda epoch, record: epochs_run.append(epoch) or {"cost": record.cost}
    resumed = run(case, callback=callback, checkpoint=path)
    assert np.all(resumed.result == vx.RESULTS.successful)
    assert epochs_run == list(range(3, len(uninterrupted.history.cost)))
    assert bits(resumed) == bits(uninterrupted)
    np.testing.assert_array_equal(resumed.notes["cost"], uninterrupted.history.cost)


@pytest.mark.thorough
def test_finished_fit_is_not_repeated_and_can_be_extended(path):
    finished = run("adam", checkpoint=path)
    fail = lambda *_: pytest.fail("an epoch was repeated")
    resumed = run("adam", checkpoint=path, callback=fail)
    assert bits(resumed) == bits(finished)
    np.testing.assert_array_equal(resumed.history.seconds, finished.history.seconds)
    longer = run("adam", EPOCHS + 3, checkpoint=path)
    assert bits(longer) == bits(run("adam", EPOCHS + 3))
    with pytest.raises(ValueError, match=f"holds {EPOCHS + 3} epochs, but argument `epochs` is 2"):
        run("adam", 2, checkpoint=path)


def test_killed_fit_resumes_from_its_last_checkpoint(path):
    def kill(epoch, record):
        if epoch == 4:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run("adam", callback=kill, checkpoint=vx.Checkpoint(path, every=0.0))
    with np.load(path) as archive:
        assert 1 <= archive["epochs"] <= 4
    assert bits(run("adam", checkpoint=path)) == bits(run("adam"))
    assert [file.name for file in path.parent.iterdir()] == ["fit.npz"]


def test_short_fit_is_saved_once(path, monkeypatch):
    written = []
    monkeypatch.setattr("vertax._base.checkpoints._save", lambda *_: written.append(1))
    run("adam", checkpoint=path)
    assert len(written) == 1


OTHERS = {
    "with another optimiser": {"optimiser": optax.adam(2e-2)},
    "sizes.*: max_steps=2000 and not max_steps=300": {
        "problem": problem_of(response=dataclasses.replace(FIXED_TOPOLOGY, max_steps=300))[0]
    },
    "numbers in its arrays": {"problem": problem_of(2)[0]},
    "another `guidance`: nan and not 10.0 in epoch 0": {"guidance": kappa},
    "sizes, classes or settings": {"truth": None},
}


@pytest.mark.thorough
@pytest.mark.parametrize("message", OTHERS)
def test_checkpoint_of_another_fit_is_rejected(message, path):
    run("adam", 2, checkpoint=path)
    before = path.read_bytes()
    arguments = {"problem": PROBLEM, "optimiser": ADAM, "truth": TRUTH} | OTHERS[message]
    with pytest.raises(ValueError, match=f"{message}.*elete the file to start"):
        vx.fit(epochs=3, progress=False, checkpoint=path, **arguments)
    assert path.read_bytes() == before


class Scaled(vx.AbstractEnergy):
    """An energy with a function of the user."""

    energy: ShapeFactorEnergy
    scale: Callable = eqx.field(static=True)

    def __call__(self, tissue):
        return self.scale(self.energy(tissue))


def scaled_by(factor):
    return lambda energy: factor * energy


@pytest.mark.thorough
def test_checkpoint_of_an_energy_with_another_function_is_rejected(path):
    fit = lambda factor: vx.fit(
        dataclasses.replace(PROBLEM, energy=Scaled(PROBLEM.energy, scaled_by(factor))),
        ADAM,
        2,
        progress=False,
        checkpoint=path,
    )
    first = fit(2.0)
    assert bits(fit(2.0)) == bits(first)
    with pytest.raises(ValueError, match=r"another problem \(what its functions compute"):
        fit(3.0)


def edited(factor):
    """A class of the same name with another constant."""

    class Edited(vx.AbstractEnergy):
        p0: jax.Array

        def __call__(self, tissue):
            return factor * ShapeFactorEnergy(self.p0)(tissue)

    return Edited(jnp.full(10, 3.7))


@pytest.mark.thorough
def test_checkpoint_of_an_edited_class_is_rejected(path):
    fit = lambda factor: vx.fit(
        dataclasses.replace(PROBLEM, energy=edited(factor)),
        ADAM,
        2,
        progress=False,
        checkpoint=path,
    )
    fit(1.0)
    with pytest.raises(ValueError, match=r"another problem \(what its functions compute"):
        fit(1.5)


@pytest.mark.thorough
def test_checkpoint_of_an_optimiser_with_another_schedule_is_rejected(path):
    def fit(rates):
        schedule = lambda step: jnp.asarray(rates)[step]
        vx.fit(PROBLEM, optax.sgd(schedule), 2, progress=False, checkpoint=path)

    fit([1e-2, 1e-2, 1e-2])
    with pytest.raises(ValueError, match="another optimiser"):
        fit([1e-2, 2e-2, 1e-2])


_FINGERPRINT = """
import jax, jax.numpy as jnp, optax
import vertax as vx
from vertax._base.fingerprint import fingerprint
tissue = vx.initialise.periodic_voronoi(6, key=jax.random.key(0))
relax = vx.Relaxation(transitions=None, contact_range=None)
weights = jnp.arange(6.0)
energy = lambda p: vx.energies.ShapeFactorEnergy(p + weights)
loss = lambda p: relax(tissue, energy(p)).tissue.vertices.sum()
print(fingerprint(jax.grad(loss), jnp.full(6, 3.6)))
"""


@pytest.mark.thorough
def test_fingerprint_is_equal_in_all_processes():
    hashes = set()
    for seed in ("1", "2"):
        result = subprocess.run(
            [sys.executable, "-c", _FINGERPRINT],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        hashes.add(result.stdout)
    assert len(hashes) == 1


def test_fingerprint_depends_on_constants_and_not_on_names():
    def times(x):
        return 2 * x

    table = lambda values: fingerprint(lambda x: jnp.asarray(values) * x, 1.0 * jnp.ones(2))
    assert fingerprint(times, jnp.ones(2)) == fingerprint(lambda y: 2 * y, jnp.zeros(2))
    assert fingerprint(times, jnp.ones(2)) != fingerprint(lambda y: 3 * y, jnp.ones(2))
    assert table([1.0, 2.0]) == table([1.0, 2.0]) != table([1.0, 3.0])
    inner = lambda values: fingerprint(jax.jit(lambda x: np.asarray(values) * x), jnp.ones(2))
    assert inner([1.0, 2.0]) == inner([1.0, 2.0]) != inner([1.0, 3.0])


@pytest.mark.thorough
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truncated_checkpoint_is_rejected(kept, path):
    run("adam", 2, checkpoint=path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ValueError, match=r"fit\.npz is truncated or damaged.*Delete the file"):
        run("adam", 3, checkpoint=path)


def test_checkpoint_in_a_missing_folder_is_rejected(path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*none\. Make it first"):
        run("adam", 3, checkpoint=path.parent / "none" / "fit.npz", callback=pytest.fail)


def test_files_of_another_format_are_rejected(path):
    vx.save(path, PROBLEM.tissue)
    with pytest.raises(ValueError, match=r"is not a vertax checkpoint file.*Delete the file"):
        run("adam", 3, checkpoint=path)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version 2 of the checkpoint format.*Update vertax"),
        ({"state_0": None}, "is broken: its state does not match the fit"),
        ({"state_0": np.zeros(3)}, "is broken: its state does not match the fit"),
        ({"epochs": 3}, "is broken: its state does not match the fit"),
        ({"identity": "{"}, "is the checkpoint of a fit with another problem"),
    ],
)
def test_inconsistent_checkpoints_are_rejected(changes, message, path):
    run("adam", 2, checkpoint=path)
    rewritten(path, **changes)
    with pytest.raises(ValueError, match=rf"fit\.npz.*{message}"):
        run("adam", 3, checkpoint=path)


def test_notes_with_changing_names_are_rejected():
    with pytest.raises(
        ValueError, match=r"same names in each epoch \(a\), but returned b in epoch 1"
    ):
        run("adam", 3, callback=lambda epoch, _: {"ab"[epoch]: 1.0})
    with pytest.raises(ValueError, match=r"\(nothing\), but returned a in epoch 1"):
        run("adam", 3, callback=lambda epoch, _: {"a": 1.0} if epoch else None)


def test_negative_checkpoint_interval_is_rejected(path):
    with pytest.raises(ValueError, match="`every` must be at least 0"):
        vx.Checkpoint(path, every=-1)
