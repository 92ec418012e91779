"""Example of a project that uses vertax: a user-defined energy and cost, a fit, and files.

`make types` checks it in strict mode; lines with unknown types of JAX, Optax and Optimistix are excluded.
`test_downstream.py` runs it.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax  # pyright: ignore[reportMissingTypeStubs]
from jaxtyping import Array, Float

import vertax as vx


class Contractility(vx.AbstractLocalEnergy):
    """Contractility of the perimeter, with one strength per cell."""

    strength: Float[Array, " cells"]
    rest: float = 0.0

    def cell_terms(self, tissue: vx.Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        return 0.5 * self.strength * (tissue.perimeters - self.rest) ** 2


class Evenness(vx.AbstractCost):
    """Variance of the cell areas."""

    weight: float = 1.0

    def __call__(self, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> Float[Array, ""]:
        """Value of the cost."""
        return self.weight * jnp.var(tissue.areas)


# Without T1 transitions and contacts, which compiles faster.
RESPONSE = vx.Relaxation(transitions=None, tolerance=1e-6, contact_range=None)


def relax(tissue: vx.Tissue, strength: Float[Array, " cells"]) -> vx.Equilibrium:
    """The equilibrium of contractile cells."""
    energy = vx.energies.AreaElasticity(1.0, 1.0) + Contractility(strength)
    return RESPONSE(tissue, energy)


def problem(tissue: vx.Tissue) -> vx.InverseProblem[vx.AbstractEnergy]:
    """Infer the contractilities for which all cells have the same area."""
    number = jnp.arange(tissue.n_cells)  # pyright: ignore[reportUnknownMemberType]
    strength = 0.1 * (1 + number)
    energy = vx.energies.AreaElasticity(1.0, 1.0) + Contractility(strength)
    cost = Evenness() + 0.1 * vx.costs.CellAreas(jnp.mean(tissue.areas))
    return vx.InverseProblem(tissue=tissue, energy=energy, cost=cost, response=RESPONSE)


def gradient(tissue: vx.Tissue, strength: Float[Array, " cells"]) -> Float[Array, " cells"]:
    """The gradient of a cost through the equilibrium, without an inverse problem."""

    def cost(strength: Float[Array, " cells"]) -> Float[Array, ""]:
        return jnp.var(relax(tissue, strength).tissue.areas)

    slope = jax.grad(cost)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    return cast(Array, slope(strength))


def fit(
    problem: vx.InverseProblem[vx.AbstractEnergy], folder: Path, epochs: int
) -> vx.Fit[vx.AbstractEnergy]:
    """Solve the problem, and save all results in a folder."""
    trajectory = vx.mesh.Trajectory()
    optimiser = optax.adam(1e-2)
    result = vx.fit(problem, optimiser, epochs, progress=False, callback=trajectory)
    vx.save(folder / "tissue.npz", result.tissue)
    vx.save(folder / "energy.npz", result.energy)
    vx.save(folder / "problem.npz", problem)
    vx.save(folder / "fit.npz", trajectory)
    vx.io.write_csv(folder / "cells.csv", vx.io.cell_table(result.tissue))
    numbers = np.arange(result.tissue.n_cells)
    vx.io.write_geojson(folder / "cells.geojson", result.tissue, cells={"number": numbers})
    return result


def load(folder: Path) -> tuple[float, vx.InverseProblem[vx.AbstractEnergy]]:
    """Load the cost of the fit, and the problem with the fitted energy."""
    classes: list[type[eqx.Module]] = [Contractility, Evenness]
    tissue = vx.load(folder / "tissue.npz", vx.Tissue)
    energy = vx.load(folder / "energy.npz", vx.AbstractEnergy, classes=classes)
    problem = vx.load(folder / "problem.npz", vx.InverseProblem, classes=classes)
    frames = vx.load(folder / "fit.npz", vx.mesh.Trajectory)
    assert len(frames) == len(frames.values["cost"])
    cost = problem.cost(tissue, energy)
    return float(cost), dataclasses.replace(problem, energy=energy)
