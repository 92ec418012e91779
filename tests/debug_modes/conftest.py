"""Settings for the tests with the checks of JAX for NaN."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="session")
def _stop_at_nan():
    with jax.debug_nans(True):
        yield
