"""Batches of tissues, energies and problems, and their members."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.fitting import member, stack


def problem(seed, **options):
    tissue = random_tissue(6, seed)
    cost = vx.costs.VertexDistance(tissue)
    return vx.InverseProblem(
        tissue, vx.energies.ShapeFactorEnergy(jnp.full(6, 3.7)), cost, **options
    )


def test_member_inverts_stack():
    # Problems hold arrays, functions (`trainable`) and settings.
    problems = [problem(seed) for seed in range(3)]
    batch = stack(problems)
    assert batch.tissue.vertices.shape == (3, 12, 2)
    for index in (0, 2, -1):
        assert eqx.tree_equal(member(batch, index), problems[index])
    assert member(batch, 1).trainable is problems[1].trainable


def test_numpy_arrays_are_stacked():
    batch = stack([{"x": np.arange(2), "n": 1}, {"x": np.arange(2) + 5, "n": 1}])
    np.testing.assert_array_equal(batch["x"], [[0, 1], [5, 6]])
    assert member(batch, 1)["n"] == 1


def test_stack_rejects_different_trees():
    with pytest.raises(ValueError, match="at least one"):
        stack([])
    with pytest.raises(ValueError, match="one structure"):
        stack([random_tissue(6), vx.initialise.free_voronoi(6, key=jax.random.key(0))])
    with pytest.raises(ValueError, match="equal shapes"):
        stack([jnp.zeros(2), jnp.zeros(3)])
    # Without the check jax.tree.map would keep the first value for all.
    with pytest.raises(ValueError, match=r"one holds 1\.0 where another holds 2\.0"):
        stack([{"a": 1.0}, {"a": 2.0}])


def test_member_rejects_an_index_out_of_range():
    with pytest.raises(IndexError, match="0 … 1"):
        member(stack([jnp.zeros(2), jnp.ones(2)]), 2)


def test_members_of_a_fit_have_their_histories():
    def fit(k: int) -> vx.Fit:
        numbers = 10.0 * k + np.arange(3)
        columns = {field.name: numbers for field in dataclasses.fields(vx.fitting.History)}
        columns |= {"converged": numbers > 0, "num_steps": np.arange(3), "num_t1": np.arange(3)}
        columns |= {"guidance": np.zeros(3), "seconds": np.arange(3.0)}
        energy = vx.energies.ShapeFactorEnergy(jnp.full(6, 3.7 + k))
        number, history = jnp.array(1.0 * k), vx.fitting.History(**columns)
        notes = {"mean": numbers}
        return vx.Fit(energy, random_tissue(6), number, number, np.array(k), history, notes)

    fits = [fit(k) for k in range(4)]
    batch = vx.fitting.stack_fits(fits, at_once=4)
    for k, single in enumerate(fits):
        assert eqx.tree_equal(member(batch, k), single)
    with pytest.raises(IndexError, match="0 … 3"):
        member(batch, 4)


@pytest.mark.thorough
def test_batched_fit_with_guidance_matches_single_fits():
    fit = lambda problem, **options: vx.fit(
        problem,
        optax.sgd(1e-3),
        2,
        guidance=lambda epoch: 1.0 / (1 + epoch),
        progress=False,
        **options,
    )
    problems = [problem(seed) for seed in range(2)]
    batched = fit(stack(problems), batched=True)
    np.testing.assert_allclose(batched.history.guidance, [1.0, 0.5])
    for index, single in enumerate(map(fit, problems)):
        np.testing.assert_allclose(
            member(batched, index).energy.target_shape_factor,
            single.energy.target_shape_factor,
            rtol=1e-9,
        )
