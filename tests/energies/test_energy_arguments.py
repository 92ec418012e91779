# pyright: reportArgumentType=false
"""Arguments and fields that energies reject."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.energies import (
    AbstractEnergy,
    AreaElasticity,
    BoundedTension,
    LineTension,
    PerimeterElasticity,
    ShapeFactorEnergy,
    foam_energy,
)


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
        (lambda: AreaElasticity(-1.0, 1.0), ValueError, "`stiffness` must be at least 0"),
        (
            lambda: AreaElasticity(jnp.array([1.0, -2.0]), 1.0),
            ValueError,
            "`stiffness` must be at least 0, but is from -2.0 to 1.0",
        ),
        (lambda: PerimeterElasticity(-0.1, 1.0), ValueError, "`stiffness` must be at least 0"),
        (lambda: foam_energy(0.1, stiffness=-1.0), ValueError, "`stiffness` must be at least 0"),
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
def test_invalid_parameters_are_rejected(make, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        make()


def test_integer_arrays_become_parameters():
    energy = ShapeFactorEnergy(np.full(6, 4))
    assert eqx.is_inexact_array(energy.target_shape_factor)
    assert isinstance(
        ShapeFactorEnergy(4).target_shape_factor, float
    )  # a Python number is a constant


def test_batch_of_tissues_requires_vmap():
    tissue = random_tissue(6)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), tissue)
    energy = ShapeFactorEnergy(3.7) + LineTension(0.1)
    with pytest.raises(ValueError, match=r"single tissue, but .*filter_vmap"):
        energy(batch)
    np.testing.assert_allclose(eqx.filter_vmap(energy)(batch), energy(tissue), rtol=1e-12)


class Part(eqx.Module):
    table: Any = eqx.field(static=True)


class Odd(AbstractEnergy):
    strength: Any
    table: Any = eqx.field(static=True, default=None)

    def __call__(self, tissue):
        return jnp.sum(tissue.perimeters**2)


# Equinox accepts static arrays with a warning.
@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Odd(1.0, np.ones(3)), "`table` of Odd must have a hash.*shape .3,"),
        (lambda: Odd(1.0, [1, 2]), "`table` of Odd must have a hash.*type list.*tuple"),
        (lambda: Odd(1.0, (1, {"a": 2})), "`table` of Odd must have a hash"),
        (lambda: Odd({"a": [Part(np.ones(3))]}), "`table` of Part must have a hash"),
        (lambda: Odd(np.array(["a", "b"])), "`strength` of Odd must hold numbers"),
    ],
)
def test_fields_that_cannot_be_compiled_are_rejected(make, message):
    with pytest.raises(TypeError, match=message):
        make()


def test_energies_with_unusual_fields_can_be_evaluated_twice():
    tissue = random_tissue(3, 1)
    value = eqx.filter_jit(lambda energy: energy(tissue))
    for odd in (
        np.ones(3),
        jax.random.key(0),
        "text",
        None,
        Part("text"),
        [1.0, "a", None, jnp.sin],
        eqx.nn.MLP(2, 2, 4, 1, key=jax.random.key(0)),
    ):
        assert value(Odd(odd, ("a", 1))) == value(Odd(odd, ("a", 1)))


class Contractility(AbstractEnergy):
    strength: Any

    def __call__(self, tissue):
        return jnp.sum(self.strength * tissue.perimeters**2)


class Springs(AbstractEnergy):
    """A column that is not expanded: one stiffness for both coordinates of a vertex."""

    stiffness: Any

    def __call__(self, tissue):
        return 0.5 * jnp.sum(self.stiffness * (tissue.vertices - 1) ** 2)


class PerimeterCost(vx.costs.AbstractLeastSquaresCost):
    target: Any

    def residuals(self, tissue, energy):
        return (tissue.perimeters - self.target).ravel()


def test_column_that_becomes_a_matrix_causes_a_warning():
    tissue, energy = random_tissue(6), ShapeFactorEnergy(jnp.full(6, 3.7))
    match = r"Field `strength` of Contractility has the shape \(6, 1\).* 6 × 6 entries.*\(6,\)"
    column = Contractility(jnp.ones((6, 1)))
    for wrong in (column, energy + column):
        with pytest.warns(UserWarning, match=match):
            vx.Relaxation().check(tissue, wrong, vx.ImplicitDifferentiation())
        with pytest.warns(UserWarning, match=match):
            vx.InverseProblem(tissue, wrong, vx.costs.VertexDistance(tissue))
    with pytest.warns(UserWarning, match=r"`target` of PerimeterCost has the shape \(6, 1\)"):
        vx.InverseProblem(tissue, energy, 2.0 * PerimeterCost(np.ones((6, 1))))


def test_columns_that_make_no_matrix_cause_no_warning():
    tissue = random_tissue(6)
    network = eqx.nn.MLP(6, 6, 1, 1, key=jax.random.key(0))  # Weights of shapes (1, 6) and (6, 1).
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for energy in (
            Springs(jnp.ones((12, 1))),
            Contractility(jnp.ones(6)),
            Odd(network),
            lambda tissue: jnp.sum(tissue.areas),
        ):
            vx.Relaxation().check(tissue, energy, vx.ImplicitDifferentiation())


@pytest.mark.parametrize("transform", [jax.grad, jax.vmap, jax.jit])
@pytest.mark.parametrize("kind", ["function", "class", "sum", "field"])
def test_energies_that_close_over_traced_values_are_named(transform, kind, without_type_checks):
    tissue = random_tissue(6)

    class Holder(vx.AbstractEnergy):
        function: Callable

        def __call__(self, tissue):
            return self.function(tissue)

    def relaxed_area(strength):
        def function(tissue):
            return strength * jnp.sum(tissue.perimeters**2)

        class Local(vx.AbstractEnergy):
            def __call__(self, tissue):
                return strength * jnp.sum(tissue.perimeters**2)

        energies = {
            "function": function,
            "class": Local(),
            "sum": vx.energies.AreaElasticity(1.0, 1.0) + Local(),
            "field": Holder(function),
        }
        return vx.equilibrate(tissue, energies[kind]).energy

    with pytest.raises(TypeError, match="closes over `strength`, a value that"):
        transform(relaxed_area)(jnp.ones(2 if transform is jax.vmap else ()))
