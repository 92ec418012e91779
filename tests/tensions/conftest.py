"""A foam of known tensions, shared by the tests of this folder."""

import pytest
from free_helpers import at_rest, cluster


@pytest.fixture(scope="session")
def foam():
    """A cluster in equilibrium, its tensions and pressures."""
    return at_rest(
        cluster(14, 3, lloyd_steps=3, inner_arcs=True), largest_area=1.3, tolerance=1e-11
    )
