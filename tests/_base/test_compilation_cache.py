"""The folder and the settings of the persistent compilation cache."""

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
    """An empty home directory without settings; the settings of JAX are restored afterwards."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    for name in ("VERTAX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other folders")
def test_default_folder_is_the_cache_folder_of_the_user(home, monkeypatch):
    assert enable_compilation_cache() == home / ".cache/vertax"
    assert (home / ".cache/vertax").stat().st_mode & 0o777 == 0o700
    assert jax.config.jax_compilation_cache_dir == str(home / ".cache/vertax")
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "elsewhere"))
    assert enable_compilation_cache() == home / "elsewhere/vertax"


def test_environment_variable_disables_the_cache_or_sets_its_folder(home, monkeypatch):
    for off in ("off", "OFF", "0", "no"):
        monkeypatch.setenv("VERTAX_CACHE", off)
        assert enable_compilation_cache() is None
        assert jax.config.jax_compilation_cache_dir is None
    assert list(home.iterdir()) == []
    monkeypatch.setenv("VERTAX_CACHE", str(home / "mine"))
    assert enable_compilation_cache() == home / "mine"


def test_folder_set_in_jax_has_priority_over_the_default(home):
    jax.config.update("jax_compilation_cache_dir", str(home / "of the user"))
    assert enable_compilation_cache() == home / "of the user"
    assert enable_compilation_cache(home / "asked for") == home / "asked for"


def test_unusable_folder_is_an_error_only_if_given(home, monkeypatch):
    (home / "file").write_text("")
    with pytest.raises(ValueError, match=r"Cannot keep compiled functions in .*VERTAX_CACHE=off"):
        enable_compilation_cache(home / "file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "file"))
    assert enable_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_incomplete_files_are_removed(home):
    folder = home / "kept"
    folder.mkdir()
    old = time.time() - 3600
    for name in ("complete-cache", "complete-atime", "incomplete-cache", "fresh-cache"):
        (folder / name).write_bytes(b"x")
        if not name.startswith("fresh"):
            os.utime(folder / name, (old, old))
    enable_compilation_cache(folder)  # without `.lockfile` JAX writes no `-atime` files
    assert (folder / "incomplete-cache").exists()
    (folder / ".lockfile").touch()
    enable_compilation_cache(folder)
    assert sorted(path.name for path in folder.glob("*-*")) == [
        "complete-atime",
        "complete-cache",
        "fresh-cache",
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


@pytest.mark.thorough
def test_second_process_reads_the_cache(home):
    def counts():
        environment = os.environ | {"VERTAX_CACHE": str(home / "kept")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # set by tests/run.py
        command = [sys.executable, "-c", CODE]
        process = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment
        )
        assert process.stderr == ""
        return [int(n) for n in process.stdout.split()]

    hits, misses = counts()
    assert hits == 0
    assert misses > 0
    assert counts() == [misses, 0]
