"""The result of a time evolution: frames, transitions and convergence."""

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
    """The result of a time evolution; as an [`Equilibrium`][vertax.Equilibrium] it is the last frame.

    `max_force` is the maximum over the steps of the residual force (of energy and dissipation together),
    `num_steps` and `num_t1` are sums over the steps, and `valid` and `result` are successful if they are for
    every step.
    """

    times: Float[Array, "*batch times"]
    """The times of the frames, starting with the initial time."""
    frames: Tissue
    """The tissue at these times: one tissue with a leading axis."""
    energies: Float[Array, "*batch times"]
    """The energy of each frame."""
    transitions: Int[Array, "*batch times"]
    """T1 transitions since the previous frame."""

    drive: PyTree[Array]
    """The final state of the activity and of its random numbers. A run from the last frame with this `drive`
    continues this run, up to rounding. None without an activity."""
    sound: Bool[Array, "*batch times"]
    """Whether all steps up to each frame converged, without overlaps."""
    steps: Float[Array, "*batch times steps"]
    """Sizes of the time steps since the previous frame, padded with 0."""
    refused: Int[Array, "*batch times"]
    """Number of rejected steps since the previous frame, see [`StepControl`][vertax.dynamics.StepControl]."""

    @property
    def flipped(self) -> Bool[Array, "*batch times edges"]:
        """Whether the cells on both sides of each edge changed since the previous frame."""
        # (A flip changes the cells of an edge, but not the indices of its half-edges.)
        edge_cells = lambda topology: topology.edge_cells
        for _ in self.times.shape:
            edge_cells = jax.vmap(edge_cells)
        cells = edge_cells(self.frames.topology)
        changed = jnp.any(cells[..., 1:, :, :] != cells[..., :-1, :, :], axis=-1)
        return jnp.concatenate([jnp.zeros_like(changed[..., :1, :]), changed], axis=-2)

    def checked(self) -> Evolved:
        """Return self if all steps converged.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if a step did not converge, or if cells overlap.
        """
        if not is_concrete(self.sound):
            # In a batch the message with the largest index is raised.
            messages = (
                f"A time step did not converge. {_REMEDY}",
                f"During a time evolution cells overlap, or the box folds. {_REMEDY}",
                f"A time evolution broke down: {_NOT_FINITE}",
            )
            index = jnp.where(jnp.isfinite(self.max_force), jnp.where(self.valid, 0, 1), 2)
            index = jnp.where(self.converged, 0, index)
            # (Random keys cannot be arguments of a callback to the host.)
            keys, rest = eqx.partition(self, _is_key)
            checked = eqx.branched_error_if(rest, ~self.converged, index, messages)
            return eqx.combine(checked, keys)
        if np.all(self.sound):
            return self
        raise RuntimeError(self._first_failure())

    def _first_failure(self) -> str:
        """The error message for the member of a batch that fails in the earliest frame."""
        sound = np.asarray(self.sound)
        n_times = sound.shape[-1]
        sound = sound.reshape(-1, n_times)
        failed = ~sound.all(axis=-1)
        frames = np.where(failed, np.argmin(sound, axis=-1), n_times)
        number = int(np.argmin(frames))
        of_member = lambda x: np.asarray(x).reshape(len(sound), -1)[number]
        frame, (force,), (valid,) = frames[number], of_member(self.max_force), of_member(self.valid)
        time = of_member(self.times)[frame]
        context = f"Before time {time:g} (frame {frame})"
        if self.sound.ndim > 1:
            context += f" of member {number} ({failed.sum()} of {failed.size} failed)"
        if not np.isfinite(force):
            return f"{context} a step broke down: {_NOT_FINITE}"
        reason = "a time step did not converge" if valid else "cells overlap, or the box folds"
        return f"{context} {reason} (largest force {force:.1e}). {_REMEDY}"

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for files.

        **Raises:**

        - `ValueError` for a batch.
        """
        if self.times.ndim != 1:
            raise ValueError(
                f"This is a batch of shape {self.times.shape[:-1]}, but a trajectory is a single evolution. "
                "Select a member: vertax.fitting.member(movies, 0).trajectory."
            )
        trajectory = Trajectory()
        arrays, static = eqx.partition(self.frames, eqx.is_array)
        values = {"time": self.times, "energy": self.energies, "num_t1": self.transitions}
        for number in range(len(self.times)):
            frame, frame_values = jax.tree.map(lambda x, i=number: x[i], (arrays, values))
            trajectory.append(eqx.combine(frame, static), **frame_values)
        return trajectory


def _is_key(x: Any) -> bool:
    return eqx.is_array(x) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


_REMEDY = (
    "Take shorter steps (more `substeps`, or a greater `most` of the StepControl), raise `max_steps` of the "
    "relaxation or loosen its `tolerance`, or pass throw=False and check `sound`."
)
