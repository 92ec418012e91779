"""The coarse part of a preconditioner: collective motions of many vertices."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, PyTree


class AbstractCoarseLevel(eqx.Module):
    """An approximate inverse of the Hessian for collective motions.

    `set_up` measures what it needs with products with the Hessian, `approximate_inverse` prepares the inverse
    for a damping, `apply` multiplies by it.
    """

    @property
    @abc.abstractmethod
    def ready(self) -> Bool[Array, ""]:
        """Whether it can be used."""

    @property
    @abc.abstractmethod
    def blank(self) -> PyTree[Array]:
        """A placeholder for the result of `set_up`."""

    @abc.abstractmethod
    def set_up(
        self, hessian: Callable[[PyTree], PyTree], like: PyTree, stiffness: Float[Array, ""]
    ) -> PyTree[Array]:
        """Measurements at one configuration.

        **Arguments:**

        - `hessian`: multiplies by the Hessian.
        - `like`: a configuration, or its shapes.
        - `stiffness`: the mean stiffness of a vertex.
        """

    @abc.abstractmethod
    def approximate_inverse(
        self, measured: PyTree[Array], damping: Float[Array, ""] | float = 0.0, shares: Any = None
    ) -> PyTree[Array]:
        """The inverse for a damping.

        **Arguments:**

        - `measured`: the result of `set_up`.
        - `damping`: the stiffness of a spring at each vertex.
        - `shares`: the fraction of the force, and of the motion, of each row that counts; None for all.
        """

    @abc.abstractmethod
    def apply(self, inverse: PyTree[Array], local: PyTree, force: PyTree) -> PyTree:
        """The response to a force.

        **Arguments:**

        - `inverse`: the result of `approximate_inverse`.
        - `local`: the response of the local part of the preconditioner.
        - `force`: the force on each row.

        **Returns:** the response of both parts.
        """
