"""The code blocks in the README and in the documentation run without errors.

The blocks marked as `python` of a page run from top to bottom, in one namespace and an empty folder, and
contain their imports. A block with a last line `# raises NAME` must raise that exception. Blocks that are not
run have another mark: `text`, `sh`, `toml`.
"""

import re
import textwrap
from contextlib import nullcontext
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import pytest

import vertax as vx

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^([ ]*)```python\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[tuple[int, str]]:
    """The Python blocks of a page, each with its first line."""
    text = page.read_text(encoding="utf-8")
    return [(text[: m.start(2)].count("\n"), textwrap.dedent(m[2])) for m in BLOCK.finditer(text)]


PAGES = [
    page.relative_to(ROOT).as_posix()
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if blocks(page)
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs a page and returns its namespace."""
    monkeypatch.chdir(tmp_path)

    def run(page: str) -> dict:
        names = {"__name__": "__main__"}
        for line, source in blocks(ROOT / page):
            # Empty lines first, so that a traceback shows the line number of the page.
            code = compile("\n" * line + source, str(ROOT / page), "exec")
            raises = re.search(r"^# raises ([\w.]+)\s*\Z", source, re.MULTILINE)
            with pytest.raises(eval(raises[1], names)) if raises else nullcontext():
                exec(code, names)
        return names

    yield run
    plt.close("all")


# Pages with long compilations run in `make test-slow`, the others in `make test-docs`.
SLOW = {
    "docs/adjoints.md",
    "docs/cells.md",
    "docs/concepts.md",
    "docs/dynamics.md",
    "docs/errors.md",
    "docs/extending.md",
    "docs/index.md",
    "docs/masks.md",
    "docs/mechanics.md",
    "docs/movies.md",
    "docs/performance.md",
    "docs/pictures.md",
    "docs/posteriors.md",
    "docs/signals.md",
    "docs/topologies.md",
    "docs/tyssue.md",
}

# Results that the text of a page states.
STATED_RESULTS = {
    "README.md": lambda names: (
        names["fit"].history.relative_error[-1] < 1e-5
        and jnp.all(jnp.isfinite(names["gradient"].terms[1].strength))
    ),
    "docs/extending.md": lambda names: abs(names["slope"] / names["difference"] - 1) < 1e-5,
    "docs/external.md": lambda names: (
        names["fit"].history.cost[-1] < 0.1 * names["fit"].history.cost[0]
    ),
    "docs/index.md": lambda names: names["fit"].history.relative_error[-1] < 1e-5,
    "docs/masks.md": lambda names: (
        names["inferred"].determined.sum() > 15 and not names["inferred"].warnings
    ),
    "docs/performance.md": lambda names: jnp.allclose(
        names["batch"], jnp.stack([names["relaxed_energy"](p0) for p0 in names["factors"]])
    ),
    "docs/topologies.md": lambda names: (
        vx.costs.mismatched_neighbours(names["fit"].tissue, names["target"]) == 0
        and names["fit"].history.relative_error[-1] < 1e-3
    ),
}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page in SLOW else pytest.mark.docs)
        for page in PAGES
    ],
)
def test_code_of_the_page_runs(page, run):
    names = run(page)
    assert STATED_RESULTS.get(page, lambda names: True)(names)


def test_listed_pages_exist():
    assert SLOW | STATED_RESULTS.keys() <= set(PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_code_blocks_have_a_language(page):
    opened = re.findall(r"^ *```(\w*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert set(opened[::2]) <= {"python", "sh", "text", "toml"}
