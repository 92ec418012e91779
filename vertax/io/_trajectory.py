"""Files of trajectories."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import groupby
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vertax._base.archive import as_jax
from vertax.io._module_file import check_tissue, load_module, save_module
from vertax.mesh import Tissue, Topology, Trajectory


class _Frames(eqx.Module):
    """The frames of a trajectory."""

    parts: list[Tissue]
    """Successive frames of one topology, with a first axis for the frames in all other arrays."""
    values: dict[str, np.ndarray]


def save_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Save a trajectory to a file, exactly.

    The format is that of [`save_energy`][vertax.io.save_energy]: successive frames of one topology are one
    batch of tissues, `data.parts.0` and so on, and the values are `data.values.0` and so on.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `trajectory`: the trajectory, with at least one frame.

    **Raises:**

    - `ValueError` if there is no frame, and as [`save_tissue`][vertax.io.save_tissue].
    - `OSError` if the file cannot be written.
    """
    if len(trajectory) == 0:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    # (Successive frames of one topology share its arrays.)
    parts = [
        _stacked([*run]) for _, run in groupby(trajectory._frames, lambda t: id(t.topology.twin))
    ]
    save_module(path, "trajectory", _Frames(parts, trajectory.values), _Frames, [_Frames])


def load_trajectory(
    path: str | os.PathLike[str], *, classes: Iterable[type[eqx.Module]] = ()
) -> Trajectory:
    """Load a trajectory that [`save_trajectory`][vertax.io.save_trajectory] wrote.

    **Arguments:**

    - `path`: the file.
    - `classes`: as of [`load_tissue`][vertax.io.load_tissue].

    **Returns:** the trajectory, each frame bit for bit as it was saved.

    **Raises:** as [`load_tissue`][vertax.io.load_tissue].
    """
    name = os.fspath(path)
    held = load_module(path, "trajectory", _Frames, [_Frames, *classes])
    trajectory = Trajectory()
    try:
        parts = jax.tree.map(lambda x: as_jax(x, name), held.parts)
        frames = [frame for part in parts for frame in _members(part)]
        for frame in frames:
            check_tissue(frame)
        for k, frame in enumerate(frames):
            trajectory.append(frame, **{key: column[k] for key, column in held.values.items()})
        if any(len(column) != len(frames) for column in held.values.values()):
            raise ValueError(f"its values are not those of {len(frames)} frames")
    except Exception as error:  # of NumPy and JAX, for arrays that do not fit
        raise ValueError(f"{name} is broken: {error}") from error
    return trajectory


def _is_topology(x: Any) -> bool:
    return isinstance(x, Topology)


def _stacked(frames: list[Tissue]) -> Tissue:
    merge = lambda first, *others: first if _is_topology(first) else np.stack([first, *others])
    return jax.tree.map(merge, *frames, is_leaf=_is_topology)


def _members(part: Tissue) -> list[Tissue]:
    take = lambda x, k: x if _is_topology(x) else x[k]
    each = lambda k: jax.tree.map(lambda x: take(x, k), part, is_leaf=_is_topology)
    return [each(k) for k in range(len(part.vertices))]
