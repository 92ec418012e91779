"""Messages during long compilations."""

import time

import jax.numpy as jnp
import pytest

from vertax._base import announce
from vertax._base.announce import announce_compilations, announced_jit


@pytest.fixture(autouse=True)
def _short_delay(monkeypatch):
    monkeypatch.setattr(announce, "DELAY", 0.01)
    monkeypatch.setattr(announce, "_label_of_process", ["the default"])


@pytest.fixture
def slow():
    def slow_to_trace(x):
        time.sleep(0.1)
        return x + 1

    return announced_jit(slow_to_trace)


def test_a_job_that_compiles_several_functions_is_announced_once(slow, capsys):
    with announce_compilations("a sum"):
        slow(jnp.ones(3))
        slow(jnp.ones(3))
        slow(jnp.ones(4))
    assert capsys.readouterr().err.count("Compiling a sum") == 1
    with announce_compilations("a sum"):
        slow(jnp.ones(5))
    assert capsys.readouterr().err.count("Compiling a sum") == 1


def test_long_execution_is_not_announced(slow, capsys):
    slow(jnp.ones(3))
    capsys.readouterr()
    with announce_compilations("a sum"):
        time.sleep(0.1)
        slow(jnp.ones(3))
    assert capsys.readouterr().err == ""


def test_nested_functions_are_announced_once(slow, capsys):
    outer = announced_jit(lambda x: slow(x) * 2)
    with announce_compilations("a product"):
        outer(jnp.ones(3))
    assert capsys.readouterr().err.count("Compiling a product") == 1
    assert "a sum" not in capsys.readouterr().err


def test_function_without_a_job_is_named(slow, capsys, monkeypatch):
    monkeypatch.setattr(announce, "_label_of_process", [])
    monkeypatch.setattr(announce, "_is_watched", lambda: True)
    slow(jnp.ones(6))
    assert "Compiling `slow_to_trace` (once" in capsys.readouterr().err
    announced_jit(lambda x: slow(x) * 2, label="a product")(jnp.ones(7))
    assert "Compiling a product" in capsys.readouterr().err


def test_nothing_is_printed_without_a_terminal(slow, capsys, monkeypatch):
    monkeypatch.setattr(announce, "_label_of_process", [])
    slow(jnp.ones(3))
    with announce_compilations("a sum"):  # no terminal
        slow(jnp.ones(4))
    assert capsys.readouterr().err == ""
