"""Lines of code per folder. The numbers only go down: added lines replace others."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Largest numbers of lines of Python, with comments and docstrings.
LINES = {
    "_base": 3601,
    "activities": 436,
    "adjoints": 974,
    "bayes": 1071,
    "costs": 1619,
    "dissipations": 287,
    "dynamics": 1003,
    "energies": 660,
    "external": 2038,
    "fitting": 2019,
    "growth": 817,
    "inference": 2274,
    "initialise": 3780,
    "io": 3602,
    "jobs": 935,
    "mechanics": 2185,
    "mesh": 2480,
    "plotting": 2130,
    "precondition": 716,
    "relax": 2124,
    "runs": 1993,
    "signals": 555,
    "solvers": 2205,
    "surfaces": 629,
    "tensions": 4191,
    "tests": 31922,
    "transitions": 1578,
}
# Largest number of lines of a file, and of the files that have more.
LINES_OF_A_FILE = 400
LONG_FILES = {
    "fitting/_inverse.py": 418,
    "initialise/_labels.py": 418,
    "initialise/_polygons.py": 562,
    "io/_module_file.py": 432,
    "mesh/_tissue.py": 616,
    "mesh/_topology.py": 343,
    "solvers/_minres.py": 437,
    "tensions/_edge_motion.py": 504,
    "tensions/_inferred.py": 396,
}


def lines(path: Path) -> int:
    return path.read_text(encoding="utf-8").count("\n")


def folders() -> dict[str, int]:
    parts = [path for path in (ROOT / "vertax").iterdir() if path.is_dir()]
    sums = {p.name: sum(map(lines, p.rglob("*.py"))) for p in parts if any(p.glob("*.py"))}
    return sums | {"tests": sum(map(lines, (ROOT / "tests").rglob("*.py")))}


@pytest.mark.parametrize("name", folders())
def test_a_folder_does_not_grow(name):
    assert folders()[name] <= LINES[name]


def test_files_are_short():
    sizes = {
        f"{path.parent.name}/{path.name}": lines(path) for path in (ROOT / "vertax").rglob("*.py")
    }
    long = {name: size for name, size in sizes.items() if size > LINES_OF_A_FILE}
    assert not {name for name, size in long.items() if size > LONG_FILES.get(name, 0)}
