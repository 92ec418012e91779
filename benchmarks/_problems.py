"""Inverse problems of the scripts."""

from __future__ import annotations

from typing import Any

import jax

import vertax as vx


def kicked_problem(
    rest: vx.Tissue, energy: vx.AbstractEnergy, **options: Any
) -> vx.InverseProblem[Any]:
    """The distance of vertices from a target near an equilibrium."""
    kicks = 0.01 * jax.random.normal(jax.random.key(2), rest.vertices.shape)
    cost = vx.costs.VertexDistance(rest.with_vertices(rest.vertices + kicks))
    adjoint = vx.ImplicitDifferentiation(throw=False)
    return vx.InverseProblem(rest, energy, cost, adjoint=adjoint, **options)
