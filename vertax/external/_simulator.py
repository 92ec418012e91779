"""The interface of external simulators, and their results."""

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
from vertax.mesh import Periodic, Tissue, Topology


class SimulatorError(RuntimeError):
    """A program failed: it crashed, exceeded its timeout, or its output is invalid."""


class Relaxed(NamedTuple):
    """The result of a relaxation by a program, in NumPy arrays."""

    vertices: Float[np.ndarray, "vertices 2"]
    """Positions of the vertices; in periodic tissues in the same images of the box as in the input."""
    topology: Topology | None = None
    """The new topology if it changed, with the shapes and the indices of cells and edges of the input."""
    angles: Float[np.ndarray, " edges"] | None = None
    """The angles of arcs, for tissues with arcs."""
    energy: float = float("nan")
    """The energy, without the nudge."""
    max_force: float = float("nan")
    """The largest residual force, if available."""
    num_steps: int = 0
    """Number of steps."""
    num_t1: int = 0
    """Number of T1 transitions."""
    slope: PyTree[np.ndarray] = None
    r"""$\partial E/\partial\theta$ at the result, shaped as the energy, for `slope="program"`."""


class AbstractSimulator(abc.ABC):
    r"""A program that relaxes a tissue, for [`External`][vertax.External].

    Subclass it and write `relax`, in NumPy, or by running a program. All arrays in its arguments are NumPy
    arrays, including those of `tissue` and `energy`; [`Edges`][vertax.external.Edges] gives the connectivity.
    The method is called inside a callback from a compiled function, where JAX must not be called: use the
    fields of the tissue only, not its properties.

    A simulator that supports torques on arcs sets `bends = True`; then its `relax` takes a fourth argument,
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
        r"""Relax a tissue.

        **Arguments:**

        - `tissue`: the initial tissue.
        - `energy`: the energy to minimise: its fields hold the parameters.
        - `forces`: a constant force on each vertex, $f$: minimise $E(X) - \sum_v f_v \cdot x_v$. The forces
            are weak and `tissue` is at rest without them, so displacements are small, and the topology must
            not change. None for the first relaxation.

        **Returns:** the positions at rest, or a [`Relaxed`][vertax.external.Relaxed] with further results.

        **Raises:** any exception, with a message, if the relaxation fails.
        """

    def parameter_gradient(self, tissue: Tissue, energy: AbstractEnergy) -> PyTree[np.ndarray]:
        r"""$\partial E / \partial\theta$ of a tissue without relaxation, for `slope="program"`.

        **Arguments:**

        - `tissue`: the relaxed tissue.
        - `energy`: the energy, which stores the parameters.

        **Returns:** the energy with derivatives in the place of its arrays (`equinox.tree_at`, or a new
            object). Other fields are ignored.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `parameter_gradient`, which slope='program' needs. Write it, let "
            "`relax` return a `slope`, or choose External(simulator, slope='energy') or 'differences'."
        )

    def energy(self, tissue: Tissue, energy: AbstractEnergy) -> float:
        """The energy of a tissue without relaxation, for `slope="differences"`.

        **Arguments:** as in `parameter_gradient`.

        **Returns:** the energy.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `energy`, which slope='differences' needs. Write it, or choose "
            "External(simulator, slope='energy') or 'program'."
        )

    def __repr__(self) -> str:
        # Checkpoints compare simulators by this text.
        settings = ", ".join(f"{k}={v!r}" for k, v in sorted(vars(self).items()) if k[0] != "_")
        return f"{type(self).__name__}({settings})"


def clockwise(h: Int[np.ndarray, " half_edges"]) -> Int[np.ndarray, " half_edges"]:
    """The next half-edge at the same vertex, clockwise."""
    return np.where(h % 3 == 0, h + 2, h - 1)


class Edges(NamedTuple):
    """The edges of a tissue as NumPy arrays: all that an energy of lengths, areas and perimeters needs."""

    ends: Int[np.ndarray, "edges 2"]
    """Indices of the two vertices of each edge."""
    across: Float[np.ndarray, "edges 2"]
    """The periodic translation of the second vertex relative to the first; 0 inside the box."""
    cells: Int[np.ndarray, "edges 2"]
    """The cells on the left and on the right of each edge; the number of cells for the exterior."""
    shifts: Float[np.ndarray, "edges 2 2"]
    """The translation of the first vertex into the frame of the cell on the left, and on the right."""
    n_cells: int

    @classmethod
    def of(cls, tissue: Tissue) -> Edges:
        """The edges of a tissue.

        **Arguments:**

        - `tissue`: the tissue, with arrays of NumPy or of JAX.

        **Returns:** its edges.
        """
        m = tissue.topology
        twin, cell, frame, h = (np.asarray(x) for x in (m.twin, m.cell, m.frame, m.half_edge))
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
        """Sum values over the edges of each cell; values alternate between left and right sides of edges."""
        return np.bincount(self.cells.ravel(), values, self.n_cells + 1)[: self.n_cells]


class Ledger:
    """Statistics of the runs of a program: counts, time, and error messages."""

    def __init__(self) -> None:
        self.runs = 0
        self.failed = 0
        self.seconds = 0.0
        self.failures: deque[str] = deque(maxlen=20)
        self._lock = threading.Lock()

    @contextmanager
    def run(self) -> Iterator[None]:
        """Time a run, and store its error message if it fails."""
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
    """The ledger of a simulator; equal simulators share one."""
    return _LEDGERS.setdefault(simulator, Ledger())
