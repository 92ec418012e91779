"""Synthetic inverse problems: a tissue with hidden parameters, and where a fit starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from pydantic import Field

from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.mesh import Tissue
from vertax.responses import equilibrate
from vertax.runs._config import Section
from vertax.runs._sections import Relaxation


class TissueSection(Section):
    """The tissue, in a square box in which the mean area of a cell is 1."""

    n_cells: int = Field(default=20, ge=4)
    """Number of cells."""
    lloyd_steps: int = Field(default=0, ge=0)
    """Steps of Lloyd's algorithm, which make the first tissue more regular."""


class ShapeFactors(Section):
    """The normal distribution that the hidden shape factors are drawn from."""

    mean: float = Field(default=3.7, gt=0)
    """Mean."""
    deviation: float = Field(default=0.1, ge=0)
    """Standard deviation."""


class Scene(eqx.Module):
    """What is hidden, what is to be matched, and where the fit starts."""

    truth: ShapeFactorEnergy
    target: Tissue
    guess: ShapeFactorEnergy
    initial: Tissue


def make_scene(
    keys: Key[Array, "3"],
    tissue: TissueSection,
    truth: ShapeFactors,
    relaxation: Relaxation,
    *,
    redrawn: bool = True,
) -> Scene:
    """Draw a tissue and its hidden shape factors, relax it, and relax it again for a guess of them.

    **Arguments:**

    - `keys`: three, of the hidden shape factors, of the guess and of the tissue.
    - `tissue`, `truth`: what to draw.
    - `relaxation`: how the guess is relaxed; the hidden tissue is a true equilibrium in any case.
    - `redrawn`: guess by another draw, and not by the mean.

    **Returns:** the scene.

    **Raises:**

    - `ValueError` if the hidden tissue does not reach equilibrium.
    """
    draw = lambda k: truth.mean + truth.deviation * jax.random.normal(k, (tissue.n_cells,))
    hidden = ShapeFactorEnergy(draw(keys[0]))
    guess = ShapeFactorEnergy(draw(keys[1]) if redrawn else jnp.full(tissue.n_cells, truth.mean))
    first = periodic_voronoi(tissue.n_cells, key=keys[2], lloyd_steps=tissue.lloyd_steps)
    # The hidden tissue is a true equilibrium, however coarsely the fit is told to relax.
    relaxed = equilibrate(first, hidden, **Relaxation().options(), throw=False)
    if not relaxed.converged:
        raise ValueError(
            f"The hidden tissue did not reach equilibrium (largest force {relaxed.max_force:.1e}): "
            "choose another seed, or a smaller truth.mean or truth.deviation."
        )
    target = relaxed.tissue
    # The guess relaxes from the target's topology, because vertices are compared by number. A
    # coarse relaxation need not reach the tolerance here; the fit reports how often it did.
    initial = equilibrate(target, guess, **relaxation.options(), throw=False).tissue
    return Scene(hidden, target, guess, initial)


def same_neighbours(tissue: Tissue, other: Tissue) -> bool:
    """Whether the same cells touch in two tissues, however their edges are numbered."""

    def pairs(t: Tissue) -> list[list[int]]:
        return sorted(np.sort(np.asarray(t.topology.edge_cells), axis=1).tolist())

    return pairs(tissue) == pairs(other)


def pearson_of(
    true: Float[np.ndarray, "replicates cells"], inferred: Float[np.ndarray, "replicates cells"]
) -> Float[np.ndarray, " replicates"]:
    """Pearson's correlation of inferred with true parameters, for each replicate."""
    return np.array([np.corrcoef(a, b)[0, 1] for a, b in zip(true, inferred, strict=True)])


Tree = TypeVar("Tree", bound=Any)


def stack(trees: Sequence[Tree]) -> Tree:
    """A batch of pytrees of one structure: each array gets a leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x) if eqx.is_array(x[0]) else x[0], *trees)
