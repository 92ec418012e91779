"""Friction and viscosity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import central_difference, random_like, random_tissue
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax.dissipations import (
    AreaViscosity,
    EdgeViscosity,
    PerimeterViscosity,
    SubstrateFriction,
)

before = random_tissue(12, 1)
tissue = before.with_vertices(before.vertices + 0.02 * random_like(before.vertices))
KINDS = [
    SubstrateFriction(jnp.linspace(0.5, 2.0, 24)),
    SubstrateFriction(0.7, per="area"),
    EdgeViscosity(jnp.linspace(0.1, 1.0, 36)),
    PerimeterViscosity(jnp.linspace(0.1, 1.0, 12)),
    AreaViscosity(0.4),
    SubstrateFriction(1.0) + PerimeterViscosity(0.3),
]
name_of = lambda d: type(d).__name__
value = eqx.filter_jit(lambda d, after, start, dt: d(after, start, dt))


def test_dissipations_match_their_formulas():
    squared = np.sum(np.asarray(tissue.vertices - before.vertices) ** 2, axis=1)
    dl = tissue.edge_lengths - before.edge_lengths
    dp, da = tissue.perimeters - before.perimeters, tissue.areas - before.areas
    expected = [
        0.5 * np.sum(np.linspace(0.5, 2.0, 24) * squared),
        None,
        0.5 * np.sum(np.linspace(0.1, 1.0, 36) * dl**2 / before.edge_lengths),
        0.5 * np.sum(np.linspace(0.1, 1.0, 12) * dp**2),
        0.2 * np.sum(da**2),
        0.5 * np.sum(squared) + 0.15 * np.sum(dp**2),
    ]
    for dissipation, value_at_unit_step in zip(KINDS, expected, strict=True):
        if value_at_unit_step is not None:
            # The dissipation of a given displacement is proportional to 1 / dt.
            np.testing.assert_allclose(
                value(dissipation, tissue, before, 0.1), value_at_unit_step / 0.1
            )


def test_friction_per_area_scales_with_the_total_area():
    # A translation dissipates as the friction of the total area.
    shifted = before.with_vertices(before.vertices + jnp.array([0.3, -0.4]))
    for start in (before, cluster(9, 2)):
        shifted = start.with_vertices(start.vertices + jnp.array([0.3, -0.4]))
        friction = SubstrateFriction(0.7, per="area")
        expected = 0.5 * 0.7 * start.areas.sum() * 0.25
        np.testing.assert_allclose(value(friction, shifted, start, 1.0), expected)


@pytest.mark.parametrize("dissipation", KINDS, ids=name_of)
def test_forces_match_finite_differences(dissipation):
    f = lambda x: value(dissipation, before.with_vertices(x), before, 0.5)
    direction = random_like(before.vertices, 3)
    slope = jnp.sum(jax.jit(jax.grad(f))(tissue.vertices) * direction)
    np.testing.assert_allclose(slope, central_difference(f, tissue.vertices, direction), rtol=1e-6)


@pytest.mark.parametrize("dissipation", KINDS, ids=name_of)
def test_dissipation_is_zero_at_rest_and_positive_otherwise(dissipation):
    assert value(dissipation, before, before, 0.1) < 1e-25
    assert value(dissipation, tissue, before, 0.1) > 0


@settings(max_examples=20, deadline=None)
@given(angle=st.floats(0, 6.3), x=st.floats(-5, 5), y=st.floats(-5, 5))
def test_viscosity_is_zero_for_rigid_motions(angle, x, y):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    start = cluster(9, 2)
    moved = start.with_vertices(jnp.asarray(np.asarray(start.vertices) @ turn + [x, y]))
    for kind in (EdgeViscosity(1.0), PerimeterViscosity(1.0), AreaViscosity(1.0)):
        assert value(kind, moved, start, 1.0) < 1e-20


def test_substrate_follows_the_affine_deformation_of_the_box():
    sheared = before.carried(vx.Periodic(before.boundary.lattice @ jnp.array([[1, 0.0], [0.2, 1]])))
    assert value(SubstrateFriction(1.0), sheared, before, 1.0) < 1e-25
    assert value(PerimeterViscosity(1.0), sheared, before, 1.0) > 1e-3
    np.testing.assert_allclose(sheared.areas.sum(), before.areas.sum())


def test_invalid_arguments_are_rejected(without_type_checks):
    for kind in (SubstrateFriction, EdgeViscosity, PerimeterViscosity, AreaViscosity):
        with pytest.raises(ValueError, match="must be at least 0"):
            kind(-1.0)
        with pytest.raises(ValueError, match="one for each"):
            kind(jnp.ones(5))(tissue, before, 1.0)
    with pytest.raises(ValueError, match="`per`"):
        SubstrateFriction(1.0, per="cell")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError):
        _ = SubstrateFriction(1.0) + 2  # pyright: ignore[reportOperatorIssue]
    with pytest.raises(TypeError, match="Free"):
        before.carried(vx.Free())
