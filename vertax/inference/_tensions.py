"""Relative tensions and pressures of a segmented cluster, with their errors."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vertax.costs import AbstractLeastSquaresCost, EdgeDistance
from vertax.energies import AbstractEnergy, LocalSum
from vertax.fitting import Fit, InverseProblem, uncertainty
from vertax.inference._foam import foam_terms, force_balance
from vertax.initialise import Segmentation
from vertax.responses import Relaxation


class RelativeTensions(AbstractLeastSquaresCost):
    r"""Penalty for tensions that differ from 1: $\tfrac12\sum_e ((\gamma_e - 1)/\sigma)^2$.

    **Arguments:**

    - `deviation`: $\sigma$, the standard deviation of relative tensions before the image was seen.
    """

    deviation: float

    def residuals(self, tissue: Any, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Differences over the standard deviation."""
        return (foam_terms(energy)[1].tension - 1) / self.deviation


class Tensions(eqx.Module):
    """What was inferred, relative to the mean tension, where the mean area of a cell is 1."""

    tension: Float[np.ndarray, " edges"]
    """Tension of each edge; their mean is 1."""
    tension_deviation: Float[np.ndarray, " edges"]
    """Their standard deviations."""
    pressure: Float[np.ndarray, " cells"]
    """Pressure of each cell, that of the exterior being 0."""
    pressure_deviation: Float[np.ndarray, " cells"]
    """Their standard deviations."""


class TensionProblem(eqx.Module):
    """A segmented cluster, and the inverse problem of its tensions and pressures.

    Made by [`tension_problem`][vertax.inference.tension_problem].
    """

    problem: InverseProblem[LocalSum]
    """The inverse problem; it starts from the balance of forces."""
    segmentation: Segmentation
    """The cluster."""
    balanced: LocalSum
    """The energy that balances forces best in the shape as it was seen."""

    def tensions(self, fit: Fit[Any]) -> Tensions:
        """Relative tensions and pressures with their standard deviations (Laplace approximation).

        **Arguments:**

        - `fit`: of `problem`.

        **Returns:** the [`Tensions`][vertax.inference.Tensions].
        """
        parameters, constants = eqx.partition(fit.energy, self.problem.trainable)
        flat, unravel = ravel_pytree(parameters)

        # Areas follow their targets, so a pressure changes with the equilibrium.
        def relative(x: Float[Array, " parameters"]) -> Float[Array, " edges_and_cells"]:
            energy = eqx.combine(unravel(x), constants)
            area, tension = foam_terms(energy)
            relaxed = self._relaxed(fit.tissue, energy)
            values = jnp.concatenate([tension.tension, area.pressures(relaxed)])
            return values / jnp.mean(tension.tension)

        slopes = jax.jit(jax.jacfwd(relative))(flat)
        # Points of one edge move together: a mesh has no more independent positions than vertices and
        # angles. The prior adds one residual an edge.
        n_edges, n_vertices = fit.tissue.n_edges, fit.tissue.n_vertices
        angles = int(fit.tissue.is_arc.sum())
        n_independent = 2 * n_vertices + angles + n_edges
        known = uncertainty(self.problem, fit, n_independent=n_independent)
        covariance = slopes @ known.covariance @ slopes.T
        values, deviations = np.asarray(relative(flat)), np.sqrt(np.diag(np.asarray(covariance)))
        return Tensions(
            values[:n_edges], deviations[:n_edges], values[n_edges:], deviations[n_edges:]
        )

    def distances(self, *energies: AbstractEnergy) -> list[float]:
        """How far the edges of equilibria are from those that were seen.

        **Arguments:**

        - `energies`: such as `balanced`, or that of a fit.

        **Returns:** for each the root mean square distance over all edges, in pixels.
        """
        seen = self.segmentation.tissue
        cost = EdgeDistance(seen)

        @eqx.filter_jit
        def squared(energy: AbstractEnergy) -> Float[Array, ""]:
            relaxed = self._relaxed(seen, energy)
            away = jnp.mean(relaxed.vertices - seen.vertices, axis=0)
            return 2 * cost(relaxed.with_vertices(relaxed.vertices - away), energy)

        return [
            float(jnp.sqrt(squared(energy))) / self.segmentation.pixel_size for energy in energies
        ]

    def inner_distance(self, fit: Fit[Any]) -> float:
        """The same for a fit and for edges between two cells alone.

        The outline of a cluster that was cut out of a tissue has corners where cells beyond it met, which
        no arc has.

        **Arguments:**

        - `fit`: of `problem`.

        **Returns:** the root mean square distance, in pixels.
        """
        seen = self.segmentation.tissue
        inner = ~np.asarray(seen.topology.on_outline)
        residuals = np.asarray(EdgeDistance(seen).residuals(fit.tissue, fit.energy))
        squared = np.sum(residuals.reshape(len(inner), -1) ** 2, axis=1)[inner].sum()
        lengths = np.asarray(seen.edge_lengths)
        share = lengths[inner].sum() / lengths.sum()
        return float(np.sqrt(squared / share)) / self.segmentation.pixel_size

    def _relaxed(self, tissue: Any, energy: AbstractEnergy) -> Any:
        return self.problem.response(tissue, energy, throw=False).tissue


def tension_problem(
    segmentation: Segmentation,
    *,
    stiffness: float = 20.0,
    low: float = 0.05,
    high: float = 4.0,
    prior: float = 0.5,
    noise: float = 1.0,
    response: Relaxation | None = None,
) -> TensionProblem:
    """The inverse problem of the tensions and pressures of a segmented cluster.

    ```python
    cluster = vx.initialise.from_labels(mask, boundary="free", inner_arcs=True)
    foam = vx.inference.tension_problem(cluster)
    fit = vx.fit(foam.problem, optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8), 30)
    foam.tensions(fit).tension  # relative to their mean
    ```

    The foam model E2 (a tension in each edge, a pressure in each cell) is to have its edges where they were
    seen. Tensions and pressures follow but for one factor.

    **Arguments:**

    - `segmentation`: the cluster, best with `inner_arcs`, whose curvature tells differences of pressure.
    - `stiffness`, `low`, `high`, `prior`: see [`force_balance`][vertax.inference.force_balance].
    - `noise`: standard deviation of the position of an edge, in pixels: how much the image counts against
        the prior.
    - `response`: how the cluster is relaxed; without T1 transitions, because edges are compared one by one
        with those of the image. [`Relaxation`][vertax.Relaxation]`(transitions=None)` by default.

    **Returns:** a [`TensionProblem`][vertax.inference.TensionProblem].

    **Raises:**

    - `ValueError` for a `response` with transitions, a `noise` that is not positive, and as
        [`force_balance`][vertax.inference.force_balance].
    """
    response = Relaxation(transitions=None) if response is None else response
    if response.transitions is not None:
        raise ValueError(
            "Argument `response` must have no transitions, because edges are compared one by one with those "
            "that were seen: Relaxation(transitions=None)."
        )
    if not noise > 0:
        raise ValueError(f"Argument `noise` must be positive, but is {noise}.")
    seen = segmentation.tissue
    guess = force_balance(seen, stiffness=stiffness, low=low, high=high, prior=prior)
    trainable = eqx.tree_at(
        lambda e: (e.terms[0].target_area, e.terms[1].logits),
        jax.tree.map(lambda _: False, guess),
        (True, True),
    )
    width = noise * segmentation.pixel_size
    # As many independent positions as edges have ends: each is known to within the noise.
    n_positions = 2 * seen.n_vertices
    cost = EdgeDistance(seen) + width**2 / n_positions * RelativeTensions(prior)
    problem = InverseProblem(seen, guess, cost, trainable, fit_position=True, response=response)
    return TensionProblem(problem, segmentation, guess)
