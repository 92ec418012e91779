"""Error messages of `vertax.mechanics` name the argument and its requirement."""

# The tests pass arguments of wrong types.
# pyright: reportArgumentType=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue

import vertax as vx
from vertax import costs, mechanics
from vertax.mechanics import BoxRelaxation

N = 9
tissue, free = random_tissue(N, 1), cluster(4, 1)
energy = vx.energies.ShapeFactorEnergy(3.6)
friction = vx.dissipations.SubstrateFriction(1.0)
batch = vx.fitting.stack([tissue, tissue])

ENERGY, TISSUE = "`energy` must be an energy", "`tissue` must be a vertax.Tissue"
PERIODIC = "`tissue` must be periodic"
TISSUE_FUNCTIONS = [
    mechanics.stress,
    mechanics.cell_stress,
    mechanics.pressures,
    mechanics.tensions,
    mechanics.elastic_tensor,
    mechanics.shear_modulus,
    mechanics.bulk_modulus,
    mechanics.youngs_modulus,
    mechanics.spectrum,
    mechanics.zero_modes,
    lambda t, e: mechanics.modes(t, e, 2),
    lambda t, e: mechanics.complex_modulus(t, e, friction, jnp.array([1.0])),
    lambda t, e: mechanics.recoil(t, e, friction, 1),
    lambda t, e: mechanics.velocities(t, e, friction),
    lambda t, e: mechanics.ramp(t, e, np.array([0.0, 0.1])),
    lambda t, e: BoxRelaxation()(t, e),
]


@pytest.mark.parametrize("function", TISSUE_FUNCTIONS)
def test_functions_require_one_tissue_and_an_energy(without_type_checks, function):
    for wrong in (None, 3.6, vx.energies.ShapeFactorEnergy):
        with pytest.raises(TypeError, match=ENERGY):
            function(tissue, wrong)
    with pytest.raises(TypeError, match=TISSUE):
        function(energy, tissue)
    with pytest.raises(ValueError, match="`tissue` must be a single tissue"):
        function(batch, energy)


@pytest.mark.parametrize(
    "function",
    [
        *TISSUE_FUNCTIONS[4:8],
        lambda t, e: mechanics.complex_modulus(t, e, friction, jnp.array([1.0])),
        lambda t, e: mechanics.ramp(t, e, np.array([0.0, 0.1])),
        lambda t, e: BoxRelaxation()(t, e),
    ],
)
def test_functions_that_strain_the_box_require_a_periodic_tissue(function):
    with pytest.raises(ValueError, match=PERIODIC):
        function(free, energy)


skewed = jnp.array([[0.0, 1.0], [0.0, 0.0]])
WRONG = {
    "angles": (
        lambda: mechanics.shear_modulus(tissue, energy, angle=[0, 1]),
        "`angle` must be one number",
    ),
    "angle": (lambda: mechanics.shear_modulus(tissue, energy, angle=np.nan), "`angle` must be fin"),
    "solver": (lambda: mechanics.elastic_tensor(tissue, energy, linear_solver=3), "linear solver"),
    "no modes": (lambda: mechanics.modes(tissue, energy, 0), "`k` must be at least 1"),
    "modes": (lambda: mechanics.modes(tissue, energy, 37), "`k` must be at most"),
    "fraction of a mode": (lambda: mechanics.modes(tissue, energy, 2.5), "`k` must be at least 1"),
    "tolerance": (lambda: mechanics.zero_modes(tissue, energy, tolerance=-1), "be positive"),
    "traced": (
        lambda: jax.jit(lambda p: mechanics.spectrum(tissue, vx.energies.ShapeFactorEnergy(p)))(
            3.6
        ),
        "does not work inside jax.jit",
    ),
    "matrix": (lambda: mechanics.density_of_states(jnp.ones((2, 2))), "one list of eigenvalues"),
    "no values": (lambda: mechanics.density_of_states(jnp.ones(0)), "one list of eigenvalues"),
    "nan": (lambda: mechanics.density_of_states(jnp.array([np.nan])), "`values` must be finite"),
    "bins": (lambda: mechanics.density_of_states(jnp.ones(3), 0), "`bins` must be at least 1"),
    "string": (lambda: mechanics.self_stresses(tissue, "areas"), "`constraints` must name"),
    "no constraints": (
        lambda: mechanics.compatibility(tissue, []),
        "`constraints` must name",
    ),
    "principal": (lambda: mechanics.principal(jnp.ones(3)), "`stresses` must have shape"),
    "negative frequency": (
        lambda: mechanics.complex_modulus(tissue, energy, friction, -1.0),
        "`frequencies` must be at least 0",
    ),
    "frequency matrix": (
        lambda: mechanics.complex_modulus(tissue, energy, friction, np.ones((2, 2))),
        "`frequencies` must be a list",
    ),
    "no frequency": (
        lambda: mechanics.complex_modulus(tissue, energy, friction, []),
        "`frequencies` must be a list",
    ),
    "method": (
        lambda: mechanics.complex_modulus(tissue, energy, friction, [1.0], method="fast"),
        "`method` must be one of None, 'dense'",
    ),
    "dissipation": (
        lambda: mechanics.complex_modulus(tissue, energy, energy, [1.0]),
        "`dissipation` must be a dissipation",
    ),
    "negative edge": (
        lambda: mechanics.recoil(tissue, energy, friction, -1),
        "`edge` must be at least 0",
    ),
    "edge too large": (
        lambda: mechanics.recoil(tissue, energy, friction, 999),
        "one of the 27 edges",
    ),
    "edge not an integer": (
        lambda: mechanics.recoil(tissue, energy, friction, 1.5),
        "`edge` must be at least 0",
    ),
    "two edges": (
        lambda: mechanics.recoil(tissue, energy, friction, jnp.arange(2)),
        "`edge` must be at least 0",
    ),
    "no dissipation": (lambda: mechanics.recoil(tissue, energy, None, 1), "must be a dissipation"),
    "number as dissipation": (
        lambda: mechanics.velocities(tissue, energy, 1.0),
        "must be a dissipation",
    ),
    "solver of velocities": (
        lambda: mechanics.velocities(tissue, energy, friction, linear_solver=3),
        "linear solver",
    ),
    "stress": (lambda: BoxRelaxation(stress=np.nan), "`stress` must be finite"),
    "skewed": (lambda: BoxRelaxation(stress=skewed), "`stress` must be symmetric"),
    "relaxation": (lambda: BoxRelaxation(relaxation=None), "`relaxation` must be"),
    "free": (lambda: BoxRelaxation(free=["x"]), "`free` must be one of 'all'"),
    "no box steps": (lambda: BoxRelaxation(max_steps=0), "`max_steps` must be at least 1"),
    "one strain": (lambda: mechanics.ramp(tissue, energy, 0.1), "`strains` must be a list"),
    "infinite strain": (
        lambda: mechanics.ramp(tissue, energy, [0, np.inf]),
        "`strains` must be finite",
    ),
    "deformation": (
        lambda: mechanics.ramp(tissue, energy, [0, 0.1], deformation=3),
        "`deformation` must be a function",
    ),
    "scalar deformation": (
        lambda: mechanics.ramp(tissue, energy, [0, 0.1], deformation=lambda s: s),
        "`deformation` must have shape",
    ),
    "relaxation of a ramp": (
        lambda: mechanics.ramp(tissue, energy, [0, 0.1], relaxation=3),
        "`relaxation` must",
    ),
    "two shears": (lambda: mechanics.simple_shear([0.1, 0.2]), "`strain` must be one number"),
    "nan shear": (lambda: mechanics.pure_shear(np.nan), "`strain` must be finite"),
    "vector": (lambda: mechanics.deformed(tissue, jnp.ones(2)), "`gradient` must have shape"),
    "singular": (lambda: mechanics.deformed(tissue, jnp.zeros((2, 2))), "a positive determinant"),
    "cost": (lambda: costs.Stress(skewed), "`target` must be symmetric"),
    "cell out of range": (
        lambda: costs.CellStress(jnp.zeros((2, 2)), jnp.array([3, 99]))(tissue, energy),
        "`cells` must hold indices of cells, from 0 to 8, but holds 99",
    ),
    "cell not an integer": (
        lambda: costs.CellStress(jnp.zeros((2, 2)), jnp.array([0.5])),
        "`cells` must hold whole numbers",
    ),
    "anisotropy": (lambda: costs.Anisotropy(2.0), "`target` must be between -1 and 1"),
    "gap": (lambda: costs.SpectralGap(0.1, below=0), "`below` must be at least 1"),
}


@pytest.mark.parametrize("name", WRONG)
def test_errors_name_the_argument(without_type_checks, name):
    call, message = WRONG[name]
    with pytest.raises((ValueError, TypeError), match=message.replace("(", r"\(")):
        call()
