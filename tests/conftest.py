"""Settings for all tests."""

import os

# Tests compile more than they compute: half the optimisation is half the time. Read when JAX starts.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import jax
import matplotlib

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")
