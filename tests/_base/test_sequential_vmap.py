"""Sequential `jax.vmap` on a CPU."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertax._base import sequential_vmap
from vertax._base.sequential_vmap import sequential_vmap_on_cpu


def halvings(x, settings):
    """Halve a number until it is below 1; return the number of halvings, the result and a setting."""
    carry = (jnp.asarray(x), jnp.array(0))
    value, n = jax.lax.while_loop(lambda c: c[0] >= 1, lambda c: (c[0] / 2, c[1] + 1), carry)
    return {"n": n, "value": value + settings["offset"], "name": settings["name"]}


SETTINGS = {"offset": jnp.array(0.5), "name": "static"}
NUMBERS = jnp.array([0.5, 3.0, 100.0])


@pytest.fixture(params=["cpu", "gpu"])
def platform(request, monkeypatch):
    monkeypatch.setattr(sequential_vmap, "_platform", lambda: request.param)
    return request.param


def test_vmap_returns_the_results_of_the_members(platform):
    function = sequential_vmap_on_cpu(halvings)
    batch = eqx.filter_vmap(function, in_axes=(0, None))(NUMBERS, SETTINGS)
    members = [halvings(x, SETTINGS) for x in NUMBERS]
    assert batch["name"] == "static"
    np.testing.assert_array_equal(batch["n"], [m["n"] for m in members])
    np.testing.assert_array_equal(batch["value"], [m["value"] for m in members])


def test_nested_vmap_returns_the_results_of_the_members(platform):
    function = sequential_vmap_on_cpu(lambda x, y: halvings(x * y, SETTINGS)["n"])
    table = jax.vmap(lambda y: jax.vmap(lambda x: function(x, y))(NUMBERS))(NUMBERS)
    expected = [[halvings(x * y, SETTINGS)["n"] for x in NUMBERS] for y in NUMBERS]
    np.testing.assert_array_equal(table, expected)


def test_vmap_is_a_scan_on_cpu_only(platform):
    function = sequential_vmap_on_cpu(lambda x: halvings(x, SETTINGS)["n"])
    program = str(jax.make_jaxpr(jax.vmap(function))(NUMBERS))
    assert ("scan" in program) == (platform == "cpu")


def test_function_of_constants_can_be_used_inside_grad():
    function = sequential_vmap_on_cpu(lambda x: halvings(x, SETTINGS)["value"])
    loss = lambda x: jnp.sum(x * jax.vmap(function)(jax.lax.stop_gradient(x)))
    gradient = jax.jit(jax.grad(loss))(NUMBERS)
    np.testing.assert_allclose(gradient, jax.vmap(function)(NUMBERS))
