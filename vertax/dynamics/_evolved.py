"""What happened while a tissue moved."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.tracing import is_concrete
from vertax.mesh import Tissue
from vertax.mesh._trajectory import Trajectory
from vertax.relax._response import _NOT_FINITE, Equilibrium


class Evolved(Equilibrium):
    """Where a tissue has gone in time; as an [`Equilibrium`][vertax.Equilibrium] it is the last frame.

    Its `max_force` is the largest that any step was left with, `num_steps` and `num_t1` count those of all
    steps, `valid` and `result` hold if they do for every step. Forces are those of energy and friction
    together.
    """

    times: Float[Array, "*batch times"]
    """The times of the frames, of which the first is the start."""
    frames: Tissue
    """The tissue at these times: the same tissue with a leading axis."""
    energies: Float[Array, "*batch times"]
    """Its energies."""
    transitions: Int[Array, "*batch times"]
    """T1 transitions from the frame before."""

    drive: PyTree[Array]
    """The state of the activity at the end, and of the random numbers: a run that begins there with `drive`
    goes on as if it had not stopped, to rounding. None without an activity."""
    sound: Bool[Array, "*batch times"]
    """Whether all steps up to a frame came to an end, in tissues without overlaps."""
    steps: Float[Array, "*batch times steps"]
    """Lengths in time of the steps to each frame from the one before; 0 where there were no more."""
    refused: Int[Array, "*batch times"]
    """How many more were tried and were too long, see [`StepControl`][vertax.dynamics.StepControl]."""

    @property
    def flipped(self) -> Bool[Array, "*batch times edges"]:
        """Which edges lie between other cells than a frame before."""
        # (Half-edges do not change places when an edge flips, and cells of half-edges do.)
        each = lambda topology: topology.edge_cells
        for _ in self.times.shape:
            each = jax.vmap(each)
        cells = each(self.frames.topology)
        changed = jnp.any(cells[..., 1:, :, :] != cells[..., :-1, :, :], axis=-1)
        return jnp.concatenate([jnp.zeros_like(changed[..., :1, :]), changed], axis=-2)

    def checked(self) -> Evolved:
        """The same, if all steps came to an end.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if one did not, or if cells overlap.
        """
        if not is_concrete(self.sound):
            # Of a batch the message with the largest index is raised.
            messages = (
                f"A step in time did not converge. {_REMEDY}",
                f"On the way of a movement cells overlap, or the box folds. {_REMEDY}",
                f"A movement broke down: {_NOT_FINITE}",
            )
            which = jnp.where(jnp.isfinite(self.max_force), jnp.where(self.valid, 0, 1), 2)
            which = jnp.where(self.converged, 0, which)
            # (A callback to the host takes no keys.)
            keys, rest = eqx.partition(self, _is_key)
            checked = eqx.branched_error_if(rest, ~self.converged, which, messages)
            return eqx.combine(checked, keys)
        if np.all(self.sound):
            return self
        raise RuntimeError(self._first_failure())

    def _first_failure(self) -> str:
        """The message for the member of a batch that fails in the earliest frame, at its own time."""
        sound = np.asarray(self.sound)
        n_times = sound.shape[-1]
        sound = sound.reshape(-1, n_times)
        failed = ~sound.all(axis=-1)
        frames = np.where(failed, np.argmin(sound, axis=-1), n_times)
        number = int(np.argmin(frames))
        of_member = lambda x: np.asarray(x).reshape(len(sound), -1)[number]
        frame, (force,), (valid,) = frames[number], of_member(self.max_force), of_member(self.valid)
        time = of_member(self.times)[frame]
        where = f"On the way to time {time:g} (frame {frame})"
        if self.sound.ndim > 1:
            where += f" of member {number} ({failed.sum()} of {failed.size} failed)"
        if not np.isfinite(force):
            return f"{where} a step broke down: {_NOT_FINITE}"
        reason = "a step in time did not converge" if valid else "cells overlap, or the box folds"
        return f"{where} {reason} (largest force {force:.1e}). {_REMEDY}"

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for files.

        **Raises:**

        - `ValueError` for a batch.
        """
        if self.times.ndim != 1:
            raise ValueError(
                f"This is a batch of {self.times.shape[:-1]} movies, and a trajectory is one. Take a member: "
                "vertax.fitting.member(movies, 0).trajectory."
            )
        trajectory = Trajectory()
        arrays, static = eqx.partition(self.frames, eqx.is_array)
        values = {"time": self.times, "energy": self.energies, "num_t1": self.transitions}
        for number in range(len(self.times)):
            arrays_then, values_then = jax.tree.map(lambda x, i=number: x[i], (arrays, values))
            trajectory.append(eqx.combine(arrays_then, static), **values_then)
        return trajectory


def _is_key(x: Any) -> bool:
    return eqx.is_array(x) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


_REMEDY = (
    "Take shorter steps (more `substeps`, or a greater `most` of their control), raise `max_steps` of its "
    "relaxation or loosen its `tolerance`, or pass throw=False and look at `sound`."
)
