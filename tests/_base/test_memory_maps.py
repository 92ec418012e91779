"""Compiled functions are forgotten before there are too many."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import pytest

from vertax._base import memory_maps


@pytest.fixture
def square():
    return eqx.filter_jit(lambda x: x**2)


def test_they_are_forgotten_with_a_warning_where_there_are_too_many(square, monkeypatch):
    if not memory_maps.MAPS.exists():
        pytest.skip("this system does not show the memory maps of a process")
    monkeypatch.setattr(memory_maps, "PAUSE", 0.0)
    forgotten = []
    monkeypatch.setattr(memory_maps.eqx, "clear_caches", lambda: forgotten.append(True))
    memory_maps.spare_memory_maps()
    assert not forgotten
    monkeypatch.setattr(memory_maps, "SHARE", 0.0)
    assert square(3) == 9
    with pytest.warns(RuntimeWarning, match="memory maps"):
        memory_maps.spare_memory_maps()
    assert forgotten
    assert square(3) == 9


def test_nothing_is_forgotten_within_a_trace(monkeypatch):
    monkeypatch.setattr(memory_maps, "SHARE", 0.0)
    monkeypatch.setattr(memory_maps, "PAUSE", 0.0)

    def square(x):
        memory_maps.spare_memory_maps()
        return x**2

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert eqx.filter_jit(square)(jnp.asarray(3.0)) == 9


def test_one_look_a_second_is_enough(monkeypatch):
    monkeypatch.setattr(memory_maps, "SHARE", 0.0)
    monkeypatch.setattr(memory_maps, "_last_look", float("inf"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        memory_maps.spare_memory_maps()


def test_other_systems_need_none(monkeypatch, tmp_path):
    monkeypatch.setattr(memory_maps, "PAUSE", 0.0)
    monkeypatch.setattr(memory_maps, "SHARE", 0.0)
    monkeypatch.setattr(memory_maps, "MAPS", tmp_path / "maps")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        memory_maps.spare_memory_maps()
