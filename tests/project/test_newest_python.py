"""The Python version and the tests of `make test-newest`."""

import newest_python
import pytest
import run


def program(path, script):
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Two folders, the only ones in PATH."""
    pair = tmp_path / "first", tmp_path / "second"
    monkeypatch.setenv("PATH", ":".join(map(str, pair)))
    monkeypatch.setattr(newest_python, "VERSIONS", ("99.2", "99.1", "3.11"))
    return pair


WORKS = "echo 99.1; echo /path/of/python99.1"
FAILS = "echo 'command not found' >&2; exit 127"


def test_a_program_that_fails_is_skipped(folders):
    first, second = folders
    program(first / "python99.2", FAILS)
    program(first / "python99.1", FAILS)
    program(second / "python99.1", WORKS)
    assert newest_python.newest_python() == "/path/of/python99.1"


def test_versions_of_pyenv_are_used(folders, tmp_path):
    first, second = folders
    program(first / "python99.1", FAILS)
    program(tmp_path / "versions" / "python", WORKS)
    which = f'[ "$PYENV_VERSION" = 99.1.5 ] && echo {tmp_path}/versions/python || exit 1'
    whence = '[ "$2" = python99.1 ] && echo 99.1.4 && echo 99.1.5 || exit 1'
    program(second / "pyenv", f'if [ "$1" = whence ]; then {whence}; else {which}; fi')
    assert newest_python.newest_python() == "/path/of/python99.1"


def test_only_newer_versions_are_returned(folders):
    program(folders[0] / "python3.11", "echo 3.11; echo /path/of/python3.11")
    assert newest_python.newest_python() is None


def test_folders_of_tests_can_be_selected_and_excluded():
    chosen = [path for group in run.groups(["io", "solvers/test_minres.py"]) for path in group]
    names = {path.relative_to(run.FOLDER).as_posix() for path in chosen}
    assert "io/test_tissue_files.py" in names
    assert {name for name in names if not name.startswith("io/")} == {"solvers/test_minres.py"}
    rest = [path for group in run.groups(without=["io", "solvers"]) for path in group]
    everything = [path for group in run.groups() for path in group]
    assert set(everything) - set(rest) > set(chosen)
