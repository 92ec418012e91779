import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, random_like, random_tissue, tissues
from hypothesis import given, settings
from jaxtyping import Array, Float

import vertax as vx
from vertax.energies import (
    AreaElasticity,
    LineTension,
    PerimeterElasticity,
    ShapeFactorEnergy,
)

tissue = random_tissue(12, 1, lloyd_steps=5)  # without short edges, for accurate finite differences
per_cell = lambda seed: 1 + 0.3 * jax.random.uniform(jax.random.key(seed), (12,))
per_edge = 1 + jax.random.uniform(jax.random.key(9), (36,))


class Contractility(vx.AbstractEnergy):
    strength: Float[Array, " cells"]

    def __call__(self, tissue):
        return 0.5 * jnp.sum(self.strength * tissue.perimeters**2)


ENERGIES = [
    ShapeFactorEnergy(3 * per_cell(0)),
    ShapeFactorEnergy(3 * per_cell(0), per_cell(1)),
    AreaElasticity(per_cell(2), per_cell(3)),
    PerimeterElasticity(per_cell(4), 3 * per_cell(5)),
    LineTension(per_edge),
    AreaElasticity(20.0, 1.0) + LineTension(per_edge),
    Contractility(per_cell(6)),
    Contractility(per_cell(6)) + AreaElasticity(jnp.array(2.0), per_cell(3)),
]
name_of = lambda e: type(e).__name__


def test_energies_match_their_formulas():
    a, p, length = tissue.areas, tissue.perimeters, tissue.edge_lengths
    p0, a0 = 3 * per_cell(0), per_cell(1)
    np.testing.assert_allclose(ShapeFactorEnergy(p0)(tissue), np.sum((a - 1) ** 2 + (p - p0) ** 2))
    np.testing.assert_allclose(
        ShapeFactorEnergy(p0, a0)(tissue), np.sum((a / a0 - 1) ** 2 + (p / np.sqrt(a0) - p0) ** 2)
    )
    np.testing.assert_allclose(AreaElasticity(3.0, a0)(tissue), 1.5 * np.sum((a - a0) ** 2))
    np.testing.assert_allclose(PerimeterElasticity(3.0, p0)(tissue), 1.5 * np.sum((p - p0) ** 2))
    np.testing.assert_allclose(LineTension(per_edge)(tissue), np.sum(per_edge * length))
    e2 = AreaElasticity(20.0, 1.0) + LineTension(per_edge)
    np.testing.assert_allclose(e2(tissue), 10 * np.sum((a - 1) ** 2) + np.sum(per_edge * length))


@pytest.mark.parametrize("energy", ENERGIES, ids=name_of)
def test_forces_match_finite_differences(energy):
    f = jax.jit(jax.value_and_grad(lambda x: energy(tissue.with_configuration(x))))
    direction = random_like(tissue.vertices)
    slope = np.sum(np.asarray(f(tissue.vertices)[1] * direction))
    difference = central_difference(lambda x: f(x)[0], tissue.vertices, direction)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.parametrize("energy", ENERGIES, ids=name_of)
def test_parameter_derivatives_match_finite_differences(energy):
    parameters, constants = eqx.partition(energy, eqx.is_inexact_array)
    f = jax.jit(jax.value_and_grad(lambda p: eqx.combine(p, constants)(tissue)))
    direction = random_like(parameters)
    slope = sum(
        jnp.sum(g * d)
        for g, d in zip(jax.tree.leaves(f(parameters)[1]), jax.tree.leaves(direction), strict=True)
    )
    difference = central_difference(lambda p: f(p)[0], parameters, direction)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@eqx.filter_jit
def forces(tissue, energy):
    return jax.grad(lambda x: energy(tissue.with_configuration(x)))(tissue.vertices)


@settings(max_examples=15, deadline=None)
@given(tissues())
def test_forces_sum_to_zero(recipe):
    force = np.asarray(forces(recipe(), ShapeFactorEnergy(3.6) + LineTension(0.3)))
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-9 * (1 + np.abs(force).max()))


def test_local_energies_are_the_sum_of_their_terms():
    energy = ShapeFactorEnergy(3.6) + AreaElasticity(2.0, 1.0) + LineTension(per_edge)
    assert isinstance(energy, vx.AbstractLocalEnergy)
    cells, edges = energy.cell_terms(tissue), energy.edge_terms(tissue)
    assert cells.shape == (12,)
    assert edges.shape == (36,)
    assert energy(tissue) == pytest.approx(float(cells.sum() + edges.sum()))


def test_sum_with_a_nonlocal_energy_is_not_local():
    energy = Contractility(per_cell(6)) + ShapeFactorEnergy(3.6)
    assert not isinstance(energy, vx.AbstractLocalEnergy)
    assert energy(tissue) == pytest.approx(
        float(Contractility(per_cell(6))(tissue) + ShapeFactorEnergy(3.6)(tissue))
    )
    with pytest.raises(TypeError):
        energy + 3.0  # pyright: ignore


def test_numbers_are_constants_and_arrays_are_parameters():
    energy = ShapeFactorEnergy(jnp.full(12, 3.7)) + AreaElasticity(20, 1.0)
    assert len(jax.tree.leaves(eqx.filter(energy, eqx.is_inexact_array))) == 1


@pytest.mark.parametrize(
    "energy",
    [
        ShapeFactorEnergy(jnp.ones(11)),
        ShapeFactorEnergy(3.0, jnp.ones(13)),
        AreaElasticity(jnp.ones((12, 1)), 1.0),
        PerimeterElasticity(1.0, jnp.ones(36)),
        LineTension(jnp.ones(12)),
    ],
)
def test_parameters_of_wrong_shape_are_rejected(energy):
    with pytest.raises(
        ValueError,
        match=r"Argument `.*` must be one number or have shape .* one for each (cell|edge)",
    ):
        energy(tissue)
