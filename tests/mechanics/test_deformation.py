"""Quasi-static deformation, and relaxation of the box."""

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
    expected = (8 * (at(1) - at(-1)) - at(2) + at(-2)) / (12 * h)
    return float(np.sum(jax.jit(jax.grad(loss))(p0) * direction)), expected


def test_deformation_gradients_of_shears():
    np.testing.assert_allclose(mechanics.simple_shear(0.3), [[1, 0.3], [0, 1]])
    np.testing.assert_allclose(np.linalg.det(mechanics.pure_shear(0.3)), 1)


@pytest.mark.thorough
def test_a_ramp_with_a_checkpoint_continues(tmp_path):
    file, strains = tmp_path / "ramp.npz", np.array([0.01, 0.0, 0.02])
    run = lambda n, factor=1.0, **settings: mechanics.ramp(
        start, ShapeFactorEnergy(factor * p0), strains[:n], relaxation=FIXED_TOPOLOGY, **settings
    )
    at_once, _ = run(3), run(2, checkpoint=file)
    continued = run(3, checkpoint=file)
    assert continued.converged
    np.testing.assert_array_equal(continued.strains, strains)
    np.testing.assert_allclose(continued.stresses, at_once.stresses, atol=1e-8)
    assert len(continued.trajectory) == 3
    np.testing.assert_allclose(continued.trajectory.values["strain"], strains)
    with pytest.raises(ValueError, match="checkpoint of a ramp with another tissue, energy or"):
        run(3, 1.01, checkpoint=file)


@pytest.mark.slow
def test_work_of_the_stress_equals_the_energy_change():
    energy = ShapeFactorEnergy(p0)
    ramp = mechanics.ramp(start, energy, jnp.linspace(0, 0.05, 11), relaxation=PRECISE)
    assert not ramp.plastic.any()
    area = start.boundary.area
    # Simpson's rule.
    shear = np.asarray(ramp.stresses[:, 0, 1])
    work = 0.005 / 3 * (shear[0] + 4 * shear[1::2].sum() + 2 * shear[2:-1:2].sum() + shear[-1])
    energy_change = (ramp.energies[-1] - ramp.energies[0]) / area
    assert work == pytest.approx(float(energy_change), rel=1e-5)
    # The slope of the stress is the modulus, corrected for the rotation in a simple shear.
    rest = jax.tree.map(lambda x: x[0], eqx.filter(ramp.frames, eqx.is_array))
    rest = eqx.combine(rest, start)
    s = ramp.stresses[0]
    slope = (-25 * shear[0] + 48 * shear[1] - 36 * shear[2] + 16 * shear[3] - 3 * shear[4]) / 0.06
    modulus = mechanics.shear_modulus(rest, energy, angle=0.0)
    assert slope == pytest.approx(float(modulus - (s[0, 0] - s[1, 1]) / 2), rel=1e-3)


@pytest.mark.slow
def test_energy_is_dissipated_at_transitions():
    relaxation = vx.Relaxation(contact_range=None)
    energy = ShapeFactorEnergy(jnp.full(N, 3.6))
    ramp = mechanics.ramp(start, energy, jnp.linspace(0, 1.0, 41), relaxation=relaxation)
    assert ramp.plastic[1:].any()
    # The work of the stress minus the change of the energy, per area.
    energy_change = np.diff(ramp.energies) / start.boundary.area
    work = 0.025 * 0.5 * (ramp.stresses[1:, 0, 1] + ramp.stresses[:-1, 0, 1])
    dissipated = np.asarray(work - energy_change)
    plastic = np.asarray(ramp.plastic[1:])
    assert dissipated[plastic].mean() > 10 * np.abs(dissipated[~plastic]).mean()


@pytest.mark.slow
def test_gradient_of_a_ramp_against_differences():
    loss = lambda p: mechanics.ramp(
        start, ShapeFactorEnergy(p), jnp.array([0.0, 0.05]), relaxation=PRECISE, throw=False
    ).stresses[-1, 0, 1]
    np.testing.assert_allclose(*slope_and_difference(jax.jit(loss)), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("free", ["all", "area", "shape"])
def test_box_relaxes_to_the_target_stress(free):
    energy = ShapeFactorEnergy(p0)
    expected = np.array([[0.1, 0.02], [0.02, 0.05]])
    relaxed = BoxRelaxation(jnp.asarray(expected), free, PRECISE)(start, energy)
    residual = np.asarray(mechanics.stress(relaxed.tissue, energy)) - expected
    constrained = {
        "all": residual.ravel(),
        "area": [np.trace(residual)],
        "shape": [residual[0, 0] - residual[1, 1], residual[0, 1]],
    }
    np.testing.assert_allclose(constrained[free], 0, atol=1e-7)
    area = float(relaxed.tissue.boundary.area)
    if free == "shape":
        assert area == pytest.approx(9)
    # The box minimises the enthalpy, the energy minus the work of the stress.
    if free == "area":
        enthalpy = lambda s: (
            float(PRECISE(mechanics.deformed(relaxed.tissue, s * jnp.eye(2)), energy).energy)
            - 0.075 * area * s**2
        )
        assert enthalpy(1.0) < min(enthalpy(0.99), enthalpy(1.01))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
def test_gradient_of_a_relaxed_box_against_differences(adjoint):
    response = BoxRelaxation(0.1, "all", PRECISE)

    def loss(p):
        relaxed = response(start, ShapeFactorEnergy(p), adjoint=adjoint, throw=False).tissue
        return jnp.sum(relaxed.boundary.lattice**2) + jnp.sum(relaxed.perimeters**2)

    slope, expected = slope_and_difference(jax.jit(loss))
    assert slope == pytest.approx(expected, rel=1e-6 if "Implicit" in str(adjoint) else 1e-3)


def test_invalid_arguments_raise(without_type_checks):
    energy = ShapeFactorEnergy(p0)
    with pytest.raises(ValueError, match="must be periodic"):
        mechanics.ramp(cluster(4, 1), energy, np.array([0.0, 0.1]))
    with pytest.raises(ValueError, match="must be a list of numbers"):
        mechanics.ramp(start, energy, 0.1)
    with pytest.raises(ValueError, match="must be periodic"):
        BoxRelaxation()(cluster(4, 1), energy)
    with pytest.raises(ValueError, match="must be one of 'all', 'area'"):
        BoxRelaxation(free="none")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="must be one number or have shape"):
        BoxRelaxation(jnp.zeros(3))
    unrolling = vx.Relaxation(solver=vx.solvers.GradientDescent())
    with pytest.raises(ValueError, match="a box takes many"):
        BoxRelaxation(relaxation=unrolling)(start, energy, adjoint=vx.AutomaticDifferentiation())
