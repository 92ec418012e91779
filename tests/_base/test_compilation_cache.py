"""Compiled functions are kept on disk where that is wanted, and only there."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from vertax import enable_compilation_cache

ROOT = Path(__file__).parents[2]

SETTINGS = [
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
]


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A user of its own, for whom nothing is set; the settings of JAX are back afterwards."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    for name in ("VERTAX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other folders")
def test_it_lies_in_the_users_cache_folder(home, monkeypatch):
    assert enable_compilation_cache() == home / ".cache/vertax"
    assert (home / ".cache/vertax").stat().st_mode & 0o777 == 0o700
    assert jax.config.jax_compilation_cache_dir == str(home / ".cache/vertax")
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "elsewhere"))
    assert enable_compilation_cache() == home / "elsewhere/vertax"


def test_the_environment_switches_it_off_or_names_a_folder(home, monkeypatch):
    for off in ("off", "OFF", "0", "no"):
        monkeypatch.setenv("VERTAX_CACHE", off)
        assert enable_compilation_cache() is None
        assert jax.config.jax_compilation_cache_dir is None
    assert list(home.iterdir()) == []
    monkeypatch.setenv("VERTAX_CACHE", str(home / "mine"))
    assert enable_compilation_cache() == home / "mine"


def test_a_folder_that_was_set_for_jax_is_left_alone(home):
    jax.config.update("jax_compilation_cache_dir", str(home / "of the user"))
    assert enable_compilation_cache() == home / "of the user"
    assert enable_compilation_cache(home / "asked for") == home / "asked for"


def test_a_folder_that_cannot_be_used_is_an_error_only_if_it_was_asked_for(home, monkeypatch):
    (home / "file").write_text("")
    with pytest.raises(ValueError, match=r"Cannot keep compiled functions in .*VERTAX_CACHE=off"):
        enable_compilation_cache(home / "file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "file"))
    assert enable_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_halves_are_forgotten(home):
    folder = home / "kept"
    folder.mkdir()
    old = time.time() - 3600
    for name in ("whole-cache", "whole-atime", "half-cache", "fresh-cache"):
        (folder / name).write_bytes(b"x")
        if not name.startswith("fresh"):
            os.utime(folder / name, (old, old))
    enable_compilation_cache(folder)  # JAX does not write times of use there
    assert (folder / "half-cache").exists()
    (folder / ".lockfile").touch()
    enable_compilation_cache(folder)
    assert sorted(path.name for path in folder.glob("*-*")) == [
        "fresh-cache",
        "whole-atime",
        "whole-cache",
    ]


CODE = """
import jax, logging, sys
import vertax as vx
vx.enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))
jax.jit(lambda x: jax.numpy.sin(x) @ x)(jax.numpy.ones((3, 3))).block_until_ready()
print(hits.count("/jax/compilation_cache/cache_hits"), hits.count("/jax/compilation_cache/cache_misses"))
"""


def test_another_process_does_not_compile_again(home):
    def counts():
        environment = os.environ | {"VERTAX_CACHE": str(home / "kept")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # what these tests share
        command = [sys.executable, "-c", CODE]
        outcome = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment
        )
        assert outcome.stderr == ""
        return [int(n) for n in outcome.stdout.split()]

    hits, misses = counts()
    assert hits == 0
    assert misses > 0
    assert counts() == [misses, 0]
