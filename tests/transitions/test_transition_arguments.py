"""Invalid arguments of transitions and growth are rejected by name."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.growth import GrowAndDivide, grow
from vertax.transitions import T1, T2, ablate, divide, remove

ENERGY = vx.energies.AreaElasticity(1.0, 1.0) + vx.energies.LineTension(0.1)


@pytest.fixture(scope="module")
def plain():
    return random_tissue(6, 3)


@pytest.fixture(scope="module")
def roomy(plain):
    return plain.with_capacity(7)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (5, "capacity of the tissue"),
        (-1, "capacity of the tissue"),
        (7.0, "whole number"),
        ("7", "whole number"),
        (True, "whole number"),
    ],
)
def test_invalid_capacities_are_rejected(plain, without_type_checks, wrong, message):
    with pytest.raises((TypeError, ValueError), match=f"`n_cells`.*{message}"):
        plain.with_capacity(wrong)


@pytest.mark.parametrize("change", [divide, remove])
@pytest.mark.parametrize("cell", [6, 7, -1, 1.5, None, jnp.arange(2)])
def test_invalid_cell_numbers_are_rejected(roomy, without_type_checks, change, cell):
    with pytest.raises((TypeError, ValueError), match="`cell`"):
        change(roomy, cell)


@pytest.mark.parametrize("axis", [[0.0, 0.0], [1.0], [np.nan, 1.0], [np.inf, 0.0], "long"])
def test_invalid_axes_are_rejected(roomy, without_type_checks, axis):
    with pytest.raises((TypeError, ValueError), match="`axis`"):
        divide(roomy, 0, axis)


def test_transitions_without_spare_slots_are_rejected(plain, without_type_checks):
    with pytest.raises(RuntimeError, match=r"with_capacity.*capacity is 6 cells"):
        divide(plain, 0)
    with pytest.raises(ValueError, match="with_capacity"):
        remove(plain, 0)
    for rule in (T2(), T1() + T2()):
        with pytest.raises(ValueError, match="with_capacity"):
            vx.equilibrate(plain, ENERGY, transitions=rule)
    with pytest.raises(TypeError):
        _ = T1() + 1  # pyright: ignore[reportOperatorIssue]
    for threshold in (-1, 0, np.nan):
        with pytest.raises(ValueError, match="`threshold`"):
            T2(threshold)


@pytest.mark.parametrize(
    "wrong",
    [
        {"edges": 999},
        {"edges": [999]},
        {"edges": jnp.arange(3)},
        {"cells": 2},
        {"cells": [2, 3]},
        {"edges": np.array(["all"])},
        {},
    ],
)
def test_invalid_masks_of_ablation_are_rejected(roomy, without_type_checks, wrong):
    name = next(iter(wrong), "edges")
    with pytest.raises((TypeError, ValueError), match=f"`{name}`"):
        ablate(roomy, ENERGY, **wrong)


def test_ablation_of_a_nonlocal_energy_or_without_spare_slots_is_rejected(
    plain, without_type_checks
):
    with pytest.raises(TypeError, match="`energy`"):
        ablate(plain, lambda tissue: 0.0, edges=jnp.zeros(18, bool))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="with_capacity"):
        ablate(plain, ENERGY, cells=jnp.arange(6) == 1)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("growth_rate", -0.1),
        ("division_area", 0.0),
        ("variation", -1.0),
        ("death_rate", -0.1),
        ("death_rate", jnp.nan),
        ("shrinking_time", 0.0),
        ("orientation", "short"),
    ],
)
def test_invalid_rates_are_rejected(without_type_checks, name, wrong):
    with pytest.raises(ValueError, match=f"`{name}`"):
        GrowAndDivide(**{"growth_rate": 0.1, "division_area": 1.5, name: wrong})


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("energy", ENERGY),
        ("cycle", 0.1),
        ("times", [0.0]),
        ("times", [1.0, 0.0]),
        ("substeps", 0),
        ("divisions", 0),
        ("records", 2),
        ("relaxation", T1()),
        ("dissipation", 1.0),
        ("tissue", None),
        ("key", "seed"),
    ],
)
def test_invalid_arguments_of_growth_are_rejected(plain, roomy, without_type_checks, name, wrong):
    arguments = {
        "tissue": roomy,
        "energy": lambda cells: ENERGY,
        "cycle": GrowAndDivide(0.1, 1.5),
        "times": [0.0, 1.0],
        "key": 0,
    } | {name: plain if name == "tissue" else wrong}
    with pytest.raises((TypeError, ValueError), match=f"`{name}`"):
        grow(**arguments)
