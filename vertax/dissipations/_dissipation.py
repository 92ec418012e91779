"""Abstract dissipations and sums of dissipations."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.field_checks import check_fields
from vertax.mesh import Tissue


class AbstractDissipation(eqx.Module):
    r"""Dissipation of a time step.

    By Onsager's variational principle the velocities minimise $R(\dot x; x) + \dot E$, with a dissipation
    function $R$ that is quadratic in $\dot x$. A time step of length $\Delta t$ minimises the incremental
    potential

    $$E(x) + \Delta t\, R\left(\frac{x - x_0}{\Delta t}; x_0\right),$$

    and a dissipation returns its second term. Subclass it, put the coefficients into fields and write
    `__call__`:

    ```python
    class Contact(vx.AbstractDissipation):
        strength: float

        def __call__(self, tissue, before, dt):
            return 0.5 * self.strength * jnp.sum((tissue.areas - before.areas) ** 2) / dt
    ```

    Dissipations add: `SubstrateFriction(1.0) + PerimeterViscosity(0.2)`. If the dissipation is half a sum of
    squares, subclass [`AbstractViscosity`][vertax.dissipations.AbstractViscosity] instead.
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def __call__(
        self, tissue: Tissue, before: Tissue, dt: float | Float[Array, ""]
    ) -> Float[Array, ""]:
        """Dissipation of a step, an energy.

        **Arguments:**

        - `tissue`: the tissue at the end of the step.
        - `before`: the tissue at the start of the step; its box may differ.
        - `dt`: the length of the step.
        """

    def __add__(self, other: AbstractDissipation) -> AbstractDissipation:
        """The sum of two dissipations."""
        if not isinstance(other, AbstractDissipation):
            return NotImplemented
        terms = (*_terms(self), *_terms(other))
        viscous = tuple(term for term in terms if isinstance(term, AbstractViscosity))
        return ViscositySum(viscous) if len(viscous) == len(terms) else Sum(terms)


class AbstractViscosity(AbstractDissipation):
    r"""A dissipation that is half a sum of squares, $\tfrac1{2 \Delta t} \sum_i s_i^2$.

    Override `strains`, which returns the $s_i$. Second-order time steps and thermal noise use them.
    """

    @abc.abstractmethod
    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """The $s_i$: changes during a step times the square roots of their coefficients; 0 without motion."""

    def __call__(
        self, tissue: Tissue, before: Tissue, dt: float | Float[Array, ""]
    ) -> Float[Array, ""]:
        """Dissipation of a step, an energy."""
        return 0.5 * jnp.sum(self.strains(tissue, before) ** 2) / dt


class Sum(AbstractDissipation):
    """A sum of dissipations; made by `+`."""

    terms: tuple[AbstractDissipation, ...]

    def __call__(
        self, tissue: Tissue, before: Tissue, dt: float | Float[Array, ""]
    ) -> Float[Array, ""]:
        """Dissipation of a step, an energy."""
        zero = jnp.zeros((), tissue.vertices.dtype)
        return sum((term(tissue, before, dt) for term in self.terms), zero)


class ViscositySum(AbstractViscosity):
    """A sum of viscosities, which is half a sum of squares; made by `+`."""

    terms: tuple[AbstractViscosity, ...]

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """The strains of all terms, concatenated."""
        return jnp.concatenate([term.strains(tissue, before) for term in self.terms])


def _terms(dissipation: AbstractDissipation) -> tuple[AbstractDissipation, ...]:
    return dissipation.terms if isinstance(dissipation, Sum | ViscositySum) else (dissipation,)
