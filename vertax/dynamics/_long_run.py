"""Time evolution frame by frame, with a progress bar and checkpoints."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Shaped
from tqdm import tqdm

from vertax._base.announce import announced_jit
from vertax._base.checkpoints import (
    COMPUTATION,
    Checkpoint,
    CheckpointFile,
    Progress,
    Row,
    digest,
    layout,
)
from vertax._base.fingerprint import fingerprint
from vertax._base.results import RESULTS
from vertax._base.tracing import is_concrete
from vertax.adjoints import ImplicitDifferentiation
from vertax.dynamics._evolved import Evolved
from vertax.dynamics._time_integration import (
    Frames,
    State,
    evolved,
    first_frame,
    initial_state,
    integrate,
)
from vertax.mesh import Tissue


def evolve_by_frames(
    tissue: Tissue,
    energy: Any,
    evolution: Any,
    checkpoint: str | os.PathLike[str] | Checkpoint | None,
    *,
    progress: bool,
    throw: bool,
) -> Evolved:
    """As `evolve_at_once`, with one call of a compiled function per frame.

    Each frame is computed by the same program from the final state of the previous frame. Therefore a run
    that continues from a checkpoint gives bitwise the same results as an uninterrupted one.

    **Raises:**

    - `TypeError` inside `jax.jit`, `jax.vmap` or `jax.grad`.
    - `ValueError` for a checkpoint that is broken or of another run.
    - `RuntimeError` if `throw` and a step did not converge; the checkpoint then holds the frames before it.
    """
    if not all(map(is_concrete, jax.tree.leaves((tissue, energy, evolution)))):
        raise TypeError(
            "Arguments `progress` and `checkpoint` do not work inside jax.jit, jax.vmap and jax.grad. Leave "
            "them out there."
        )
    times = np.asarray(evolution.times)
    file = CheckpointFile(checkpoint, lambda: _identity(tissue, energy, evolution), "movement")
    start, first = _initial_state_and_frame(tissue, energy, evolution)
    reached = file.load(start)
    if not reached.rows:
        reached = Progress(start, (_row(times[0], first),))
    _check_times(np.array([row["time"] for row in reached.rows]), times)
    bar = tqdm(
        total=len(times) - 1,
        initial=len(reached.rows) - 1,
        unit="frame",
        disable=None if progress else True,
        desc="compiling",  # until the first frame is done
    )
    try:
        while len(reached.rows) < len(times):
            ends = times[len(reached.rows) - 1 : len(reached.rows) + 1]
            state, frame = _advance(reached.state, energy, _for_one_frame(evolution, ends))
            rows = (*reached.rows, _row(ends[1], frame))
            if throw and bool(state.result != RESULTS.successful):
                _joined_frames(times[: len(rows)], state, rows, first).checked()  # raises the error
            reached = Progress(state, rows)
            bar.set_description(refresh=False)
            bar.set_postfix(time=f"{ends[1]:g}", t1=int(state.num_t1))
            bar.update()
            file.save_if_due(reached)
    except KeyboardInterrupt:
        file.save(reached)
        raise
    finally:
        bar.close()
    file.save(reached)
    return _joined_frames(times, reached.state, reached.rows, first)


def _check_times(stored: np.ndarray, times: np.ndarray) -> None:
    """Raise an error unless the times of a checkpoint are those that `times` begins with, up to rounding."""
    common = min(len(stored), len(times))
    differences = np.abs(stored[:common] - times[:common])
    # The same time computed in two ways, such as 3 * 0.1 and 0.3, differs by units in the last place.
    rounding = 4 * np.finfo(times.dtype).eps * np.max(np.abs(times))
    tolerance = max(_EQUAL_TIMES * np.min(np.diff(times)), rounding)
    if len(stored) <= len(times) and np.all(differences <= tolerance):
        return
    difference = ""
    if np.any(differences > tolerance):
        frame = int(np.argmax(differences > tolerance))
        difference = (
            f"; frame {frame} differs first: {stored[frame]:.17g} there, {times[frame]:.17g} here"
        )
    raise ValueError(
        f"The checkpoint holds frames at other times ({len(stored)}, from {stored[0]:g} to {stored[-1]:g}) "
        f"than argument `times` begins with ({len(times)}, from {times[0]:g} to {times[-1]:g}{difference}). "
        "Give the same times again, followed by further times to continue for longer, or delete the file to "
        "start anew."
    )


# Times that differ by less than this fraction of the shortest frame are equal.
_EQUAL_TIMES = 1e-9


def _joined_frames(times: np.ndarray, end: State, rows: tuple[Row, ...], like: Frames) -> Evolved:
    """The result of an evolution from the rows of its frames."""
    columns = [jnp.asarray(np.stack([row[name] for row in rows])) for name in _names(like)]
    frames = jax.tree.unflatten(jax.tree.structure(like), columns)
    return evolved(jnp.asarray(times), end, frames)


@announced_jit
def _initial_state_and_frame(tissue: Tissue, energy: Any, evolution: Any) -> tuple[State, Frames]:
    start = initial_state(tissue, evolution)
    return start, first_frame(start, energy, evolution)


@announced_jit
def _advance(state: State, energy: Any, evolution: Any) -> tuple[State, Frames]:
    # Nothing is differentiated: one program serves all adjoints.
    return integrate(state, energy, evolution, ImplicitDifferentiation())


def _first_step(tissue: Tissue, energy: Any, evolution: Any) -> tuple[Frames, Frames]:
    """The first two frames of an evolution, to compare evolutions."""
    start, first = _initial_state_and_frame(tissue, energy, evolution)
    _, second = _advance(start, energy, _for_one_frame(evolution, evolution.times))
    return first, second


def _for_one_frame(evolution: Any, ends: Shaped[ArrayLike, "2"]) -> Any:
    """The evolution over one frame; without its key and first drive, which the state replaces."""
    parts: Callable = lambda e: (e.times, e.key, e.drive)
    return eqx.tree_at(parts, evolution, (jnp.asarray(ends), None, None), is_leaf=_is_none)


def _is_none(x: Any) -> bool:
    return x is None


def _names(frames: Frames) -> list[str]:
    return [f"leaf_{number}" for number in range(len(jax.tree.leaves(frames)))]


def _row(time: Any, frames: Frames) -> Row:
    """A frame as NumPy arrays by name."""
    leaves = [np.asarray(x)[0] for x in jax.tree.leaves(frames)]
    return {"time": np.asarray(time)} | dict(zip(_names(frames), leaves, strict=True))


def _identity(tissue: Tissue, energy: Any, evolution: Any) -> dict[str, str]:
    """A description of the run, which a checkpoint must match."""
    # The times are left out: `_check_times` compares the stored ones, and further times may follow.
    without_times = eqx.tree_at(lambda e: e.times, evolution, None)
    parts = (tissue, energy, without_times)
    two_times = eqx.tree_at(lambda e: e.times, evolution, evolution.times[:2])
    return {
        "tissue, energy or setting": layout(parts),
        "tissue, energy or setting (numbers in its arrays)": digest(parts),
        f"tissue, energy or setting ({COMPUTATION})": fingerprint(
            _first_step, tissue, energy, two_times
        ),
    }
