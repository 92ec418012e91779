"""The code blocks in the README and in the documentation run without errors."""

import re
from pathlib import Path

import code_blocks
import jax.numpy as jnp
import matplotlib.pyplot as plt
import pytest

import vertax as vx

ROOT = Path(__file__).parents[2]
PAGES = [
    page.relative_to(ROOT).as_posix()
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if code_blocks.blocks(page)
]


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
def test_code_of_the_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = code_blocks.run(ROOT / page)
    plt.close("all")
    assert STATED_RESULTS.get(page, lambda names: True)(names)


def test_listed_pages_exist():
    assert SLOW | STATED_RESULTS.keys() <= set(PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_code_blocks_have_a_language(page):
    opened = re.findall(r"^ *```(\w*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert set(opened[::2]) <= {"python", "sh", "text", "toml"}
