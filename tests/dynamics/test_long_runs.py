"""Movements that are interrupted, and go on."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, NO_CONTACT, counted_compilations, random_tissue

import vertax as vx
from vertax.activities import SelfPropulsion, ThermalNoise
from vertax.dissipations import SubstrateFriction
from vertax.dynamics._long_run import _check_times
from vertax.energies import ShapeFactorEnergy

FRICTION = SubstrateFriction(1.0)
ENERGY = ShapeFactorEnergy(jnp.linspace(3.2, 3.6, 9))
TIMES = 0.02 * np.arange(7)


def driven(times=TIMES, key=3, **settings):
    """A quench through transitions, with noise and cells that propel themselves."""
    activity = ThermalNoise(1e-4) + SelfPropulsion(0.05)
    return vx.evolve(
        random_tissue(9, 0),
        ENERGY,
        FRICTION,
        times,
        activity=activity,
        key=key,
        relaxation=NO_CONTACT,
        **settings,
    )


def assert_same_bits(one, other):
    plain = lambda x: np.asarray(
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    for a, b in zip(
        *(jax.tree.leaves(eqx.filter(x, eqx.is_array)) for x in (one, other)), strict=True
    ):
        np.testing.assert_array_equal(plain(a), plain(b))


class Interrupt:
    """A key pressed after so many writings."""

    def __init__(self, monkeypatch, after):
        calls = itertools.count(1)
        write = vx._base.checkpoints.CheckpointFile.note

        def note(file, progress):
            write(file, progress)
            if next(calls) == after:
                raise KeyboardInterrupt

        monkeypatch.setattr(vx._base.checkpoints.CheckpointFile, "note", note)


@pytest.mark.thorough
def test_what_was_interrupted_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    whole = driven(checkpoint=tmp_path / "whole.npz")
    assert whole.num_t1 > 0
    file = tmp_path / "part.npz"
    for after in (2, 1, 2):
        with monkeypatch.context() as patch:
            Interrupt(patch, after)
            with pytest.raises(KeyboardInterrupt):
                driven(checkpoint=file)
    names: list[str] = []
    with counted_compilations(names):
        assert_same_bits(whole, driven(checkpoint=file))
        # What is done is not repeated, and another one is refused.
        assert_same_bits(whole, driven(checkpoint=file))
    assert not [name for name in names if "advance" in name]
    # In one piece it is the same to rounding.
    at_once = driven()
    assert jax.tree.structure(at_once) == jax.tree.structure(whole)
    np.testing.assert_array_equal(at_once.transitions, whole.transitions)
    np.testing.assert_allclose(at_once.frames.vertices, whole.frames.vertices, atol=1e-7)
    np.testing.assert_array_equal(at_once.steps, whole.steps)
    # Further times go on; others are refused, and so is another movement.
    longer = driven(checkpoint=file, times=np.append(TIMES, 0.14))
    np.testing.assert_array_equal(longer.frames.vertices[:-1], whole.frames.vertices)
    with pytest.raises(ValueError, match=r"frames at other times \(8, from 0 to 0.14\)"):
        driven(checkpoint=file)
    with pytest.raises(ValueError, match="checkpoint of a movement with another tissue, energy or"):
        driven(checkpoint=file, key=4)


@pytest.mark.thorough
def test_without_noise_and_with_a_control_of_steps(tmp_path):
    control = vx.dynamics.StepControl(1e-3, most=20)
    run = lambda **settings: vx.evolve(
        random_tissue(9, 0),
        ENERGY,
        FRICTION,
        [0, 0.1, 0.2],
        relaxation=FIXED_TOPOLOGY,
        control=control,
        **settings,
    )
    at_once, by_frames = run(), run(checkpoint=tmp_path / "run.npz", progress=True)
    np.testing.assert_array_equal(at_once.steps > 0, by_frames.steps > 0)
    np.testing.assert_allclose(at_once.tissue.vertices, by_frames.tissue.vertices, atol=1e-9)


def test_times_equal_up_to_rounding_continue(tmp_path):
    file = tmp_path / "run.npz"
    run = lambda times: vx.evolve(
        random_tissue(9, 0), ENERGY, FRICTION, times, relaxation=FIXED_TOPOLOGY, checkpoint=file
    )
    computed = np.arange(4) * 0.1
    written = [0, 0.1, 0.2, 0.3, 0.4]
    assert computed[3] != written[3]
    run(computed)
    assert run(written).times.shape == (5,)
    with pytest.raises(ValueError, match=r"frame 3 differs first: 0.30000000000000004 there, 0.31"):
        run([0, 0.1, 0.2, 0.31, 0.4])
    _check_times(np.asarray(computed, np.float32), np.asarray(written, np.float32))
    with pytest.raises(ValueError, match="frame 1 differs first"):
        _check_times(np.asarray([0, 1e-3, 2e-3]), np.asarray([0, 1e-3 + 1e-11, 2e-3]))


class TestBadInput:
    def test_a_step_that_comes_to_no_end_leaves_the_frames_before(self, tmp_path):
        file = tmp_path / "run.npz"
        few = vx.Relaxation(transitions=None, contact_range=None, max_steps=1)
        go = lambda **settings: vx.evolve(
            random_tissue(9, 0), ENERGY, FRICTION, [0.0, 0.5, 1.0], relaxation=few, **settings
        )
        with pytest.raises(RuntimeError, match=r"On the way to time 0\.5 \(frame 1\)"):
            go(checkpoint=file)
        assert not go(checkpoint=file, throw=False).sound[1]

    def test_inside_a_compiled_function(self):
        tissue = random_tissue(9, 0)

        def go(targets):
            return vx.evolve(
                tissue, ShapeFactorEnergy(targets), FRICTION, TIMES, progress=True
            ).energy

        with pytest.raises(TypeError, match="movements that run outside"):
            jax.jit(go)(jnp.full(9, 3.5))

    def test_a_folder_that_is_not_there(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            driven(checkpoint=tmp_path / "nowhere" / "run.npz")
