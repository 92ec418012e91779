"""One loop over the frames of a simulation: in one compiled function, or frame by frame."""

from __future__ import annotations

import abc
import os
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Shaped
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
from vertax._base.results import RESULTS, where_is
from vertax._base.tracing import is_concrete

Frame = dict[str, PyTree]

# Times that differ by less than this fraction of the shortest frame are equal.
_EQUAL_TIMES = 1e-9


class AbstractSimulation(eqx.Module):
    """A state that advances from frame to frame: a motion, a growth, a quasi-static deformation.

    A frame is a dictionary: what the state is at one of the `points`, which are times or strains.
    """

    name: ClassVar[str]
    """The simulation in messages, e.g. `"movement"`."""
    points: ClassVar[str]
    """The points in messages, e.g. `"times"`."""

    @abc.abstractmethod
    def begin(self, start: PyTree, points: Float[Array, " points"]) -> tuple[Any, Frame]:
        """The initial state, with a field `result`, and the frame of the first point.

        **Arguments:**

        - `start`: what the state is made of, e.g. a tissue and a random key.
        - `points`: the points, at least the first two.
        """

    def keys(self, start: PyTree, n: int) -> Shaped[Array, "intervals ..."] | None:
        """A random key for each of n intervals; the first ones must not depend on n."""
        return None

    @abc.abstractmethod
    def advance(self, state: Any, interval: Float[Array, "2"], key: Any) -> tuple[Any, Frame]:
        """The state and the frame at the end of an interval between two points, with a random key or None."""

    @abc.abstractmethod
    def outcome(self, points: Float[Array, " points"], end: Any, frames: Frame) -> Any:
        """The result from the final state and all frames, as one with a leading axis."""

    @abc.abstractmethod
    def counts(self, state: Any) -> dict[str, Array]:
        """Numbers for the progress bar."""


def simulate(
    simulation: AbstractSimulation,
    start: PyTree,
    points: Float[Array, " points"],
    *,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    throw: bool = True,
) -> Any:
    """All frames of a simulation.

    With `progress` or `checkpoint`, each frame is a call of a compiled function from the final state of the
    frame before. Therefore a run that continues from a checkpoint gives bitwise the same results as an
    uninterrupted one.

    **Arguments:**

    - `simulation`, `start`, `points`: see [`AbstractSimulation`][].
    - `progress`: show a progress bar on a terminal.
    - `checkpoint`: the file of the frames so far.
    - `throw`: raise an error if a frame failed.

    **Raises:**

    - `TypeError` for `progress` or `checkpoint` inside `jax.jit`, `jax.vmap` or `jax.grad`.
    - `ValueError` for a checkpoint that is broken or of another run.
    - `RuntimeError` if `throw` and a frame failed; the checkpoint then holds the frames before it.
    """
    if progress or checkpoint is not None:
        outcome = _by_frames(simulation, start, points, progress, checkpoint, throw)
    else:
        outcome = _at_once(simulation, start, points)
    return outcome.checked() if throw else outcome


@announced_jit
def _at_once(simulation: AbstractSimulation, start: PyTree, points: Float[Array, " points"]) -> Any:
    state, first = simulation.begin(start, points)
    (arrays, first), static = eqx.partition((state, first), eqx.is_array)

    def advance(arrays: Any, inputs: tuple) -> tuple[Any, Frame]:
        after = simulation.advance(eqx.combine(arrays, static[0]), *inputs)
        return eqx.filter(after, eqx.is_array)

    intervals = jnp.stack([points[:-1], points[1:]], axis=-1)
    arrays, later = jax.lax.scan(
        advance, arrays, (intervals, simulation.keys(start, len(intervals)))
    )
    frames = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later)
    return simulation.outcome(points, *eqx.combine((arrays, frames), static))


def _by_frames(
    simulation: AbstractSimulation,
    start: PyTree,
    points: Float[Array, " points"],
    progress: bool,
    checkpoint: str | os.PathLike[str] | Checkpoint | None,
    throw: bool,
) -> Any:
    if not all(map(is_concrete, jax.tree.leaves((simulation, start, points)))):
        raise TypeError(
            "Arguments `progress` and `checkpoint` do not work inside jax.jit, jax.vmap and jax.grad. Leave "
            "them out there."
        )
    numbers, keys = np.asarray(points), simulation.keys(start, len(points) - 1)
    identity = lambda: _identity(simulation, start, points, None if keys is None else keys[0])
    file = CheckpointFile(checkpoint, identity, simulation.name)
    state, first = _begin(simulation, start, points[:2])
    reached = file.load(state)
    if not reached.rows:
        reached = Progress(state, (_row(numbers[0], first),))
    check_points(simulation, np.array([row["point"] for row in reached.rows]), numbers)
    bar = tqdm(
        total=len(numbers) - 1,
        initial=len(reached.rows) - 1,
        unit="frame",
        disable=None if progress else True,
        desc="compiling",  # until the first frame is done
    )
    try:
        while (number := len(reached.rows)) < len(numbers):
            key = None if keys is None else keys[number - 1]
            interval = jnp.asarray(numbers[number - 1 : number + 1])
            state, frame = _advance(simulation, reached.state, interval, key)
            rows = (*reached.rows, _row(numbers[number], frame))
            if throw and not where_is(state.result, RESULTS.successful):
                # Raises the error of the frame.
                _joined(simulation, points[: number + 1], state, rows, first).checked()
            reached = Progress(state, rows)
            bar.set_description(refresh=False)
            if not bar.disable:
                counts = {name: int(count) for name, count in simulation.counts(state).items()}
                bar.set_postfix({simulation.points[:-1]: f"{numbers[number]:g}"} | counts)
            bar.update()
            file.save_if_due(reached)
    except KeyboardInterrupt:
        file.save(reached)
        raise
    finally:
        bar.close()
    file.save(reached)
    return _joined(simulation, points, reached.state, reached.rows, first)


@announced_jit
def _begin(
    simulation: AbstractSimulation, start: PyTree, points: Float[Array, "2"]
) -> tuple[Any, Frame]:
    return simulation.begin(start, points)


@announced_jit
def _advance(
    simulation: AbstractSimulation,
    state: Any,
    interval: Float[Array, "2"],
    key: PRNGKeyArray | None,
) -> tuple[Any, Frame]:
    return simulation.advance(state, interval, key)


def _joined(
    simulation: AbstractSimulation,
    points: Float[Array, " points"],
    end: Any,
    rows: tuple[Row, ...],
    like: Frame,
) -> Any:
    """The result from the rows of the frames."""
    arrays, static = eqx.partition(like, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    columns = [jnp.asarray(np.stack([row[str(i)] for row in rows])) for i in range(len(leaves))]
    frames = eqx.combine(jax.tree.unflatten(structure, columns), static)
    return simulation.outcome(points, end, frames)


def _row(point: Any, frame: Frame) -> Row:
    """The arrays of a frame by their number."""
    leaves = jax.tree.leaves(eqx.filter(frame, eqx.is_array))
    return {"point": np.asarray(point)} | {str(i): np.asarray(x) for i, x in enumerate(leaves)}


def _first_frames(
    simulation: AbstractSimulation, start: PyTree, points: Array, key: PRNGKeyArray | None
) -> tuple[Frame, Frame]:
    """The first two frames, to compare simulations."""
    state, first = _begin(simulation, start, points)
    return first, _advance(simulation, state, points, key)[1]


def _identity(
    simulation: AbstractSimulation,
    start: PyTree,
    points: Float[Array, " points"],
    key: PRNGKeyArray | None,
) -> dict[str, str]:
    """A description of the run, which a checkpoint must match."""
    # The points are left out: `check_points` compares the stored ones, and further ones may follow.
    parts = (simulation, start, key)
    name = "tissue, energy or setting"
    return {
        name: layout(parts),
        f"{name} (numbers in its arrays)": digest(parts),
        f"{name} ({COMPUTATION})": fingerprint(_first_frames, simulation, start, points[:2], key),
    }


def check_points(
    simulation: AbstractSimulation | type[AbstractSimulation],
    stored: np.ndarray,
    points: np.ndarray,
) -> None:
    """Raise an error unless the points of a checkpoint are the first ones of a run, up to rounding."""
    common = min(len(stored), len(points))
    differences = np.abs(stored[:common] - points[:common])
    # The same time computed in two ways, such as 3 * 0.1 and 0.3, differs by units in the last place.
    rounding = 4 * np.finfo(points.dtype).eps * np.max(np.abs(points))
    tolerance = max(_EQUAL_TIMES * np.min(np.abs(np.diff(points))), rounding)
    if len(stored) <= len(points) and np.all(differences <= tolerance):
        return
    difference = ""
    if np.any(differences > tolerance):
        frame = int(np.argmax(differences > tolerance))
        difference = (
            f"; frame {frame} differs first: {stored[frame]:.17g} there, {points[frame]:.17g} here"
        )
    raise ValueError(
        f"The checkpoint holds frames at other {simulation.points} ({len(stored)}, from {stored[0]:g} to "
        f"{stored[-1]:g}) than this {simulation.name} begins with ({len(points)}, from {points[0]:g} to "
        f"{points[-1]:g}{difference}). Give the same {simulation.points} again, followed by further ones to "
        "continue for longer, or delete the file to start anew."
    )
