"""What every energy is, and how energies add up."""

from __future__ import annotations

import abc
import inspect
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, describe
from vertax._base.field_checks import check_fields
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
    constants. Energies add: `AreaElasticity(...) + LineTension(...)`. An energy that is a sum over cells
    and edges is better a subclass of [`AbstractLocalEnergy`][vertax.AbstractLocalEnergy]: T1 transitions
    are then judged many at a time.

    `jax.custom_vjp` must not be used inside: implicit differentiation needs forward mode through the
    gradient (`jax.custom_jvp` is fine).
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
        """What `sum` of some energies begins with: 0 and the first one."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


class AbstractLocalEnergy(AbstractEnergy):
    """An energy that is a sum of one term a cell and one term an edge.

    Override `cell_terms`, `edge_terms` or both. Each term may depend on the geometry of its own cell
    (or edge) alone; that is what lets T1 transitions be judged by local differences.
    """

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        return jnp.zeros(tissue.n_cells, tissue.vertices.dtype)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return jnp.zeros(tissue.n_edges, tissue.vertices.dtype)

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Energy of a tissue: the sum of all terms, of cells and edges that there are."""
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
    """A sum of local energies; made by `+`, and local itself."""

    terms: tuple[AbstractLocalEnergy, ...]

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        zero = jnp.zeros((), tissue.vertices.dtype)
        return sum((term.cell_terms(tissue) for term in self.terms), zero)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        zero = jnp.zeros((), tissue.vertices.dtype)
        return sum((term.edge_terms(tissue) for term in self.terms), zero)


def check_energy(energy: Any, name: str = "energy") -> None:
    """Raise an error unless an argument is an energy, or another function of a tissue.

    **Arguments:**

    - `energy`: the argument.
    - `name`: its name in the message.

    **Raises:**

    - `TypeError` for an object that cannot be called, or a class of energies in place of an instance.
    """
    if callable(energy) and not isinstance(energy, type):
        return
    raise TypeError(
        f"Argument `{name}` must be an energy, e.g. vertax.energies.ShapeFactorEnergy(3.8), but is "
        f"{describe(energy)}.{instance_hint(energy)}"
    )


def instance_hint(value: Any) -> str:
    """How to make an instance of a class that was passed in its place; empty for other values."""
    if not isinstance(value, type):
        return ""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # a class of C code without a signature
        return f" Pass an instance, {value.__name__}(...)."
    required = [p.name for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    return f" Pass an instance, {value.__name__}({', '.join(required)})."


def _terms(energy: AbstractEnergy) -> tuple[AbstractEnergy, ...]:
    return energy.terms if isinstance(energy, Sum | LocalSum) else (energy,)


Parameter: TypeAlias = float | Float[Array, "*shape"]
"""A parameter of an energy: an array, which is what a fit adjusts by default, or a constant float."""


def as_parameter(name: str, value: ArrayLike) -> Parameter:
    """A Python number stays one, a constant; anything else becomes an array of floating-point numbers.

    **Arguments:**

    - `name`: of the parameter.
    - `value`: the parameter.

    **Returns:** a float or an array.

    **Raises:**

    - `TypeError` for what are no real numbers.
    - `ValueError` for NaN and infinity.
    """
    array = as_real(name, value)
    return float(value) if isinstance(value, int | float) else array


def per_cell(values: Parameter, tissue: Tissue, name: str) -> Parameter:
    """Check that a parameter is a scalar or has one entry a cell."""
    return _check(values, tissue, tissue.n_cells, name, "cell")


def per_edge(values: Parameter, tissue: Tissue, name: str) -> Parameter:
    """Check that a parameter is a scalar or has one entry an edge."""
    return _check(values, tissue, tissue.n_edges, name, "edge")


def _check(values: Parameter, tissue: Tissue, size: int, name: str, what: str) -> Parameter:
    if tissue.vertices.ndim != 2:
        raise ValueError(
            "An energy is that of a single tissue, but the vertices have shape "
            f"{tissue.vertices.shape}. Take a batch through equinox.filter_vmap."
        )
    if jnp.shape(values) not in ((), (size,)):
        raise ValueError(
            f"Parameter `{name}` must be a scalar or have one entry a {what}, shape ({size},), but its "
            f"shape is {jnp.shape(values)}."
        )
    return values
