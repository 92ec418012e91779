"""Quasi-static deformation: a relaxation after each small strain of the box."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.batch import member
from vertax._base.checks import as_real, describe
from vertax._base.results import RESULTS, checked, first_of
from vertax._base.tracing import traced
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
    r"""Pure shear at fixed area: the deformation gradient `diag(exp(ε), exp(-ε))`."""
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
    """The relaxed tissue at each strain of a quasi-static deformation."""

    strains: Float[Array, " strains"]
    """The strains."""
    frames: Tissue
    """The relaxed tissues: one tissue with a leading axis."""
    energies: Float[Array, " strains"]
    """Their energies."""
    stresses: Float[Array, "strains 2 2"]
    """Their stresses, energy per area."""
    num_t1: Int[Array, " strains"]
    """T1 transitions since the previous strain."""
    results: RESULTS
    """How the relaxation at each strain ended."""

    @property
    def tissue(self) -> Tissue:
        """The relaxed tissue at the last strain."""
        return member(self.frames, -1)

    @property
    def result(self) -> RESULTS:
        """How the ramp ended: the first failure."""
        return first_of(self.results)

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether all relaxations converged."""
        return self.result == RESULTS.successful

    def checked(self) -> Ramp:
        """The same, if all relaxations converged.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) with the message of `result` if they did not.
        """
        return checked(self, self.result, self._details)

    def _details(self) -> str:
        number = int(np.argmax(self.results != RESULTS.successful))
        return f"strain {self.strains[number]:g}, number {number}"

    @property
    def plastic(self) -> Bool[Array, " strains"]:
        """Whether cells changed neighbours at each strain."""
        return self.num_t1 > 0


def ramp(
    tissue: Tissue,
    energy: AbstractEnergy,
    strains: ArrayLike,
    *,
    deformation: Deformation = simple_shear,
    relaxation: Relaxation = Relaxation(),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    throw: bool = True,
) -> Ramp:
    r"""Deform a tissue quasi-statically at zero temperature (AQS), through its T1 transitions.

    For each strain:

    1. Deform the initial box by the strain.
    2. Map the relaxed tissue of the previous strain affinely into that box.
    3. Relax the tissue.

    Between transitions the work of the stress equals the change of the energy; at a transition energy is
    dissipated (Maloney & Lemaître 2006, doi:10.1103/PhysRevE.74.016118).

    **Arguments:**

    - `tissue`: a periodic tissue.
    - `energy`: its energy.
    - `strains`: the strains in order, in steps small enough for the tissue to follow the same branch of
        minima.
    - `deformation`: a function from a strain to the deformation gradient of the box, shape `(2, 2)`:
        [`simple_shear`][vertax.mechanics.simple_shear], [`pure_shear`][vertax.mechanics.pure_shear], or any
        other function.
    - `relaxation`: the relaxation, by default [`Relaxation()`][vertax.Relaxation].
    - `adjoint`: the differentiation method, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
        default.
    - `throw`: raise an error if a relaxation does not converge.

    **Returns:** a [`Ramp`][vertax.mechanics.Ramp]; its `frames` form a trajectory. Differentiable with
        respect to the energy, as long as the same transitions happen in the same steps.

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    - `ValueError` for a free tissue, strains that are not a list of numbers, or a deformation of another
        shape.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a relaxation did not converge.
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
    check_relaxation(relaxation)
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    relaxation.check(tissue, energy, adjoint)
    result = _ramp(tissue, energy, values, deformation, relaxation.traced(), adjoint)
    return result.checked() if throw else result


@announced_jit
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
        start = eqx.combine(arrays, static).carried(box)
        rest = relaxation.solve(start, energy, adjoint, recompute=True)
        arrays = eqx.filter(rest.tissue, eqx.is_array)
        frame = (arrays, rest.energy, stress(rest.tissue, energy), rest.num_t1, rest.result)
        return arrays, frame

    _, (frames, *rest) = jax.lax.scan(step, arrays, strains)
    return Ramp(strains, eqx.combine(frames, static), *rest)
