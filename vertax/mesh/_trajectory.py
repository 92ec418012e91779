"""Trajectories: the tissues of a relaxation, a fit or an evolution."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, overload, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Shaped

from vertax._base.checks import check_integer
from vertax._base.model_checks import check_single
from vertax.mesh import Tissue


@runtime_checkable
class _Record(Protocol):
    """The part of the record of an epoch that a trajectory stores."""

    tissue: Tissue
    cost: Array
    max_force: Array
    num_t1: Array


class Trajectory(Sequence[Tissue]):
    """A sequence of tissues of the same size (frames), each with named numbers or arrays.

    T1 transitions change the topology, so each frame has its own. As the callback of a fit it records
    the equilibrium of each epoch:

    ```python
    trajectory = vx.mesh.Trajectory(every=10)
    vx.fit(problem, optimiser, epochs=200, callback=trajectory)
    vx.save("fit.npz", trajectory)
    for tissue, cost in zip(trajectory, trajectory.values["cost"]):
        ...
    ```

    [`record_relaxation`][vertax.relax.record_relaxation] records a relaxation. Frames are
    stored in host memory, not in device memory.

    **Arguments:**

    - `every`: number of epochs between two frames, if used as a callback; the first epoch is recorded.

    **Raises:**

    - `ValueError` if `every` is less than 1.
    """

    every: int

    def __init__(self, *, every: int = 1):
        check_integer("every", every, at_least=1)
        self.every = every
        self._frames: list[Tissue] = []
        self._values: dict[str, list[int | float | np.ndarray]] = {}

    @classmethod
    def from_frames(cls, frames: Tissue, **values: Shaped[ArrayLike, "frames ..."]) -> Trajectory:
        """The trajectory of one tissue with a leading axis, such as the `frames` of an evolution.

        **Arguments:**

        - `frames`: the tissue, each of its arrays with a leading axis.
        - `values`: numbers or arrays of the frames by name, with the same leading axis.

        **Raises:**

        - `ValueError` for a tissue without a leading axis or with several, and as `append`.
        """
        if frames.vertices.ndim != 3:
            raise ValueError(
                "Argument `frames` must be one tissue with one leading axis, but its vertices have shape "
                f"{frames.vertices.shape}. Take one of a batch of them: vertax.fitting.member(batch, 0)."
            )
        trajectory = cls()
        stacked = jax.tree.map(np.asarray, (frames, values))
        for i in range(len(frames.vertices)):
            frame, numbers = jax.tree.map(lambda x, i=i: x[i], stacked)
            trajectory.append(frame, **numbers)
        return trajectory

    def append(self, tissue: Tissue, **values: ArrayLike) -> None:
        """Add a frame.

        **Arguments:**

        - `tissue`: a single tissue of the same sizes, kind and precision as the frames before.
        - `values`: numbers of the frame by name (such as a time or a cost), or arrays of numbers (such as
            concentrations); each frame has the same names and shapes.

        **Raises:**

        - `ValueError` for a tissue of another size, kind or precision, for other names or shapes, or for a
            value that does not hold numbers.
        """
        check_single(tissue, "Record the members of a batch one by one.")
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
            for name, value in numbers.items():
                if np.shape(value) != (shape := np.shape(self._values[name][-1])):
                    raise ValueError(
                        f"Value `{name}` must have the shape of the frames before it, {shape}, but has "
                        f"{np.shape(value)}."
                    )
            if eqx.tree_equal(frame.topology, last.topology):
                frame = frame.with_topology(last.topology)  # share the arrays
        self._frames.append(frame)
        for name, value in numbers.items():
            self._values.setdefault(name, []).append(value)

    def __call__(self, epoch: int, record: _Record) -> None:
        """Add the equilibrium of an epoch; the callback of [`fit`][vertax.fit].

        **Arguments:**

        - `epoch`: its number, recorded as a value.
        - `record`: the record of the fit; its cost, largest force and number of T1 transitions are
            recorded as values.
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
    def values(self) -> dict[str, Shaped[np.ndarray, "frames ..."]]:
        """The numbers of all frames by name; of arrays, such as `signals`, with a first axis for frames."""
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


def _number(name: str, value: Any) -> int | float | np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"Value `{name}` must hold numbers, but is {value!r}.")
    return array if array.shape else array.item()


def _kind(frame: Tissue) -> tuple:
    leaves, structure = jax.tree.flatten(frame)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _sizes(frame: Tissue) -> str:
    return (
        f"{frame.n_cells} cells, {frame.n_vertices} vertices, {type(frame.boundary).__name__}, "
        f"{frame.vertices.dtype}"
    )
