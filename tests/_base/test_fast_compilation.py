"""Fewer optimisations by the compiler give the same results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax._base import fast_compilation
from vertax._base.announce import announced_jit
from vertax._base.fast_compilation import compiles_fast, has_options

supported = pytest.mark.skipif(not has_options(), reason="this version of JAX has no such options")


@pytest.fixture(autouse=True)
def _disabled_afterwards():
    yield
    vx.enable_fast_compilation(False)


@supported
def test_it_compiles_a_second_version_with_the_same_result():
    traces = []

    @announced_jit
    def double(x):
        traces.append(None)
        return 2 * x

    x = jnp.arange(3.0)
    expected = double(x)
    vx.enable_fast_compilation()
    np.testing.assert_array_equal(double(x), expected)
    double(x)
    assert len(traces) == 2
    vx.enable_fast_compilation(False)
    double(x)
    assert len(traces) == 2


@supported
def test_it_works_inside_of_compiled_and_differentiated_functions():
    double = announced_jit(lambda x: 2 * x)
    vx.enable_fast_compilation()
    assert compiles_fast(None) == (jax.default_backend() == "cpu")
    assert jax.jit(lambda x: double(x) + double(jnp.ones(())))(1.0) == 4.0
    assert jax.grad(double)(1.0) == 2.0
    np.testing.assert_array_equal(jax.vmap(double)(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    assert not jax.jit(lambda: jnp.array(compiles_fast(None)))()


def test_a_version_of_jax_without_the_options_is_named(monkeypatch):
    monkeypatch.setattr(fast_compilation, "has_options", lambda: False)
    with pytest.warns(UserWarning, match="has no options for faster compilation"):
        vx.enable_fast_compilation()
    assert not compiles_fast(None)
