"""Mechanical equilibrium: relaxation with topology changes, then one differentiable solve."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.checks import check_instance, check_integer, check_number
from vertax._base.memory_maps import warn_of_memory_maps
from vertax._base.model_checks import check_energy, warn_of_columns
from vertax._base.results import RESULTS, any_is
from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import closed_over_tracers, frozen, is_concrete, traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.energies._scales import scales_of
from vertax.mesh import Tissue
from vertax.relax._compatibility import check_adjoint, check_sharding
from vertax.relax._equilibrium import SearchEnd, conclude
from vertax.relax._feasibility import Feasibility
from vertax.relax._loop import Search
from vertax.relax._response import AbstractResponse, Equilibrium
from vertax.solvers import AbstractIteration, AbstractSolver, NewtonCG, Wrapped
from vertax.solvers._optimistix import check_solver
from vertax.solvers._solver import Stepwise
from vertax.solvers._stop_at_rest import StopAtRest
from vertax.transitions import T1, AbstractTransitions


class Relaxation(AbstractResponse):
    r"""The tissue comes to rest, $X^* \in \arg\min_X E(X, \theta)$ (paper, Methods).

    Call it with a tissue and an energy, or give it to an
    [`InverseProblem`][vertax.InverseProblem]; [`equilibrate`][vertax.equilibrate] does both in one line.

    Defaults are in units of the tissue, so results are the same in micrometres, in pixels and in cells of
    area 1: lengths are measured in the root mean cell area $\ell$, forces in $k \ell$ with $k$ the mean
    eigenvalue of the Hessian where the relaxation starts.

    **Arguments:**

    - `solver`: a minimiser of `vertax.solvers` or of Optimistix; [`NewtonCG`][vertax.solvers.NewtonCG]
        by default, which reaches true equilibria.
    - `transitions`: the rule for topology changes, or None to keep the topology.
    - `tolerance`: largest force (component of $\nabla_X E$) that counts as equilibrium, in units of
        energy per length; by default $10^{-10}\,k \ell$ in float64 and $10^{-5}\,k \ell$ in float32
        ($10^{-4}\,k \ell$ with arcs), or the force of rounded coordinates, $4 \epsilon\,k \max |x|$, where
        that is larger (in float32, above some hundred cells).
    - `consecutive_steps`: number of consecutive steps for which the force must stay below the tolerance.
    - `max_steps`: most steps of the minimiser.
    - `contact_range`: how near a corner comes to a side of the same cell (or of the outline) before a
        barrier holds it off, in units of the size of a cell; see [Contact](../concepts.md#contact). 0 leaves
        the barrier out, and steps that would make cells overlap are still refused; None lets them overlap.
    - `max_contacts`: most corners that may be near a side of the same cell at once (an integer); by default
        the number of vertices, but at least 64, and above 2000 vertices 2000 or a quarter of their number.
        Where there are more, a call outside of `jax.jit` repeats the relaxation with more room, and otherwise
        the `result` says so.

    `tolerance`, `consecutive_steps`, `max_steps`, `contact_range`, numbers of `transitions` and numbers of an
    energy are data: another number compiles nothing. The solver and the adjoint are static.

    **Raises:**

    - `TypeError` for a solver that is no minimiser, transitions that are no rule, or a `max_contacts` that is
        no integer.
    - `ValueError` for a tolerance, number of steps or of contacts that is not positive, or a negative
        contact range.
    """

    solver: optx.AbstractMinimiser[Any, Any, Any] = NewtonCG()
    transitions: AbstractTransitions | None = T1()
    tolerance: float | Float[Array, ""] | None = None
    consecutive_steps: int | Int[Array, ""] = 1
    max_steps: int | Int[Array, ""] = 2000
    contact_range: float | Float[Array, ""] | None = 0.01
    max_contacts: int | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_solver(self.solver)
        expected = "a rule for topology changes, e.g. vertax.T1(), or None"
        check_instance("transitions", self.transitions, AbstractTransitions | None, expected)
        for name in ("tolerance", "consecutive_steps", "max_steps"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0, many=True)
        if self.max_contacts is not None:
            check_integer("max_contacts", self.max_contacts, at_least=1)
        if self.contact_range is not None:
            check_number("contact_range", self.contact_range, at_least=0, many=True)

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint = ImplicitDifferentiation(),
        throw: bool = True,
    ) -> Equilibrium:
        """Relax a tissue.

        **Arguments:**

        - `tissue`: where the relaxation starts.
        - `energy`: what to minimise.
        - `adjoint`: how to differentiate, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
            default.
        - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

        **Returns:** an [`Equilibrium`][vertax.Equilibrium].

        **Raises:** as [`equilibrate`][vertax.equilibrate].
        """
        self.check(tissue, energy, adjoint)
        for name in closed_over_tracers(energy):
            raise TypeError(
                f"Argument `energy` must hold traced values in its fields, but closes over `{name}`, a value "
                "that jax.grad, jax.vmap or jax.jit traces. Make it a field of an AbstractEnergy."
            )
        warn_of_memory_maps()
        tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
        relaxation = self.traced()
        if all(map(is_concrete, jax.tree.leaves((tissue, energy, relaxation, adjoint)))):
            # Nothing is differentiated: one program serves all adjoints.
            adjoint = _NO_DERIVATIVES
        end = relaxation.primal(tissue, energy)
        equilibrium = relaxation.attach(end, tissue, energy, adjoint)
        # An error that is raised within a compiled program calls back to the host, and JAX keeps no such
        # program in its cache on disk.
        return equilibrium.checked() if throw else equilibrium

    def check(self, tissue: Tissue, energy: Any, adjoint: AbstractAdjoint) -> None:
        """Raise an error for arguments that do not work together.

        **Raises:**

        - `TypeError` for an energy that is no function, or an adjoint that is none.
        - `ValueError` for an adjoint that the solver excludes, a `jax.shard_map` with checks, or a tissue
            far from the origin in float32.
        """
        check_energy(energy)
        warn_of_columns(energy, tissue)
        _check_position(tissue)
        check_adjoint(adjoint, self._solver)
        check_sharding((tissue, energy))

    def primal(self, tissue: Tissue, energy: AbstractEnergy) -> SearchEnd:
        """The relaxed tissue, by the compiled function that all callers share.

        It is relaxed again, with more room for contacts, as long as there are too many.
        """
        end = _search(*frozen((tissue, energy, self.traced())))
        while any_is(end.result, RESULTS.too_many_contacts):
            assert end.contacts is not None
            room = _MORE_ROOM * end.contacts.capacity
            wider = dataclasses.replace(self, max_contacts=room)
            end = _search(*frozen((tissue, energy, wider.traced())))
        return end

    def attach(
        self, primal: SearchEnd, tissue: Tissue, energy: AbstractEnergy, adjoint: AbstractAdjoint
    ) -> Equilibrium:
        return _compiled_attachment(primal, tissue, energy, self.traced(), adjoint)

    def solve(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        adjoint: AbstractAdjoint,
        *,
        recompute: bool = False,
    ) -> Equilibrium:
        """Relax a tissue as a part of a larger compiled function, without checks.

        With `recompute` the backward pass recomputes intermediate results: for one of many steps in a row.
        """
        end = sequential_vmap_on_cpu(search)(*frozen((tissue, energy, self)))
        finish = eqx.filter_checkpoint(attached) if recompute else attached
        return finish(end, tissue, energy, self, adjoint)

    def finer(self, tolerance: Float[Array, ""]) -> Relaxation:
        """A copy with a tolerance that is at most this one."""
        if self.tolerance is not None:
            tolerance = jnp.minimum(tolerance, self.tolerance)
        return dataclasses.replace(self, tolerance=tolerance)

    @property
    def minimiser(self) -> StopAtRest:
        """The solver, stopped by the largest force."""
        return StopAtRest(solver=self._solver, consecutive_steps=self.consecutive_steps)

    @property
    def _solver(self) -> AbstractSolver:
        return self.solver if isinstance(self.solver, AbstractSolver) else Wrapped(self.solver)

    def traced(self) -> Relaxation:
        """A copy with its numbers as arrays: another number compiles nothing."""
        if not any(isinstance(x, float | int) for x in jax.tree.leaves(self._numbers)):
            return self
        try:
            return _prepared(self, jnp.result_type(float))
        except TypeError:  # some numbers are arrays, which cannot be keys of a cache
            return self._with_arrays()

    @property
    def _numbers(self) -> dict[str, Any]:
        names = ("transitions", "tolerance", "consecutive_steps", "max_steps", "contact_range")
        return {name: getattr(self, name) for name in names}

    def _with_arrays(self) -> Relaxation:
        return dataclasses.replace(self, **traced(self._numbers, integers=True))

    def search(self, tissue: Tissue, energy: AbstractEnergy) -> Search:
        """The search for an equilibrium, step by step, in the units of a tissue."""
        solver = self._solver
        scales, tolerance = scales_of(tissue, energy), self.tolerance
        if tolerance is None:
            tolerance = _precision(tissue, scales.length) * scales.force
        tolerance = jnp.asarray(tolerance, tissue.vertices.dtype)
        return Search(
            solver if isinstance(solver, AbstractIteration) else Stepwise(solver),
            Feasibility(self.transitions),
            frozen(dataclasses.replace(scales, tolerance=tolerance)),
            self.consecutive_steps,
            self.contact_range,
            self.max_contacts,
        )


def _check_position(tissue: Tissue) -> None:
    """Raise a `ValueError` for a tissue so far from the origin that rounded coordinates distort its cells."""
    # (In float64 such a tissue is 10¹⁰ cells from the origin.)
    if tissue.vertices.dtype == jnp.float64 or not is_concrete(tissue.vertices):
        return
    positions = np.asarray(tissue.vertices, float).reshape(-1, 2)
    middle = positions.mean(axis=0)
    extent = np.abs(positions - middle).max()
    rounding = float(jnp.finfo(tissue.vertices.dtype).eps) * np.abs(middle).max()
    # (A tissue of n cells is about √n cells wide.)
    distortion = rounding * tissue.n_cells**0.5 / extent
    if np.abs(middle).max() > 10 * extent and distortion > _MAX_DISTORTION:
        raise ValueError(
            f"Argument `tissue` must be near the origin in {tissue.vertices.dtype}, but its centre is at "
            f"({middle[0]:.4g}, {middle[1]:.4g}), where coordinates are rounded by {distortion:.1g} of a "
            "cell. Subtract the mean of the vertices: tissue.with_vertices(tissue.vertices - "
            "tissue.vertices.mean(axis=0))."
        )


def _precision(tissue: Tissue, size: Float[Array, ""]) -> Float[Array, ""]:
    """The default tolerance, in the unit of force.

    Rounded coordinates change forces by about $\\epsilon k \\max |x|$. Rounding errors of arcs are ten times
    larger: their lengths are quotients that are nearly singular for large angles.
    """
    x = tissue.vertices
    rounding = _ROUNDING * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)) / size
    single = 1e-5 if tissue.arcs is None else 1e-4
    return jnp.maximum(1e-10 if x.dtype == jnp.float64 else single, rounding)


@functools.lru_cache(maxsize=64)
def _prepared(relaxation: Relaxation, dtype: Any) -> Relaxation:
    """A relaxation with its numbers as arrays, converted once for each precision."""
    with jax.ensure_compile_time_eval():
        return relaxation._with_arrays()


_of_settings: Any = functools.lru_cache(maxsize=64, typed=True)(Relaxation)
_NO_DERIVATIVES = ImplicitDifferentiation()
_MAX_DISTORTION = 1e-5
"""Largest rounding of coordinates in units of a cell, for tissues far from the origin."""
_ROUNDING = 4
"""Factor of the force of rounded coordinates. (Relaxations of 1000 and 10 000 cells in float32 reach 0.6 and
1.5.)"""
_MORE_ROOM = 4
"""Factor of `max_contacts` where they are too few."""


def equilibrate(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    solver: optx.AbstractMinimiser[Any, Any, Any] = NewtonCG(),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    transitions: AbstractTransitions | None = T1(),
    tolerance: float | Float[Array, ""] | None = None,
    consecutive_steps: int | Int[Array, ""] = 1,
    max_steps: int | Int[Array, ""] = 2000,
    contact_range: float | Float[Array, ""] | None = 0.01,
    throw: bool = True,
) -> Equilibrium:
    r"""Relax a tissue to mechanical equilibrium, $X^* \in \arg\min_X E(X, \theta)$ (paper, Methods).

    The relaxation and its T1 transitions find the final topology and positions; the gradient is that
    of the equilibrium in this topology, by the method that `adjoint` names. Works under `jax.jit`,
    `jax.vmap` (over tissues of one size, and over parameters) and `jax.grad` with respect to the energy,
    the boundary, pinned vertices and the start. (The equilibrium keeps the centroid of the start, and the
    orientation of a free tissue, unless the energy or pins determine them. Otherwise it does not depend on
    the start, if it is unique.)

    **Arguments:**

    - `tissue`: where the relaxation starts.
    - `energy`: what to minimise.
    - `adjoint`: how to differentiate, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
        default.
    - `solver`, `transitions`, `tolerance`, `consecutive_steps`, `max_steps`, `contact_range`: see
        [`Relaxation`][vertax.Relaxation]; this function is its short form.
    - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

    **Returns:** an [`Equilibrium`][vertax.Equilibrium].

    **Raises:**

    - `ValueError` for a tolerance or number of steps that is not positive, and for a tissue so far from the
        origin that rounded coordinates distort its cells (in float32, 100 times the size of a cell).
    - `ValueError` within `jax.shard_map` that checks which values differ between devices: pass
        `check_vma=False`.
    - `TypeError` for an adjoint that is none of `vertax.adjoints`, a solver that is no minimiser, or an
        energy that closes over a traced value.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the relaxation did not converge, or
        its cells overlap, as they already did in `tissue`.
    """
    settings = (solver, transitions, tolerance, consecutive_steps, max_steps, contact_range)
    try:
        response = _of_settings(*settings)
    except TypeError:  # as in `Relaxation.traced`, or a wrong argument
        response = Relaxation(*settings)
    return response(tissue, energy, adjoint=adjoint, throw=throw)


def search(tissue: Tissue, energy: AbstractEnergy, relaxation: Relaxation) -> SearchEnd:
    """Relax a tissue, step by step."""
    search = relaxation.search(tissue, energy)
    state = search.advance(search.begin(tissue, energy), energy, relaxation.max_steps)
    return SearchEnd.of(search, state)


def attached(
    end: SearchEnd,
    tissue: Tissue,
    energy: AbstractEnergy,
    relaxation: Relaxation,
    adjoint: AbstractAdjoint,
) -> Equilibrium:
    """The equilibrium at the end of a search by `relaxation`, differentiable."""
    return conclude(end, tissue, energy, adjoint, relaxation.minimiser, relaxation.max_steps)


_search = announced_jit(sequential_vmap_on_cpu(search), label="a relaxation")
_compiled_attachment = announced_jit(attached, label="the derivatives of an equilibrium")
