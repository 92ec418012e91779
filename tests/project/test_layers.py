"""Imports point downward, and experiments use what users can use."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "vertax"

# From the bottom to the top: a package imports from itself and from what stands before it.
LAYERS = [
    "_base",
    "mesh",
    "energies",
    "dissipations",
    "activities",
    "transitions",
    "solvers",
    "adjoints",
    "responses",
    "mechanics",
    "costs",
    "growth",
    "fitting",
    "initialise",
    "io",
    "inference",
    "plotting",
    "runs",
    "experiments",
]
# An experiment sees what a user sees: these packages by their public names.
PUBLIC = {"vertax", *(f"vertax.{name}" for name in LAYERS if name != "_base")}


def imports(path: Path) -> list[str]:
    """The modules of vertax that a file imports from, at the top or in a function."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
            if node.module == "vertax":
                found += [f"vertax.{alias.name}" for alias in node.names if alias.name in LAYERS]
    return [name for name in found if name.split(".")[0] == "vertax"]


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def test_every_package_has_its_layer():
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == set(LAYERS)
    assert {path.name for path in ROOT.glob("*.py")} == {"__init__.py", "__main__.py"}


@pytest.mark.parametrize("package", LAYERS)
def test_imports_point_downward(package):
    allowed = LAYERS[: LAYERS.index(package) + 1]
    upward = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(package)
        for name in imports(path)
        if name != "vertax" and name.split(".")[1] not in allowed
    ]
    assert not upward


def test_no_circles_within_a_package():
    files = {path: set(imports(path)) for path in ROOT.rglob("*.py") if path.name != "__init__.py"}
    name_of = lambda path: ".".join(["vertax", *path.relative_to(ROOT).with_suffix("").parts])
    below = {name_of(path): names for path, names in files.items()}
    while below:
        leaves = [name for name, names in below.items() if not names & (below.keys() - {name})]
        assert leaves, f"these import each other: {sorted(below)}"
        for name in leaves:
            del below[name]


def test_experiments_are_clients():
    private = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules("experiments")
        for name in imports(path)
        if name not in PUBLIC and not name.startswith("vertax.experiments.")
    ]
    assert not private
