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

from vertax._base.checks import check_integer, check_number, describe
from vertax._base.tracing import is_concrete, traced
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation
from vertax.adjoints._adjoint import frozen
from vertax.energies import AbstractEnergy
from vertax.energies._energy import check_energy
from vertax.energies._units import Units, cell_size, units_of
from vertax.external._external_gradient import Rest, at_rest, force_of
from vertax.external._host import Answer, Job, Request, ask, stacked
from vertax.external._simulator import AbstractSimulator, Ledger, SimulatorError, ledger_of
from vertax.mesh import Tissue
from vertax.relax import RESULTS
from vertax.relax._equilibrium import follow_start, free_motions
from vertax.relax._response import AbstractResponse, Equilibrium


class External(AbstractResponse):
    r"""Another program brings the tissue to rest, and equilibrium propagation differentiates through it.

    The program need not be differentiable, nor in JAX, nor in Python. It is asked for equilibria: first of
    the energy, and for a gradient once more (or twice) under a weak constant force on each vertex. All else
    that the gradient takes is $\partial E/\partial\theta$ where the vertices came to rest.

    ```python
    problem = vx.InverseProblem(
        tissue, energy, cost, response=vx.External(simulator), adjoint=vx.EquilibriumPropagation()
    )
    fit = vx.fit(problem, optax.adam(1e-2), epochs=100)
    ```

    Works under `jax.jit`, `jax.vmap` (the members run side by side) and `jax.grad` in reverse mode.

    **Arguments:**

    - `simulator`: the program, an [`AbstractSimulator`][vertax.external.AbstractSimulator].
    - `slope`: where $\partial E/\partial\theta$ comes from. `"energy"`: from the energy, which describes the
        program, by JAX; it is checked that what the program returns is at rest by this energy too.
        `"program"`: from the program. `"differences"`: from differences of the energy that the program
        computes, two energies (no relaxation) for each parameter. With the latter two the energy need do no
        more than hold the parameters.
    - `tolerance`: largest force, by the energy, that counts as equilibrium, in units of energy per length; by
        default $10^{-6}\,k \ell$ in float64 and $10^{-3}\,k \ell$ in float32 with the units of
        [`Relaxation`][vertax.Relaxation]. Not looked at unless `slope` is `"energy"`.
    - `stiffness`: a typical second derivative $k$ of the energy, in which the nudge is measured; by default
        that of the energy. Needed unless `slope` is `"energy"`.
    - `workers`: how many runs at a time, by default as many as there are processors.
    - `processes`: run in processes of their own, and not in threads: for programs in Python, which keep each
        other waiting otherwise, and for those that may crash. The simulator must be one that can be pickled,
        and a script needs `if __name__ == "__main__":` as always then.
    - `step`: of the differences, relative to the parameter.
    - `timeout`: seconds after which a run is ended, and has failed; of processes only, for a thread cannot be
        ended. Programs that a simulator runs by [`run_program`][vertax.external.run_program] have a limit of
        their own.

    **Raises:**

    - `TypeError` for a simulator that is none.
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
        if not isinstance(self.simulator, AbstractSimulator):
            raise TypeError(
                "Argument `simulator` must be a subclass of vertax.external.AbstractSimulator, made by "
                f"calling it, but is {describe(self.simulator)}."
            )
        if self.slope not in ("energy", "program", "differences"):
            raise ValueError(
                "Argument `slope` must be 'energy', 'program' or 'differences', but is "
                f"{self.slope!r}."
            )
        if self.slope != "energy" and self.stiffness is None:
            raise ValueError(
                "Argument `stiffness` is missing: the nudge is measured in it, and without an energy that "
                "JAX can differentiate nobody knows it. Pass a typical second derivative of the energy, e.g. "
                "stiffness=1.0; the `beta` of the adjoint multiplies it."
            )
        for name in ("tolerance", "stiffness", "step", "timeout"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0, many=True)
        if self.workers is not None:
            check_integer("workers", self.workers, at_least=1)
        if self.timeout is not None and not self.processes:
            raise ValueError(
                "Argument `timeout` needs processes=True: a simulator that hangs in a thread cannot be ended."
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
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
    ) -> Equilibrium:
        """Let the program relax a tissue.

        **Arguments:**

        - `tissue`: where it starts.
        - `energy`: holds the parameters.
        - `adjoint`: [`EquilibriumPropagation`][vertax.EquilibriumPropagation], with a linear nudge.
        - `throw`: raise an error if the program fails, or reaches no equilibrium. If False, look at
            `converged`, and at `last_error_message()`.

        **Returns:** an [`Equilibrium`][vertax.Equilibrium].

        **Raises:**

        - [`SimulatorError`][vertax.external.SimulatorError] if the program fails; inside `jax.jit` and
            `jax.grad` an error of JAX that quotes it.
        - `RuntimeError` if what it returns is not at rest, or its cells overlap.
        - `ValueError` for another adjoint.
        """
        if isinstance(energy, type):  # (A program may take parameters that are no function.)
            check_energy(energy)
        adjoint = EquilibriumPropagation() if adjoint is None else adjoint
        self.check_compatible(adjoint)
        assert isinstance(adjoint, EquilibriumPropagation)
        inputs = (tissue, energy, self, adjoint)
        concrete = all(map(is_concrete, jax.tree.leaves(inputs)))
        failed = self.ledger.failed
        response = self.traced()
        equilibrium = _answered(
            *traced((tissue, energy), tissue.vertices.dtype),
            response,
            adjoint,
            throw and not concrete,
        )
        if not throw:
            return equilibrium
        if concrete and self.ledger.failed > failed:
            raise SimulatorError(self.last_error_message())
        if concrete and not np.all(equilibrium.converged) and np.all(equilibrium.valid):
            raise RuntimeError(
                "What the program returned is not at rest by the energy (largest force "
                f"{np.max(equilibrium.max_force):.1e}). {_AT_REST}"
            )
        return equilibrium.checked()

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Refuse all adjoints but equilibrium propagation by constant forces.

        **Arguments:** as for every response.

        **Raises:**

        - `ValueError` for another adjoint, and for a cost that is to pull the tissue.
        """
        if not isinstance(adjoint, EquilibriumPropagation):
            raise ValueError(
                f"{type(adjoint).__name__} needs derivatives of what relaxes the tissue, and an external "
                "program has none. Pass adjoint=vertax.EquilibriumPropagation(), which asks it for "
                "relaxations only."
            )
        if adjoint.nudge == "cost" or guided:
            what = "`guidance`" if guided else "EquilibriumPropagation(nudge='cost')"
            raise ValueError(
                f"{what} lets the tissue relax the cost too, which an external program does not know. Use "
                "EquilibriumPropagation(), whose nudge is a constant force, and no guidance."
            )

    def last_error_message(self) -> str | None:
        """Why the program failed last; None if it never did."""
        failures = self.ledger.failures
        return f"{type(self.simulator).__name__} failed: {failures[-1]}" if failures else None

    @property
    def ledger(self) -> Ledger:
        """How often the program ran so far, how many seconds that took, and why it failed."""
        return ledger_of(self.simulator)

    def traced(self) -> External:
        """The same with its numbers as arrays, of which another one compiles nothing anew."""
        numbers = {name: traced(getattr(self, name)) for name in ("tolerance", "stiffness")}
        return dataclasses.replace(self, **numbers)

    def finer(self, tolerance: Float[Array, ""]) -> External:
        """The same, at rest only where the largest force is below this tolerance too."""
        if self.tolerance is not None:
            tolerance = jnp.minimum(tolerance, self.tolerance)
        return dataclasses.replace(self, tolerance=tolerance)

    def units(self, tissue: Tissue, energy: AbstractEnergy) -> Units:
        """In what forces and lengths are measured."""
        if self.slope == "energy" and self.stiffness is None:
            return units_of(tissue, energy)
        return Units(cell_size(tissue), jnp.asarray(self.stiffness, tissue.vertices.dtype))

    def ask(self, request: Request, throw: bool) -> Answer:
        """What the program says, as a part of a compiled function."""
        arrays, static = eqx.partition(request, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        tissue = request.tissue
        number = jax.ShapeDtypeStruct((), tissue.vertices.dtype)
        whole = jax.ShapeDtypeStruct((), jnp.int32)
        shapes = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
        slope = None if self.slope == "energy" else eqx.filter(request.energy, eqx.is_inexact_array)
        dynamic, fixed = eqx.partition(tissue.topology, eqx.is_array)
        wanted = Answer(
            vertices=shapes(tissue.vertices),
            angles=shapes(tissue.angles),
            topology=shapes(dynamic),
            energy=number,
            max_force=number,
            num_steps=whole,
            num_t1=whole,
            slope=shapes(slope),
        )
        ranks = [x.ndim for x in leaves]
        workers = self.workers or os.cpu_count() or 1

        def host(*arrays: Any) -> Answer:
            given = [np.asarray(x) for x in arrays]
            batch = given[0].shape[: given[0].ndim - ranks[0]]
            n = int(np.prod(batch))
            rows = [x.reshape((n, *x.shape[len(batch) :])) for x in given]
            requests = [
                eqx.combine(jax.tree.unflatten(structure, [row[i] for row in rows]), static)
                for i in range(n)
            ]
            jobs = [Job(self.simulator, r, self.slope, self.step) for r in requests]
            answers, reason = ask(jobs, workers, self.processes, throw, self.timeout)
            if throw and reason is not None:
                raise reason
            return stacked(answers, requests, wanted, batch)

        answer = jax.pure_callback(host, wanted, *leaves, vmap_method="broadcast_all")
        return answer._replace(topology=eqx.combine(answer.topology, fixed))


_AT_REST = (
    "Its energy may not be the one given here; or it stops too early: then let it go on, or raise the "
    "`tolerance` of External."
)


@eqx.filter_jit
def _answered(
    tissue: Tissue,
    energy: AbstractEnergy,
    response: External,
    adjoint: EquilibriumPropagation,
    throw: bool,
) -> Equilibrium:
    start, constant = frozen((tissue, energy))
    answer = frozen(response.ask(Request(start, constant, None, None), throw))
    there = eqx.tree_at(
        lambda t: (t.vertices, t.topology), start, (answer.vertices, answer.topology)
    )
    if answer.angles is not None:
        there = there.with_angles(answer.angles)
    units = response.units(there, constant)
    known = response.slope == "energy"
    # Which motions of the whole cost nothing cannot be asked of a program. As a rule all.
    free = free_motions(there, constant, units) if known else jnp.ones(_n_motions(there), bool)
    if known:
        # Where the program left the whole is its own affair, unless the energy minds.
        settled = there.settled(start)
        there = there.with_vertices(jnp.where(jnp.all(free), settled.vertices, there.vertices))
    slots = (energy, tissue.boundary, adjoint.outcome)
    rest = Rest(there, answer.slope, free, units)
    configuration = at_rest(slots, rest, response, adjoint.without_outcome())
    whole = eqx.tree_at(lambda t: t.boundary, there, tissue.boundary)
    final = whole.with_configuration(configuration)
    if known:
        final = follow_start(final, tissue, free)
    force = optx.max_norm(force_of(there, constant)) if known else answer.max_force
    return Equilibrium(
        tissue=final,
        energy=energy(final) if known else answer.energy,
        max_force=force,
        num_steps=answer.num_steps,
        num_t1=answer.num_t1,
        valid=~there.overlaps.any,
        result=_result(there, force, response, units),
    )


def _result(tissue: Tissue, force: Float[Array, ""], response: External, units: Units) -> RESULTS:
    still = jnp.array(True)
    if response.slope == "energy":
        tolerance = response.tolerance
        if tolerance is None:
            precise = tissue.vertices.dtype == jnp.float64
            tolerance = (1e-6 if precise else 1e-3) * units.force
        still = force <= tolerance
    result = RESULTS.where(still, RESULTS.successful, RESULTS.nonlinear_max_steps_reached)
    finite = jnp.all(jnp.isfinite(tissue.vertices))
    return RESULTS.where(finite, result, RESULTS.nonfinite)


def _n_motions(tissue: Tissue) -> int:
    return jax.eval_shape(lambda x: tissue.boundary.motions(x, x[0, 0]), tissue.vertices).shape[0]
