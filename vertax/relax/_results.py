"""The outcomes of a computation."""

from __future__ import annotations

import equinox as eqx


class RESULTS(eqx.Enumeration):
    """Outcomes of relaxations and of what is built of them; `RESULTS[result]` is the message.

    The names are those of `optimistix.RESULTS`, where it has them.
    """

    successful = ""
    nonlinear_max_steps_reached = "The relaxation reached no equilibrium within `max_steps`."
    nonfinite = "The relaxation broke down: its forces are not finite."
    too_many_contacts = (
        "More corners are near a side of their cell than there is room for. Raise `max_contacts`."
    )
