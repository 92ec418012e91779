"""The result of a time evolution: frames, transitions and convergence."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax._base.results import RESULTS
from vertax.mesh import Tissue, Trajectory
from vertax.relax import Equilibrium


class Evolved(Equilibrium):
    """The result of a time evolution; as an [`Equilibrium`][vertax.Equilibrium] it is the last frame.

    `max_force` is the maximum over the steps of the residual force (of energy and dissipation together),
    `num_steps` and `num_t1` are sums over the steps, and `result` is the first failure of a step.
    """

    times: Float[Array, "*batch times"]
    """The times of the frames, starting with the initial time."""
    frames: Tissue
    """The tissue at these times: one tissue with a leading axis."""
    energies: Float[Array, "*batch times"]
    """The energy of each frame."""
    transitions: Int[Array, "*batch times"]
    """T1 transitions since the previous frame."""

    drive: Any
    """The final state of the activity and of its random numbers. A run from the last frame with this `drive`
    continues this run, up to rounding. None without an activity."""
    results: RESULTS
    """The first failure of the steps up to each frame, `successful` if there is none."""
    steps: Float[Array, "*batch times steps"]
    """Sizes of the time steps since the previous frame, padded with 0."""
    num_rejected: Int[Array, "*batch times"]
    """Number of rejected steps since the frame before, see [`PIController`][vertax.dynamics.PIController]."""
    signals: Any
    """The concentrations in each frame, shape `(times, species, cells)`, see
    [`Signals`][vertax.signals.Signals]; in general the record of the activity. None without a record."""

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

    def _details(self) -> str:
        """The time and the force of the member of a batch that fails in the earliest frame."""
        converged = np.asarray(self.results == RESULTS.successful)
        n_times = converged.shape[-1]
        converged = converged.reshape(-1, n_times)
        frames = np.where(converged.all(axis=-1), n_times, np.argmin(converged, axis=-1))
        number = int(np.argmin(frames))
        of_member = lambda x: np.asarray(x).reshape(len(converged), -1)[number]
        time, (force,) = of_member(self.times)[frames[number]], of_member(self.max_force)
        member = f" of member {number}" if self.times.ndim > 1 else ""
        return f"before time {time:g}, frame {frames[number]}{member}; largest force {force:.1e}"

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for files.

        **Raises:**

        - `ValueError` for a batch: take a `member` of it.
        """
        signals = {"signals": self.signals} if eqx.is_array(self.signals) else {}
        return Trajectory.from_frames(
            self.frames, time=self.times, energy=self.energies, num_t1=self.transitions, **signals
        )
