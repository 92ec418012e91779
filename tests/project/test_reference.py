"""Every public name is in the reference."""

import importlib
import re
from functools import reduce
from pathlib import Path

import pytest

import vertax as vx
from vertax.relax._feasibility import Feasibility
from vertax.relax._loop import Search
from vertax.solvers import NewtonCG, TruncatedCG, VertexTrustRegion

PAGES = sorted((Path(__file__).parents[2] / "docs" / "reference").glob("*.md"))
DOCUMENTED = [
    name
    for page in PAGES
    for name in re.findall(
        r"^::: vertax\.([\w.]+)$", page.read_text(encoding="utf-8"), re.MULTILINE
    )
]
ROOT = PAGES[0].parents[2]
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
PACKAGES = sorted(name for name in dir(vx) if hasattr(getattr(vx, name), "__path__"))


def public(package: str) -> set[str]:
    module = importlib.import_module(f"vertax.{package}")
    # The import hook of jaxtyping, which checks types in tests, adds this name.
    names = {name for name in dir(module) if not name.startswith("_")} - {"jaxtyping"}
    return {name for name in names if not hasattr(getattr(module, name), "__path__")}


def resolve(path: str) -> object:
    """The object with a name in the reference."""
    return reduce(getattr, path.split("."), vx)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_documented(package):
    # A name in two packages, or also at the top level, is documented once.
    documented = {id(resolve(name)) for name in DOCUMENTED}
    module = importlib.import_module(f"vertax.{package}")
    assert not [n for n in public(package) if id(getattr(module, n)) not in documented]


def test_names_are_documented_once():
    assert len(DOCUMENTED) == len(set(DOCUMENTED))


def test_reference_pages_are_in_the_table_of_contents():
    contents = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert {f"reference/{page.name}" for page in PAGES} == set(
        re.findall(r"reference/\w+\.md", contents)
    )


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_paths_on_pages_exist(page):
    folders = "vertax|tests|configs|docs|notebooks|benchmarks"
    paths = re.findall(rf"`((?:{folders})/[\w./]*)`", page.read_text(encoding="utf-8"))
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_table_of_constants_is_that_of_the_code():
    owners: dict[str, object] = {
        owner.__name__: owner() for owner in (NewtonCG, TruncatedCG, VertexTrustRegion)
    }
    owners["relaxation"] = Feasibility(None)
    owners["search"] = Search  # defaults of a dataclass are attributes of the class
    table = (ROOT / "docs/solvers.md").read_text(encoding="utf-8").partition("| class | field |")[2]
    owner, compared = None, 0
    for row in table.partition("\n\n")[0].splitlines()[2:]:
        name, fields, values = (entry.strip() for entry in row.split("|")[1:4])
        owner = owners[name.strip("[`").partition("`")[0]] if name else owner
        for field, value in zip(fields.split(", "), values.split(", "), strict=True):
            assert getattr(owner, field.strip("`")) == float(value), field
            compared += 1
    assert compared >= 25
