"""Checkpoints of time evolutions: interruption and continuation."""

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
from vertax.energies import ShapeFactorEnergy

FRICTION = SubstrateFriction(1.0)
ENERGY = ShapeFactorEnergy(jnp.linspace(3.2, 3.6, 9))
TIMES = 0.02 * np.arange(7)


def evolve_driven(times=TIMES, key=3, **settings):
    """A quench through T1 transitions, with thermal noise and self-propulsion."""
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
    """A keyboard interrupt after a given number of frames."""

    def __init__(self, monkeypatch, after):
        calls = itertools.count(1)
        write = vx._base.checkpoints.CheckpointFile.save_if_due

        def note(file, progress):
            write(file, progress)
            if next(calls) == after:
                raise KeyboardInterrupt

        monkeypatch.setattr(vx._base.checkpoints.CheckpointFile, "save_if_due", note)


@pytest.mark.thorough
def test_interrupted_run_continues_bitwise(tmp_path, monkeypatch):
    uninterrupted = evolve_driven(checkpoint=tmp_path / "whole.npz")
    assert uninterrupted.num_t1 > 0
    file = tmp_path / "part.npz"
    for after in (2, 1, 2):
        with monkeypatch.context() as patch:
            Interrupt(patch, after)
            with pytest.raises(KeyboardInterrupt):
                evolve_driven(checkpoint=file)
    names: list[str] = []
    with counted_compilations(names):
        assert_same_bits(uninterrupted, evolve_driven(checkpoint=file))
        # A finished run is not repeated.
        assert_same_bits(uninterrupted, evolve_driven(checkpoint=file))
    assert not [name for name in names if "advance" in name]
    # A run in one compiled function agrees up to rounding.
    at_once = evolve_driven()
    assert jax.tree.structure(at_once) == jax.tree.structure(uninterrupted)
    np.testing.assert_array_equal(at_once.transitions, uninterrupted.transitions)
    np.testing.assert_allclose(at_once.frames.vertices, uninterrupted.frames.vertices, atol=1e-7)
    np.testing.assert_array_equal(at_once.steps, uninterrupted.steps)
    # Further times continue the run. Other times, and another run, raise an error.
    longer = evolve_driven(checkpoint=file, times=np.append(TIMES, 0.14))
    np.testing.assert_array_equal(longer.frames.vertices[:-1], uninterrupted.frames.vertices)
    with pytest.raises(ValueError, match=r"frames at other times \(8, from 0 to 0.14\)"):
        evolve_driven(checkpoint=file)
    with pytest.raises(ValueError, match="checkpoint of a movement with another tissue, energy or"):
        evolve_driven(checkpoint=file, key=4)


@pytest.mark.thorough
def test_checkpoints_with_step_control(tmp_path):
    control = vx.dynamics.PIController(1e-3, max_steps=20)
    run = lambda **settings: vx.evolve(
        random_tissue(9, 0),
        ENERGY,
        FRICTION,
        [0, 0.1, 0.2],
        relaxation=FIXED_TOPOLOGY,
        stepsize_controller=control,
        **settings,
    )
    at_once, by_frames = run(), run(checkpoint=tmp_path / "run.npz", progress=True)
    np.testing.assert_array_equal(at_once.steps > 0, by_frames.steps > 0)
    np.testing.assert_allclose(at_once.tissue.vertices, by_frames.tissue.vertices, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("changed", ["energy", "boundary"])
def test_checkpoint_of_another_function_is_rejected(changed, tmp_path):
    tissue = random_tissue(9, 0)

    def run(times=(0.0, 0.1), **factors):
        factors = {"energy": 1.0, "boundary": 0.1} | factors
        return vx.evolve(
            tissue,
            lambda time: ShapeFactorEnergy(factors["energy"] * ENERGY.target_shape_factor),
            FRICTION,
            times,
            boundary=lambda time: vx.Periodic(
                tissue.boundary.lattice * (1 + factors["boundary"] * time)
            ),
            relaxation=FIXED_TOPOLOGY,
            checkpoint=tmp_path / "run.npz",
        )

    run()
    for times in ((0.0, 0.1), (0.0, 0.1, 0.2)):
        with pytest.raises(ValueError, match=r"energy or setting \(what its functions compute"):
            run(times, **{changed: 1.1})
    assert run((0.0, 0.1, 0.2)).times.shape == (3,)


def test_progress_inside_jit_raises():
    tissue = random_tissue(9, 0)
    evolve_tissue = lambda targets: vx.evolve(
        tissue, ShapeFactorEnergy(targets), FRICTION, TIMES, progress=True
    )
    with pytest.raises(TypeError, match="do not work inside"):
        jax.jit(lambda targets: evolve_tissue(targets).energy)(jnp.full(9, 3.5))
