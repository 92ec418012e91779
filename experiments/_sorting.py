"""The cell sorting benchmark of the OpenVT workshop 2026: tissues, adhesions and published results."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from vertax import runs
from vertax.energies import AreaElasticity, by_type

ADHESIONS = {
    "sorting": ([[0.14, 0.11], [0.11, 0.02]], 0.16),
    "engulfment": ([[0.14, 0.11], [0.11, 0.02]], 0.16),
    "mixing": ([[0.10, 0.06], [0.06, 0.08]], 0.12),
}
"""Of each test the adhesions by type (plain, labelled), and that of the outline."""
PUBLISHED = {
    "sorting": {0: 103.92, 10: 90.75, 100: 84.53, 500: 80.55, 1000: 78.97},
    "engulfment": {0: 10.97, 10: 10.14, 100: 9.72, 500: 9.26, 1000: 9.23},
    "mixing": {0: 10.97, 10: 14.28, 100: 15.09, 500: 14.98, 1000: 14.88},
}
"""Length of unlike contacts by time, one run of Chaste each (repository `OpenVt2026Workshop` on GitHub)."""


class Model(runs.Section):
    """The vertex model of the benchmark."""

    across: int = Field(default=10, ge=2)
    """Cells in each row and column of the honeycomb."""
    inner_factor: float = Field(default=2.0, gt=0)
    """Factor of the adhesions between cells: Chaste sums over cells, so it counts these edges twice."""
    dt: float = Field(default=0.05, gt=0)
    """Time step, in units of friction over stiffness."""
    temperature: float = Field(default=1e-4, ge=0)
    """Diffusion constant of a free vertex."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(t1_threshold=0.1, tolerance=1e-5)
    """Relaxation of each step."""

    def types(self, test: str) -> np.ndarray:
        """0 for plain and 1 for labelled cells: a checkerboard, or the upper half."""
        row, column = np.divmod(np.arange(self.across**2), self.across)
        labelled = (row + column) % 2 == 0 if test == "sorting" else row >= self.across // 2
        return labelled.astype(int)

    def energy(self, test: str) -> vx.AbstractEnergy:
        """The energy of a test."""
        table, outline = ADHESIONS[test]
        tension = by_type(self.inner_factor * np.array(table), self.types(test), outline=outline)
        return AreaElasticity(1.0, 1.0) + tension

    def evolution(self, times: Any, **options: Any) -> vx.Evolution:
        """The motion with noise and friction 1."""
        if self.temperature:
            options["activity"] = vx.activities.ThermalNoise(self.temperature)
        substeps = max(round((times[1] - times[0]) / self.dt), 1)
        friction, relaxation = vx.dissipations.SubstrateFriction(1.0), self.relaxation.build()
        return vx.Evolution(friction, times, substeps=substeps, relaxation=relaxation, **options)


def honeycomb(across: int) -> vx.Tissue:
    """A free honeycomb of unit distance between centres; its cells have the area 0.866."""
    row, column = np.divmod(np.arange(across**2), across)
    centres = np.stack([column + 0.5 * (row % 2), row * np.sqrt(3) / 2], axis=1)
    angle = np.pi / 6 + np.pi / 3 * np.arange(6)
    corners = centres[:, None] + np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(3)
    # In units of (1/2, √3/6) corners have integer coordinates.
    grid = np.rint(corners.reshape(-1, 2) / [0.5, np.sqrt(3) / 6]).astype(int)
    _, first, number = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return vx.initialise.from_polygons(corners.reshape(-1, 2)[first], number.reshape(-1, 6)).tissue


@eqx.filter_jit
def unlike_length(frames: vx.Tissue, types: Any) -> Any:
    """Length of the contacts of cells of different types in each frame."""

    def one(tissue: vx.Tissue) -> Any:
        first, second = (jnp.take(types, c, mode="clip") for c in tissue.topology.edge_cells.T)
        unlike = (first != second) & ~tissue.topology.on_outline
        return jnp.sum(jnp.where(unlike, tissue.edge_lengths, 0))

    return eqx.filter_vmap(one)(frames)
