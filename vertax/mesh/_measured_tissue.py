"""A tissue with cached edge lengths, areas and perimeters."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float

from vertax.mesh._tissue import Measurements, Tissue


class MeasuredTissue(Tissue):
    """A tissue with cached edge lengths, areas and perimeters.

    Each property of a `Tissue`, and its derivative, gathers the vertices separately. The cached properties
    share one gather, which halves the cost of a Hessian-vector product.

    The cache is valid only for the arrays from which it was computed (compared by identity). With other
    arrays, for example after `with_vertices` or as an argument of a compiled function, the properties are
    computed as for any `Tissue`.

    **Arguments:**

    - `tissue`: the tissue.
    - `measurements`: its measurements; None to compute them.
    """

    measurements: Measurements
    source: list[Array]

    def __init__(self, tissue: Tissue, measurements: Measurements | None = None):
        for name in Tissue.__dataclass_fields__:
            setattr(self, name, getattr(tissue, name))
        self.measurements = tissue.measured() if measurements is None else measurements
        self.source = jax.tree.leaves(tissue)

    @property
    def edge_lengths(self) -> Float[Array, " edges"]:
        """Length of each edge."""
        return self.measurements.lengths if self._is_valid else super().edge_lengths

    @property
    def areas(self) -> Float[Array, " cells"]:
        """Area of each cell."""
        return self.measurements.areas if self._is_valid else super().areas

    @property
    def perimeters(self) -> Float[Array, " cells"]:
        """Perimeter of each cell."""
        return self.measurements.perimeters if self._is_valid else super().perimeters

    @property
    def _is_valid(self) -> bool:
        """Whether all arrays are those from which the measurements were computed."""
        fields = [getattr(self, name) for name in Tissue.__dataclass_fields__]
        return all(a is b for a, b in zip(jax.tree.leaves(fields), self.source, strict=True))
