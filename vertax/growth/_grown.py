"""The result of a growth: frames, cell states, lineage and convergence."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.results import RESULTS, AbstractOutcome
from vertax.growth._lineage import Lineage
from vertax.mesh import Tissue, Trajectory


class Grown(AbstractOutcome):
    """Result of [`grow`][vertax.growth.grow]."""

    tissue: Tissue
    """The final tissue."""
    cells: Any
    """The final cell states, see [`AbstractLifeCycle`][vertax.growth.AbstractLifeCycle]."""
    times: Float[Array, "*batch times"]
    """The times of the frames; the first is the initial time."""
    frames: Tissue
    """The tissue at these times, with a leading axis."""
    cells_then: Any
    """The cell states at these times, with a leading axis."""
    number: Int[Array, "*batch times cells"]
    """Index in the lineage of the cell in each slot; -1 for spare slots."""
    lineage: Lineage
    """The mother, birth and end of each cell."""
    results: RESULTS
    """The first failure of the steps up to each frame, `successful` if there is none: a relaxation that did
    not converge, overlaps, a division without a spare slot, a lineage with too few records, or the death of
    one of the last two cells of a free tissue, after which the tissue does not change."""
    failed_divisions: Int[Array, "*batch times"]
    """Number of failed divisions up to a frame: there was no spare slot, or the cell could not be cut in two.
    A failed division is tried again, and counted again, in each following step."""
    failed_deaths: Int[Array, "*batch times"]
    """Number of overdue deaths up to a frame (see `overdue` of the life cycle), e.g. because a neighbour
    would have too few sides without the cell. Counted again in each step."""
    log_likelihood: Float[Array, "*batch"]
    """Log-likelihood of the discrete random choices of the life cycle, see
    [`score_function`][vertax.growth.score_function]."""

    signals: Any
    """The concentrations in each frame, shape `(times, species, cells)`, 0 in spare slots; see
    [`Signals`][vertax.signals.Signals]. In general the record of the activity, None without one."""

    @property
    def n_alive(self) -> Int[Array, "*batch times"]:
        """Number of living cells in each frame."""
        return jnp.sum(self.number >= 0, axis=-1)

    @property
    def trajectory(self) -> Trajectory:
        """The frames as a trajectory, for [`animate`][vertax.animate] and for writing files."""
        signals = {"signals": self.signals} if eqx.is_array(self.signals) else {}
        return Trajectory.from_frames(self.frames, time=self.times, cells=self.n_alive, **signals)

    @property
    def result(self) -> RESULTS:
        """How the growth ended: the first failure."""
        return jax.tree.map(lambda x: x[..., -1], self.results)

    def _details(self) -> str:
        return f"{self.tissue.n_cells} cell slots, {self.lineage.mother.shape[-1]} records"
