"""Batches over several devices, which these tests make of one, and over several processes."""

import socket
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


PROCESS = """
import os
os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
import sys, jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(f"127.0.0.1:{sys.argv[2]}", num_processes=2, process_id=int(sys.argv[1]))
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
import vertax as vx

tissue = vx.initialise.periodic_voronoi(6, key=jax.random.key(0))
p0 = np.array([3.5, 3.55, 3.6, 3.65])
relaxed = lambda p0: vx.equilibrate(
    tissue, vx.energies.ShapeFactorEnergy(p0), transitions=None, contact_range=None
)
area = lambda p0: relaxed(p0).tissue.areas[0]
mesh, spec = Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch")
shared = jax.make_array_from_callback(p0.shape, NamedSharding(mesh, spec), lambda i: p0[i])
assert len(jax.devices()) == 2 and len(shared.addressable_shards) == 1
share = jax.jit(jax.shard_map(
    lambda p: jax.lax.map(area, p), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
))
every = multihost_utils.process_allgather(share(shared), tiled=True)
np.testing.assert_allclose(every, jax.lax.map(area, jnp.asarray(p0)), rtol=1e-9)
jax.distributed.shutdown()
"""


@pytest.mark.thorough
def test_a_batch_is_shared_between_processes():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", PROCESS]
    both = [subprocess.Popen([*command, str(rank), str(port)]) for rank in range(2)]
    try:
        assert [process.wait(timeout=300) for process in both] == [0, 0]
    finally:
        for process in both:
            process.kill()
