"""Movement in time frame by frame, which shows how far it has come and can be resumed."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from vertax._base.announce import announced_jit
from vertax._base.checkpoints import (
    Checkpoint,
    CheckpointFile,
    Progress,
    Row,
    digest,
    without_addresses,
)
from vertax._base.tracing import is_concrete
from vertax.adjoints import AbstractAdjoint
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._time_integration import Frames, State, begin, evolved, first_frame, march
from vertax.mesh import Tissue


def evolve_by_frames(
    tissue: Tissue,
    energy: Any,
    evolution: Any,
    adjoint: AbstractAdjoint,
    checkpoint: str | os.PathLike[str] | Checkpoint | None,
    *,
    progress: bool,
    throw: bool,
) -> Evolved:
    """As `evolve_at_once`, one compiled function a frame.

    Each frame is the same program, which begins with the state that the last one ended with: a run that goes
    on from a file is the one that never stopped.

    **Raises:**

    - `TypeError` inside `jax.jit`, `jax.vmap` or `jax.grad`.
    - `ValueError` for a checkpoint that is broken or of something else.
    - `RuntimeError` if `throw` and a step came to no end: at once, and the checkpoint stays before it.
    """
    if not all(map(is_concrete, jax.tree.leaves((tissue, energy, evolution)))):
        raise TypeError(
            "`progress` and `checkpoint` belong to movements that run outside jax.jit, jax.vmap and "
            "jax.grad: leave them out there."
        )
    times = np.asarray(evolution.times)
    file = CheckpointFile(checkpoint, lambda: _identity(tissue, energy, evolution), "movement")
    start, first = _begin(tissue, energy, evolution)
    done = file.load(start)
    if not done.rows:
        done = Progress(start, (_row(times[0], first),))
    _check_times(np.array([row["time"] for row in done.rows]), times)
    bar = tqdm(
        total=len(times) - 1,
        initial=len(done.rows) - 1,
        unit="frame",
        disable=None if progress else True,
        desc="compiling",  # while the first frame stands at 0
    )
    try:
        while len(done.rows) < len(times):
            ends = times[len(done.rows) - 1 : len(done.rows) + 1]
            state, frame = _advance(done.state, energy, _between(evolution, ends), adjoint)
            rows = (*done.rows, _row(ends[1], frame))
            if throw and not bool(frame.sound[0]):
                _joined(
                    times[: len(rows)], state, rows, first
                ).checked()  # says what happened, and when
            done = Progress(state, rows)
            bar.set_description(refresh=False)
            bar.set_postfix(time=f"{ends[1]:g}", t1=int(state.num_t1))
            bar.update()
            file.save_if_due(done)
    except KeyboardInterrupt:
        file.save(done)
        raise
    finally:
        bar.close()
    file.save(done)
    return _joined(times, done.state, done.rows, first)


def _check_times(stored: np.ndarray, times: np.ndarray) -> None:
    """Raise an error unless the times of a checkpoint are those that `times` begins with, up to rounding."""
    common = min(len(stored), len(times))
    differences = np.abs(stored[:common] - times[:common])
    # The same time computed in two ways, such as 3 * 0.1 and 0.3, differs by units in the last place.
    rounding = 4 * np.finfo(times.dtype).eps * np.max(np.abs(times))
    tolerance = max(_EQUAL_TIMES * np.min(np.diff(times)), rounding)
    if len(stored) <= len(times) and np.all(differences <= tolerance):
        return
    where = ""
    if np.any(differences > tolerance):
        frame = int(np.argmax(differences > tolerance))
        where = (
            f"; frame {frame} differs first: {stored[frame]:.17g} there, {times[frame]:.17g} here"
        )
    raise ValueError(
        f"The checkpoint holds frames at other times ({len(stored)}, from {stored[0]:g} to {stored[-1]:g}) "
        f"than argument `times` begins with ({len(times)}, from {times[0]:g} to {times[-1]:g}{where}). Give "
        "the same times again, with more after them if it is to go on for longer, or delete the file to "
        "start anew."
    )


# Times that differ by less than this fraction of the shortest frame are equal.
_EQUAL_TIMES = 1e-9


def _joined(times: np.ndarray, end: State, rows: tuple[Row, ...], like: Frames) -> Evolved:
    """All frames as one."""
    columns = [jnp.asarray(np.stack([row[name] for row in rows])) for name in _names(like)]
    frames = jax.tree.unflatten(jax.tree.structure(like), columns)
    return evolved(jnp.asarray(times), end, frames)


@announced_jit
def _begin(tissue: Tissue, energy: Any, evolution: Any) -> tuple[State, Frames]:
    start = begin(tissue, evolution)
    return start, first_frame(start, energy, evolution)


@announced_jit
def _advance(
    state: State, energy: Any, evolution: Any, adjoint: AbstractAdjoint
) -> tuple[State, Frames]:
    return march(state, energy, evolution, adjoint)


def _between(evolution: Any, ends: np.ndarray) -> Any:
    """The same evolution from one frame to the next; its key and its first drive are used up."""
    pieces: Callable = lambda e: (e.times, e.key, e.drive)
    return eqx.tree_at(pieces, evolution, (jnp.asarray(ends), None, None), is_leaf=_is_none)


def _is_none(x: Any) -> bool:
    return x is None


def _names(frames: Frames) -> list[str]:
    return [f"leaf_{number}" for number in range(len(jax.tree.leaves(frames)))]


def _row(time: Any, frames: Frames) -> Row:
    """A frame as arrays of the host by name."""
    leaves = [np.asarray(x)[0] for x in jax.tree.leaves(frames)]
    return {"time": np.asarray(time)} | dict(zip(_names(frames), leaves, strict=True))


def _identity(tissue: Tissue, energy: Any, evolution: Any) -> dict[str, str]:
    """What makes this movement another one than others."""
    # Of times those that are done must agree, and others may follow.
    endless = eqx.tree_at(lambda e: e.times, evolution, None)
    parts = (tissue, energy, endless)
    return {
        "tissue, energy or setting": without_addresses(
            eqx.tree_pformat(parts, short_arrays=True, width=100)
        ),
        "tissue, energy or setting (numbers in its arrays)": digest(parts),
    }
