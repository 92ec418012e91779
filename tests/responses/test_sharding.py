"""Batches over several devices, which this test makes of one."""

import subprocess
import sys

import pytest

CODE = """
import os
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0"
import sys, jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import vertax as vx
from jax.sharding import Mesh, PartitionSpec

options = {} if "all" in sys.argv else {"transitions": None, "contact_range": None}
tissue = vx.initialise.periodic_voronoi(6, key=jax.random.key(0))
p0 = jnp.array([3.5, 3.55, 3.6, 3.65])
relaxed = lambda p0: vx.equilibrate(tissue, vx.energies.ShapeFactorEnergy(p0), **options)
area = lambda p0: relaxed(p0).tissue.areas[0]
mesh, spec = Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch")
share = lambda **options: jax.shard_map(
    lambda p: jax.lax.map(area, p), mesh=mesh, in_specs=spec, out_specs=spec, **options
)
try:
    share()(p0)
except ValueError as error:
    assert "check_vma=False" in str(error), error
else:
    raise AssertionError("it works: no need to refuse it any more")
np.testing.assert_allclose(share(check_vma=False)(p0), jax.lax.map(area, p0), rtol=1e-9)
"""


# With transitions and contacts four times as much is compiled.
@pytest.mark.parametrize("what", ["solver", pytest.param("all", marks=pytest.mark.slow)])
@pytest.mark.thorough
def test_a_batch_is_shared_between_devices(what):
    subprocess.run([sys.executable, "-c", CODE, what], check=True)
