"""Synthetic inverse problems: a tissue with hidden parameters, and the start of a fit."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from vertax._base.checks import check_choice
from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.mesh import Tissue
from vertax.relax import Relaxation


class Scene(eqx.Module):
    """Hidden parameters, the target that they produce, and the start of the fit."""

    truth: ShapeFactorEnergy
    """The hidden parameters."""
    target: Tissue
    """Their equilibrium."""
    guess: ShapeFactorEnergy
    """The parameters that the fit starts from."""
    initial: Tissue
    """Their equilibrium."""
    converged: Bool[Array, ""]
    """Whether the initial tissue is in equilibrium; after a coarse relaxation it may not be."""


def shape_factor_scene(
    n_cells: int,
    *,
    key: Key[Array, ""] | Key[Array, "3"],
    mean: float = 3.7,
    deviation: float = 0.1,
    lloyd_steps: int = 0,
    guess: str = "redrawn",
    start: str = "target",
    response: Relaxation | None = None,
    target_response: Relaxation | None = None,
) -> Scene:
    """Draw a periodic tissue and hidden shape factors, relax it, and relax it again for a guess of them.

    ```python
    scene = vx.inference.shape_factor_scene(20, key=jax.random.key(0))
    problem = vx.InverseProblem(scene.initial, scene.guess, vx.costs.VertexDistance(scene.target))
    ```

    **Arguments:**

    - `n_cells`: number of cells, of mean area 1.
    - `key`: of all draws; or three keys: of the hidden shape factors, of the guess and of the tissue.
    - `mean`, `deviation`: of the normal distribution of the shape factors.
    - `lloyd_steps`: steps of Lloyd's algorithm, which make the first tissue more regular.
    - `guess`: start from another draw (`"redrawn"`), or from the mean in all cells (`"mean"`).
    - `start`: where the guess relaxes from: the `"target"`, so that vertices can be compared by number if no
        T1 transition occurs; or the `"first"` tissue, which the target came from, so that neighbours differ.
    - `response`: how the guess is relaxed, [`Relaxation`][vertax.Relaxation]`()` by default.
    - `target_response`: how the hidden tissue is relaxed; left out, with the transitions of `response` and
        otherwise by default: it is a true equilibrium, however coarsely the guess relaxes.

    **Returns:** the [`Scene`][vertax.inference.Scene].

    **Raises:**

    - `ValueError` for an unknown `guess` or `start`, or if the hidden tissue does not reach equilibrium.
    """
    check_choice("guess", guess, ("redrawn", "mean"))
    check_choice("start", start, ("target", "first"))
    response = Relaxation() if response is None else response
    if target_response is None:
        target_response = Relaxation(transitions=response.transitions)
    keys = key if key.ndim else jax.random.split(key, 3)
    draw = lambda k: mean + deviation * jax.random.normal(k, (n_cells,))
    hidden = ShapeFactorEnergy(draw(keys[0]))
    guessed = ShapeFactorEnergy(draw(keys[1]) if guess == "redrawn" else jnp.full(n_cells, mean))
    first = periodic_voronoi(n_cells, key=keys[2], lloyd_steps=lloyd_steps)
    relaxed = target_response(first, hidden, throw=False)
    if not relaxed.converged:
        raise ValueError(
            f"The hidden tissue did not reach equilibrium (largest force {relaxed.max_force:.1e}): "
            "choose another seed, or a smaller `mean` or `deviation` of its shape factors."
        )
    target = relaxed.tissue
    origin = target if start == "target" else first
    initial = response(origin, guessed, throw=False)
    return Scene(hidden, target, guessed, initial.tissue, initial.converged)
