"""What every adjoint here says of itself."""

from __future__ import annotations

from typing import ClassVar

import optimistix as optx


class AbstractAdjoint(optx.AbstractAdjoint):
    """A way to differentiate through an equilibrium: an Optimistix adjoint that says what it needs.

    [`equilibrate`][vertax.equilibrate] first finds the equilibrium and its topology, without gradients.
    """

    runs_solver: ClassVar[bool]
    """Whether the adjoint runs the minimiser itself, or needs the equilibrium alone."""
