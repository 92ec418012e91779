"""Draws from a posterior, their diagnostics and tables."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from vertax._base.announce import announced_jit
from vertax.bayes._laplace import Laplace
from vertax.bayes._log_posterior import LogPosterior
from vertax.transitions import T1

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # ArviZ 0.23 announces ArviZ 1.
    import arviz


class Posterior(eqx.Module):
    """Draws from a posterior, made by [`sample`][vertax.bayes.sample].

    ```python
    posterior.table()["mean"]
    arviz.plot_pair(posterior.data)
    deviations = posterior.draws("target_shape_factor").std((0, 1))
    vx.plot_tissue(fit.tissue, cells=deviations)
    ```
    """

    laplace: Laplace
    """The Laplace approximation; the sampler moved in its coordinates."""
    data: Any
    """An `InferenceData` (a `DataTree` from ArviZ 1 on). Group `posterior`: the parameters. Group
    `sample_stats`: for each draw `lp` (log density), `diverging`, `acceptance_rate`, `n_steps` (gradients),
    `rejected` (whether the trajectory met a tissue without equilibrium), `num_t1` and `shortest_edge` (in
    units of the size of a cell)."""
    num_gradients: int
    """Evaluations of the gradient, with those of the Laplace approximation and of the adaptation."""

    @classmethod
    def of(
        cls, laplace: Laplace, columns: dict[str, Shaped[np.ndarray, "..."]], warmup_steps: int
    ) -> Posterior:
        """The posterior of the arrays of a sampler, with axes of chains and draws; warns of problems."""
        stats = dict(columns)
        parameters = _parameters(laplace.log_posterior, jnp.asarray(stats.pop("z")))
        groups = {"posterior": jax.tree.map(np.asarray, parameters), "sample_stats": stats}
        _warn(laplace.log_posterior, stats)
        num_gradients = int(laplace.num_gradients + warmup_steps + np.sum(stats["n_steps"]))
        return cls(laplace, _inference_data(groups), num_gradients)

    def draws(self, name: str) -> Shaped[np.ndarray, "chains draws ..."]:
        """The draws of a parameter."""
        return np.asarray(self.data["posterior"][name])

    def table(self, quantiles: Sequence[float] = (0.05, 0.5, 0.95)) -> dict[str, np.ndarray]:
        """One row for each number of the parameters.

        **Arguments:**

        - `quantiles`: the quantiles among the columns.

        **Returns:** columns `parameter`, `mean`, `deviation`, the quantiles, `ess` (effective sample size of
        the bulk), `r_hat` (near 1 if the chains agree; NaN for one chain), `laplace_deviation`.
        """
        approximate = self.laplace.draw(0, 2000)
        rows = []
        for name in self.laplace.log_posterior.prior:
            draws = self.draws(name)
            for index in np.ndindex(draws.shape[2:]):
                values = draws[(slice(None), slice(None), *index)]
                rows.append(
                    {
                        "parameter": name + (f"[{', '.join(map(str, index))}]" if index else ""),
                        "mean": values.mean(),
                        "deviation": values.std(),
                        **{f"{q:g}": np.quantile(values, q) for q in quantiles},
                        "ess": float(arviz.ess(values)),
                        "r_hat": float(arviz.rhat(values)) if len(values) > 1 else np.nan,
                        "laplace_deviation": float(
                            np.std(approximate[name][(slice(None), *index)])
                        ),
                    }
                )
        return {column: np.array([row[column] for row in rows]) for column in rows[0]}

    def loo(self) -> Any:
        r"""Expected log density of new data, by leave-one-out (PSIS) over the residuals.

        The result of `arviz.loo`, for `arviz.compare`. Vehtari et al. 2017, doi:10.1007/s11222-016-9696-4.

        **Raises:**

        - `ValueError` for `noise=None`, which does not define a likelihood of single residuals.
        """
        log_posterior = self.laplace.log_posterior
        if log_posterior.noise is None:
            raise ValueError(
                "Argument `noise` of the LogPosterior must not be None for `loo`: integrated over the noise, "
                "single residuals have no likelihood. Fit the noise, see LogPosterior."
            )
        draws = {name: jnp.asarray(self.draws(name)) for name in log_posterior.prior}
        terms, measured = map(np.asarray, _terms(log_posterior, draws))
        groups = {
            "posterior": jax.tree.map(np.asarray, draws),
            "log_likelihood": {"residuals": terms[:, :, measured[0, 0]]},
        }
        return arviz.loo(_inference_data(groups))


def _inference_data(groups: dict[str, dict[str, np.ndarray]]) -> Any:
    if arviz.__version__.startswith("0."):
        return arviz.from_dict(**groups)  # pyright: ignore[reportArgumentType]
    return arviz.from_dict(groups)  # pyright: ignore[reportArgumentType]


@announced_jit
def _parameters(log_posterior: LogPosterior, z: Array) -> dict[str, Array]:
    return jax.vmap(jax.vmap(log_posterior.parameters_at))(z)


@announced_jit
def _terms(log_posterior: LogPosterior, draws: dict[str, Array]) -> tuple[Array, Array]:
    """The log likelihood of each residual, and which are measurements, of all draws."""

    def one(draw: dict[str, Array]) -> tuple[Array, Array]:
        terms, outcome = log_posterior.likelihood(draw)
        return terms, outcome.measured

    return jax.lax.map(lambda chain: jax.lax.map(one, chain), draws)


def _warn(log_posterior: LogPosterior, stats: dict[str, np.ndarray]) -> None:
    """Warn of divergences, failed relaxations, short edges and transitions."""
    n = np.size(stats["rejected"])
    rejected, diverging = (int(np.sum(stats[name])) for name in ("rejected", "diverging"))
    flipped = int(np.sum(stats["num_t1"] > 0))
    threshold = _threshold(log_posterior)
    short = int(np.sum(stats["shortest_edge"] < threshold))
    texts = []
    if rejected:
        texts.append(
            f"{rejected} of {n} trajectories met a tissue that did not reach equilibrium: its density counts "
            "as 0. If that is rare, nothing is lost. Otherwise raise `max_steps` of the relaxation, or "
            "choose a prior whose parameters have an equilibrium."
        )
    if diverging > rejected:
        texts.append(
            f"{diverging - rejected} of {n} trajectories diverged: the curvature of the posterior varies. "
            "Raise `warmup`, or choose other parameters (in hierarchies, deviations in units of their scale)."
        )
    if flipped:
        texts.append(
            f"{flipped} of {n} draws differ from the tissue of the problem by T1 transitions: there the "
            "density may jump, and its gradient is that of one side."
        )
    elif short:
        texts.append(
            f"{short} of {n} draws have an edge shorter than {threshold:g} of the size of a cell. The "
            "posterior is that of the topology of the tissue; near a T1 transition a tissue may have left "
            "it. Compare with across_t1=True."
        )
    for text in texts:
        warnings.warn(text, stacklevel=5)


def _threshold(log_posterior: LogPosterior) -> float:
    transitions = getattr(log_posterior.problem.response, "transitions", None)
    rule = transitions if isinstance(transitions, T1) else T1()
    value = float(np.asarray(rule.threshold))
    return value if math.isfinite(value) else 0.0
