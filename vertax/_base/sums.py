"""Sums of a small number of arrays."""

import functools
import operator
from collections.abc import Iterable

from jaxtyping import Array, Inexact


def total(terms: Iterable[Inexact[Array, "*shape"]]) -> Inexact[Array, "*shape"]:
    """The sum of one or more arrays, unrolled: faster in XLA than a reduction along a short axis."""
    return functools.reduce(operator.add, terms)
