"""A box that comes to rest together with the tissue in it."""

from __future__ import annotations

from typing import Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.checks import as_real, check_integer, check_number
from vertax._base.tracing import traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.adjoints._adjoint import frozen
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import as_matrix, check_relaxation, check_system
from vertax.mechanics._elasticity import elastic_tensor
from vertax.mechanics._landscape import deformed
from vertax.mechanics._stress import stress
from vertax.mesh import Tissue
from vertax.relax import RESULTS, AbstractResponse, Equilibrium, Relaxation

# Orthogonal directions of strain, in components xx, yy and γ = 2 xy.
_FREEDOMS = {
    "all": np.eye(3),
    "area": np.array([[1.0, 1.0, 0.0]]),
    "shape": np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    "x": np.array([[1.0, 0.0, 0.0]]),
    "y": np.array([[0.0, 1.0, 0.0]]),
    "shear": np.array([[0.0, 0.0, 1.0]]),
}
# The furthest that a box is strained at a time.
_LARGEST = 0.05


def _as_stress(value: ArrayLike) -> Float[Array, "2 2"]:
    given = as_real("stress", value)
    if given.shape not in ((), (2, 2)):
        raise ValueError(
            f"Argument `stress` must be a number or have shape (2, 2), but its shape is {given.shape}."
        )
    if given.shape == ():
        return given * jnp.eye(2, dtype=given.dtype)
    return as_matrix("stress", given, symmetric=True)


class BoxRelaxation(AbstractResponse):
    r"""The tissue comes to rest, and its periodic box with it: at a given stress, or at a given area.

    The box is strained until the stress of the relaxed tissue is the one given, in those components that
    are free: $\sigma(\theta) = \sigma_\mathrm{given}$ (Farhadifar et al. 2007,
    doi:10.1016/j.cub.2007.11.049, relax the box like that). Newton steps by the
    [`elastic_tensor`][vertax.mechanics.elastic_tensor] find it, and a last one is what is
    differentiated, so the derivative is that of the box at rest. The box never turns.

    Give it to an [`InverseProblem`][vertax.InverseProblem] as its response, or call it.

    **Arguments:**

    - `stress`: the stress to come to: a number, the isotropic stress (minus a pressure from outside), or
        a symmetric matrix; energy per area, positive to pull. 0 by default: nothing acts from outside.
    - `free`: what the box may do: `"all"`; `"area"`, at a given shape; `"shape"`, at a given area; or only
        one strain, `"x"`, `"y"` or `"shear"`.
    - `relaxation`: how the tissue comes to rest in each box.
    - `tolerance`: the largest difference of stress that counts as rest; by default $10^{-9}$ of the largest
        modulus in float64, and $10^{-4}$ of it in float32.
    - `max_steps`: most steps of the box.

    **Raises:**

    - `TypeError` for a relaxation that is none.
    - `ValueError` for a stress of the wrong shape or that is not symmetric, another `free`, or numbers that
        are not positive.
    """

    stress: Float[Array, "2 2"] = eqx.field(default=0.0, converter=_as_stress)
    free: Literal["all", "area", "shape", "x", "y", "shear"] = eqx.field(static=True, default="all")
    relaxation: Relaxation = eqx.field(default_factory=Relaxation)
    tolerance: float | Float[Array, ""] | None = None
    max_steps: int = eqx.field(static=True, default=50)

    def __check_init__(self):
        if not isinstance(self.free, str) or self.free not in _FREEDOMS:
            raise ValueError(
                f"Argument `free` must be one of {', '.join(_FREEDOMS)}, but is {self.free!r}."
            )
        check_relaxation(self.relaxation)
        if self.tolerance is not None:
            check_number("tolerance", self.tolerance, above=0)
        check_integer("max_steps", self.max_steps, at_least=1)

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
    ) -> Equilibrium:
        """Relax a tissue and its box.

        **Arguments:**

        - `tissue`: where it starts, periodic.
        - `energy`: what to minimise, apart from the work of the stress.
        - `adjoint`: how to differentiate, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
            default; not one that unrolls a relaxation.
        - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

        **Returns:** an [`Equilibrium`][vertax.Equilibrium]; `energy` is that of the tissue alone.

        **Raises:**

        - `ValueError` for a free tissue, or an adjoint that unrolls.
        - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and no equilibrium was reached.
        """
        check_system(tissue, energy, box="a BoxRelaxation")
        adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
        self.relaxation.check(tissue, energy, adjoint)
        self.check_compatible(adjoint)
        found = _relax_box(*traced((tissue, energy), tissue.vertices.dtype), self.traced(), adjoint)
        return found.checked() if throw else found

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Refuse adjoints that unroll a relaxation.

        **Arguments:** as for every response.

        **Raises:**

        - `ValueError` for one that does.
        """
        if adjoint.unrolls:
            raise ValueError(
                f"{type(adjoint).__name__} differentiates the steps of one relaxation, and a box takes "
                "many: pass ImplicitDifferentiation or EquilibriumPropagation."
            )

    def traced(self) -> BoxRelaxation:
        """The same with its numbers as arrays, of which another one compiles nothing anew."""
        parts = lambda r: (r.relaxation, r.tolerance)
        new = (self.relaxation.traced(), traced(self.tolerance))
        return eqx.tree_at(parts, self, new, is_leaf=lambda x: x is None)

    def finer(self, tolerance: Float[Array, ""]) -> BoxRelaxation:
        """The same, at rest only where the largest force is below this tolerance too."""
        return eqx.tree_at(lambda r: r.relaxation, self, self.relaxation.finer(tolerance))


class _State(eqx.Module):
    tissue: Tissue
    missing: Float[Array, " free"]
    """What is missing to the stress, along what is free."""
    stiffness: Float[Array, "free free"]
    largest: Float[Array, ""]
    num_t1: Int[Array, ""]
    num_steps: Int[Array, ""]
    count: Int[Array, ""]


@eqx.filter_jit
def _relax_box(
    tissue: Tissue, energy: AbstractEnergy, response: BoxRelaxation, adjoint: AbstractAdjoint
) -> Equilibrium:
    constant, held = frozen(energy), frozen(response)
    basis = jnp.asarray(_FREEDOMS[response.free], tissue.vertices.dtype)
    default = 1e-9 if tissue.vertices.dtype == jnp.float64 else 1e-4

    def missing(stressed: Float[Array, "2 2"], response: BoxRelaxation) -> Float[Array, " free"]:
        difference = stressed - response.stress.astype(stressed.dtype)
        return -basis @ _voigt(difference)

    def at_rest(start: Tissue, before: _State | None) -> _State:
        found = held.relaxation.solve(start, constant, ImplicitDifferentiation())
        stressed, tensor = (
            stress(found.tissue, constant),
            elastic_tensor(found.tissue, constant, throw=False),
        )
        # Stress answers to strain by C and, if it is not isotropic, by a part that is not symmetric.
        trace = jnp.array([1.0, 1.0, 0.0], tensor.dtype)
        turn = jnp.outer(trace, _voigt(stressed))
        stiffness = basis @ (tensor + 0.5 * (turn - turn.T)) @ basis.T
        counts = (found.num_t1, found.num_steps, jnp.array(0))
        if before is not None:
            counts = (
                before.num_t1 + counts[0],
                before.num_steps + counts[1],
                before.count + 1,
            )
        largest = jnp.max(jnp.abs(tensor))
        return _State(found.tissue, missing(stressed, held), stiffness, largest, *counts)

    def done(state: _State) -> Bool[Array, ""]:
        limit = default * state.largest if held.tolerance is None else held.tolerance
        return jnp.max(jnp.abs(state.missing)) <= limit

    def strained(state: _State) -> Tissue:
        # Against softening, a step goes where the stress pushes.
        sizes, vectors = jnp.linalg.eigh(0.5 * (state.stiffness + state.stiffness.T))
        sound = jnp.min(sizes) > 1e-6 * state.largest
        exact = jnp.linalg.solve(state.stiffness, state.missing)
        safe = jnp.maximum(jnp.abs(sizes), 1e-3 * state.largest)
        amount = jnp.where(sound, exact, vectors @ ((vectors.T @ state.missing) / safe))
        furthest = jnp.max(jnp.abs(amount))
        amount = amount * jnp.minimum(1, _LARGEST / jnp.where(furthest > 0, furthest, 1))
        return deformed(state.tissue, _gradient(amount @ basis))

    first = at_rest(frozen(tissue), None)
    arrays, static = eqx.partition(first, eqx.is_array)

    def unfinished(arrays: _State) -> Bool[Array, ""]:
        sound = jnp.all(jnp.isfinite(arrays.missing))
        return ~done(arrays) & sound & (arrays.count < held.max_steps)

    def iterate(arrays: _State) -> _State:
        state = eqx.combine(arrays, static)
        return eqx.filter(at_rest(strained(state), state), eqx.is_array)

    end = frozen(eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static))
    # One more Newton step, of which only the derivative matters: how the stress in this box depends on the
    # parameters, and so how the box that makes up for it does.
    here = response.relaxation.solve(end.tissue, energy, adjoint)
    amount = jnp.linalg.solve(end.stiffness, missing(stress(here.tissue, energy), response))
    box = deformed(end.tissue, _gradient(amount @ basis)).boundary
    final = response.relaxation.solve(here.tissue.carried(box), energy, adjoint)
    result = RESULTS.where(done(end), final.result, RESULTS.nonlinear_max_steps_reached)
    return Equilibrium(
        tissue=final.tissue,
        energy=final.energy,
        max_force=final.max_force,
        num_steps=end.num_steps + here.num_steps + final.num_steps,
        num_t1=end.num_t1 + here.num_t1 + final.num_t1,
        valid=final.valid,
        result=cast(RESULTS, result),
    )


def _voigt(matrix: Float[Array, "2 2"]) -> Float[Array, "3"]:
    return jnp.stack([matrix[0, 0], matrix[1, 1], 0.5 * (matrix[0, 1] + matrix[1, 0])])


def _gradient(strain: Float[Array, "3"]) -> Float[Array, "2 2"]:
    """The deformation gradient of a logarithmic strain, by its components xx, yy and γ."""
    half = 0.5 * strain[2]
    matrix = jnp.stack([jnp.stack([strain[0], half]), jnp.stack([half, strain[1]])])
    return jax.scipy.linalg.expm(matrix)
