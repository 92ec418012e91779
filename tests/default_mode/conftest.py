"""Settings for the tests in JAX's default mode."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="session")
def _only_in_default_mode():
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        pytest.skip(
            "these tests need float32: VERTAX_TESTS_DEFAULT_MODE=1 pytest tests/default_mode"
        )
