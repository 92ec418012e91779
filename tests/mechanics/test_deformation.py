"""Slow deformation, and boxes that come to rest."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import FIXED_TOPOLOGY, random_tissue

import vertax as vx
from vertax import mechanics
from vertax.energies import ShapeFactorEnergy
from vertax.mechanics import BoxRelaxation

N = 9
PRECISE = eqx.tree_at(lambda r: r.tolerance, FIXED_TOPOLOGY, 1e-11, is_leaf=lambda x: x is None)
start = random_tissue(N, 1)
p0 = jnp.linspace(3.5, 3.7, N)
direction = np.cos(np.arange(N))


def slope_and_difference(loss, h=1e-4):
    at = lambda s: float(loss(p0 + s * h * direction))
    wanted = (8 * (at(1) - at(-1)) - at(2) + at(-2)) / (12 * h)
    return float(np.sum(jax.jit(jax.grad(loss))(p0) * direction)), wanted


def test_shears():
    np.testing.assert_allclose(mechanics.simple_shear(0.3), [[1, 0.3], [0, 1]])
    np.testing.assert_allclose(np.linalg.det(mechanics.pure_shear(0.3)), 1)


@pytest.mark.slow
def test_the_work_of_the_stress_is_the_change_of_the_energy():
    energy = ShapeFactorEnergy(p0)
    found = mechanics.ramp(start, energy, jnp.linspace(0, 0.05, 11), relaxation=PRECISE)
    assert not found.plastic.any()
    area = start.boundary.area
    # Simpson's rule.
    shear = np.asarray(found.stresses[:, 0, 1])
    work = 0.005 / 3 * (shear[0] + 4 * shear[1::2].sum() + 2 * shear[2:-1:2].sum() + shear[-1])
    gained = (found.energies[-1] - found.energies[0]) / area
    assert work == pytest.approx(float(gained), rel=1e-5)
    # The slope of the stress is the modulus, but that simple shear turns the tissue as well.
    rest = jax.tree.map(lambda x: x[0], eqx.filter(found.frames, eqx.is_array))
    rest = eqx.combine(rest, start)
    s = found.stresses[0]
    slope = (-25 * shear[0] + 48 * shear[1] - 36 * shear[2] + 16 * shear[3] - 3 * shear[4]) / 0.06
    modulus = mechanics.shear_modulus(rest, energy, angle=0.0)
    assert slope == pytest.approx(float(modulus - (s[0, 0] - s[1, 1]) / 2), rel=1e-3)


@pytest.mark.slow
def test_a_large_strain_has_transitions_at_which_energy_is_lost():
    relaxation = vx.Relaxation(contact_range=None)
    energy = ShapeFactorEnergy(jnp.full(N, 3.6))
    found = mechanics.ramp(start, energy, jnp.linspace(0, 1.0, 41), relaxation=relaxation)
    assert found.plastic[1:].any()
    # Less than what elastic deformation would have gained.
    gain = np.diff(found.energies) / start.boundary.area
    work = 0.025 * 0.5 * (found.stresses[1:, 0, 1] + found.stresses[:-1, 0, 1])
    lost = np.asarray(work - gain)
    plastic = np.asarray(found.plastic[1:])
    assert lost[plastic].mean() > 10 * np.abs(lost[~plastic]).mean()


@pytest.mark.slow
def test_gradient_of_a_ramp_against_differences():
    loss = lambda p: mechanics.ramp(
        start, ShapeFactorEnergy(p), jnp.array([0.0, 0.05]), relaxation=PRECISE, throw=False
    ).stresses[-1, 0, 1]
    np.testing.assert_allclose(*slope_and_difference(jax.jit(loss)), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("free", ["all", "area", "shape"])
def test_a_box_comes_to_the_stress_given(free):
    energy = ShapeFactorEnergy(p0)
    wanted = np.array([[0.1, 0.02], [0.02, 0.05]])
    found = BoxRelaxation(jnp.asarray(wanted), free, PRECISE)(start, energy)
    missing = np.asarray(mechanics.stress(found.tissue, energy)) - wanted
    left = {
        "all": missing.ravel(),
        "area": [np.trace(missing)],
        "shape": [missing[0, 0] - missing[1, 1], missing[0, 1]],
    }
    np.testing.assert_allclose(left[free], 0, atol=1e-7)
    area = float(found.tissue.boundary.area)
    if free == "shape":
        assert area == pytest.approx(9)
    # It is a minimum of the energy less the work of the stress.
    if free == "area":
        enthalpy = lambda s: (
            float(PRECISE(mechanics.deformed(found.tissue, s * jnp.eye(2)), energy).energy)
            - 0.075 * area * s**2
        )
        assert enthalpy(1.0) < min(enthalpy(0.99), enthalpy(1.01))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
def test_gradient_of_a_relaxed_box_against_differences(adjoint):
    response = BoxRelaxation(0.1, "all", PRECISE)

    def loss(p):
        found = response(start, ShapeFactorEnergy(p), adjoint=adjoint, throw=False).tissue
        return jnp.sum(found.boundary.lattice**2) + jnp.sum(found.perimeters**2)

    slope, wanted = slope_and_difference(jax.jit(loss))
    assert slope == pytest.approx(wanted, rel=1e-6 if "Implicit" in str(adjoint) else 1e-3)


def test_what_is_refused(without_type_checks):
    energy = ShapeFactorEnergy(p0)
    with pytest.raises(ValueError, match="must be periodic"):
        mechanics.ramp(cluster(4, 1), energy, np.array([0.0, 0.1]))
    with pytest.raises(ValueError, match="must be a list of numbers"):
        mechanics.ramp(start, energy, 0.1)
    with pytest.raises(ValueError, match="must be periodic"):
        BoxRelaxation()(cluster(4, 1), energy)
    with pytest.raises(ValueError, match="must be one of all, area"):
        BoxRelaxation(free="none")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="a number or have shape"):
        BoxRelaxation(jnp.zeros(3))
    unrolling = vx.Relaxation(solver=vx.solvers.GradientDescent())
    with pytest.raises(ValueError, match="a box takes many"):
        BoxRelaxation(relaxation=unrolling)(start, energy, adjoint=vx.AutomaticDifferentiation())
