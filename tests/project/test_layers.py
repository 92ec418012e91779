"""Imports point downward; applications, jobs and experiments import public names only."""

import ast
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "vertax"
EXPERIMENTS = ROOT.parent / "experiments"

# From bottom to top: a package imports from itself and from packages before it.
LAYERS = [
    "_base",
    "surfaces",
    "mesh",
    "energies",
    "dissipations",
    "activities",
    "transitions",
    "solvers",
    "precondition",
    "adjoints",
    "relax",
    "dynamics",
    "signals",
    "external",
    "mechanics",
    "costs",
    "growth",
    "fitting",
    "bayes",
    "initialise",
    "io",
    "tensions",
    "inference",
    "plotting",
    "runs",
    "jobs",
]
# What is built on the library: each could be a separate distribution.
APPLICATIONS = LAYERS[LAYERS.index("bayes") :]
# Names of private modules that other packages import (without those of `_base`). The number only goes down.
PRIVATE_NAMES = 60
# The packages with public names that jobs and experiments may import.
PUBLIC = {"vertax", *(f"vertax.{name}" for name in LAYERS if name != "_base")}
PUBLIC |= {f"vertax.jobs.{path.stem}" for path in (ROOT / "jobs").glob("[!_]*.py")}


def module_name(path: Path) -> str:
    """The absolute name of the module in a file, e.g. `vertax.mesh._tissue`."""
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {module_name(path) for path in ROOT.rglob("*.py")}


def imports(path: Path, source: str | None = None) -> list[str]:
    """The absolute names of the vertax modules that a file imports, at the top or in a function.

    `source` replaces the text of the file.
    """
    text = path.read_text(encoding="utf-8") if source is None else source
    # `from .` in a module is its package; in an `__init__.py` it is the package itself.
    package = module_name(path if path.name == "__init__.py" else path.parent / "__init__.py")
    names = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                module = importlib.util.resolve_name("." * node.level + module, package)
            names.append(module)
            submodules = [f"{module}.{alias.name}" for alias in node.names]
            names += [name for name in submodules if name in MODULES]
    return [name for name in names if name.split(".")[0] == "vertax"]


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("from . import _tissue", ["vertax.mesh", "vertax.mesh._tissue"]),
        ("from ._tissue import Tissue", ["vertax.mesh._tissue"]),
        ("from ..io import _vtk", ["vertax.io", "vertax.io._vtk"]),
        ("from vertax.mesh import _tissue", ["vertax.mesh", "vertax.mesh._tissue"]),
        ("from vertax import mesh, Tissue", ["vertax", "vertax.mesh"]),
        ("import numpy, vertax.mesh", ["vertax.mesh"]),
    ],
)
def test_imports_are_resolved_to_absolute_names(statement, expected):
    assert imports(ROOT / "mesh" / "_topology.py", statement) == expected


def test_every_package_has_a_layer():
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == set(LAYERS)
    assert {path.name for path in ROOT.glob("*.py")} == {"__init__.py", "__main__.py"}


@pytest.mark.parametrize("package", LAYERS)
def test_packages_import_from_lower_layers_only(package):
    allowed = LAYERS[: LAYERS.index(package) + 1]
    upward = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(package)
        for name in imports(path)
        if name != "vertax" and name.split(".")[1] not in allowed
    ]
    assert not upward


def test_there_are_no_circular_imports():
    files = {path: set(imports(path)) for path in ROOT.rglob("*.py") if path.name != "__init__.py"}
    below = {module_name(path): names for path, names in files.items()}
    while below:
        leaves = [name for name, names in below.items() if not names & (below.keys() - {name})]
        assert leaves, f"these import each other: {sorted(below)}"
        for name in leaves:
            del below[name]


@pytest.mark.parametrize("folder", [ROOT / "jobs", EXPERIMENTS], ids=lambda path: path.name)
def test_jobs_and_experiments_import_public_names_only(folder):
    private = [
        f"{path.name} imports {name}"
        for path in sorted(folder.rglob("*.py"))
        for name in imports(path)
        if name not in PUBLIC
    ]
    assert not private


def private_names(path: Path) -> set[tuple[str, str]]:
    """The packages and names that a file imports from private modules of other packages."""
    folder = path.relative_to(ROOT).parts[0]
    return {
        (module[1], alias.name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        for module in [(node.module or "").split(".")]
        if module[0] == "vertax" and len(module) > 1 and module[1] not in ("_base", folder)
        for alias in node.names
        if len(module) > 2 or alias.name.startswith("_")
    }


@pytest.mark.parametrize("package", APPLICATIONS)
def test_applications_import_public_names_of_the_library_only(package):
    private = [
        f"{path.name} imports {name} of {other}"
        for path in modules(package)
        for other, name in sorted(private_names(path))
        if other not in APPLICATIONS
    ]
    assert not private


def test_private_names_that_cross_packages_become_fewer():
    crossing = {
        name for package in LAYERS for path in modules(package) for name in private_names(path)
    }
    assert len(crossing) == PRIVATE_NAMES


def test_the_package_imports_no_experiment():
    importing = [
        path for path in ROOT.rglob("*.py") if "import experiments" in path.read_text("utf-8")
    ]
    assert not importing
