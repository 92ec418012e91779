"""Slow deformation: a tissue that comes to rest again after each small strain of its box."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.checks import as_real, describe
from vertax._base.tracing import is_concrete, traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import as_matrix, check_relaxation, check_system
from vertax.mechanics._landscape import deformed
from vertax.mechanics._stress import stress
from vertax.mesh import Tissue
from vertax.relax import Relaxation

Deformation = Callable[[Float[Array, ""]], Float[Array, "2 2"]]


def simple_shear(strain: ArrayLike) -> Float[Array, "2 2"]:
    r"""Simple shear along x by $\gamma$: the deformation gradient `[[1, γ], [0, 1]]`."""
    strain = _as_strain(strain)
    zero, one = jnp.zeros_like(strain), jnp.ones_like(strain)
    return jnp.stack([jnp.stack([one, strain]), jnp.stack([zero, one])])


def pure_shear(strain: ArrayLike) -> Float[Array, "2 2"]:
    r"""Pure shear that stretches along x by $e^\epsilon$, at fixed area."""
    strain = _as_strain(strain)
    return jnp.diag(jnp.stack([jnp.exp(strain), jnp.exp(-strain)]))


def _as_strain(strain: ArrayLike) -> Float[Array, ""]:
    value = as_real("strain", strain)
    if value.shape != ():
        raise ValueError(
            f"Argument `strain` must be one number, but its shape is {value.shape}. Take more of them "
            "through jax.vmap."
        )
    return value


class Ramp(eqx.Module):
    """A tissue on its way through some strains, at rest at each."""

    strains: Float[Array, " strains"]
    """The strains."""
    frames: Tissue
    """The tissue at each: the same tissue with a leading axis."""
    energies: Float[Array, " strains"]
    """Its energies."""
    stresses: Float[Array, "strains 2 2"]
    """Its stresses, energy per area."""
    num_t1: Int[Array, " strains"]
    """T1 transitions since the strain before."""
    converged: Bool[Array, " strains"]
    """Whether it came to rest there."""

    @property
    def plastic(self) -> Bool[Array, " strains"]:
        """At which strains cells have changed neighbours."""
        return self.num_t1 > 0


def ramp(
    tissue: Tissue,
    energy: AbstractEnergy,
    strains: ArrayLike,
    *,
    deformation: Deformation = simple_shear,
    relaxation: Relaxation | None = None,
    adjoint: AbstractAdjoint | None = None,
    throw: bool = True,
) -> Ramp:
    r"""Deform a tissue slowly: athermal and quasi-static, through its T1 transitions.

    At each strain the box is deformed, from where it began, and the tissue, carried along from the
    strain before, comes to rest. Between transitions the work of the stress is the change of the energy;
    at one, energy is lost (Maloney & Lemaître 2006, doi:10.1103/PhysRevE.74.016118).

    **Arguments:**

    - `tissue`: a periodic tissue.
    - `energy`: its energy.
    - `strains`: strains one after the other, in steps small enough that each leads to the next state at
        rest.
    - `deformation`: a function from a strain to the deformation gradient of the box, shape `(2, 2)`:
        [`simple_shear`][vertax.mechanics.simple_shear], [`pure_shear`][vertax.mechanics.pure_shear], or
        your own.
    - `relaxation`: how it comes to rest, by default [`Relaxation()`][vertax.Relaxation].
    - `adjoint`: how to differentiate, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
        default.
    - `throw`: raise an error if it does not come to rest at a strain.

    **Returns:** a [`Ramp`][vertax.mechanics.Ramp]; `frames` of it make a trajectory. Differentiable with
    respect
        to the energy, as long as the same transitions happen in the same steps.

    **Raises:**

    - `TypeError` for what is no tissue, energy, relaxation or function.
    - `ValueError` for a free tissue, strains that are no list of numbers, or a deformation of another shape.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the tissue did not come to rest at some
        strain.
    """
    check_system(tissue, energy, box="a ramp")
    values = as_real("strains", strains).astype(tissue.vertices.dtype)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(
            f"Argument `strains` must be a list of numbers, but its shape is {values.shape}."
        )
    if not callable(deformation):
        raise TypeError(
            "Argument `deformation` must be a function from a strain to a deformation gradient, e.g. "
            f"vertax.mechanics.pure_shear, but is {describe(deformation)}."
        )
    as_matrix("deformation", jnp.zeros(jax.eval_shape(deformation, values[0]).shape))
    relaxation = Relaxation() if relaxation is None else relaxation
    check_relaxation(relaxation)
    adjoint = ImplicitDifferentiation() if adjoint is None else adjoint
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    relaxation.check(tissue, energy, adjoint)
    found = _ramp(tissue, energy, values, deformation, relaxation.traced(), adjoint)
    if not throw:
        return found
    reason = (
        "A tissue did not come to rest at some strain of a ramp. Take smaller steps, raise `max_steps` of "
        "its "
        "`relaxation`, or pass throw=False and look at `converged`."
    )
    if not is_concrete(found.converged):
        return eqx.error_if(found, ~jnp.all(found.converged), reason)
    if not found.converged.all():
        raise RuntimeError(reason)
    return found


@eqx.filter_jit
def _ramp(
    tissue: Tissue,
    energy: AbstractEnergy,
    strains: Float[Array, " strains"],
    deformation: Deformation,
    relaxation: Relaxation,
    adjoint: AbstractAdjoint,
) -> Ramp:
    arrays, static = eqx.partition(tissue, eqx.is_array)

    def step(arrays: Tissue, strain: Array) -> tuple[Tissue, tuple]:
        box = deformed(tissue, deformation(strain)).boundary
        there = eqx.combine(arrays, static).carried(box)
        rest = relaxation.solve(there, energy, adjoint, recompute=True)
        arrays = eqx.filter(rest.tissue, eqx.is_array)
        known = (arrays, rest.energy, stress(rest.tissue, energy), rest.num_t1, rest.converged)
        return arrays, known

    _, (frames, *rest) = jax.lax.scan(step, arrays, strains)
    return Ramp(strains, eqx.combine(frames, static), *rest)
