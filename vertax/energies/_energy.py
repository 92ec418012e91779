"""Abstract energies, sums of energies, and the parameters of energies."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, check_shape
from vertax._base.field_checks import check_fields
from vertax._base.model_checks import check_energy, check_single
from vertax.mesh import Tissue


class AbstractEnergy(eqx.Module):
    """The energy of a tissue as a function of its geometry and of parameters held in fields.

    Subclass it, put the parameters into fields and write `__call__`:

    ```python
    class Contractility(vx.AbstractEnergy):
        strength: Float[Array, " cells"]

        def __call__(self, tissue):
            return 0.5 * jnp.sum(self.strength * tissue.perimeters**2)
    ```

    Fields that are arrays are parameters, which a fit adjusts by default; plain Python numbers are
    constants. Energies add: `AreaElasticity(...) + LineTension(...)`. For an energy that is a sum over cells
    and edges, subclass [`AbstractLocalEnergy`][vertax.AbstractLocalEnergy] instead: candidate T1
    transitions are then evaluated in one batch.

    Use `jax.custom_jvp`, not `jax.custom_vjp`: implicit differentiation needs forward mode.
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Energy of a tissue."""

    def __add__(self, other: AbstractEnergy) -> AbstractEnergy:
        """The sum of two energies."""
        if isinstance(other, type):
            check_energy(other, "other")
        if not isinstance(other, AbstractEnergy):
            return NotImplemented
        terms = (*_terms(self), *_terms(other))
        local = tuple(term for term in terms if isinstance(term, AbstractLocalEnergy))
        return LocalSum(local) if len(local) == len(terms) else Sum(terms)

    def __radd__(self, other: int) -> AbstractEnergy:
        """The energy itself for 0, with which the built-in `sum` starts."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


class AbstractLocalEnergy(AbstractEnergy):
    r"""An energy $\sum_c E_c + \sum_e E_e$ with one term per cell and one term per edge.

    Override `cell_terms`, `edge_terms` or both. Each term must depend only on the geometry of that cell
    or edge, so that the energy change of a T1 transition is a sum of local differences.
    """

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        return jnp.zeros(tissue.n_cells, tissue.vertices.dtype)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return jnp.zeros(tissue.n_edges, tissue.vertices.dtype)

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Sum of the terms of all living cells and edges; spare slots add 0."""
        by_cell, by_edge = self.cell_terms(tissue), self.edge_terms(tissue)
        if tissue.topology.spare:
            by_cell = jnp.where(tissue.alive, by_cell, 0)
            by_edge = jnp.where(tissue.topology.alive_edges, by_edge, 0)
        return jnp.sum(by_cell) + jnp.sum(by_edge)


class Sum(AbstractEnergy):
    """A sum of energies; made by `+`."""

    terms: tuple[AbstractEnergy, ...]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Energy of a tissue."""
        return sum((term(tissue) for term in self.terms), jnp.zeros((), tissue.vertices.dtype))


class LocalSum(AbstractLocalEnergy):
    """A sum of local energies, which is a local energy; made by `+`."""

    terms: tuple[AbstractLocalEnergy, ...]

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        zero = jnp.zeros((), tissue.vertices.dtype)
        return sum((term.cell_terms(tissue) for term in self.terms), zero)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        zero = jnp.zeros((), tissue.vertices.dtype)
        return sum((term.edge_terms(tissue) for term in self.terms), zero)


def _terms(energy: AbstractEnergy) -> tuple[AbstractEnergy, ...]:
    return energy.terms if isinstance(energy, Sum | LocalSum) else (energy,)


_Value = TypeVar("_Value")
if TYPE_CHECKING:  # An array to type checkers: it is a float only where the user passes one.
    OrFloat: TypeAlias = Annotated[_Value, "or a float"]
else:
    OrFloat = float | _Value
Parameter: TypeAlias = OrFloat[Float[Array, "*shape"]]
"""A parameter of an energy: an array, which a fit adjusts by default, or a constant float."""


def as_parameter(name: str, value: ArrayLike) -> Parameter:
    """Convert a Python number to a float (a constant), and anything else to a floating-point array.

    **Arguments:**

    - `name`: name of the parameter, for error messages.
    - `value`: the parameter.

    **Returns:** a float or an array.

    **Raises:**

    - `TypeError` unless the value holds real numbers.
    - `ValueError` for NaN and infinity.
    """
    array = as_real(name, value)
    return cast(Any, float(value)) if isinstance(value, int | float) else array


def per_cell(values: Parameter, tissue: Tissue, name: str) -> Parameter:
    """Check that a parameter is a scalar or has one entry per cell."""
    return _check(values, tissue, tissue.n_cells, name, "cell")


def per_edge(values: Parameter, tissue: Tissue, name: str) -> Parameter:
    """Check that a parameter is a scalar or has one entry per edge."""
    return _check(values, tissue, tissue.n_edges, name, "edge")


def _check(values: Parameter, tissue: Tissue, size: int, name: str, item: str) -> Parameter:
    check_single(tissue)
    check_shape(name, values, (), (size,), remedy=f"Give one number, or one for each {item}.")
    return values
