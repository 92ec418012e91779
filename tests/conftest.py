"""Settings for all tests."""

import gc
import os
from importlib.metadata import version

# Tests compile more than they compute: less optimisation is a third of the time. Read when JAX starts.
FLAGS = ["--xla_backend_optimization_level=0"]
if version("jaxlib").startswith("0.10."):
    # (XLA stops at flags that it does not know.)
    FLAGS += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["VERTAX_CACHE"] = "off"  # nothing of the tests in the user's cache folder
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FLAGS])

import equinox as eqx
import jax
import jaxtyping
import matplotlib
import pytest

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

# What is traced and compiled makes very many objects that stay: looking through them a twentieth of the time.
gc.set_threshold(20_000, 20, 10)


@pytest.fixture(autouse=True)
def _few_compiled_functions():
    """Forget compiled functions before there are too many."""
    # Each holds some memory maps, of which Linux allows a process 65530; beyond, the compiler aborts.
    from vertax._base.memory_maps import memory_maps

    yield
    if memory_maps() > 15_000:
        eqx.clear_caches()
        jax.clear_caches()


@pytest.fixture
def without_type_checks():
    """Without the type checks that the tests add to every function: what a user sees of a wrong type."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
