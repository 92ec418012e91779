"""Small tools used in several rooms; the only place that reaches around other libraries' habits."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.core

if TYPE_CHECKING:
    compiled_property = property  # so that type checkers see the type of each property
else:

    class compiled_property(property):
        """A property of an Equinox module that is compiled as one function.

        Outside `jax.jit` a property of thirty array operations would otherwise compile thirty functions
        when it is first used; inside, it is inlined.
        """

        def __init__(self, method: Callable[[Any], Any]):
            super().__init__(eqx.filter_jit(method, inline=True), doc=method.__doc__)


def is_concrete(value: Any) -> bool:
    """Whether the numbers of an array can be looked at (outside of `jax.jit` and `jax.grad`)."""
    return not isinstance(value, jax.core.Tracer)


def without_addresses(text: str) -> str:
    """A text in which no address of an object in memory is left, so that two processes write the same."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)
