"""Draws from a posterior by the no-U-turn sampler of BlackJAX."""

from __future__ import annotations

import os
from typing import Any

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.mcmc.hmc import HMCState
from jaxtyping import Array, Float, Int, PRNGKeyArray
from tqdm import tqdm

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.checkpoints import (
    Checkpoint,
    CheckpointFile,
    Progress,
    columns_of,
    digest,
    without_addresses,
)
from vertax._base.checks import as_key, check_integer
from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax.bayes._laplace import Laplace, evaluate
from vertax.bayes._log_posterior import LogPosterior, Outcome, Parameters, check_log_posterior
from vertax.bayes._posterior import Posterior

_CHUNK = 20
"""Draws between two updates of the progress bar; a checkpoint holds multiples of it."""


class _Chain(eqx.Module):
    """State of one chain, or of all, in the coordinates u of the Laplace approximation, z = ẑ + L u."""

    state: Any
    """A state of BlackJAX."""
    step_size: Float[Array, "*chains"]
    inverse_mass: Float[Array, "*chains coordinates"]
    warmup_steps: Int[Array, "*chains"]


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
    3. Each chain starts at a draw of that approximation; window adaptation (Stan) adjusts its step size and
        the scale of each $u_i$.
    4. Draw.

    A gradient that is not exact costs efficiency and no bias: a leapfrog step with any fixed field of
    gradients is reversible and preserves volume, and the acceptance uses the density alone.

    **Arguments:**

    - `log_posterior`: the density.
    - `key`: a random key or a seed.
    - `draws`: draws of each chain.
    - `warmup`: steps of the adaptation of each chain, not part of the draws.
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
    check_log_posterior(log_posterior)
    for name, value, least in (("draws", draws, 1), ("warmup", warmup, 20), ("chains", chains, 1)):
        check_integer(name, value, at_least=least)
    key = as_key(key)

    def identity() -> dict[str, str]:
        return {
            "density (sizes, classes or settings)": without_addresses(
                eqx.tree_pformat(log_posterior, short_arrays=True, width=100)
            ),
            "density (numbers in its arrays)": digest((log_posterior, start)),
            "`key`, `warmup` or `chains`": f"{digest(key)} {warmup} {chains}",
        }

    file = CheckpointFile(checkpoint, identity, "run of a sampler")
    laplace = Laplace(log_posterior, start)
    keys = jax.random.split(key, (2, chains))
    n_chunks = -(-draws // _CHUNK)
    done = file.load(_blank(laplace, chains))
    if not np.any(done.state.warmup_steps):
        done = Progress(_warm_up(laplace, *_starts(laplace, keys[0]), warmup))
    try:
        with tqdm(
            total=n_chunks * _CHUNK,
            initial=len(done.rows) * _CHUNK,
            unit="draw",
            disable=None if progress else True,
        ) as bar:
            while len(done.rows) < n_chunks:
                first = jnp.asarray(len(done.rows) * _CHUNK)
                state, row = _advance(laplace, done.state, keys[1], first)
                row = {name: np.asarray(value) for name, value in row.items()}
                done = Progress(state, (*done.rows, row))
                bar.update(_CHUNK)
                file.save_if_due(done)
    finally:
        file.save(done)
    # (chunks, chains, draws of a chunk, …) → (chains, draws, …)
    columns = columns_of(done.rows[:n_chunks])
    joined = {n: np.swapaxes(x, 0, 1).reshape(chains, -1, *x.shape[3:]) for n, x in columns.items()}
    return Posterior.of(
        laplace,
        {name: x[:, :draws] for name, x in joined.items()},
        int(np.sum(done.state.warmup_steps)),
    )


def _density(laplace: Laplace, u: Array) -> tuple[Array, Outcome]:
    """Log density in the coordinates u, up to a constant."""
    posterior, z = laplace.log_posterior, laplace.mode + laplace.factor @ u
    log_likelihood, outcome = posterior.log_likelihood(z)
    return posterior.log_prior(z)[0] + log_likelihood, outcome


def _blank(laplace: Laplace, chains: int) -> _Chain:
    """The layout of the state of all chains, before the adaptation."""
    u = jnp.zeros((chains, len(laplace.mode)), laplace.mode.dtype)
    state: Any = HMCState(u, u[:, 0], u)  # pyright: ignore[reportArgumentType]
    return _Chain(state, u[:, 0], u, jnp.zeros(chains, int))


def _starts(laplace: Laplace, keys: Array) -> tuple[Array, Array]:
    """A key and the first u of each chain: a draw of the Laplace approximation, or its mode."""
    pairs = [jax.random.split(key) for key in keys]
    firsts = []
    for key, _ in pairs:
        u = jax.random.normal(key, laplace.mode.shape, laplace.mode.dtype)
        point = evaluate(laplace.log_posterior, laplace.mode + laplace.factor @ u)
        firsts.append(jnp.where(jnp.isfinite(point.log_density), u, 0))
    return jnp.stack([key for _, key in pairs]), jnp.stack(firsts)


@announced_jit
def _warm_up(laplace: Laplace, keys: Array, firsts: Array, steps: int) -> _Chain:
    """The state of each chain after the adaptation."""

    def one(laplace: Laplace, key: Array, u: Array) -> _Chain:
        density = lambda u: _density(laplace, u)[0]
        adaptation: Any = blackjax.window_adaptation(
            blackjax.nuts,
            density,
            initial_step_size=0.5,
            adaptation_info_fn=lambda state, info, _: info.num_integration_steps,
        )
        (state, tuned), n_steps = adaptation.run(key, u, num_steps=steps)
        inverse_mass = tuned["inverse_mass_matrix"].astype(u.dtype)
        step_size = jnp.asarray(tuned["step_size"], u.dtype)
        return _Chain(state, step_size, inverse_mass, jnp.sum(n_steps).astype(int))

    return eqx.filter_vmap(sequential_vmap_on_cpu(one), in_axes=(None, 0, 0))(laplace, keys, firsts)


@announced_jit
def _advance(
    laplace: Laplace, chains: _Chain, keys: Array, first: Int[Array, ""]
) -> tuple[_Chain, dict[str, Array]]:
    """The next draws of each chain, numbered from `first`, with an axis of chains and one of draws."""

    def one(
        laplace: Laplace, chain: _Chain, key: Array, first: Int[Array, ""]
    ) -> tuple[_Chain, dict[str, Array]]:
        kernel, density = blackjax.nuts.build_kernel(), lambda u: _density(laplace, u)[0]

        # The key depends on the number of the draw: runs with and without a checkpoint are equal.
        def step(state: Any, number: Int[Array, ""]) -> tuple[Any, dict[str, Any]]:
            draw_key = jax.random.fold_in(key, number)
            info: Any
            state, info = kernel(draw_key, state, density, chain.step_size, chain.inverse_mass)
            outcome = _density(laplace, state.position)[1]
            # (A trajectory ends at its first divergence, so a failed relaxation is one of its ends.)
            ends = (info.trajectory_leftmost_state, info.trajectory_rightmost_state)
            rejected = ~jnp.isfinite(ends[0].logdensity) | ~jnp.isfinite(ends[1].logdensity)
            return state, {
                "z": laplace.mode + laplace.factor @ state.position,
                "lp": state.logdensity,
                "energy": info.energy,
                "acceptance_rate": info.acceptance_rate,
                "diverging": info.is_divergent,
                "n_steps": info.num_integration_steps,
                "rejected": rejected,
                "num_t1": outcome.num_t1,
                "shortest_edge": outcome.shortest_edge,
            }

        state, rows = jax.lax.scan(step, chain.state, first + jnp.arange(_CHUNK))
        return eqx.tree_at(lambda c: c.state, chain, state), rows

    run = eqx.filter_vmap(sequential_vmap_on_cpu(one), in_axes=(None, 0, 0, None))
    return run(laplace, chains, keys, first)
