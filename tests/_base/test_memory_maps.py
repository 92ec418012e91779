"""The warning before the memory maps of the process run out."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import pytest

from vertax._base import memory_maps
from vertax._base.memory_maps import warn_of_memory_maps


@pytest.fixture(autouse=True)
def _fresh_state(monkeypatch):
    monkeypatch.setattr(memory_maps, "INTERVAL", 0.0)
    monkeypatch.setattr(memory_maps, "_has_warned", False)


def test_warning_is_given_once_with_a_remedy(monkeypatch):
    if not memory_maps.MAPS.exists():
        pytest.skip("this system does not list the memory maps of a process")
    square = eqx.filter_jit(lambda x: x**2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_memory_maps()
    monkeypatch.setattr(memory_maps, "FRACTION", 0.0)
    assert square(3) == 9
    with pytest.warns(RuntimeWarning, match=r"memory maps.*jax\.clear_caches"):
        warn_of_memory_maps()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_memory_maps()
    assert square(3) == 9


def test_no_warning_inside_a_trace(monkeypatch):
    monkeypatch.setattr(memory_maps, "FRACTION", 0.0)

    def square(x):
        warn_of_memory_maps()
        return x**2

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert eqx.filter_jit(square)(jnp.asarray(3.0)) == 9


def test_maps_are_counted_at_most_once_per_interval(monkeypatch):
    monkeypatch.setattr(memory_maps, "FRACTION", 0.0)
    monkeypatch.setattr(memory_maps, "_last_count", float("inf"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_memory_maps()


def test_no_warning_without_proc_self_maps(monkeypatch, tmp_path):
    monkeypatch.setattr(memory_maps, "FRACTION", 0.0)
    monkeypatch.setattr(memory_maps, "MAPS", tmp_path / "maps")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_memory_maps()
