"""Energies in the form of Surface Evolver: coefficients of edges and cells."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vertax.energies import (
    AbstractEnergy,
    AreaElasticity,
    BoundedTension,
    LineTension,
    PerimeterElasticity,
    ShapeFactorEnergy,
)
from vertax.external._simulator import SimulatorError


class Terms(NamedTuple):
    """The coefficients of an energy: tensions of edges, quadratic terms of areas and perimeters."""

    tension: Float[np.ndarray, " edges"]
    area_stiffness: Float[np.ndarray, " cells"]
    area: Float[np.ndarray, " cells"]
    perimeter_stiffness: Float[np.ndarray, " cells"]
    perimeter: Float[np.ndarray, " cells"]

    @classmethod
    def of(cls, energy: AbstractEnergy, n_cells: int, n_edges: int) -> Terms:
        """The coefficients of a sum of supported energies."""
        tension = np.zeros(n_edges)
        targets: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        per_cell = lambda x: np.broadcast_to(np.asarray(x, float), n_cells)

        def add(name: str, stiffness: Any, target: Any) -> None:
            # The sum of two parabolas is a parabola, up to a constant.
            k, x = per_cell(stiffness), per_cell(target)
            if name in targets:
                k0, x0 = targets[name]
                k, x = k0 + k, np.divide(k0 * x0 + k * x, k0 + k)
            targets[name] = (k, x)

        for term in terms_of(energy):
            if isinstance(term, LineTension | BoundedTension):
                tension = tension + tension_of(term)
            elif isinstance(term, AreaElasticity):
                add("area", term.stiffness, term.target_area)
            elif isinstance(term, PerimeterElasticity):
                add("perimeter", term.stiffness, term.target_perimeter)
            elif isinstance(term, ShapeFactorEnergy):
                area = np.asarray(term.mean_area, float)
                add("area", 2 / area**2, area)
                add("perimeter", 2 / area, np.asarray(term.target_shape_factor) * np.sqrt(area))
            else:
                raise SimulatorError(
                    f"Surface Evolver does not support {type(term).__name__}: the energy must be a sum of "
                    "LineTension, BoundedTension, AreaElasticity, PerimeterElasticity and ShapeFactorEnergy."
                )
        zeros = (np.zeros(n_cells), np.zeros(n_cells))
        return cls(tension, *targets.get("area", zeros), *targets.get("perimeter", zeros))


def terms_of(energy: AbstractEnergy) -> tuple[AbstractEnergy, ...]:
    """The terms of a sum, or the energy itself."""
    return getattr(energy, "terms", (energy,))


def tension_of(term: Any) -> Any:
    """The tensions of a term, computed by NumPy."""
    if isinstance(term, BoundedTension):
        low, high = (np.asarray(x, float) for x in (term.low, term.high))
        return low + (high - low) / (1 + np.exp(-np.asarray(term.logits, float)))
    return np.asarray(term.tension, float)


def parameter_derivatives(
    energy: AbstractEnergy,
    lengths: Float[np.ndarray, " edges"],
    areas: Float[np.ndarray, " cells"],
    perimeters: Float[np.ndarray, " cells"],
    pressures: Float[np.ndarray, " cells"] | None,
) -> AbstractEnergy:
    """The energy with its partial derivatives in the place of its parameters.

    `pressures` are the multipliers of fixed areas; None for elastic areas.
    """

    def with_derivatives(term: Any, **slopes: np.ndarray) -> Any:
        for name, slope in slopes.items():
            old = getattr(term, name)
            if not isinstance(old, np.ndarray | np.generic):
                continue
            new = np.sum(slope) if old.ndim == 0 else slope
            term = eqx.tree_at(lambda t, n=name: getattr(t, n), term, np.asarray(new, old.dtype))
        return term

    def derived(term: Any) -> Any:
        if isinstance(term, LineTension):
            return with_derivatives(term, tension=lengths)
        if isinstance(term, BoundedTension):
            tension, low, high = tension_of(term), float(term.low), float(term.high)
            return with_derivatives(
                term, logits=lengths * (tension - low) * (high - tension) / (high - low)
            )
        if isinstance(term, AreaElasticity):
            if pressures is not None:
                return with_derivatives(term, stiffness=0 * areas, target_area=pressures)
            excess = areas - np.asarray(term.target_area)
            return with_derivatives(
                term, stiffness=0.5 * excess**2, target_area=-np.asarray(term.stiffness) * excess
            )
        if isinstance(term, PerimeterElasticity):
            excess = perimeters - np.asarray(term.target_perimeter)
            slopes = (0.5 * excess**2, -np.asarray(term.stiffness) * excess)
            return with_derivatives(term, stiffness=slopes[0], target_perimeter=slopes[1])
        area = np.asarray(term.mean_area, float)
        excess = perimeters / np.sqrt(area) - np.asarray(term.target_shape_factor)
        by_area = -2 * (areas / area - 1) * areas / area**2 - excess * perimeters / area**1.5
        return with_derivatives(term, target_shape_factor=-2 * excess, mean_area=by_area)

    terms = tuple(derived(term) for term in terms_of(energy))
    if hasattr(energy, "terms"):
        return eqx.tree_at(lambda e: e.terms, energy, terms)
    return terms[0]
