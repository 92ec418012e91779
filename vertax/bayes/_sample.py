"""Draws from a posterior by the no-U-turn sampler of BlackJAX."""

from __future__ import annotations

import os
from typing import Any

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.mass_matrix import mass_matrix_adaptation
from blackjax.adaptation.step_size import dual_averaging_adaptation
from blackjax.adaptation.window_adaptation import build_schedule
from blackjax.mcmc.hmc import HMCState
from jaxtyping import Array, Float, Int, PRNGKeyArray
from tqdm import tqdm

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.checkpoints import (
    COMPUTATION,
    Checkpoint,
    CheckpointFile,
    Progress,
    columns_of,
    digest,
    layout,
)
from vertax._base.checks import as_key, check_instance, check_integer
from vertax._base.fingerprint import fingerprint
from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import tree_where
from vertax.bayes._laplace import Laplace, evaluate
from vertax.bayes._log_posterior import LogPosterior, Parameters
from vertax.bayes._posterior import Posterior

_CHUNK = 20
"""Steps between two updates of the progress bar; a checkpoint holds multiples of it."""
_FAST, _SLOW, _END_OF_WINDOW, _DRAW = range(4)
"""What a step adapts: the step size; also the scales, which change at the end of a window; or nothing."""


class _Chain(eqx.Module):
    """State of one chain, or of all, in the coordinates u of the Laplace approximation, z = ẑ + L u."""

    state: Any
    """State of the Hamiltonian Monte Carlo of BlackJAX."""
    step_size: Any
    """State of the dual averaging of BlackJAX."""
    scales: Any
    """State of its estimate of the variance of each u_i."""


@announce_compilations("a sampler")
def sample(
    log_posterior: LogPosterior,
    key: PRNGKeyArray | int,
    *,
    draws: int = 1000,
    warmup: int = 300,
    chains: int = 4,
    start: Parameters | None = None,
    progress: bool = True,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
) -> Posterior:
    r"""Draw parameters from a posterior by the no-U-turn sampler (NUTS) of BlackJAX.

    1. Find the mode and the [`Laplace`][vertax.bayes.Laplace] approximation $N(\hat z, L L^T)$.
    2. Move in $u$ with $z = \hat z + L u$: there the metric of the Laplace approximation is the identity.
    3. Each chain starts at a draw of that approximation. The first steps, in the windows of Stan, adapt its
        step size and the scale of each $u_i$.
    4. Draw.

    A gradient that is not exact costs efficiency and no bias: a leapfrog step with any fixed field of
    gradients is reversible and preserves volume, and the acceptance uses the density alone.

    **Arguments:**

    - `log_posterior`: the density.
    - `key`: a random key or a seed.
    - `draws`: draws of each chain.
    - `warmup`: steps of the adaptation of each chain, not part of the draws; rounded up to a multiple of 20.
    - `chains`: number of chains, one after the other on a CPU and in parallel elsewhere.
    - `start`: see [`Laplace`][vertax.bayes.Laplace].
    - `progress`: show a progress bar (only on a terminal).
    - `checkpoint`: a file or a [`Checkpoint`][vertax.Checkpoint], to continue from if it exists, bit for bit.
        A larger number of `draws` continues a finished run.

    **Returns:** a [`Posterior`][vertax.bayes.Posterior]. It warns of divergences, of rejected relaxations and
    of transitions of the topology.

    **Raises:**

    - `TypeError` for a density that is no `LogPosterior`.
    - `ValueError` for a number below 1 (`warmup` below 20), a checkpoint of another run, and as
        [`Laplace`][vertax.bayes.Laplace].
    """
    check_instance("log_posterior", log_posterior, LogPosterior, "a vertax.bayes.LogPosterior")
    for name, value, least in (("draws", draws, 1), ("warmup", warmup, 20), ("chains", chains, 1)):
        check_integer(name, value, at_least=least)
    key = as_key(key)

    def identity() -> dict[str, str]:
        return {
            "density (sizes, classes or settings)": layout(log_posterior),
            "density (numbers in its arrays)": digest((log_posterior, start)),
            f"density ({COMPUTATION})": fingerprint(
                lambda density: evaluate(density, density.start()), log_posterior
            ),
            "`key`, `warmup` or `chains`": f"{digest(key)} {warmup} {chains}",
        }

    file = CheckpointFile(checkpoint, identity, "run of a sampler")
    laplace = Laplace(log_posterior, start)
    n_warmup = -(-warmup // _CHUNK)
    n_chunks = n_warmup + -(-draws // _CHUNK)
    stages = _stages(n_warmup * _CHUNK, n_chunks * _CHUNK).reshape(n_chunks, _CHUNK)
    keys, start_keys = jax.random.split(key, (2, chains))
    done = file.load(
        jax.tree.map(lambda *x: jnp.stack(x), *(_first(laplace, k) for k in start_keys))
    )
    try:
        with tqdm(
            total=n_chunks * _CHUNK,
            initial=len(done.rows) * _CHUNK,
            unit="step",
            disable=None if progress else True,
        ) as bar:
            while len(done.rows) < n_chunks:
                number = len(done.rows)
                first = jnp.asarray(number * _CHUNK)
                state, row = _advance(laplace, done.state, keys, first, stages[number])
                row = {name: np.asarray(value) for name, value in row.items()}
                done = Progress(state, (*done.rows, row))
                bar.update(_CHUNK)
                file.save_if_due(done)
    finally:
        file.save(done)
    # (chunks, chains, steps of a chunk, …) → (chains, steps, …)
    columns = columns_of(done.rows[:n_chunks])
    joined = {n: np.swapaxes(x, 0, 1).reshape(chains, -1, *x.shape[3:]) for n, x in columns.items()}
    warmup_steps = int(np.sum(joined["n_steps"][:, : n_warmup * _CHUNK]))
    drawn = {name: x[:, n_warmup * _CHUNK :][:, :draws] for name, x in joined.items()}
    # The compiled function of the Laplace approximation: another in `_advance` would double its compilation.
    points = [
        evaluate(log_posterior, jnp.asarray(z)) for z in drawn["z"].reshape(-1, len(laplace.mode))
    ]
    for name in ("num_t1", "shortest_edge"):
        values = np.array([getattr(point.outcome, name) for point in points])
        drawn[name] = values.reshape(chains, draws)
    return Posterior.of(laplace, drawn, warmup_steps)


def _stages(warmup: int, steps: int) -> Int[Array, " steps"]:
    """What each step adapts."""
    schedule = np.asarray(build_schedule(warmup), int)
    stages = np.full(steps, _DRAW)
    stages[:warmup] = np.where(schedule[:, 1], _END_OF_WINDOW, schedule[:, 0])
    return jnp.asarray(stages)


def _first(laplace: Laplace, key: PRNGKeyArray) -> _Chain:
    """A chain at a draw of the Laplace approximation, or at its mode if that draw has no equilibrium."""
    draw = jax.random.normal(key, laplace.mode.shape, laplace.mode.dtype)
    for u in (draw, jnp.zeros_like(draw)):
        point = evaluate(laplace.log_posterior, laplace.mode + laplace.factor @ u)
        if jnp.isfinite(point.log_density):
            break
    slope = laplace.factor.T @ (point.prior_slope + point.data_slope)
    state: Any = HMCState(u, point.log_density, slope)  # pyright: ignore[reportArgumentType]
    adaptation = jax.tree.map(np.asarray, (_STEP_SIZE[0](0.5), _SCALES[0](u.size)))
    # (In the types that `_advance` returns, so that it compiles once.)
    strong = lambda x: jnp.asarray(x, u.dtype if x.dtype.kind == "f" else x.dtype)
    return _Chain(state, *jax.tree.map(strong, adaptation))


# Each a triple of functions: initial state, update, result.
_STEP_SIZE = dual_averaging_adaptation(0.8)
_SCALES = mass_matrix_adaptation(True)


def _adapted(chain: _Chain, stage: Int[Array, ""], acceptance: Float[Array, ""]) -> _Chain:
    """The chain with another step size and other scales, as the stage demands."""
    (restart, update, result), (_, observe, estimate) = _STEP_SIZE, _SCALES
    # (`tree_where` needs arrays; the initial states of BlackJAX have Python numbers.)
    pick = lambda condition, new, old: tree_where(condition, jax.tree.map(jnp.asarray, new), old)
    adapts, ends = stage != _DRAW, stage == _END_OF_WINDOW
    observes = ends | (stage == _SLOW)
    step_size = pick(adapts, update(chain.step_size, acceptance), chain.step_size)
    step_size = pick(ends, restart(result(step_size)), step_size)
    scales = pick(observes, observe(chain.scales, chain.state.position), chain.scales)
    return _Chain(chain.state, step_size, pick(ends, estimate(scales), scales))


@announced_jit
def _advance(
    laplace: Laplace,
    chains: _Chain,
    keys: Array,
    first: Int[Array, ""],
    stages: Int[Array, " steps"],
) -> tuple[_Chain, dict[str, Array]]:
    """The next steps of each chain, numbered from `first`, with an axis of chains and one of steps."""

    def one(
        laplace: Laplace,
        chain: _Chain,
        key: Array,
        first: Int[Array, ""],
        stages: Int[Array, " steps"],
    ) -> tuple[_Chain, dict[str, Array]]:
        kernel = blackjax.nuts.build_kernel()
        density = lambda u: laplace.log_posterior.log_density(laplace.mode + laplace.factor @ u)

        # The key depends on the number of the step: runs with and without a checkpoint are equal.
        def step(chain: _Chain, now: tuple[Array, Array]) -> tuple[_Chain, dict[str, Any]]:
            number, stage = now
            sizes = chain.step_size
            log_step_size = jnp.where(stage == _DRAW, sizes.log_step_size_avg, sizes.log_step_size)
            scales = chain.scales.inverse_mass_matrix
            draw_key = jax.random.fold_in(key, number)
            state, info = kernel(draw_key, chain.state, density, jnp.exp(log_step_size), scales)
            # (A trajectory ends at its first divergence, so a failed relaxation is one of its ends.)
            ends = (info.trajectory_leftmost_state, info.trajectory_rightmost_state)
            rejected = ~jnp.isfinite(ends[0].logdensity) | ~jnp.isfinite(ends[1].logdensity)
            moved = eqx.tree_at(lambda c: c.state, chain, state)
            return _adapted(moved, stage, info.acceptance_rate), {
                "z": laplace.mode + laplace.factor @ state.position,
                "lp": state.logdensity,
                "energy": info.energy,
                "acceptance_rate": info.acceptance_rate,
                "diverging": info.is_divergent,
                "n_steps": info.num_integration_steps,
                "rejected": rejected,
            }

        return jax.lax.scan(step, chain, (first + jnp.arange(_CHUNK), stages))

    run = eqx.filter_vmap(sequential_vmap_on_cpu(one), in_axes=(None, 0, 0, None, None))
    return run(laplace, chains, keys, first, stages)
