r"""Fluid tissues that become solid where they are sheared far enough.

Cells of given areas need, at a strain $\gamma$, a perimeter of at least
$\ell(\gamma) = \ell_0 + b (\gamma - \gamma_0)^2$. Where they want more, nothing resists; beyond the critical
strain, $|\gamma - \gamma_0| = \gamma_c$, the energy grows with the square of what is missing,
$e \propto ((\gamma - \gamma_0)^2 - \gamma_c^2)^2$. So there the stress $\tau = e'$ and the modulus $G = e''$,
which jumps from 0 to $\Delta G$, have

$$\frac{G - \Delta G}{\tau} = \frac{3}{\gamma - \gamma_0} \to \frac{3}{\gamma_c}$$

whatever the numbers (Merkel, Baumgarten, Tighe & Manning 2019, doi:10.1073/pnas.1815436116).

Here random tissues are quenched where they are solid, and keep their neighbours from then on. The target
shape factor at which each becomes fluid is found, and a little more makes it fluid. It is then sheared both
ways; since it need not begin at $\gamma_0$, $\gamma_c$ is half of the distance between both onsets.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from vertax.energies import ShapeFactorEnergy
from vertax.fitting import member
from vertax.mechanics import ramp, shear_modulus
from vertax.mesh import Tissue
from vertax.relax import Relaxation as Response
from vertax.runs import RunFolder, Section, TissueSection, scan, spread_of

from . import figures
from ._branch import Branch


class Stiffening(Section):
    """Fluid tissues, sheared slowly both ways until they are solid; cells keep their neighbours."""

    quench: float = Field(default=3.75, gt=0)
    """Target shape factor of all cells at which tissues are quenched; solid."""
    excess: list[float] = Field(default=[0.0025, 0.01], min_length=1)
    """How much more than at its transition the target shape factor of a tissue is."""
    replicates: int = Field(default=16, ge=0)
    """Independent tissues, of which those with a four-sided cell are left aside; 0 leaves all this out."""
    strain: float = Field(default=0.35, gt=0)
    """The largest shear."""
    steps: int = Field(default=35, ge=8)
    """Steps to it."""
    window: float = Field(default=0.05, gt=0)
    """The range of strains beyond the onset in which stress and modulus are compared."""
    zero_stress: float = Field(default=1e-6, gt=0)
    """Shear stress below which a tissue counts as fluid. (One cell with four sides may have energy, and is
    alone with it.)"""
    tissue: TissueSection = TissueSection(n_cells=64, lloyd_steps=5)
    """The tissues."""


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
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), config.replicates)
    drawn = config.tissue.draw(keys)
    # The minimal perimeter is that of one arrangement of cells.
    same = eqx.tree_at(lambda r: r.transitions, response, None, is_leaf=lambda x: x is None)
    quench = jnp.asarray(config.quench)
    edges = [_edge_of_the_solid(member(drawn, k), quench, response, same) for k in range(len(keys))]
    # A cell with four sides is content from 4 on only, and alone with its energy: it hides the transition.
    edges = [edge for edge in edges if _fewest_sides(edge[0]) > 4]
    if not edges:
        return {"sheared": 0}

    def compute(excess: float) -> dict[str, np.ndarray]:
        on, zero = jnp.asarray(strains), jnp.asarray(config.zero_stress)
        courses = [_shear(tissue, p0 + excess, on, zero, same) for tissue, p0 in edges]
        return {name: np.stack([np.asarray(c[name]) for c in courses]) for name in courses[0]}

    found = scan("excess", config.excess, compute, folder, progress=progress)
    pairs: list[tuple[Branch, Branch]] = []
    rows: list[dict[str, float]] = []
    for i, k in np.ndindex(len(config.excess), len(edges)):
        one = {name: values[i, k] for name, values in found.items()}
        sides = [branch(strains, one, side, config) for side in range(2)]
        if sides[0] is not None and sides[1] is not None:
            pairs.append((sides[0], sides[1]))
            row = {"tissue": k, "p0": float(edges[k][1]), "excess": config.excess[i]}
            rows.append(row | compared(*pairs[-1]))
    if not rows:
        return {"sheared": 0}
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    folder.save_table("stiffening", table)
    folder.save_figure("stiffening", figures.stiffening(pairs, table))
    chosen = {f"{excess:g}": table["excess"] == excess for excess in config.excess}
    return {
        "sheared": len(rows),
        "transition": spread_of(table["p0"]),
        "critical_strain": {
            name: spread_of(table["critical_strain"][c]) for name, c in chosen.items()
        },
        "factor": {name: spread_of(table["factor"][c]) for name, c in chosen.items()},
        "factor_median": {name: float(np.median(table["factor"][c])) for name, c in chosen.items()},
    }


def _fewest_sides(tissue: Tissue) -> int:
    return int(np.bincount(np.asarray(tissue.topology.cell), minlength=tissue.n_cells).min())


def branch(
    strains: Float[np.ndarray, " strains"],
    found: dict[str, np.ndarray],
    side: int,
    config: Stiffening,
) -> Branch | None:
    """The solid part of one way, or None if there is none that a line can be laid through.

    **Arguments:**

    - `strains`: the strains, from 0 on.
    - `found`: shear stresses and moduli along both ways, shape `(2, strains)`.
    - `side`: which way.
    - `config`: the section of the configuration.

    **Returns:** the branch, with positive stresses.
    """
    modulus, stress = found["modulus"][side], np.abs(found["stress"][side])
    solid = stress > config.zero_stress
    first = int(np.argmax(solid))
    near = slice(first, int(np.searchsorted(strains, strains[first] + config.window)) + 1)
    known = found["converged"][side][near].all() and np.isfinite(modulus[near]).all()
    x = strains[near]
    if first == 0 or not known or not solid[near].all() or x.size < 4:
        return None
    # Back from the first solid point to where the stress is 0, with the modulus there and its slope:
    # τ = G d - G' d² / 2.
    here, slope = modulus[first], (modulus[first + 1] - modulus[first]) / (x[1] - x[0])
    root = np.sqrt(max(here**2 - 2 * slope * stress[first], 0.0))
    onset = x[0] - 2 * stress[first] / (here + root)
    return Branch(x, stress[near], modulus[near], float(onset))


def compared(right: Branch, left: Branch) -> dict[str, float]:
    """What both ways of one tissue tell.

    **Arguments:**

    - `right`, `left`: both ways.

    **Returns:** critical strain, mean jump of the modulus, and the factor that theory says is 3.
    """
    centre = 0.5 * (right.onset - left.onset)
    lines = np.array([right.line(centre), left.line(-centre)])
    factor, jump = lines.mean(axis=0)
    critical = 0.5 * (right.onset + left.onset)
    return {"critical_strain": critical, "centre": centre, "jump": jump, "factor": factor}


@eqx.filter_jit
def _edge_of_the_solid(
    start: Tissue, p0: Float[Array, ""], response: Response, same: Response
) -> tuple[Tissue, Float[Array, ""]]:
    """A quenched tissue, still solid, and the shape factor at which it becomes fluid."""
    # The root of the energy is what is missing to the perimeter: nearly a line in the shape factor.
    step = jnp.asarray(0.01, p0.dtype)
    quenched = response(start, ShapeFactorEnergy(p0), throw=False)
    arrays, static = eqx.partition(quenched.tissue, eqx.is_array)

    def nearer(carry: tuple, _: None) -> tuple[tuple, Array]:
        arrays, p0, root, step = carry
        further = p0 + step
        found = same(eqx.combine(arrays, static), ShapeFactorEnergy(further), throw=False)
        slope = (jnp.sqrt(found.energy) - root) / step
        left = -jnp.sqrt(found.energy) / slope
        arrays = eqx.filter(found.tissue, eqx.is_array)
        # Not as far as the line says, lest it be passed.
        return (arrays, further, jnp.sqrt(found.energy), 0.7 * left), left

    first = arrays, p0, jnp.sqrt(quenched.energy), step
    (arrays, p0, *_), left = jax.lax.scan(nearer, first, length=8)
    return eqx.combine(arrays, static), p0 + left[-1]


@eqx.filter_jit
def _shear(
    rest: Tissue,
    p0: Float[Array, ""],
    strains: Float[Array, " strains"],
    zero_stress: Float[Array, ""],
    same: Response,
) -> dict[str, Array]:
    energy = ShapeFactorEnergy(p0)

    def way(sign: Array) -> dict[str, Array]:
        course = ramp(rest, energy, sign * strains, relaxation=same, throw=False)
        arrays, static = eqx.partition(course.frames, eqx.is_array)

        def modulus(part: tuple[Tissue, Array]) -> Array:
            arrays, stress = part
            tissue = eqx.combine(arrays, static)
            # Simple shear turns the tissue as well.
            turning = (stress[0, 0] - stress[1, 1]) / 2
            g = lambda: shear_modulus(tissue, energy, angle=0.0, throw=False) - turning
            resists = jnp.abs(stress[0, 1]) > zero_stress
            return jax.lax.cond(resists, g, lambda: jnp.zeros_like(turning))

        return {
            "stress": course.stresses[:, 0, 1],
            "modulus": jax.lax.map(modulus, (arrays, course.stresses)),
            "converged": course.converged,
        }

    return jax.lax.map(way, jnp.array([1.0, -1.0], strains.dtype))
