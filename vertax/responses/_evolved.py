"""What happened while a tissue moved."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.modules import is_concrete
from vertax.mesh import Tissue
from vertax.responses._response import Equilibrium
from vertax.responses._trajectory import Trajectory


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
    """How many more were tried and were too long, see [`StepControl`][vertax.responses.StepControl]."""

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
            reason = f"A step in time came to no end, or cells overlap. {_REMEDY}"
            # (A callback to the host takes no keys.)
            keys, rest = eqx.partition(self, _is_key)
            return eqx.combine(eqx.error_if(rest, ~self.converged, reason), keys)
        if np.all(self.sound):
            return self
        first = np.argmin(np.asarray(self.sound), axis=-1).max()
        time = np.asarray(self.times).reshape(-1, np.shape(self.times)[-1])[0, first]
        what = (
            "cells overlap, or the box folds"
            if not np.all(self.valid)
            else "a step in time came to no end"
        )
        if not np.isfinite(np.asarray(self.max_force)).all():
            what = "forces are not finite"
        raise RuntimeError(
            f"On the way to time {time:g} (frame {first}) {what} (largest force "
            f"{np.max(self.max_force):.1e}). {_REMEDY}"
        )

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
