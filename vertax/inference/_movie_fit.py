"""Parameters of an energy from the motion in a movie, across changes of neighbours."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.batch import member
from vertax._base.checks import check_integer, check_number
from vertax._base.model_checks import check_energy
from vertax.energies import AbstractEnergy
from vertax.inference._movie import Movie
from vertax.inference._movie_equations import (
    Settings,
    Solution,
    equations,
    frame_at,
    sandwich_covariance,
    scaled_inverse,
)
from vertax.inference._movie_warnings import (
    names_of,
    undetermined_in,
    warn_of_long_intervals,
    warn_of_straight_outlines,
)
from vertax.inference._tracking_noise import tracking_noise
from vertax.mesh import Tissue


class MovieFit(eqx.Module):
    """Parameters that explain the motion in a movie; with windows all arrays have a leading axis."""

    energy: AbstractEnergy
    """The energy with the fitted parameters."""
    deviation: AbstractEnergy
    """Standard errors in the place of the parameters, which include `interval_error`; infinite for those that
    the movie does not determine, and NaN with fewer steps than parameters."""
    interval_error: AbstractEnergy
    """Change of the parameters with the other `implicitness`, 0.5 or 1: the order of magnitude of the error
    by the time between frames."""
    friction: Float[Array, "*windows"]
    """The friction of a vertex, fitted or given."""
    friction_deviation: Float[Array, "*windows"]
    """Its standard error; 0 if it was given."""
    covariance: Float[Array, "*windows parameters parameters"]
    """Covariance of the parameters, the friction last if it was fitted; infinite variances and covariances of
    0 for those that the movie does not determine."""
    noise: Float[Array, "*windows"]
    """The tracking noise, estimated or given."""
    misfit: Float[Array, "*windows"]
    """Root mean square of a component of the residual force."""
    num_equations: Int[Array, "*windows"]
    """Number of force components that were used."""
    converged: Bool[Array, "*windows"]
    """Whether the parameters no longer changed in the last step."""
    undetermined: tuple[str, ...] = eqx.field(static=True)
    """Parameters that the movie does not determine, by name, such as `"terms[1].outline"`; several with `+`
    if it does not determine them together. With windows, those of any window."""


def fit_movie(
    movie: Movie,
    energy: AbstractEnergy,
    *,
    friction: float | Float[Array, ""] = 1.0,
    fit_friction: bool = False,
    noise: float | None = None,
    implicitness: float = 1.0,
    min_edge_length: float = 4.0,
    outline: bool = True,
    node_friction: bool = False,
    windows: int | None = None,
    max_steps: int = 30,
) -> MovieFit:
    r"""Parameters of an energy from the motion in a movie in which neighbours change.

    A vertex obeys $\zeta\dot x = -\nabla E(x;\theta)$. Its residual in the step from frame $n$ to $n + 1$ is

    $$r = \zeta\,\frac{x_{n+1} - x_n}{\Delta t}
      + \alpha \nabla E(x_{n+1};\theta) + (1 - \alpha) \nabla E(x_n;\theta),$$

    for each vertex that joins the same three cells in frames $n - 1$, $n$ and $n + 1$: in a step with a T1
    transition, a division or a death all other vertices count. The parameters solve
    $\sum Z^\mathsf T w\, r = 0$ with the instruments $Z = \partial_\theta \nabla E(x_{n-1};\theta)$ of the
    frame before. Least squares, with $Z$ from the frames of $r$, are biased, because an error of the position
    of a vertex changes $r$ and $Z$ together; errors of different frames are independent, and so is the noise
    of a later step (instrumental variables: Sargan 1958, doi:10.2307/1907619; noise in stochastic
    trajectories: Frishman and Ronceray 2020, doi:10.1103/PhysRevX.10.021009). The weight of a vertex is

    $$1/w = \sigma^2 \left(\tfrac12 \|\nabla\nabla E_v\|^2 + 2 \zeta^2/\Delta t^2\right) + s^2$$

    with the tracking noise $\sigma$, the rows $\nabla\nabla E_v$ of its Hessian (estimated by random
    vectors), and a variance $s^2$ that explains the remaining residuals. Standard errors are those of the
    sandwich formula over steps, with the correlation of successive steps (Newey and West 1987,
    doi:10.2307/1913610), and over cells, for residuals that last (Cameron, Gelbach and Miller 2011,
    doi:10.1198/jbes.2010.07136); they require more steps than parameters.

    The direction of an edge of length $\ell$ is biased by noise, by about $(\sigma / \ell)^2$. So a vertex
    counts only if its edges in frame $n - 1$ are longer than `min_edge_length` times $\sigma$; errors of that
    frame are independent of those of $r$.

    Velocities between frames approximate those of the motion only if the forces change little in that time.
    The fit is repeated with $\alpha = 0.5$, or 1 if $\alpha \le 0.75$, and `interval_error` is the
    difference $\delta$. A warning appears if a parameter changes by more than three standard errors and 5 %;
    then $\delta \delta^\mathsf T$ is added to the covariance.

    | symbol | argument | choose |
    |---|---|---|
    | $\alpha$ | `implicitness` | 1 if tissues relax between frames; 0.5 if frames are closer |
    | $\zeta$ | `friction` | a known value; with another one all parameters scale, unless some are constants |
    | $\sigma$ | `noise` | standard deviation of the coordinates of vertices |

    All arrays of the energy are parameters, and numbers are constants. Parameters for each cell are in the
    order of `movie.cells`; [`by_type`][vertax.energies.by_type] gives one for each pair of types, and
    with `types=jnp.arange(n_cells)` one for each pair of cells, which is one for each edge.

    ```python
    guess = vx.energies.AreaElasticity(1.0, 1.0) + vx.energies.by_type(0.1 * jnp.ones((2, 2)), movie.types)
    fit = vx.inference.fit_movie(movie, guess)
    fit.energy, fit.deviation
    ```

    **Arguments:**

    - `movie`: the [`Movie`][vertax.inference.Movie], three frames at least.
    - `energy`: the energy with a first guess of the parameters.
    - `friction`: friction $\zeta$ of a vertex, force over velocity; a first guess with `fit_friction`.
    - `fit_friction`: fit the friction too. That requires a constant in the energy that sets the scale of
        forces, such as a known stiffness.
    - `noise`: standard deviation $\sigma$ of tracked positions, in units of length. By default it is
        estimated from the second differences of the positions of vertices that survive six frames at equal
        intervals, $\sigma^2 = \langle a_n a_{n+2} \rangle - \langle a_n a_{n+3} \rangle$; it is 0 if there
        are none.
    - `implicitness`: $\alpha$, from 0.5 to 1.
    - `min_edge_length`: length of the shortest edge of a vertex that is used, in units of `noise`.
    - `outline`: whether to use the vertices of cells on the outline; False for a part of a tissue, and for
        tables of corners without the bulges of outer sides.
    - `node_friction`: whether the points along the outer sides of the table are nodes that have the friction
        of a vertex, as in Chaste. Then their friction acts on the vertices at the ends of a side.
    - `windows`: split the steps into this number of parts and fit each, in parallel.
    - `max_steps`: largest number of Newton steps; one is enough for parameters of which forces are linear
        functions, but weights change.

    **Returns:** a [`MovieFit`][vertax.inference.MovieFit].

    **Warns:** if frames are too far apart for the motion between them, and if the vertices of outer cells are
    used but all outer sides are straight; naming the parameters, if the movie does not determine them, or
    determines them together only within half of their values (as it does a stiffness or the friction from
    frames that are far apart); and if there are fewer steps than parameters.

    **Raises:**

    - `ValueError` for numbers out of range, fewer than three frames, an energy without arrays, more windows
        than steps, `node_friction` for a movie without nodes, and if no vertex survives three frames.
    """
    check_energy(energy)
    check_number("friction", friction, above=0)
    if noise is not None:
        check_number("noise", noise, at_least=0)
    if not 0.5 <= implicitness <= 1:
        raise ValueError(f"Argument `implicitness` must be from 0.5 to 1, but is {implicitness}.")
    check_number("min_edge_length", min_edge_length, at_least=0)
    check_integer("max_steps", max_steps, at_least=1)
    n_steps = movie.n_frames - 2
    if n_steps < 1:
        raise ValueError(
            f"Argument `movie` must have three frames or more, but has {movie.n_frames}."
        )
    n_windows = 1 if windows is None else windows
    check_integer("windows", n_windows, at_least=1)
    if n_windows > n_steps:
        raise ValueError(
            f"Argument `windows` must be at most the number of steps, {n_steps}, but is {n_windows}."
        )
    nodes = None
    if node_friction and movie.outline_nodes is not None:
        nodes = jnp.asarray(movie.outline_nodes)
    elif node_friction:
        raise ValueError(
            "Argument `node_friction` must be False for a movie without nodes on its outline. Read the table "
            "of a free tissue by vertax.inference.movie_from_table."
        )
    parameters, static = eqx.partition(energy, eqx.is_inexact_array)
    theta, unravel = ravel_pytree(parameters)
    if not theta.size:
        raise ValueError(
            "Argument `energy` must have arrays, which are parameters, but has none. Give a parameter as "
            "jnp.array(0.1)."
        )
    dtype = movie.tissue.vertices.dtype
    zeta, times = jnp.asarray(friction, dtype), movie.times.astype(dtype)
    sigma = tracking_noise(movie.tissue, times) if noise is None else jnp.asarray(noise, dtype)
    theta = jnp.append(theta, zeta) if fit_friction else theta
    settings = Settings(
        static=static,
        unravel=unravel,
        friction=zeta,
        noise=sigma,
        implicitness=jnp.asarray(implicitness, dtype),
        min_edge_length=min_edge_length * sigma,
        fit_friction=fit_friction,
        outline=outline,
        most_nodes=0 if nodes is None else int(nodes.max()),
    )
    warn_of_straight_outlines(movie.tissue, outline)
    parts = np.array_split(np.arange(n_steps), n_windows)
    steps = jnp.asarray([np.resize(part, len(parts[0])) for part in parts])
    used = jnp.asarray([np.arange(len(parts[0])) < len(part) for part in parts])
    other = eqx.tree_at(
        lambda s: s.implicitness, settings, jnp.asarray(1.0 if implicitness <= 0.75 else 0.5, dtype)
    )
    with announce_compilations("a fit of a movie"):
        best, compared = (
            _solve_windows(movie.tissue, nodes, times, each, theta, steps, used, max_steps)
            for each in (settings, other)
        )
    if not np.all(best.num_equations > 0):
        raise ValueError(
            "Argument `movie` must have vertices that join the same three cells in three successive frames, "
            "with edges longer than `min_edge_length` times `noise`, but has none. Take frames in shorter "
            "intervals, or a smaller `min_edge_length`."
        )
    deviations = jnp.sqrt(jnp.diagonal(best.covariance, axis1=1, axis2=2))
    change = compared.theta - best.theta
    n = theta.size - fit_friction
    names = [*names_of(parameters), *["friction"] * fit_friction]
    undetermined = undetermined_in(names, best)
    warn_of_long_intervals(best.theta[:, :n], change[:, :n], deviations[:, :n])
    # (The covariance of a parameter that is not determined stays as it is.)
    determined = jnp.isfinite(deviations)
    determined = determined[:, :, None] & determined[:, None, :]
    covariance = best.covariance + jnp.where(determined, change[:, :, None] * change[:, None, :], 0)
    deviations = jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2))
    in_energy = eqx.filter_vmap(settings.energy, out_axes=eqx.if_array(0))
    fits = MovieFit(
        energy=in_energy(best.theta),
        deviation=in_energy(deviations),
        interval_error=in_energy(change),
        friction=jax.vmap(settings.zeta)(best.theta),
        friction_deviation=deviations[:, -1] if fit_friction else jnp.zeros(n_windows, dtype),
        covariance=covariance,
        noise=jnp.full(n_windows, sigma),
        misfit=best.misfit,
        num_equations=best.num_equations,
        converged=best.converged,
        undetermined=undetermined,
    )
    return fits if windows is not None else member(fits, 0)


@announced_jit
def _solve_windows(
    frames: Tissue,
    nodes: Int[Array, "frames edges"] | None,
    times: Float[Array, " frames"],
    settings: Settings,
    theta: Float[Array, " parameters"],
    steps: Int[Array, "windows steps"],
    used: Bool[Array, "windows steps"],
    max_steps: int,
) -> Solution:
    """The solution in each window."""

    def sums(theta: Array, floor: Array, steps: Array, used: Array) -> tuple[Array, ...]:
        """The equations of each step, see `equations`."""

        def one(item: tuple[Array, Array]) -> tuple[Array, ...]:
            triple = [frame_at(frames, item[0] + j) for j in range(3)]
            dt = times[item[0] + 2] - times[item[0] + 1]
            inside = None if nodes is None else nodes[item[0] + 2]
            return equations(settings, theta, floor, triple, inside, dt, item[1])

        return jax.lax.map(one, (steps, used))

    def solve(steps: Array, used: Array) -> Solution:
        def newton(carry: tuple) -> tuple:
            theta, floor, _, count, _ = carry
            of_steps = sums(theta, floor, steps, used)
            moments, slopes, scales, squares = (x.sum(axis=0) for x in of_steps)
            step = scaled_inverse(slopes, scales)[0] @ moments.sum(axis=0)
            squared, tracking, n = squares
            mean = squared / jnp.maximum(n, 1)
            excess = jnp.maximum((squared - tracking) / jnp.maximum(n, 1), 1e-3 * mean)
            change = jnp.max(jnp.abs(step) / (1e-3 + jnp.abs(theta)))
            change = jnp.maximum(change, jnp.abs(excess - floor) / (excess + 1e-6))
            floor = excess + jnp.finfo(theta.dtype).tiny
            return theta - step, floor, change, count + 1, of_steps

        going = lambda carry: (carry[2] > 1e-6) & (carry[3] < max_steps)
        p, one = theta.size, jnp.ones((), theta.dtype)
        shapes = [(frames.n_cells + 2, p), (p, p), (2, p), (3,)]
        empty = tuple(jnp.zeros((len(steps), *shape), theta.dtype) for shape in shapes)
        # First with equal weights. The sums of the last step, where parameters changed by less than 1e-6,
        # also give the covariance: a second trace of the equations would double the compile time.
        start = (theta, one, jnp.inf * one, 0, empty)
        best, _, change, _, of_steps = jax.lax.while_loop(going, newton, start)
        moments, slopes, scales, squares = of_steps
        covariance = sandwich_covariance(moments, slopes.sum(axis=0), scales.sum(axis=0), used)
        n = jnp.maximum(squares[:, 2].sum(), 1)
        return Solution(
            theta=best,
            covariance=covariance,
            misfit=jnp.sqrt(squares[:, 0].sum() / n),
            num_equations=2 * squares[:, 2].sum().astype(int),
            converged=change <= 1e-6,
            slopes=slopes.sum(axis=0),
            scales=scales.sum(axis=0),
        )

    return jax.vmap(solve)(steps, used)
