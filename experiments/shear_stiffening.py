r"""Fluid tissues that become solid under shear, and the ratio of their modulus and stress.

At a strain $\gamma$ cells of fixed areas need a perimeter of at least
$\ell(\gamma) = \ell_0 + b (\gamma - \gamma_0)^2$. Beyond the critical strain,
$|\gamma - \gamma_0| = \gamma_c$, that exceeds their target and
$e \propto ((\gamma - \gamma_0)^2 - \gamma_c^2)^2$. The stress $\tau = e'$ and the modulus $G = e''$, which
jumps from 0 to $\Delta G$, then have the ratio

$$\frac{G - \Delta G}{\tau} = \frac{3}{\gamma - \gamma_0} \to \frac{3}{\gamma_c}$$

without a free parameter (Merkel et al. 2019, doi:10.1073/pnas.1815436116). Random tissues are quenched in the
solid phase and keep their topology. The target shape factor of each is increased to slightly beyond its
transition, and the tissue is sheared in both directions: $\gamma_c$ is half of the distance of both onsets.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import columns, scan, spread_of
from vertax import mechanics, plotting, runs
from vertax.energies import ShapeFactorEnergy
from vertax.plotting import INK, SERIES


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    quench: float = Field(default=3.75, gt=0)
    """Target shape factor of the quench, in the solid phase."""
    excess: list[float] = Field(default=[0.0025, 0.01], min_length=1)
    """Increases of the target shape factor of a tissue beyond its transition."""
    replicates: int = Field(default=16, ge=1)
    """Independent tissues; those with a four-sided cell are left out."""
    strain: float = Field(default=0.35, gt=0)
    """Largest shear strain."""
    steps: int = Field(default=35, ge=8)
    """Steps to it."""
    window: float = Field(default=0.05, gt=0)
    """Range of strains beyond the onset in which stress and modulus are compared."""
    zero_stress: float = Field(default=1e-6, gt=0)
    """Shear stress below which a tissue counts as fluid."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=64, lloyd_steps=5)
    """The tissues."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=1000, contacts=False)
    """Relaxation of the tissues; moduli do not include forces of contacts."""


class Branch(NamedTuple):
    """A tissue sheared in one direction, beyond its onset; stresses are positive."""

    strains: np.ndarray
    stresses: np.ndarray
    moduli: np.ndarray
    onset: float
    """The strain at which it becomes solid."""

    def line(self, centre: float) -> np.ndarray:
        """Slope and offset of the modulus over stress per strain, counted from a centre."""
        return np.polyfit(self.stresses / (self.strains - centre), self.moduli, 1)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The transitions, critical strains, and factors between excess modulus and stress per strain."""
    strains = np.linspace(0, config.strain, config.steps + 1)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 1), config.replicates)
    drawn, response = config.tissue.draw(keys), config.relaxation.build()
    fixed = eqx.tree_at(lambda r: r.transitions, response, None, is_leaf=lambda x: x is None)
    tissues = [vx.fitting.member(drawn, k) for k in range(config.replicates)]
    edges = [find_transition(t, jnp.asarray(config.quench), response, fixed) for t in tissues]
    # A cell with four sides stores energy up to a target of 4 and hides the transition of the tissue.
    edges = [(tissue, p0) for tissue, p0 in edges if fewest_sides(tissue) > 4]
    if not edges:
        return {"sheared": 0}
    settings = jnp.asarray(strains), jnp.asarray(config.zero_stress), fixed
    compute = partial(shear_all, edges, settings)
    curves = scan(folder, "excess", config.excess, compute, progress=progress)
    pairs, rows = [], []
    for i, k in np.ndindex(len(config.excess), len(edges)):
        one = {name: values[i, k] for name, values in curves.items()}
        right, left = (branch(strains, one, side, config) for side in range(2))
        if right is not None and left is not None:
            pairs.append((right, left))
            row = {"tissue": k, "p0": float(edges[k][1]), "excess": config.excess[i]}
            rows.append(row | compare(right, left))
    if not rows:
        return {"sheared": 0}
    table = columns(rows)
    folder.save_table("stiffening", table)
    folder.save_figure("stiffening", plot_stiffening(pairs, table))
    chosen = {f"{excess:g}": table["excess"] == excess for excess in config.excess}
    by_excess = lambda name, f: {key: f(table[name][rows]) for key, rows in chosen.items()}
    return {
        "sheared": len(rows),
        "transition": spread_of(table["p0"]),
        "critical_strain": by_excess("critical_strain", spread_of),
        "factor": by_excess("factor", spread_of),
        "factor_median": by_excess("factor", lambda values: float(np.median(values))),
    }


def shear_all(edges: list[Any], settings: tuple[Any, ...], excess: float) -> dict[str, np.ndarray]:
    """The curves of all tissues, at one excess of the shape factor over that of the transition."""
    return columns([shear(tissue, p0 + excess, *settings) for tissue, p0 in edges])


def fewest_sides(tissue: vx.Tissue) -> int:
    """The smallest number of sides of a cell."""
    return int(np.bincount(np.asarray(tissue.topology.cell), minlength=tissue.n_cells).min())


def branch(strains: np.ndarray, curves: dict[str, np.ndarray], side: int, config: Config) -> Branch | None:
    """The solid part of the curves in one direction; None if it has no onset or too few points for a line."""
    modulus, stress = curves["modulus"][side], np.abs(curves["stress"][side])
    solid = stress > config.zero_stress
    first = int(np.argmax(solid))
    near = slice(first, int(np.searchsorted(strains, strains[first] + config.window)) + 1)
    valid, x = curves["converged"][side][near] & np.isfinite(modulus[near]) & solid[near], strains[near]
    if first == 0 or not valid.all() or x.size < 4:
        return None
    # The onset d before the first solid point, where τ = G d - G' d² / 2.
    g, slope = modulus[first], (modulus[first + 1] - modulus[first]) / (x[1] - x[0])
    root = np.sqrt(max(g**2 - 2 * slope * stress[first], 0.0))
    return Branch(x, stress[near], modulus[near], float(x[0] - 2 * stress[first] / (g + root)))


def compare(right: Branch, left: Branch) -> dict[str, float]:
    """Critical strain, centre, mean jump of the modulus, and the factor, which theory predicts to be 3."""
    centre, critical = 0.5 * (right.onset - left.onset), 0.5 * (right.onset + left.onset)
    factor, jump = np.mean([right.line(centre), left.line(-centre)], axis=0)
    return {"critical_strain": critical, "centre": centre, "jump": jump, "factor": factor}


@eqx.filter_jit
def find_transition(start: vx.Tissue, p0: Any, response: Any, fixed: Any) -> tuple[vx.Tissue, Any]:
    """A quenched tissue in the solid phase, and the shape factor at which it becomes fluid."""
    # The root of the energy is nearly linear in the shape factor: secant steps, shortened to 0.7.
    quenched = response(start, ShapeFactorEnergy(p0), throw=False)
    arrays, static = eqx.partition(quenched.tissue, eqx.is_array)

    def step(carry: tuple, _: None) -> tuple[tuple, Any]:
        arrays, p0, root, length = carry
        further = p0 + length
        equilibrium = fixed(eqx.combine(arrays, static), ShapeFactorEnergy(further), throw=False)
        slope = (jnp.sqrt(equilibrium.energy) - root) / length
        rest = -jnp.sqrt(equilibrium.energy) / slope
        arrays = eqx.filter(equilibrium.tissue, eqx.is_array)
        return (arrays, further, jnp.sqrt(equilibrium.energy), 0.7 * rest), rest

    first = arrays, p0, jnp.sqrt(quenched.energy), jnp.asarray(0.01, p0.dtype)
    (arrays, p0, *_), rest = jax.lax.scan(step, first, length=8)
    return eqx.combine(arrays, static), p0 + rest[-1]


@eqx.filter_jit
def shear(rest: vx.Tissue, p0: Any, strains: Any, zero_stress: Any, fixed: Any) -> dict[str, Any]:
    """Shear stress, modulus and convergence at each strain, to the right and to the left."""
    energy = ShapeFactorEnergy(p0)

    def one_side(sign: Any) -> dict[str, Any]:
        course = mechanics.ramp(rest, energy, sign * strains, relaxation=fixed, throw=False)
        arrays, static = eqx.partition(course.frames, eqx.is_array)

        def modulus(part: tuple) -> Any:
            tissue, stress = eqx.combine(part[0], static), part[1]
            # Simple shear also rotates the tissue.
            rotation = (stress[0, 0] - stress[1, 1]) / 2
            solid = lambda: mechanics.shear_modulus(tissue, energy, angle=0.0, throw=False) - rotation
            return jax.lax.cond(jnp.abs(stress[0, 1]) > zero_stress, solid, lambda: jnp.zeros_like(rotation))

        moduli = jax.lax.map(modulus, (arrays, course.stresses))
        return {
            "stress": course.stresses[:, 0, 1],
            "modulus": moduli,
            "converged": course.results == vx.RESULTS.successful,
        }

    return jax.lax.map(one_side, jnp.array([1.0, -1.0], strains.dtype))


@plotting.house_style()
def plot_stiffening(pairs: list[tuple[Branch, Branch]], table: dict[str, np.ndarray]) -> Any:
    """Stress and excess modulus beyond the critical strain, and the factor between them."""
    figure, ((stress, excess, factor),) = plotting.new_figure(1, 3, width=2.3)
    style: Any = {"color": SERIES[0], "lw": 0.5, "alpha": 0.5}
    for pair, centre in zip(pairs, table["centre"], strict=True):
        for side, c in zip(pair, (centre, -centre), strict=True):
            stress.plot(side.strains, side.stresses, **style)
            ratio = 3 * side.stresses / (side.strains - c)
            excess.plot(ratio, side.moduli - side.line(c)[1], **style)
    stress.set(xlabel="shear strain", ylabel="shear stress", ylim=(0, None))
    top = min(excess.get_xlim()[1], excess.get_ylim()[1])
    excess.plot([0, top], [0, top], color=INK, lw=0.8, ls="--")
    excess.set(xlabel=r"$3\,\tau / (\gamma - \gamma_0)$", ylabel=r"excess modulus $G - \Delta G$")
    factor.plot(table["critical_strain"], table["factor"], "o", ms=3, color=SERIES[0])
    factor.axhline(3, color=INK, lw=0.8, ls="--")
    factor.set(xlabel=r"critical strain $\gamma_c$", ylim=(0, 6))
    factor.set_ylabel(r"factor $(\gamma - \gamma_0) (G - \Delta G) / \tau$")
    return figure
