"""Trajectories: a tissue on its way through a relaxation or a fit."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Shaped

from vertax._base.archive import read_archive, write_archive
from vertax.fitting import Record
from vertax.io._tissue_file import tissue_arrays, tissue_from
from vertax.mesh import Tissue, Topology

_VERSION = 1
_TOPOLOGY = ("twin", "cell", "frame", "edge", "half_edge")
_ONCE = ("boundary", "inner_arcs")


class Trajectory(Sequence[Tissue]):
    """A sequence of tissues of one size, its frames, each with some numbers.

    T1 transitions change the topology, so every frame has its own. As the callback of a fit it records
    the equilibrium of each epoch:

    ```python
    trajectory = vx.io.Trajectory(every=10)
    vx.fit(problem, optimiser, epochs=200, callback=trajectory)
    vx.io.save_trajectory("fit.npz", trajectory)
    for tissue, cost in zip(trajectory, trajectory.values["cost"]):
        ...
    ```

    [`record_relaxation`][vertax.io.record_relaxation] records a relaxation. Frames are kept in the memory
    of the host, not of the device.

    **Arguments:**

    - `every`: as a callback, record every so many epochs, beginning with the first.

    **Raises:**

    - `ValueError` if `every` is less than 1.
    """

    every: int

    def __init__(self, *, every: int = 1):
        if every < 1:
            raise ValueError(f"Argument `every` must be at least 1, but is {every}.")
        self.every = every
        self._frames: list[Tissue] = []
        self._values: dict[str, list[int | float]] = {}

    def append(self, tissue: Tissue, **values: ArrayLike) -> None:
        """Add a frame.

        **Arguments:**

        - `tissue`: a single tissue of the same sizes, kind and precision as the frames before.
        - `values`: numbers by name that go with it (a time, a cost), of the same names in each frame.

        **Raises:**

        - `ValueError` for a tissue that does not go with those before, for other names, or for a value
            that is not one number.
        """
        if tissue.vertices.ndim != 2:
            raise ValueError(
                "Argument `tissue` must be a single tissue, but its vertices have shape "
                f"{tissue.vertices.shape}. Record the members of a batch one by one."
            )
        frame: Tissue = jax.tree.map(np.asarray, tissue)
        numbers = {name: _number(name, value) for name, value in values.items()}
        if self._frames:
            last = self._frames[-1]
            if _kind(frame) != _kind(last):
                raise ValueError(
                    "Argument `tissue` must have the sizes, the boundary and the precision of the frames "
                    f"before it ({_sizes(last)}), but does not ({_sizes(frame)})."
                )
            if numbers.keys() != self._values.keys():
                raise ValueError(
                    f"A frame must have the values of those before it ({', '.join(self._values)}), but "
                    f"has: {', '.join(numbers)}."
                )
            if eqx.tree_equal(frame.topology, last.topology):
                frame = frame.with_topology(last.topology)  # the same arrays, held once
        self._frames.append(frame)
        for name, value in numbers.items():
            self._values.setdefault(name, []).append(value)

    def __call__(self, epoch: int, record: Record) -> None:
        """Add the equilibrium of an epoch; the callback of [`fit`][vertax.fit].

        **Arguments:**

        - `epoch`: its number, which is recorded too.
        - `record`: what the fit knows of it, of which cost, largest force and number of T1 transitions
            are recorded.
        """
        if epoch % self.every == 0:
            self.append(
                record.tissue,
                epoch=epoch,
                cost=record.cost,
                max_force=record.max_force,
                num_t1=record.num_t1,
            )

    @property
    def values(self) -> dict[str, Shaped[np.ndarray, " frames"]]:
        """The numbers of all frames by name."""
        return {name: np.asarray(values) for name, values in self._values.items()}

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Tissue: ...

    @overload
    def __getitem__(self, index: slice) -> Trajectory: ...

    def __getitem__(self, index: int | slice) -> Tissue | Trajectory:
        if isinstance(index, slice):
            part = Trajectory(every=self.every)
            part._frames = self._frames[index]
            part._values = {name: values[index] for name, values in self._values.items()}
            return part
        return jax.tree.map(jnp.asarray, self._frames[index])

    def __iter__(self) -> Iterator[Tissue]:
        return (self[i] for i in range(len(self)))


def save_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Save a trajectory to a file, exactly.

    The file is a NumPy `.npz` archive without pickles. Its arrays are those of
    [`save_tissue`][vertax.io.save_tissue] with a first axis for the frames; but those of the topology
    have one for the distinct topologies, and `topology` says which each frame has. The values are there
    as `value_…`. It is written atomically.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `trajectory`: the trajectory, with at least one frame.

    **Raises:**

    - `ValueError` if there is no frame, and as [`save_tissue`][vertax.io.save_tissue].
    - `OSError` if the file cannot be written.
    """
    if len(trajectory) == 0:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    frames = [tissue_arrays(frame) for frame in trajectory._frames]
    topologies = [frame.topology for frame in trajectory._frames]
    new = [
        i
        for i, topology in enumerate(topologies)
        if i == 0 or not eqx.tree_equal(topology, topologies[i - 1])
    ]
    number = np.cumsum(np.isin(np.arange(len(frames)), new)) - 1
    arrays = {"topology": number}
    for name in frames[0]:
        if name in _ONCE:
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
    - `ValueError`, with the file's name, for what is no trajectory, or a broken one, as
        [`load_tissue`][vertax.io.load_tissue].
    """
    name = os.fspath(path)
    arrays = read_archive(path, "trajectory", _VERSION)
    number = arrays.pop("topology", np.zeros(()))
    if number.ndim != 1 or number.dtype.kind != "i" or len(number) == 0:
        raise ValueError(f"{name} is broken: `topology` must number the topologies of the frames.")
    values = {key: arrays.pop(key) for key in [*arrays] if key.startswith("value_")}
    framed = {key: a for key, a in arrays.items() if key not in (*_ONCE, "format", "version")}
    for key, array in (framed | values).items():
        n = number.max() + 1 if key in _TOPOLOGY else len(number)
        if array.ndim == 0 or len(array) != n:
            raise ValueError(
                f"{name} is broken: `{key}` has shape {array.shape}, but must have {n} entries."
            )
    if number.min() < 0 or any(array.shape != number.shape for array in values.values()):
        raise ValueError(f"{name} is broken: `topology` or the values do not go with the frames.")
    topologies: dict[int, Topology] = {}
    trajectory = Trajectory()
    once = {key: arrays[key] for key in _ONCE if key in arrays}
    for i, k in enumerate(number.tolist()):
        own = {
            key: np.asarray(array[k if key in _TOPOLOGY else i]) for key, array in framed.items()
        }
        tissue = tissue_from(once | own, name, topologies.get(k))
        topologies.setdefault(k, tissue.topology)
        trajectory.append(
            tissue, **{key.removeprefix("value_"): column[i] for key, column in values.items()}
        )
    return trajectory


def _number(name: str, value: Any) -> int | float:
    array = np.asarray(value)
    if array.shape != () or array.dtype.kind not in "iuf":
        raise ValueError(f"Value `{name}` must be one number, but is {value!r}.")
    return array.item()


def _kind(frame: Tissue) -> tuple:
    leaves, structure = jax.tree.flatten(frame)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _sizes(frame: Tissue) -> str:
    return (
        f"{frame.n_cells} cells, {frame.n_vertices} vertices, {type(frame.boundary).__name__}, "
        f"{frame.vertices.dtype}"
    )
