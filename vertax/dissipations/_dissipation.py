"""What every dissipation is, and how dissipations add up."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.field_checks import check_fields
from vertax.mesh import Tissue


class AbstractDissipation(eqx.Module):
    r"""What a motion from one configuration to the next dissipates.

    By Onsager's principle velocities minimise the dissipation $R(\dot x; x)$, quadratic in them, plus the
    rate at which the energy changes. A step of a length of time $\Delta t$ then minimises

    $$E(x) + \Delta t\, R\left(\frac{x - x_0}{\Delta t}; x_0\right),$$

    and a dissipation is the second term. Subclass it, put the coefficients into fields and write
    `__call__`:

    ```python
    class Contact(vx.AbstractDissipation):
        strength: float

        def __call__(self, tissue, before, dt):
            return 0.5 * self.strength * jnp.sum((tissue.areas - before.areas) ** 2) / dt
    ```

    Dissipations add: `SubstrateFriction(1.0) + PerimeterViscosity(0.2)`. One that is half a sum of squares
    is better a subclass of [`AbstractViscosity`][vertax.dissipations.AbstractViscosity].
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def __call__(
        self, tissue: Tissue, before: Tissue, dt: float | Float[Array, ""]
    ) -> Float[Array, ""]:
        """Dissipation of a step, an energy.

        **Arguments:**

        - `tissue`: at the end of the step.
        - `before`: the same tissue where the step begins; it may lie in another box.
        - `dt`: the length of the step in time.
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

    Override `strains`. That it is known what is squared lets steps be of second order, and gives thermal
    noise the right correlations.
    """

    @abc.abstractmethod
    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """What changed in a step, times the square root of what resists it; 0 if nothing moved."""

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
    """A sum of viscosities; made by `+`, and half a sum of squares itself."""

    terms: tuple[AbstractViscosity, ...]

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Those of all terms, one after the other."""
        return jnp.concatenate([term.strains(tissue, before) for term in self.terms])


def _terms(dissipation: AbstractDissipation) -> tuple[AbstractDissipation, ...]:
    return dissipation.terms if isinstance(dissipation, Sum | ViscositySum) else (dissipation,)
