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
    BoundedTension,
    LineTension,
    PerimeterElasticity,
    ShapeFactorEnergy,
)

tissue = random_tissue(12, 1, lloyd_steps=5)  # no edge so short that its length bends over a step
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


def test_values():
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
    f = lambda x: energy(tissue.with_configuration(x))
    direction = random_like(tissue.vertices)
    slope = jnp.sum(jax.grad(f)(tissue.vertices) * direction)
    assert slope == pytest.approx(
        float(central_difference(f, tissue.vertices, direction)), rel=1e-6
    )


@pytest.mark.parametrize("energy", ENERGIES, ids=name_of)
def test_parameter_derivatives_match_finite_differences(energy):
    parameters, constants = eqx.partition(energy, eqx.is_inexact_array)
    f = lambda p: eqx.combine(p, constants)(tissue)
    direction = random_like(parameters)
    slope = sum(
        jnp.sum(g * d)
        for g, d in zip(
            jax.tree.leaves(jax.grad(f)(parameters)), jax.tree.leaves(direction), strict=True
        )
    )
    assert slope == pytest.approx(float(central_difference(f, parameters, direction)), rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(tissues())
def test_forces_sum_to_zero(recipe):
    random = recipe()
    energy = ShapeFactorEnergy(3.6) + LineTension(0.3)
    force = jax.grad(lambda x: energy(random.with_configuration(x)))(random.vertices)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-9 * (1 + float(jnp.abs(force).max())))


def test_local_energies_are_the_sum_of_their_terms():
    energy = ShapeFactorEnergy(3.6) + AreaElasticity(2.0, 1.0) + LineTension(per_edge)
    assert isinstance(energy, vx.AbstractLocalEnergy)
    cells, edges = energy.cell_terms(tissue), energy.edge_terms(tissue)
    assert cells.shape == (12,)
    assert edges.shape == (36,)
    assert energy(tissue) == pytest.approx(float(cells.sum() + edges.sum()))


def test_a_sum_with_a_general_energy_is_general():
    energy = Contractility(per_cell(6)) + ShapeFactorEnergy(3.6)
    assert not isinstance(energy, vx.AbstractLocalEnergy)
    assert energy(tissue) == pytest.approx(
        float(Contractility(per_cell(6))(tissue) + ShapeFactorEnergy(3.6)(tissue))
    )
    with pytest.raises(TypeError):
        energy + 3.0  # pyright: ignore


def test_python_numbers_are_constants_and_arrays_are_parameters():
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
def test_parameters_of_the_wrong_shape_are_named(energy):
    with pytest.raises(ValueError, match=r"Parameter `.*` must be a scalar or have one entry"):
        energy(tissue)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: ShapeFactorEnergy("3.7"),
            TypeError,
            "`target_shape_factor` must hold real .* '3.7'",
        ),
        (
            lambda: ShapeFactorEnergy(None),
            TypeError,
            "`target_shape_factor` must hold real numbers",
        ),
        (lambda: ShapeFactorEnergy([[1], [2, 3]]), TypeError, "must hold real numbers"),
        (lambda: ShapeFactorEnergy(jnp.full(6, 1j)), TypeError, "an array of type complex128"),
        (lambda: ShapeFactorEnergy(np.nan), ValueError, "`target_shape_factor` must be finite"),
        (
            lambda: ShapeFactorEnergy(3.7, 0.0),
            ValueError,
            "`mean_area` must be positive, but is 0.0",
        ),
        (lambda: ShapeFactorEnergy(3.7, jnp.array([1.0, -1])), ValueError, "from -1.0 to 1.0"),
        (lambda: AreaElasticity(np.inf, 1.0), ValueError, "`stiffness` must be finite"),
        (lambda: AreaElasticity(1.0, np.nan), ValueError, "`target_area` must be finite"),
        (lambda: PerimeterElasticity("a", 1.0), TypeError, "`stiffness` must hold real numbers"),
        (lambda: LineTension("a"), TypeError, "`tension` must hold real numbers, but is 'a'"),
        (lambda: BoundedTension(np.ones(3), -np.inf, 2.0), ValueError, "`low` must be finite"),
        (lambda: BoundedTension(np.ones(3), 0.0, "2"), TypeError, "`high` must be one real number"),
        (lambda: BoundedTension(None, 0.0, 2.0), TypeError, "`tension` must hold real numbers"),
        (lambda: BoundedTension("a", 0.0, 2.0), TypeError, "`tension` must hold real numbers"),
        (
            lambda: BoundedTension(np.full(3, np.nan), 0.0, 2.0),
            ValueError,
            "`tension` must be finite",
        ),
    ],
)
def test_what_is_no_parameter_is_named(make, error, message, as_a_user):
    with pytest.raises(error, match=message):
        make()


def test_whole_numbers_in_an_array_are_parameters_too():
    energy = ShapeFactorEnergy(np.full(6, 4))
    assert eqx.is_inexact_array(energy.target_shape_factor)
    assert isinstance(ShapeFactorEnergy(4).target_shape_factor, float)  # and one number a constant


def test_a_batch_of_tissues_wants_vmap():
    tissue = random_tissue(6)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), tissue)
    energy = ShapeFactorEnergy(3.7) + LineTension(0.1)
    with pytest.raises(ValueError, match=r"single tissue, but .*filter_vmap"):
        energy(batch)
    np.testing.assert_allclose(eqx.filter_vmap(energy)(batch), energy(tissue), rtol=1e-12)
