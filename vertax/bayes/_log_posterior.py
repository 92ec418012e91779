"""The log density of parameters, given data: priors, noise, and the equilibrium that links them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from numpyro.distributions import Distribution, Normal
from numpyro.distributions.transforms import biject_to

from vertax._base.checks import check_instance, check_number, describe
from vertax._base.results import RESULTS
from vertax._base.tracing import is_concrete, traced
from vertax.dynamics import Evolution
from vertax.fitting import InverseProblem
from vertax.mesh import Tissue
from vertax.relax import AbstractResponse, Relaxation

Parameters: TypeAlias = Mapping[str, Any]
"""Arrays by the name of the parameter."""


class Outcome(eqx.Module):
    """The equilibrium behind a density; with replicates, the worst of them."""

    converged: Bool[Array, ""]
    num_t1: Int[Array, ""]
    """T1 transitions of the relaxations."""
    shortest_edge: Float[Array, ""]
    """Length of the shortest edge, in units of the size of a cell."""
    measured: Bool[Array, "..."]
    """Which residuals are measurements, in the shape of the residuals."""


class LogPosterior(eqx.Module):
    r"""Log density of parameters $\theta$, given the data of an inverse problem.

    $$\log p(\theta \mid \text{data}) = \log p(\theta)
      + \sum_i \log p_\text{noise}\bigl(r_i(X^*_\theta)\bigr) + \text{const}$$

    with the residuals $r_i$ of the cost at the equilibrium $X^*_\theta$. The gradient is that of the adjoint
    of the problem. Each evaluation relaxes the tissue of the problem, so the density depends on $\theta$
    alone; take the tissue of a fit. If the relaxation does not reach equilibrium, the density is 0 (its
    logarithm $-\infty$): a sampler rejects the proposal.

    Residuals are in the units of the cost. The costs of vertax are means; multiplied by a number they have
    residuals in units of the data: `n_vertices * VertexDistance(target)` displacements of vertices,
    `n_pixels * MeshImage(image, width)` differences of pixels, with all weights equal. Residuals without data
    (spare slots, pixels of weight 0) do not count: `is_measurement` of the cost leaves them out.

    ```python
    import numpyro.distributions as dist

    density = vx.bayes.LogPosterior(problem, {"target_shape_factor": dist.Normal(3.7, 0.1)}, noise=0.01)
    ```

    **Arguments:**

    - `problem`: the inverse problem, with a sum of squares as its cost; or a batch from
        [`stack`][vertax.fitting.stack] (replicates): the log likelihood is the sum over its members.
    - `prior`: distributions of NumPyro by name of the parameter. Without `energy`, names are those of arrays
        of the energy of the problem, e.g. `"target_shape_factor"` or `"terms.0.stiffness"`, and a
        distribution of one number is that of each entry; other arrays are constants.
    - `noise`: standard deviation of Gaussian noise of a residual; or the distribution of a residual, e.g.
        `dist.StudentT(4.0, 0.0, 0.01)`; one, or one for each residual; or a function of the parameters that
        returns one of these, to fit the noise: `lambda p: p["noise"]`. None integrates over the standard
        deviation $\sigma$ of Gaussian noise with the prior $1/\sigma$, in closed form for $m$ residuals:
        $\log \tfrac12\Gamma(\tfrac m2) - \tfrac m2 \log (\pi \sum_i r_i^2)$. (It has no upper bound, so a sum
        of exactly 0 counts as a tiny positive number.)
    - `energy`: a function of the parameters, a dictionary of arrays, that returns the energy: for
        parameters by type or position, and hierarchies. For a batch, every array of the energy has the
        leading axis of the replicates. With `fit_position` it returns a tuple of energy and displacement.
    - `across_t1`: False keeps the topology of the tissue, so the posterior is that of one topology. True
        keeps the transitions of the response: the density jumps where a transition moves the
        vertices that the cost compares; take a cost of centroids or of an image.

    **Raises:**

    - `TypeError` for arguments of a wrong type.
    - `ValueError` for an improper or discrete prior, a prior of another shape than its parameter, a name that
        is no array of the energy, a response that cannot keep the topology, and in an evaluation for noise
        of another shape than the residuals.
    """

    problem: InverseProblem[Any]
    prior: dict[str, Distribution]
    noise: Any
    energy: Callable[[Parameters], Any] | None
    across_t1: bool = eqx.field(static=True)

    def __init__(
        self,
        problem: InverseProblem[Any],
        prior: Mapping[str, Any],
        noise: Any,
        *,
        energy: Callable[[Parameters], Any] | None = None,
        across_t1: bool = False,
    ):
        check_instance("problem", problem, InverseProblem, "a vertax.fitting.InverseProblem")
        if not isinstance(prior, Mapping) or not prior:
            raise TypeError(
                "Argument `prior` must hold distributions by name, e.g. "
                f'{{"target_shape_factor": dist.Normal(3.7, 0.1)}}, but is {describe(prior)}.'
            )
        for name, distribution in prior.items():
            _check_proper(name, distribution)
        if not (noise is None or callable(noise) or isinstance(noise, Distribution)):
            check_number("noise", noise, above=0, many=True)
        if problem.fit_position and energy is None:
            raise ValueError(
                "Argument `energy` must be given for a problem with `fit_position`: a function of the "
                "parameters that returns a tuple of energy and displacement."
            )
        if energy is None:
            prior = _expanded(prior, _arrays_of(problem.energy), fitted_noise=callable(noise))
        adjoint = dataclasses.replace(problem.adjoint, throw=False)
        response = problem.response if across_t1 else _without_transitions(problem.response)
        problem = dataclasses.replace(problem, adjoint=adjoint, response=response)
        dtype = problem.tissue.vertices.dtype
        if problem.tissue.vertices.ndim == 2:  # (Numbers of a batch would lack its axis.)
            problem = traced(problem.with_array_numbers(dtype), dtype)
        self.problem, self.prior = problem, traced(dict(prior), dtype)
        number = noise is not None and not callable(noise)
        self.noise = jnp.asarray(noise, dtype) if number else noise
        self.energy, self.across_t1 = energy, across_t1

    def __call__(self, parameters: Parameters) -> Float[Array, ""]:
        """Log density of parameters.

        **Arguments:**

        - `parameters`: arrays by name, as in the prior.

        **Returns:** the log density, without the constant; $-\\infty$ without an equilibrium, outside the
        support of a prior, and for a standard deviation of the noise that is not positive.

        **Raises:**

        - `ValueError` for other names or shapes than those of the prior.
        """
        self._check_parameters("parameters", parameters)
        supports: dict[str, Any] = {name: d.support for name, d in self.prior.items()}
        values = {name: jnp.asarray(parameters[name]) for name in supports}
        each = [jnp.all(supports[name](value)) for name, value in values.items()]
        inside = jnp.all(jnp.stack(each))
        # Outside the support evaluate at parameters inside, where all terms and derivatives are finite.
        parameters = {
            name: jnp.where(inside, value, supports[name].feasible_like(value))
            for name, value in values.items()
        }
        log_prior = sum(jnp.sum(d.log_prob(parameters[n])) for n, d in self.prior.items())
        terms, outcome = self.likelihood(parameters)
        return log_prior + jnp.where(inside & outcome.converged, jnp.sum(terms), -jnp.inf)

    def draw(self, key: PRNGKeyArray) -> dict[str, Array]:
        """Draw parameters from the prior."""
        keys = jax.random.split(key, len(self.prior))
        pairs = zip(self.prior.items(), keys, strict=True)
        return {name: jnp.asarray(d.sample(key)) for (name, d), key in pairs}

    def residuals(self, parameters: Parameters) -> tuple[Float[Array, "..."], Outcome]:
        """Residuals of the cost at the equilibrium, with the leading axis of a batch, and its outcome."""
        energy = self.energy(parameters) if self.energy else self._with_arrays(parameters)
        energy, shift = energy if isinstance(energy, tuple) else (energy, None)
        batched = self.problem.tissue.vertices.ndim == 3
        residuals, outcome = (eqx.filter_vmap(_observe) if batched else _observe)(
            self.problem, energy, shift
        )
        finite = jnp.all(jnp.isfinite(residuals))
        converged = jnp.all(outcome.converged) & finite
        edge = jnp.min(outcome.shortest_edge)
        return residuals, Outcome(converged, jnp.sum(outcome.num_t1), edge, outcome.measured)

    def likelihood(self, parameters: Parameters) -> tuple[Float[Array, "..."], Outcome]:
        """Log likelihood of each residual (with `noise=None` of all, one number), and the outcome."""
        residuals, outcome = self.residuals(parameters)
        if self.noise is None:
            n = jnp.sum(outcome.measured)
            limits = jnp.finfo(residuals.dtype)
            # At an exact fit the density has no bound. Above this limit its derivative does not overflow.
            squares = jnp.maximum(jnp.sum(residuals**2), limits.tiny / limits.eps)
            log_sum = jnp.log(jnp.pi * squares)
            return jax.lax.lgamma(n / 2) - jnp.log(2.0) - n / 2 * log_sum, outcome
        noise = self.noise
        if callable(noise) and not isinstance(noise, Distribution):
            noise = noise(parameters)
        _check_noise(noise, residuals.shape)
        if isinstance(noise, Distribution):
            terms = noise.log_prob(residuals)
        else:
            deviation: Any = noise
            positive = jnp.asarray(deviation) > 0
            terms = Normal(0.0, jnp.where(positive, deviation, 1)).log_prob(residuals)
            terms = jnp.where(positive, terms, -jnp.inf)
        return jnp.where(outcome.measured, terms, 0), outcome

    # Samplers move in coordinates z of all real numbers: θ = b(z) with the bijections b to the supports of
    # the priors, log p(z) = log p(b(z)) + log |det ∂b/∂z|.
    def log_prior(
        self, z: Float[Array, " coordinates"]
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Log prior density of real coordinates, and their parameters."""
        density, parameters = jnp.zeros((), z.dtype), {}
        for name, part in self._unravel(z).items():
            transform = biject_to(self.prior[name].support)
            parameters[name] = transform(part)
            density += jnp.sum(self.prior[name].log_prob(parameters[name]))
            density += jnp.sum(transform.log_abs_det_jacobian(part, parameters[name]))
        return density, parameters

    def log_likelihood(self, z: Float[Array, " coordinates"]) -> tuple[Float[Array, ""], Outcome]:
        """Log likelihood of real coordinates, and the outcome of the equilibrium."""
        terms, outcome = self.likelihood(self.log_prior(z)[1])
        return jnp.where(outcome.converged, jnp.sum(terms), -jnp.inf), outcome

    def log_density(self, z: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log density of real coordinates, up to a constant."""
        return self.log_prior(z)[0] + self.log_likelihood(z)[0]

    def parameters_at(self, z: Float[Array, " coordinates"]) -> dict[str, Array]:
        """The parameters with real coordinates z."""
        return self.log_prior(z)[1]

    def coordinates_of(self, parameters: Parameters) -> Float[Array, " coordinates"]:
        """The real coordinates of parameters."""
        self._check_parameters("start", parameters)
        parts = {}
        for name, d in self.prior.items():
            value = jnp.asarray(parameters[name])
            parts[name] = biject_to(d.support).inv(value)
            _check_inside(name, d, value, parts[name])
        return ravel_pytree(parts)[0].astype(self.problem.tissue.vertices.dtype)

    def start(self) -> Float[Array, " coordinates"]:
        """Coordinates of the energy of the problem; of the mean of prior draws for other parameters."""
        mean = jnp.mean(self.prior_draws(), axis=0)
        given = {} if self.energy else _arrays_of(self.problem.energy)
        return self.coordinates_of(
            {name: given.get(name, value) for name, value in self.parameters_at(mean).items()}
        )

    def prior_draws(self) -> Float[Array, "draws coordinates"]:
        """Coordinates of 200 draws from the prior, for its mean and scale."""
        keys = jax.random.split(jax.random.key(0), 200)
        return jax.vmap(lambda key: self.coordinates_of(self.draw(key)))(keys)

    def _check_parameters(self, argument: str, parameters: Parameters) -> None:
        given = {name: jnp.shape(value) for name, value in parameters.items()}
        expected = {name: d.shape() for name, d in self.prior.items()}
        if given != expected:
            raise ValueError(
                f"Argument `{argument}` must have the names and shapes of the prior, {expected}, but has "
                f"{given}."
            )

    def _unravel(self, z: Float[Array, " coordinates"]) -> dict[str, Array]:
        zero = {
            name: jnp.zeros(biject_to(d.support).inverse_shape(d.shape()), z.dtype)
            for name, d in self.prior.items()
        }
        return ravel_pytree(zero)[1](z)

    def _with_arrays(self, parameters: Parameters) -> Any:
        """The energy of the problem with the arrays that `parameters` name."""
        replace = lambda path, x: jnp.asarray(parameters.get(_name(path), x)) if _is_real(x) else x
        return jax.tree_util.tree_map_with_path(replace, self.problem.energy)


def _observe(
    problem: InverseProblem, energy: Any, shift: Float[Array, "2"] | None
) -> tuple[Float[Array, " residuals"], Outcome]:
    residuals, equilibrium, _ = problem.residuals(energy, problem.tissue, shift)
    tissue: Tissue = jax.lax.stop_gradient(equilibrium.tissue)
    lengths = jnp.where(tissue.topology.alive_edges, tissue.edge_lengths, jnp.inf)
    converged = jnp.all(equilibrium.result == RESULTS.successful)
    shortest = jnp.min(lengths) / tissue.cell_size
    measured = problem.is_measurement(energy, equilibrium)
    return residuals, Outcome(converged, jnp.sum(equilibrium.num_t1), shortest, measured)


_is_real = eqx.is_inexact_array


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _arrays_of(energy: Any) -> dict[str, Array]:
    """The real arrays of an energy by their name."""
    leaves = jax.tree_util.tree_flatten_with_path(energy)[0]
    return {_name(path): leaf for path, leaf in leaves if _is_real(leaf)}


def _expanded(
    prior: Mapping[str, Any], arrays: dict[str, Array], *, fitted_noise: bool
) -> dict[str, Distribution]:
    """Priors in the shapes of the arrays that they name; distributions of one number are expanded."""
    expanded = {}
    for name, distribution in prior.items():
        if name not in arrays and not fitted_noise:
            raise ValueError(
                f"Argument `prior` must name arrays of the energy ({', '.join(arrays) or 'it has none'}), "
                f"but has {name!r}. Make it an array, or pass `energy`, a function of the parameters."
            )
        shape = arrays[name].shape if name in arrays else distribution.shape()
        if distribution.shape() == ():
            distribution = distribution.expand(shape)
        if distribution.shape() != shape:
            raise ValueError(
                f"The prior of {name!r} must have its shape {shape}, but has {distribution.shape()}."
            )
        expanded[name] = distribution
    return expanded


def _check_proper(name: str, distribution: Any) -> None:
    if not isinstance(distribution, Distribution):
        raise TypeError(
            f"The prior of {name!r} must be a distribution of numpyro.distributions, but is "
            f"{describe(distribution)}."
        )
    support: Any = distribution.support
    try:
        jax.eval_shape(distribution.sample, jax.random.key(0))
        proper = not support.is_discrete
    except NotImplementedError:
        proper = False
    if not proper:
        raise ValueError(
            f"The prior of {name!r} must be a proper distribution of real numbers, but is "
            f"{type(distribution).__name__}. Take a wide one, such as dist.Normal(mean, 10 * deviation)."
        )


def _check_inside(
    name: str, distribution: Distribution, value: Array, coordinates: Float[Array, "..."]
) -> None:
    """Raise an error for a concrete value at which a prior has no density, or no real coordinates."""
    if not is_concrete(coordinates):
        return
    support: Any = distribution.support
    inside = np.asarray(support(value))
    if inside.shape == np.shape(coordinates):
        inside = inside & np.isfinite(
            coordinates
        )  # (The end of an interval has no real coordinate.)
    if inside.all() and np.isfinite(coordinates).all():
        return
    entries = np.asarray(value)[~inside] if inside.shape == value.shape else np.asarray(value)
    raise ValueError(
        "Argument `start` (by default the parameters of the problem) must be inside the prior, but "
        f"{entries.flat[0]:g} of {name!r} lies outside its prior, which has the support {support}. Choose "
        "another start, or a wider prior."
    )


def _check_noise(noise: Any, shape: tuple[int, ...]) -> None:
    """Raise an error unless noise has one entry, or one for each residual."""
    event = noise.event_shape if isinstance(noise, Distribution) else ()
    if event:
        raise ValueError(
            f"Argument `noise` must be the distribution of one residual, but is joint, of shape {event}. "
            "Leave out `to_event`. For correlated residuals r with covariance L Lᵀ, take a cost with the "
            "residuals L⁻¹ r, and noise=1.0."
        )
    given = noise.batch_shape if isinstance(noise, Distribution) else jnp.shape(noise)
    missing = len(shape) - len(given)
    if missing < 0 or any(n not in (1, m) for n, m in zip(given, shape[missing:], strict=True)):
        raise ValueError(
            f"Argument `noise` must be one number or distribution, or one for each residual, shape {shape}, "
            f"but its shape is {given}. Give it this shape."
        )


def _without_transitions(response: AbstractResponse) -> AbstractResponse:
    if isinstance(response, Relaxation):
        return dataclasses.replace(response, transitions=None)
    if isinstance(response, Evolution):
        relaxation = dataclasses.replace(response.relaxation, transitions=None)
        return eqx.tree_at(lambda r: r.relaxation, response, relaxation)
    raise ValueError(
        "Argument `across_t1` must be True for a response that cannot keep the topology, but is False for "
        f"a {type(response).__name__}."
    )
