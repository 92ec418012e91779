"""The side of a call to another program that JAX does not see: many at a time, and what comes back."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree, Shaped

from vertax.external._simulator import AbstractSimulator, Relaxed, SimulatorError, ledger_of
from vertax.external._workers import elsewhere
from vertax.mesh import Tissue


class Request(NamedTuple):
    """What a simulator is asked, in arrays."""

    tissue: Tissue
    energy: Any
    forces: Any
    """On the vertices; None for none."""
    torques: Any
    """On the angles of arcs."""


class Answer(NamedTuple):
    """What it says, in arrays: what is not known is NaN."""

    vertices: Any
    angles: Any
    topology: Any
    energy: Any
    max_force: Any
    num_steps: Any
    num_t1: Any
    slope: Any


class Job(NamedTuple):
    """One question to a simulator, in a form that goes to another process."""

    simulator: AbstractSimulator
    request: Request
    slope: str
    step: float

    def __call__(self) -> Answer:
        tissue, energy, forces, torques = self.request
        bends = torques is not None and np.any(torques != 0)
        if bends and not self.simulator.bends:
            raise SimulatorError(
                "The cost depends on the angles of arcs, and this program cannot be told to pull on them. "
                "Use a cost of the vertices, or let `relax` take `torques` and say so by `bends = True`."
            )
        relax: Any = self.simulator.relax
        said = relax(tissue, energy, forces, *([torques] if bends else []))
        said = said if isinstance(said, Relaxed) else Relaxed(said)
        vertices = _array("vertices", said.vertices, np.shape(tissue.vertices))
        angles = None if tissue.arcs is None else tissue.arcs.angles
        if said.angles is not None:
            if angles is None:
                raise SimulatorError("The program returned `angles`, but the tissue has no arcs.")
            angles = _array("angles", said.angles, np.shape(angles))
        topology = tissue.topology
        if said.tissue is not None:
            topology = said.tissue.topology
            if _shapes(topology) != _shapes(tissue.topology):
                raise SimulatorError("The program returned a tissue of another size.")
        changed = np.any(np.asarray(topology.twin) != tissue.topology.twin)
        if forces is not None and changed:
            raise SimulatorError("The program changed the topology of a tissue that was nudged.")
        slope = None
        if self.slope != "energy":
            there = _there(tissue, topology, vertices, angles)
            slope = _slope(self, said, there, energy)
        return Answer(
            vertices,
            angles,
            topology,
            np.asarray(said.energy, vertices.dtype),
            np.asarray(said.max_force, vertices.dtype),
            np.asarray(said.num_steps, np.int32),
            np.asarray(said.num_t1, np.int32),
            slope,
        )


def ask(
    requests: Sequence[Job],
    workers: int,
    processes: bool,
    throw: bool,
    timeout: float | None = None,
) -> tuple[list[Answer | None], SimulatorError | None]:
    """The answers to some questions, side by side; None, and the first reason, where there is none.

    In processes of their own they may take `timeout` seconds each.
    """
    reasons: list[SimulatorError] = []

    def one(job: Job) -> Answer | None:
        try:
            with ledger_of(job.simulator).run():
                return elsewhere(job, timeout) if processes else job()
        except Exception as error:
            reasons.append(_as_error(error))
            return None

    # An array that is not finite has no equilibrium: the relaxation before, say, has failed already.
    sound = [all(map(_finite, jax.tree.leaves(job.request))) for job in requests]
    asked = [job for job, ok in zip(requests, sound, strict=True) if ok]
    if min(len(asked), workers) > 1:
        with ThreadPoolExecutor(min(len(asked), workers)) as pool:
            found = list(pool.map(one, asked))
    else:
        found = [one(job) for job in asked]
    answers = iter(found)
    return [next(answers) if ok else None for ok in sound], reasons[0] if reasons else None


def stacked(
    answers: list[Answer | None], requests: list[Request], wanted: Answer, batch: tuple[int, ...]
) -> Answer:
    """The answers of a batch as JAX expects them; NaN where there is none."""
    structure = jax.tree.structure(wanted)
    like = jax.tree.leaves(wanted)

    def leaves(answer: Answer | None, request: Request) -> list[Any]:
        if answer is None:
            nothing = [
                np.full(x.shape, np.nan if x.dtype.kind == "f" else 0, x.dtype) for x in like
            ]
            empty = jax.tree.unflatten(structure, nothing)
            # An index that is none would be worse than a position.
            answer = empty._replace(topology=eqx.filter(request.tissue.topology, _numeric))
        else:
            answer = answer._replace(topology=eqx.filter(answer.topology, _numeric))
        return jax.tree.leaves(answer)

    rows = [leaves(*pair) for pair in zip(answers, requests, strict=True)]
    columns = [
        np.stack([np.asarray(row[i]) for row in rows]).astype(x.dtype).reshape((*batch, *x.shape))
        for i, x in enumerate(like)
    ]
    return jax.tree.unflatten(structure, columns)


def _as_error(error: Exception) -> SimulatorError:
    if isinstance(error, SimulatorError):
        return error
    told = SimulatorError(f"{type(error).__name__}: {error}")
    told.__cause__ = error
    return told


def _slope(job: Job, said: Relaxed, tissue: Tissue, energy: Any) -> PyTree[np.ndarray]:
    """The partial derivatives of the energy as the program has it."""
    wanted = eqx.filter(energy, _floating)
    if job.slope == "differences":
        return _differences(job, tissue, energy)
    slope = said.slope
    if slope is None:
        slope = job.simulator.parameter_gradient(tissue, energy)
    leaves, structure = jax.tree.flatten(wanted)
    given = jax.tree.leaves(eqx.filter(slope, _numeric))
    if len(given) != len(leaves):
        raise SimulatorError(
            f"The program returned derivatives for {len(given)} arrays, but the energy has {len(leaves)}."
        )
    named = [
        _array("the derivatives", g, x.shape).astype(x.dtype)
        for g, x in zip(given, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, named)


def _differences(job: Job, tissue: Tissue, energy: Any) -> PyTree[np.ndarray]:
    """Centred differences of the energy of the program, two for each parameter."""
    parameters, constants = eqx.partition(energy, _floating)
    leaves, structure = jax.tree.flatten(parameters)

    def at(number: int, place: int, step: float) -> float:
        moved = [np.array(x) for x in leaves]
        moved[number].flat[place] += step
        there = eqx.combine(jax.tree.unflatten(structure, moved), constants)
        energy = float(job.simulator.energy(tissue, there))
        if not np.isfinite(energy):
            raise SimulatorError(f"The energy by the program is {energy}.")
        return energy

    slopes = []
    for number, x in enumerate(leaves):
        slope = np.zeros_like(x)
        typical = float(np.sqrt(np.mean(np.square(x)))) or 1.0
        for place, value in enumerate(np.ravel(x)):
            step = job.step * max(abs(float(value)), typical)
            slope.flat[place] = (at(number, place, step) - at(number, place, -step)) / (2 * step)
        slopes.append(slope)
    return jax.tree.unflatten(structure, slopes)


def _there(tissue: Tissue, topology: Any, vertices: np.ndarray, angles: Any) -> Tissue:
    there = eqx.tree_at(lambda t: (t.vertices, t.topology), tissue, (vertices, topology))
    if angles is None:
        return there
    return eqx.tree_at(lambda t: t.arcs.angles, there, angles)


def _array(name: str, value: Any, shape: tuple[int, ...]) -> Shaped[np.ndarray, "..."]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.shape != tuple(shape):
        raise SimulatorError(
            f"The program returned `{name}` as an array of shape {array.shape} and type {array.dtype}, but "
            f"it must hold real numbers in the shape {tuple(shape)}."
        )
    if not np.isfinite(array).all():
        raise SimulatorError(f"The program returned `{name}` with NaN or infinity in it.")
    return array if array.dtype.kind == "f" else array.astype(float)


def _shapes(tree: PyTree) -> list[tuple[int, ...]]:
    return [np.shape(x) for x in jax.tree.leaves(tree)]


def _numeric(x: Any) -> bool:
    return isinstance(x, np.ndarray | np.generic | jax.Array)


def _floating(x: Any) -> bool:
    return _numeric(x) and np.issubdtype(x.dtype, np.floating)


def _finite(x: Any) -> bool:
    return not _floating(x) or bool(np.isfinite(x).all())
