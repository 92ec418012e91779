"""What every adjoint here has in common."""

from __future__ import annotations

import optimistix as optx


class AbstractAdjoint(optx.AbstractAdjoint):
    """A way to differentiate through an equilibrium, given the equilibrium itself.

    [`equilibrate`][vertax.equilibrate] first finds the equilibrium and its topology without gradients;
    the adjoint then sees a minimisation that starts, and ends, there. (An adjoint that unrolls the steps
    of a minimiser would find none, and a gradient of zero: so Optimistix's own are not accepted.)
    """
