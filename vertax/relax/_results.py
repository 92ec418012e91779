"""The outcomes of a computation."""

from __future__ import annotations

import optimistix as optx


class RESULTS(optx.RESULTS):
    """Outcomes of relaxations and of what is built of them; `RESULTS[result]` is the message."""

    too_many_contacts = (
        "More corners are near a side of their cell than there is room for. Raise `max_contacts`."
    )
