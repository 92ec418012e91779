"""A tissue whose geometry is worked out once for all that is to be made of it."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float

from vertax.mesh._tissue import Measurements, Tissue


class MeasuredTissue(Tissue):
    """A tissue that knows its lengths and areas.

    Each property of a tissue is a function of its vertices, and so is its derivative, on its own. Here they
    share what they have in common: less than half the looks at the vertices in a product with a Hessian.

    What is known counts for the very arrays that it was made of. With others in their place, as after
    `with_vertices` or as arguments of another program, it is a tissue like any other.

    **Arguments:**

    - `tissue`: the tissue.
    - `known`: what is known of it; None to work it out.
    """

    known: Measurements
    of: list[Array]

    def __init__(self, tissue: Tissue, known: Measurements | None = None):
        for name in Tissue.__dataclass_fields__:
            setattr(self, name, getattr(tissue, name))
        self.known = tissue.measured() if known is None else known
        self.of = jax.tree.leaves(tissue)

    @property
    def edge_lengths(self) -> Float[Array, " edges"]:
        """Length of each edge."""
        return self.known.lengths if self._is_known else super().edge_lengths

    @property
    def areas(self) -> Float[Array, " cells"]:
        """Area of each cell."""
        return self.known.areas if self._is_known else super().areas

    @property
    def perimeters(self) -> Float[Array, " cells"]:
        """Perimeter of each cell."""
        return self.known.perimeters if self._is_known else super().perimeters

    @property
    def _is_known(self) -> bool:
        fields = [getattr(self, name) for name in Tissue.__dataclass_fields__]
        return all(a is b for a, b in zip(jax.tree.leaves(fields), self.of, strict=True))
