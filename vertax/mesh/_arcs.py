"""The degrees of freedom of arcs."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float


class Arcs(eqx.Module):
    """The angles of the edges of a tissue.

    **Arguments:**

    - `angles`: angle of each edge, in radians; ignored for straight edges.
    - `length`: factor that converts an angle to a length, the unit of the other degrees of freedom.
    - `inner`: whether edges between two cells are arcs too, or only edges on the outline.
    """

    angles: Float[Array, " edges"]
    length: Float[Array, ""]
    inner: bool = eqx.field(static=True, kw_only=True)

    @property
    def scaled(self) -> Float[Array, " edges"]:
        """The angles as degrees of freedom: `angles * length`."""
        return self.angles * self.length
