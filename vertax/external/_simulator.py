"""What a program must be able to do that takes the place of the relaxation."""

from __future__ import annotations

import abc
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int, PyTree, Shaped

from vertax.energies import AbstractEnergy
from vertax.mesh import Periodic, Tissue


class SimulatorError(RuntimeError):
    """A program came to no result: it crashed, took too long, or said what cannot be read."""


class Relaxed(NamedTuple):
    """Where a program has come to rest, in NumPy arrays."""

    vertices: Float[np.ndarray, "vertices 2"]
    """Where the vertices are; of a periodic tissue in the same images of the box as before."""
    tissue: Tissue | None = None
    """The tissue in its new topology if that changed (`vertices` count, not its own); its arrays have the
    shapes that they had, and cells and edges keep their numbers."""
    angles: Float[np.ndarray, " edges"] | None = None
    """The angles of its arcs, if it has some."""
    energy: float = float("nan")
    """Its energy, without the nudge."""
    max_force: float = float("nan")
    """The largest force left, if the program knows."""
    num_steps: int = 0
    """Its steps."""
    num_t1: int = 0
    """T1 transitions on the way."""
    slope: PyTree[np.ndarray] = None
    r"""$\partial E/\partial\theta$ there, shaped as the energy, if the program knows: `slope="program"`."""


class AbstractSimulator(abc.ABC):
    r"""A program that brings a tissue to rest, for [`External`][vertax.External].

    Subclass it and write `relax`, in NumPy, or by running a program. All arrays that it is given are NumPy
    arrays, those of `tissue` and `energy` too; [`Edges`][vertax.external.Edges] says who is where. It is
    called from within a compiled program, in which nothing can be computed by JAX: so use no property of the
    tissue beyond its fields.

    A program that can pull at arcs says so by `bends = True`; then its `relax` takes a fourth argument,
    `torques`, of shape `(edges,)`: minimise $E(X) - \sum_v f_v \cdot x_v - \sum_e \tau_e \alpha_e$ with the
    angles $\alpha$ of the arcs.
    """

    bends: ClassVar[bool] = False

    @abc.abstractmethod
    def relax(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        forces: Float[np.ndarray, "vertices 2"] | None,
    ) -> Relaxed | Shaped[np.ndarray, "vertices 2"]:
        r"""Bring a tissue to rest.

        **Arguments:**

        - `tissue`: where to begin.
        - `energy`: what to minimise: its fields hold the parameters.
        - `forces`: a constant force on each vertex, $f$: minimise $E(X) - \sum_v f_v \cdot x_v$. They are
            weak and `tissue` is at rest without them, so there is only a short way to go, and the topology
            must stay. None for the first relaxation.

        **Returns:** the positions at rest, or more of what is known, as
        [`Relaxed`][vertax.external.Relaxed].

        **Raises:** whatever it likes, with a reason, if it comes to no end: the relaxation has failed then.
        """

    def parameter_gradient(self, tissue: Tissue, energy: AbstractEnergy) -> PyTree[np.ndarray]:
        r"""$\partial E / \partial\theta$ of a tissue as it is, for `slope="program"`.

        **Arguments:**

        - `tissue`: where it came to rest.
        - `energy`: holds the parameters.

        **Returns:** the same energy with derivatives in place of its arrays (`equinox.tree_at`, or a new
        one). What is no array does not matter.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `parameter_gradient`, which slope='program' needs. Write it, let "
            "`relax` return a `slope`, or choose External(simulator, slope='energy') or 'differences'."
        )

    def energy(self, tissue: Tissue, energy: AbstractEnergy) -> float:
        """The energy of a tissue as it is, for `slope="differences"`.

        **Arguments:** as in `parameter_gradient`.

        **Returns:** its energy by the program.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `energy`, which slope='differences' needs. Write it, or choose "
            "External(simulator, slope='energy') or 'program'."
        )

    def __repr__(self) -> str:
        # A checkpoint knows a simulator by this text.
        settings = ", ".join(f"{k}={v!r}" for k, v in sorted(vars(self).items()) if k[0] != "_")
        return f"{type(self).__name__}({settings})"


class Edges(NamedTuple):
    """The edges of a tissue as NumPy arrays: all that an energy of lengths, areas and perimeters needs."""

    ends: Int[np.ndarray, "edges 2"]
    """The vertices that each edge joins."""
    across: Float[np.ndarray, "edges 2"]
    """What to add to the second one to see it from the first, across the periodic boundary; else 0."""
    cells: Int[np.ndarray, "edges 2"]
    """The cells on its left and on its right; the number of cells for the outside."""
    shifts: Float[np.ndarray, "edges 2 2"]
    """What to add to the first vertex to see it in the frame of the cell on the left, and on the right."""
    n_cells: int

    @classmethod
    def of(cls, tissue: Tissue) -> Edges:
        """Those of a tissue.

        **Arguments:**

        - `tissue`: the tissue, with arrays of NumPy or of JAX.

        **Returns:** its edges.
        """
        m = tissue.topology
        twin, cell, frame, h = (np.asarray(x) for x in (m.twin, m.cell, m.frame, m.half_edge))
        clockwise = lambda h: np.where(h % 3 == 0, h + 2, h - 1)
        lattice = np.zeros((2, 2))
        if isinstance(tissue.boundary, Periodic):
            lattice = np.asarray(tissue.boundary.lattice, float)
        images = frame @ lattice
        following = clockwise(twin[h])
        return cls(
            np.stack([h // 3, twin[h] // 3], axis=-1),
            images[following] - images[h],
            np.stack([cell[h], cell[twin[h]]], axis=-1),
            np.stack([images[h], images[clockwise(h)]], axis=1),
            m.n_cells,
        )

    def vectors(self, vertices: Float[np.ndarray, "vertices 2"]) -> Float[np.ndarray, "edges 2"]:
        """From the first end of each edge to the second."""
        return vertices[self.ends[:, 1]] + self.across - vertices[self.ends[:, 0]]

    def areas(self, vertices: Float[np.ndarray, "vertices 2"]) -> Float[np.ndarray, " cells"]:
        """Area of each cell, of straight edges."""
        vectors = self.vectors(vertices)
        corners = vertices[self.ends[:, 0], None] + self.shifts
        shares = corners[..., 0] * vectors[:, None, 1] - corners[..., 1] * vectors[:, None, 0]
        return self.sums((0.5 * shares * [1, -1]).ravel())

    def sums(self, values: Float[np.ndarray, " sides"]) -> Float[np.ndarray, " cells"]:
        """Of values on the left and on the right of each edge, in turn, the sum for each cell."""
        return np.bincount(self.cells.ravel(), values, self.n_cells + 1)[: self.n_cells]


class Ledger:
    """What the runs of a program came to so far."""

    def __init__(self) -> None:
        self.runs = 0
        self.failed = 0
        self.seconds = 0.0
        self.failures: deque[str] = deque(maxlen=20)
        self._lock = threading.Lock()

    @contextmanager
    def run(self) -> Iterator[None]:
        """Count a run, and keep why it failed."""
        began = time.perf_counter()
        reason = None
        try:
            yield
        except Exception as error:
            reason = str(error) or type(error).__name__
            if not isinstance(error, SimulatorError):
                reason = f"{type(error).__name__}: {reason}"
            raise
        finally:
            with self._lock:
                self.runs += 1
                self.seconds += time.perf_counter() - began
                if reason is not None:
                    self.failed += 1
                    self.failures.append(reason)


_LEDGERS: weakref.WeakKeyDictionary[Any, Ledger] = weakref.WeakKeyDictionary()


def ledger_of(simulator: AbstractSimulator) -> Ledger:
    """The ledger of a simulator: equal ones share it."""
    return _LEDGERS.setdefault(simulator, Ledger())
