r"""Fluid tissues that become solid where they are sheared far enough.

Cells of given areas need, at a strain $\gamma$, a perimeter of at least
$\ell(\gamma) = \ell_0 + b (\gamma - \gamma_0)^2$. Where they want more, nothing resists; beyond the critical
strain, $|\gamma - \gamma_0| = \gamma_c$, the energy grows with the square of what is missing,
$e \propto ((\gamma - \gamma_0)^2 - \gamma_c^2)^2$. So there the stress $\tau = e'$ and the modulus $G = e''$,
which jumps from 0 to $\Delta G$, have

$$\frac{G - \Delta G}{\tau} = \frac{3}{\gamma_c}$$

whatever the numbers (Merkel, Baumgarten, Tighe & Manning 2019, doi:10.1073/pnas.1815436116). Here the
strain is simple shear both ways from a random fluid tissue, which need not be at $\gamma_0$: so $\gamma_c$ is
half of the distance between both onsets.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from vertax.energies import ShapeFactorEnergy
from vertax.mechanics import ramp, shear_modulus
from vertax.mesh import Tissue
from vertax.responses import Relaxation as Response
from vertax.runs import RunFolder, Section, TissueSection, scan

from . import figures


class Stiffening(Section):
    """Fluid tissues, sheared slowly both ways until they are solid; cells keep their neighbours."""

    shape_factors: list[float] = Field(default=[3.9, 3.92, 3.95, 4.0], min_length=1)
    """Target shape factors of all cells."""
    replicates: int = Field(default=20, ge=0)
    """Independent tissues for each of them; 0 leaves all this out."""
    strain: float = Field(default=0.8, gt=0)
    """The largest shear."""
    steps: int = Field(default=80, ge=8)
    """Steps to it."""
    window: float = Field(default=0.06, gt=0)
    """The range of strains beyond the onset in which stress and modulus are compared."""
    zero_energy: float = Field(default=1e-8, gt=0)
    """Energy per cell below which a tissue counts as fluid."""
    tissue: TissueSection = TissueSection(n_cells=64, lloyd_steps=2)
    """The tissues."""


class Branch(NamedTuple):
    """One tissue sheared one way, from its onset on."""

    strains: Float[np.ndarray, " points"]
    stresses: Float[np.ndarray, " points"]
    moduli: Float[np.ndarray, " points"]
    onset: float
    """The strain at which it becomes solid."""
    jump: float
    """Its modulus there."""
    slope: float
    """Of the modulus over the stress beyond."""


def stiffen(
    config: Stiffening, seed: int, response: Response, folder: RunFolder, *, progress: bool
) -> dict[str, Any]:
    """Shear fluid tissues and compare excess modulus and stress.

    **Arguments:**

    - `config`: the section of the configuration.
    - `seed`: of the run.
    - `response`: how tissues are relaxed before they are sheared.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics; none without replicates.
    """
    if not config.replicates:
        return {}
    strains = np.linspace(0, config.strain, config.steps + 1)

    def compute(p0: float) -> dict[str, np.ndarray]:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), config.replicates)
        arguments = (config.tissue.draw(keys), jnp.asarray(p0), jnp.asarray(strains), response)
        return {name: np.asarray(value) for name, value in _shear(*arguments).items()}

    found = scan("sheared p0", config.shape_factors, compute, folder, progress=progress)
    pairs: list[tuple[Branch, Branch]] = []
    rows: list[dict[str, float]] = []
    for i, k in np.ndindex(len(config.shape_factors), config.replicates):
        one = {name: values[i, k] for name, values in found.items()}
        sides = [branch(strains, one, side, config) for side in range(2)]
        if sides[0] is not None and sides[1] is not None:
            pairs.append((sides[0], sides[1]))
            rows.append({"p0": config.shape_factors[i], "tissue": k} | compared(*pairs[-1]))
    if not rows:
        return {"sheared": 0}
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    folder.save_table("stiffening", table)
    folder.save_figure("stiffening", figures.stiffening(pairs, table))
    factor = table["factor"]
    return {
        "sheared": len(rows),
        "critical_strain": float(table["critical_strain"].mean()),
        "factor": float(factor.mean()),
        "factor_error": float(factor.std() / np.sqrt(factor.size)),
        "factor_median": float(np.median(factor)),
    }


def branch(
    strains: Float[np.ndarray, " strains"],
    found: dict[str, np.ndarray],
    side: int,
    config: Stiffening,
) -> Branch | None:
    """The solid part of one way, or None if there is none that a line can be laid through.

    **Arguments:**

    - `strains`: the strains, from 0 on.
    - `found`: energies per cell, shear stresses and moduli along both ways, shape `(2, strains)`.
    - `side`: which way.
    - `config`: the section of the configuration.

    **Returns:** the branch, with positive stresses.
    """
    energy, modulus = found["energy"][side], found["modulus"][side]
    stress = np.abs(found["stress"][side])
    solid = energy > config.zero_energy
    known = found["converged"][side] & (~solid | np.isfinite(modulus))
    first = int(np.argmax(solid))
    if first < 2 or not known.all() or not solid[first:].all():
        return None
    near = slice(first, int(np.searchsorted(strains, strains[first] + config.window)) + 1)
    x, root = strains[near], np.sqrt(energy[near])
    if x.size < 4:
        return None
    # The root of the energy is what is missing to the perimeter: smooth, and 0 at the onset.
    zeros = np.roots(np.polyfit(x - x[0], root, 2))
    zeros = zeros[np.isreal(zeros)].real
    if zeros.size == 0:
        return None
    onset = x[0] + zeros[np.argmin(np.abs(zeros))]
    slope, jump = np.polyfit(stress[near], modulus[near], 1)
    return Branch(x, stress[near], modulus[near], float(onset), float(jump), float(slope))


def compared(right: Branch, left: Branch) -> dict[str, float]:
    """What both ways of one tissue tell.

    **Arguments:**

    - `right`, `left`: both ways.

    **Returns:** critical strain, mean jump of the modulus, and the factor that theory says is 3.
    """
    critical = 0.5 * (right.onset + left.onset)
    return {
        "critical_strain": critical,
        "centre": 0.5 * (right.onset - left.onset),
        "jump": 0.5 * (right.jump + left.jump),
        "factor": critical * 0.5 * (right.slope + left.slope),
    }


@eqx.filter_jit
def _shear(
    first: Tissue, p0: Float[Array, ""], strains: Float[Array, " strains"], response: Response
) -> dict[str, Array]:
    energy = ShapeFactorEnergy(p0)
    # The minimal perimeter is that of one arrangement of cells.
    same = eqx.tree_at(lambda r: r.transitions, response, None, is_leaf=lambda x: x is None)

    def one(start: Tissue) -> dict[str, Array]:
        rest = response(start, energy, throw=False).tissue

        def way(sign: Array) -> dict[str, Array]:
            course = ramp(rest, energy, sign * strains, relaxation=same, throw=False)
            arrays, static = eqx.partition(course.frames, eqx.is_array)

            def modulus(part: tuple[Tissue, Array, Array]) -> Array:
                arrays, value, stress = part
                tissue = eqx.combine(arrays, static)
                # Simple shear turns the tissue as well.
                turning = (stress[0, 0] - stress[1, 1]) / 2
                g = lambda: shear_modulus(tissue, energy, angle=0.0, throw=False) - turning
                return jax.lax.cond(value > 1e-10, g, lambda: jnp.zeros_like(value))

            return {
                "energy": course.energies / start.n_cells,
                "stress": course.stresses[:, 0, 1],
                "modulus": jax.lax.map(modulus, (arrays, course.energies, course.stresses)),
                "converged": course.converged,
            }

        return jax.lax.map(way, jnp.array([1.0, -1.0], strains.dtype))

    return jax.lax.map(one, first)
