"""The processes of `tests/run.py` hold each file of tests once."""

import run


def test_folders_of_tests_can_be_selected_and_excluded():
    chosen = [path for group in run.groups(["io", "solvers/test_minres.py"]) for path in group]
    names = {path.relative_to(run.FOLDER).as_posix() for path in chosen}
    assert "io/test_tissue_files.py" in names
    assert {name for name in names if not name.startswith("io/")} == {"solvers/test_minres.py"}
    rest = [path for group in run.groups(without=["io", "solvers"]) for path in group]
    assert {path for group in run.groups() for path in group} - set(rest) > set(chosen)
