"""Calls of simulators on the host: parallel runs, checks of their results, and conversion to arrays."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree, Shaped

from vertax._base.processes import ProcessDied, ProcessKilled, run_in_process
from vertax._base.tasks import map_tasks
from vertax.external._simulator import AbstractSimulator, Relaxed, SimulatorError, ledger_of
from vertax.mesh import Tissue


class Request(NamedTuple):
    """The arguments of a simulator, in arrays."""

    tissue: Tissue
    energy: Any
    forces: Any
    """Forces on the vertices, or None."""
    torques: Any
    """Torques on the angles of arcs, or None."""


class Job(NamedTuple):
    """One run of a simulator, as a picklable function; its result is in arrays."""

    simulator: AbstractSimulator
    request: Request
    slope: str
    step: float

    def __call__(self) -> Relaxed:
        tissue, energy, forces, torques = self.request
        needs_torques = torques is not None and np.any(torques != 0)
        if needs_torques and not self.simulator.bends:
            raise SimulatorError(
                "The cost depends on the angles of arcs, and this simulator does not support torques on "
                "them. Use a cost of the vertices, or let `relax` take `torques` and set `bends = True`."
            )
        relax: Any = self.simulator.relax
        relaxed = relax(tissue, energy, forces, *([torques] if needs_torques else []))
        relaxed = relaxed if isinstance(relaxed, Relaxed) else Relaxed(relaxed)
        vertices = _array("vertices", relaxed.vertices, np.shape(tissue.vertices))
        angles = None if tissue.arcs is None else tissue.arcs.angles
        if relaxed.angles is not None:
            if angles is None:
                raise SimulatorError("The program returned `angles`, but the tissue has no arcs.")
            angles = _array("angles", relaxed.angles, np.shape(angles))
        topology = relaxed.topology or tissue.topology
        if _shapes(topology) != _shapes(tissue.topology):
            raise SimulatorError("The program returned a topology of another size.")
        changed = np.any(np.asarray(topology.twin) != tissue.topology.twin)
        if forces is not None and changed:
            raise SimulatorError("The program changed the topology of a tissue that was nudged.")
        result = relaxed._replace(
            vertices=vertices,
            topology=topology,
            angles=angles,
            energy=np.asarray(relaxed.energy, vertices.dtype),
            max_force=np.asarray(relaxed.max_force, vertices.dtype),
            num_steps=np.asarray(relaxed.num_steps, np.int32),
            num_t1=np.asarray(relaxed.num_t1, np.int32),
            slope=None,
        )
        if self.slope == "energy":
            return result
        slope = _slope(self, relaxed, with_result(tissue, result), energy)
        return result._replace(slope=slope)


def run_jobs(
    requests: Sequence[Job],
    workers: int,
    processes: bool,
    throw: bool,
    timeout: float | None = None,
) -> tuple[list[Relaxed | None], SimulatorError | None]:
    """Run jobs in parallel; return their results (None for failed ones) and the first error, if any.

    With `processes` each job is killed after `timeout` seconds.
    """
    results: list[Relaxed | None] = [None] * len(requests)
    reasons: list[SimulatorError] = []

    def one(number: int) -> Relaxed:
        job = requests[number]
        with ledger_of(job.simulator).run():
            return _in_process(job, timeout) if processes else job()

    # Requests with NaN, for example from a relaxation that failed before, are not run.
    is_finite = [all(map(_finite, jax.tree.leaves(job.request))) for job in requests]
    numbers = [number for number, finite in enumerate(is_finite) if finite]
    with ThreadPoolExecutor(max(1, min(len(numbers), workers))) as pool:
        for place, result, error in map_tasks(one, numbers, executor=pool, progress=False):
            results[numbers[place]] = result
            if error is not None:
                reasons.append(_as_error(error))
    return results, reasons[0] if reasons else None


def stack_results(
    results: list[Relaxed | None],
    requests: list[Request],
    structures: Relaxed,
    batch: tuple[int, ...],
) -> Relaxed:
    """The results of a batch as arrays of the shapes that JAX expects; NaN for failed runs."""
    structure = jax.tree.structure(structures)
    like = jax.tree.leaves(structures)

    def leaves(result: Relaxed | None, request: Request) -> list[Any]:
        if result is None:
            fill = [np.full(x.shape, np.nan if x.dtype.kind == "f" else 0, x.dtype) for x in like]
            empty = jax.tree.unflatten(structure, fill)
            # (Topologies must hold valid indices, so that of the request is returned.)
            result = empty._replace(topology=eqx.filter(request.tissue.topology, _numeric))
        else:
            result = result._replace(topology=eqx.filter(result.topology, _numeric))
        return jax.tree.leaves(result)

    rows = [leaves(*pair) for pair in zip(results, requests, strict=True)]
    columns = [
        np.stack([np.asarray(row[i]) for row in rows]).astype(x.dtype).reshape((*batch, *x.shape))
        for i, x in enumerate(like)
    ]
    return jax.tree.unflatten(structure, columns)


def _on_cpu(job: Job) -> Relaxed:
    """Run a job in another process, which leaves the accelerator to the main process."""
    jax.config.update("jax_platforms", "cpu")
    return job()


def _in_process(job: Job, timeout: float | None) -> Relaxed:
    try:
        return run_in_process(partial(_on_cpu, job), timeout)
    except ProcessDied as error:
        raise SimulatorError(
            "The process that ran the program died. If it died at its start: a script with a simulator in "
            'processes needs `if __name__ == "__main__":` around its code.'
        ) from error
    except ProcessKilled as error:
        raise SimulatorError(
            f"The program was not done after {timeout:g} s, and its process was killed. If that is too "
            "short, raise `timeout`."
        ) from error


def _as_error(error: Exception) -> SimulatorError:
    if isinstance(error, SimulatorError):
        return error
    wrapped = SimulatorError(f"{type(error).__name__}: {error}")
    wrapped.__cause__ = error
    return wrapped


def _slope(job: Job, relaxed: Relaxed, tissue: Tissue, energy: Any) -> PyTree[np.ndarray]:
    """The partial derivatives of the energy, from the program or from differences."""
    parameters = eqx.filter(energy, _floating)
    if job.slope == "differences":
        return _differences(job, tissue, energy)
    slope = relaxed.slope
    if slope is None:
        slope = job.simulator.parameter_gradient(tissue, energy)
    leaves, structure = jax.tree.flatten(parameters)
    derivatives = jax.tree.leaves(eqx.filter(slope, _numeric))
    if len(derivatives) != len(leaves):
        raise SimulatorError(
            f"The program returned derivatives for {len(derivatives)} arrays, but the energy has "
            f"{len(leaves)}."
        )
    cast = [
        _array("the derivatives", g, x.shape).astype(x.dtype)
        for g, x in zip(derivatives, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, cast)


def _differences(job: Job, tissue: Tissue, energy: Any) -> PyTree[np.ndarray]:
    """Centred differences of the energy of the program, two evaluations per parameter."""
    parameters, constants = eqx.partition(energy, _floating)
    leaves, structure = jax.tree.flatten(parameters)

    def energy_at(number: int, entry: int, step: float) -> float:
        values = [np.array(x) for x in leaves]
        values[number].flat[entry] += step
        shifted = eqx.combine(jax.tree.unflatten(structure, values), constants)
        energy = float(job.simulator.energy(tissue, shifted))
        if not np.isfinite(energy):
            raise SimulatorError(f"The energy by the program is {energy}.")
        return energy

    slopes = []
    for number, x in enumerate(leaves):
        slope = np.zeros_like(x)
        typical = float(np.sqrt(np.mean(np.square(x)))) or 1.0
        for entry, value in enumerate(np.ravel(x)):
            step = job.step * max(abs(float(value)), typical)
            slope.flat[entry] = (
                energy_at(number, entry, step) - energy_at(number, entry, -step)
            ) / (2 * step)
        slopes.append(slope)
    return jax.tree.unflatten(structure, slopes)


def with_result(tissue: Tissue, result: Relaxed) -> Tissue:
    """The tissue with vertices, topology and angles of a result."""
    parts = result.vertices, result.topology
    moved = eqx.tree_at(lambda t: (t.vertices, t.topology), tissue, parts)
    if result.angles is None:
        return moved
    return eqx.tree_at(lambda t: t.arcs.angles, moved, result.angles)


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
