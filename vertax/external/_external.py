"""A response that another program computes, differentiated by equilibrium propagation."""

from __future__ import annotations

import dataclasses
import os
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from vertax._base.checks import check_choice, check_instance, check_integer, check_number
from vertax._base.model_checks import check_energy, check_planar
from vertax._base.results import RESULTS
from vertax._base.scales import Scales
from vertax._base.tracing import frozen, is_concrete, traced
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation
from vertax.energies import AbstractEnergy
from vertax.energies._scales import scales_of
from vertax.external._external_gradient import ExternalEquilibrium, attach_gradient, force_of
from vertax.external._host import Job, Request, run_jobs, stack_results, with_result
from vertax.external._simulator import AbstractSimulator, Ledger, Relaxed, SimulatorError, ledger_of
from vertax.mesh import Tissue
from vertax.relax import AbstractResponse, Equilibrium
from vertax.relax._equilibrium import follow_start, free_motions
from vertax.relax._response import with_overlaps


class External(AbstractResponse):
    r"""Relaxation by an external program, differentiated by equilibrium propagation.

    The program need not be differentiable, nor use JAX or Python. It computes equilibria: one of the energy,
    and for a gradient one or two more under a weak constant force on each vertex. The gradient also needs
    $\partial E/\partial\theta$ at these equilibria.

    ```python
    problem = vx.InverseProblem(
        tissue, energy, cost, response=vx.External(simulator), adjoint=vx.EquilibriumPropagation()
    )
    fit = vx.fit(problem, optax.adam(1e-2), epochs=100)
    ```

    Works under `jax.jit`, `jax.vmap` (members of a batch run in parallel) and `jax.grad` in reverse mode.

    **Arguments:**

    - `simulator`: the program, an [`AbstractSimulator`][vertax.external.AbstractSimulator].
    - `slope`: the method for $\partial E/\partial\theta$. `"energy"`: by JAX from the energy, which must
        describe the program; the forces of this energy are checked to vanish at the result. `"program"`: by
        the program. `"differences"`: by centred differences of the energy of the program, two evaluations
        (no relaxation) per parameter. With the last two the energy only stores the parameters.
    - `tolerance`: largest force of the energy at convergence, in units of energy per length; by default
        $10^{-6}\,k \ell$ in float64 and $10^{-3}\,k \ell$ in float32 with the units of
        [`Relaxation`][vertax.Relaxation]. Used only if `slope` is `"energy"`.
    - `stiffness`: a typical second derivative $k$ of the energy, the unit of the nudge; by default
        that of the energy. Required unless `slope` is `"energy"`.
    - `workers`: number of parallel runs, by default the number of processors.
    - `processes`: run in separate processes instead of threads: for simulators in Python, which threads
        cannot run in parallel, and for programs that may crash. The simulator must be picklable, and a
        script needs `if __name__ == "__main__":`.
    - `step`: step of the differences, relative to the parameter.
    - `timeout`: seconds after which a run is killed and counts as failed. It requires `processes`, because a
        thread cannot be killed. Programs that a simulator runs by
        [`run_program`][vertax.external.run_program] have a separate limit.

    **Raises:**

    - `TypeError` if `simulator` is not an `AbstractSimulator`.
    - `ValueError` for another `slope`, a missing `stiffness`, and numbers that are not positive.
    """

    simulator: AbstractSimulator = eqx.field(static=True)
    slope: Literal["energy", "program", "differences"] = eqx.field(static=True, default="energy")
    tolerance: float | Float[Array, ""] | None = None
    stiffness: float | Float[Array, ""] | None = None
    workers: int | None = eqx.field(static=True, default=None)
    processes: bool = eqx.field(static=True, default=False)
    step: float = eqx.field(static=True, default=1e-4)
    timeout: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        expected = "a vertax.external.AbstractSimulator"
        check_instance("simulator", self.simulator, AbstractSimulator, expected)
        check_choice("slope", self.slope, ("energy", "program", "differences"))
        if self.slope != "energy" and self.stiffness is None:
            raise ValueError(
                "Argument `stiffness` is missing: it is the unit of the nudge, and is computed from the "
                "energy only for slope='energy'. Pass a typical second derivative of the energy, e.g. "
                "stiffness=1.0; the `beta` of the adjoint multiplies it."
            )
        for name in ("tolerance", "stiffness", "step", "timeout"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0, many=True)
        if self.workers is not None:
            check_integer("workers", self.workers, at_least=1)
        if self.timeout is not None and not self.processes:
            raise ValueError(
                "Argument `timeout` needs processes=True: a simulator in a thread cannot be killed."
            )

    @property
    def prefers_batching(self) -> bool:
        """True: the runs of a batch are started at the same time."""
        return True

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint = EquilibriumPropagation(),
        throw: bool = True,
    ) -> Equilibrium:
        """Relax a tissue by the program.

        **Arguments:**

        - `tissue`: the initial tissue.
        - `energy`: the energy, which stores the parameters.
        - `adjoint`: [`EquilibriumPropagation`][vertax.EquilibriumPropagation], with a linear nudge.
        - `throw`: raise an error if the program fails, or reaches no equilibrium. If False, check `converged`
            and `last_error_message()`.

        **Returns:** an [`Equilibrium`][vertax.Equilibrium].

        **Raises:**

        - [`SimulatorError`][vertax.external.SimulatorError] if the program fails; inside `jax.jit` and
            `jax.grad` an error of JAX that quotes it.
        - `RuntimeError` if the result is not at rest, or its cells overlap.
        - `ValueError` for another adjoint, or a tissue on a surface.
        """
        check_planar("another program", tissue)
        if isinstance(
            energy, type
        ):  # (Other objects are allowed: a program may need parameters only.)
            check_energy(energy)
        self.check_compatible(adjoint)
        assert isinstance(adjoint, EquilibriumPropagation)
        inputs = (tissue, energy, self, adjoint)
        concrete = all(map(is_concrete, jax.tree.leaves(inputs)))
        failed = self.ledger.failed
        response = self.traced()
        equilibrium = _relax_externally(
            *traced((tissue, energy), tissue.vertices.dtype),
            response,
            adjoint,
            throw and not concrete,
        )
        if not throw:
            return equilibrium
        if concrete and self.ledger.failed > failed:
            raise SimulatorError(self.last_error_message())
        if concrete and np.any(equilibrium.result == RESULTS.nonlinear_max_steps_reached):
            raise RuntimeError(
                "The tissue that the program returned is not at rest under the energy (largest force "
                f"{np.max(equilibrium.max_force):.1e}). {_REMEDY}"
            )
        return equilibrium.checked()

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Raise an error for all adjoints except equilibrium propagation with constant forces.

        **Arguments:** as for every response.

        **Raises:**

        - `ValueError` for another adjoint, a nudge by the cost, and guidance.
        """
        if not isinstance(adjoint, EquilibriumPropagation):
            raise ValueError(
                f"{type(adjoint).__name__} needs derivatives of the relaxation, and an external program has "
                "none. Pass adjoint=vertax.EquilibriumPropagation(), which needs relaxations only."
            )
        if adjoint.nudge == "cost" or guided:
            option = "`guidance`" if guided else "EquilibriumPropagation(nudge='cost')"
            raise ValueError(
                f"{option} adds the cost to the relaxed energy, which an external program cannot do. Use "
                "EquilibriumPropagation(), which adds a constant force, and no guidance."
            )

    def last_error_message(self) -> str | None:
        """The error message of the last failure of the program; None if it never failed."""
        failures = self.ledger.failures
        return f"{type(self.simulator).__name__} failed: {failures[-1]}" if failures else None

    @property
    def ledger(self) -> Ledger:
        """The number of runs of the program so far, their time in seconds, and error messages."""
        return ledger_of(self.simulator)

    def traced(self) -> External:
        """A copy with its numbers as arrays: other values need no recompilation."""
        numbers = {name: traced(getattr(self, name)) for name in ("tolerance", "stiffness")}
        return dataclasses.replace(self, **numbers)

    def finer(self, tolerance: Float[Array, ""]) -> External:
        """A copy that also requires the largest force to be below this tolerance."""
        if self.tolerance is not None:
            tolerance = jnp.minimum(tolerance, self.tolerance)
        return dataclasses.replace(self, tolerance=tolerance)

    def scales(self, tissue: Tissue, energy: AbstractEnergy) -> Scales:
        """The typical sizes."""
        if self.slope == "energy" and self.stiffness is None:
            return scales_of(tissue, energy)
        return Scales(tissue.cell_size, jnp.asarray(self.stiffness, tissue.vertices.dtype))

    def run_simulator(self, request: Request, throw: bool) -> Relaxed:
        """Run the program for one request, inside a compiled function; batches run in parallel."""
        arrays, static = eqx.partition(request, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        tissue = request.tissue
        number: Any = jax.ShapeDtypeStruct((), tissue.vertices.dtype)
        integer: Any = jax.ShapeDtypeStruct((), jnp.int32)
        shapes = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
        slope = None if self.slope == "energy" else eqx.filter(request.energy, eqx.is_inexact_array)
        dynamic, fixed = eqx.partition(tissue.topology, eqx.is_array)
        structures = Relaxed(
            vertices=shapes(tissue.vertices),
            angles=shapes(tissue.angles),
            topology=shapes(dynamic),
            energy=number,
            max_force=number,
            num_steps=integer,
            num_t1=integer,
            slope=shapes(slope),
        )
        ranks = [x.ndim for x in leaves]
        workers = self.workers or os.cpu_count() or 1

        def host(*arrays: Any) -> Relaxed:
            host_arrays = [np.asarray(x) for x in arrays]
            batch = host_arrays[0].shape[: host_arrays[0].ndim - ranks[0]]
            n = int(np.prod(batch))
            rows = [x.reshape((n, *x.shape[len(batch) :])) for x in host_arrays]
            requests = [
                eqx.combine(jax.tree.unflatten(structure, [row[i] for row in rows]), static)
                for i in range(n)
            ]
            jobs = [Job(self.simulator, r, self.slope, self.step) for r in requests]
            results, reason = run_jobs(jobs, workers, self.processes, throw, self.timeout)
            if throw and reason is not None:
                raise reason
            return stack_results(results, requests, structures, batch)

        result = jax.pure_callback(host, structures, *leaves, vmap_method="broadcast_all")
        return result._replace(topology=eqx.combine(result.topology, fixed))


_REMEDY = (
    "Its energy may differ from the argument `energy`; or it stops too early: then let it take more steps, "
    "or raise the `tolerance` of External."
)


@eqx.filter_jit
def _relax_externally(
    tissue: Tissue,
    energy: AbstractEnergy,
    response: External,
    adjoint: EquilibriumPropagation,
    throw: bool,
) -> Equilibrium:
    start, constant = frozen((tissue, energy))
    result: Any = frozen(response.run_simulator(Request(start, constant, None, None), throw))
    relaxed = with_result(start, result)
    scales = response.scales(relaxed, constant)
    slope_by_energy = response.slope == "energy"
    # For a program the rigid motions without stiffness are unknown: assume all of them.
    free = (
        free_motions(relaxed, constant, scales)
        if slope_by_energy
        else jnp.ones(_n_motions(relaxed), bool)
    )
    if slope_by_energy:
        # If the energy is invariant under all rigid motions, move the result to the position of the start.
        settled = relaxed.settled(start)
        relaxed = relaxed.with_vertices(
            jnp.where(jnp.all(free), settled.vertices, relaxed.vertices)
        )
    slots = (energy, tissue.boundary, adjoint.outcome)
    equilibrium = ExternalEquilibrium(relaxed, result.slope, free, scales)
    configuration = attach_gradient(slots, equilibrium, response, adjoint.without_outcome())
    with_boundary = eqx.tree_at(lambda t: t.boundary, relaxed, tissue.boundary)
    final = with_boundary.with_configuration(configuration)
    if slope_by_energy:
        final = follow_start(final, tissue, free)
    force = optx.max_norm(force_of(relaxed, constant)) if slope_by_energy else result.max_force
    return Equilibrium(
        tissue=final,
        energy=energy(final) if slope_by_energy else result.energy,
        max_force=force,
        num_steps=result.num_steps,
        num_t1=result.num_t1,
        result=_result(relaxed, force, response, scales),
    )


def _result(tissue: Tissue, force: Float[Array, ""], response: External, scales: Scales) -> RESULTS:
    is_converged = jnp.array(True)
    if response.slope == "energy":
        tolerance = response.tolerance
        if tolerance is None:
            precise = tissue.vertices.dtype == jnp.float64
            tolerance = (1e-6 if precise else 1e-3) * scales.force
        is_converged = force <= tolerance
    result = RESULTS.where(is_converged, RESULTS.successful, RESULTS.nonlinear_max_steps_reached)
    finite = jnp.all(jnp.isfinite(tissue.vertices))
    return with_overlaps(RESULTS.where(finite, result, RESULTS.nonfinite), tissue.overlaps.any)


def _n_motions(tissue: Tissue) -> int:
    return jax.eval_shape(lambda x: tissue.boundary.motions(x, x[0, 0]), tissue.vertices).shape[0]
