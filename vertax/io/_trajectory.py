"""Files of trajectories."""

from __future__ import annotations

import os

import equinox as eqx
import numpy as np

from vertax._base.archive import read_archive, write_archive
from vertax.io._tissue_file import tissue_arrays, tissue_from
from vertax.mesh import Topology, Trajectory

_VERSION = 1
_TOPOLOGY = ("twin", "cell", "frame", "edge", "half_edge")
_ONCE = ("boundary", "inner_arcs", "spare")


def save_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Save a trajectory to a file, exactly.

    The file is a NumPy `.npz` archive without pickles. Its arrays are those of
    [`save_tissue`][vertax.io.save_tissue] with a first axis for the frames; those of the topology
    have a first axis for the distinct topologies, and `topology` is the number of that of each frame. Values
    are stored as `value_…`. It is written atomically.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `trajectory`: the trajectory, with at least one frame.

    **Raises:**

    - `ValueError` if there is no frame, if frames have different surfaces, and as
        [`save_tissue`][vertax.io.save_tissue].
    - `OSError` if the file cannot be written.
    """
    if len(trajectory) == 0:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    tissues = list(trajectory)
    frames = [tissue_arrays(tissue) for tissue in tissues]
    topologies = [tissue.topology for tissue in tissues]
    new = [
        i
        for i, topology in enumerate(topologies)
        if i == 0 or not eqx.tree_equal(topology, topologies[i - 1])
    ]
    number = np.cumsum(np.isin(np.arange(len(frames)), new)) - 1
    arrays = {"topology": number}
    surfaces = [tissue.surface for tissue in tissues]
    if not all(eqx.tree_equal(surface, surfaces[0]) for surface in surfaces):
        raise ValueError(
            "Argument `trajectory` must have one surface to be saved, but it differs between frames. Save "
            "the frames one by one with save_tissue."
        )
    for name in frames[0]:
        if _is_stored_once(name):
            arrays[name] = frames[0][name]
        else:
            chosen = [frames[i] for i in new] if name in _TOPOLOGY else frames
            arrays[name] = np.stack([frame[name] for frame in chosen])
    arrays |= {f"value_{name}": values for name, values in trajectory.values.items()}
    write_archive(path, "trajectory", _VERSION, arrays)


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Load a trajectory that [`save_trajectory`][vertax.io.save_trajectory] wrote.

    **Arguments:**

    - `path`: the file.

    **Returns:** the trajectory, each frame bit for bit as it was saved.

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError`, with the file's name, if it is not a trajectory file or is broken, as
        [`load_tissue`][vertax.io.load_tissue].
    """
    name = os.fspath(path)
    arrays = read_archive(path, "trajectory", _VERSION)
    number = arrays.pop("topology", np.zeros(()))
    if number.ndim != 1 or number.dtype.kind != "i" or len(number) == 0:
        raise ValueError(f"{name} is broken: `topology` must number the topologies of the frames.")
    values = {key: arrays.pop(key) for key in [*arrays] if key.startswith("value_")}
    once = {key: a for key, a in arrays.items() if _is_stored_once(key)}
    framed = {key: a for key, a in arrays.items() if key not in (*once, "format", "version")}
    for key, array in (framed | values).items():
        n = number.max() + 1 if key in _TOPOLOGY else len(number)
        if array.ndim == 0 or len(array) != n:
            raise ValueError(
                f"{name} is broken: `{key}` has shape {array.shape}, but must have {n} entries."
            )
    if number.min() < 0 or any(array.shape[:1] != number.shape for array in values.values()):
        raise ValueError(f"{name} is broken: `topology` or the values do not match the frames.")
    topologies: dict[int, Topology] = {}
    trajectory = Trajectory()
    for i, k in enumerate(number.tolist()):
        frame = {
            key: np.asarray(array[k if key in _TOPOLOGY else i]) for key, array in framed.items()
        }
        tissue = tissue_from(once | frame, name, topologies.get(k))
        topologies.setdefault(k, tissue.topology)
        trajectory.append(
            tissue, **{key.removeprefix("value_"): column[i] for key, column in values.items()}
        )
    return trajectory


def _is_stored_once(name: str) -> bool:
    """Whether an array is the same in all frames."""
    return name in _ONCE or name.startswith("surface")
