"""Trajectories as batches of tissues."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import jax
import numpy as np

from vertax.mesh import Tissue, Topology, Trajectory


def parts_of(trajectory: Trajectory) -> list[Tissue]:
    """Successive frames of one topology as one tissue, with a first axis for the frames in other arrays."""
    if len(trajectory) == 0:
        raise ValueError("Argument `content` must have at least one frame, but is empty.")
    # (Successive frames of one topology share its arrays.)
    return [
        _stacked([*run]) for _, run in groupby(trajectory._frames, lambda t: id(t.topology.twin))
    ]


def members_of(part: Tissue) -> list[Tissue]:
    """The frames of one part."""
    take = lambda x, k: x if _is_topology(x) else x[k]
    each = lambda k: jax.tree.map(lambda x: take(x, k), part, is_leaf=_is_topology)
    return [each(k) for k in range(len(part.vertices))]


def _stacked(frames: list[Tissue]) -> Tissue:
    merge = lambda first, *others: first if _is_topology(first) else np.stack([first, *others])
    return jax.tree.map(merge, *frames, is_leaf=_is_topology)


def _is_topology(x: Any) -> bool:
    return isinstance(x, Topology)
