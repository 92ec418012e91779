"""Settings for all tests."""

import gc
import os
import time
from importlib.metadata import version

# Tests spend most time on compilation; without optimisation it takes a third. Read when JAX starts.
FLAGS = ["--xla_backend_optimization_level=0"]
if version("jaxlib").startswith("0.10."):
    # (XLA exits at unknown flags.)
    FLAGS += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["VERTAX_CACHE"] = "off"  # no files of tests in the user's cache folder
# The tests of `default_mode` run as users run JAX: in float32, with the normal optimisation (tests/run.py).
DEFAULT_MODE = "VERTAX_TESTS_DEFAULT_MODE" in os.environ
if not DEFAULT_MODE:
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FLAGS])

import equinox as eqx
import jax
import jaxtyping
import matplotlib
import pytest

jax.config.update("jax_enable_x64", not DEFAULT_MODE)
matplotlib.use("Agg")

# Tracing creates many long-lived objects: collect garbage less often.
gc.set_threshold(20_000, 20, 10)
last_count = 0.0


@pytest.fixture(autouse=True)
def _limit_memory_maps():
    """Clear the caches of compiled functions before the memory maps run out."""
    # Each compiled function uses memory maps, of which Linux allows 65530; above, the compiler aborts.
    from vertax._base.memory_maps import memory_maps

    global last_count
    yield
    if time.monotonic() - last_count < 5:
        return  # a count takes up to ten milliseconds
    last_count = time.monotonic()
    if memory_maps() > 15_000:
        eqx.clear_caches()
        jax.clear_caches()


@pytest.fixture
def without_type_checks():
    """Disable the type checks of the tests, to get the errors that users get for a wrong type."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
