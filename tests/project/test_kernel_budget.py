"""Compile time is proportional to the number of kernels of a program: each program has a budget.

A kernel is a fusion of the program that XLA has optimised for CPUs. Their number depends on shapes only
through size classes, and a little on the version of XLA.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy


def periodic(n: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
    return random_tissue(n, 0), ShapeFactorEnergy(jnp.full(n, 3.7))


def cluster(n: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
    tissue = vx.initialise.free_voronoi(n, key=jax.random.key(0))
    return tissue, AreaElasticity(20.0, 1.0) + LineTension(jnp.ones(tissue.n_edges))


def kernels(function: Callable, *args) -> int:
    """The number of kernels of a function of these arguments."""
    jitted: Any = eqx.filter_jit(function)
    compiled = jitted.lower(*args).compile().compiled
    return len(re.findall(r" = [^=]*? fusion\(", compiled.as_text()))


def relaxed(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.Equilibrium:
    return vx.equilibrate(tissue, energy, throw=False)


def slope(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.AbstractEnergy:
    cost = lambda energy: jnp.sum(relaxed(tissue, energy).tissue.perimeters ** 2)
    return eqx.filter_grad(cost)(energy)


def step(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.dynamics.Evolved:
    friction = vx.dissipations.SubstrateFriction(1.0)
    return vx.evolve(tissue, energy, friction, jnp.array([0.0, 0.1]), throw=False)


@pytest.mark.parametrize(
    ("function", "case", "budget"),
    [
        pytest.param(relaxed, lambda: periodic(100), 600, id="equilibrate 100"),
        pytest.param(
            slope, lambda: periodic(100), 896, id="gradient 100", marks=pytest.mark.thorough
        ),
        pytest.param(step, lambda: periodic(100), 677, id="evolve 100", marks=pytest.mark.thorough),
        pytest.param(relaxed, lambda: cluster(30), 940, id="arcs 30", marks=pytest.mark.thorough),
        pytest.param(
            relaxed, lambda: periodic(400), 860, id="equilibrate 400", marks=pytest.mark.thorough
        ),
    ],
)
def test_programs_stay_within_their_budget_of_kernels(function, case, budget):
    number = kernels(function, *case())
    assert 0.5 * budget < number <= budget  # far fewer: count again, and lower the budget
