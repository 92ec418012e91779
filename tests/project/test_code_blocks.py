"""The code blocks in the README and in the documentation run without errors."""

import json
import re
import subprocess
import sys
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


# Pages with long compilations run in `make test-slow`, these in `make test-docs`.
QUICK = {"README.md"} | {
    f"docs/{name}.md"
    for name in ("checkpoints", "clusters", "external", "solvers", "surfaces", "tensions")
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


MARKED = [
    pytest.param(page, marks=pytest.mark.docs if page in QUICK else pytest.mark.slow)
    for page in PAGES
]


@pytest.mark.parametrize("page", MARKED)
def test_code_of_the_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = code_blocks.run(ROOT / page)
    plt.close("all")
    assert STATED_RESULTS.get(page, lambda names: True)(names)


def test_listed_pages_exist():
    assert QUICK | STATED_RESULTS.keys() <= set(PAGES)


# What strict pyright checks with the page on machine learning.
TYPED = """
moved = vx.evolve(tissue, energy, vx.dissipations.SubstrateFriction(1.0), [0.0, 1.0])
guess = vx.energies.ShapeFactorEnergy(moved.tissue.shape_factors)
problem = vx.InverseProblem(moved.frames, guess, vx.costs.VertexDistance(tissue))
fit = vx.fit(problem, optimiser, epochs=3, callback=(trajectory := vx.mesh.Trajectory(every=5)))
modulus = vx.mechanics.shear_modulus(fit.tissue, fit.energy) + vx.mechanics.bulk_modulus(tissue, guess)
print(moved.drive, trajectory[0].areas, vx.tensions.infer_tensions("mask.tif").pressures, modulus.item())
print(fit.energy.target_shape_factor.std(), vx.uncertainty(problem, fit).deviation)
"""


@pytest.mark.docs
def test_strict_pyright_accepts_the_names_of_vertax(tmp_path):
    page = code_blocks.blocks(ROOT / "docs/machine_learning.md")
    lines = ("".join(source for _, source in page) + TYPED).splitlines()
    (tmp_path / "page.py").write_text("\n".join(lines))
    settings = {"typeCheckingMode": "strict", "pythonVersion": "3.11", "extraPaths": [str(ROOT)]}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [python := sys.executable, "-m", "pyright", "--pythonpath", python, "--outputjson"]
    checked = subprocess.run([*command, "-p", tmp_path], capture_output=True, check=False)
    for diagnostic in json.loads(checked.stdout)["generalDiagnostics"]:
        line, character = diagnostic["range"]["start"].values()
        expression = lines[line][character:]
        # Types that JAX, Equinox and Optax leave unknown, and what follows from them.
        foreign = re.match(r"(jax|jnp|eqx|optax|energy\.network)\b", expression)
        follows = r"report(MissingTypeStubs|Unknown(Variable|Argument)Type)"
        assert foreign or re.fullmatch(follows, diagnostic["rule"]), diagnostic["message"]


@pytest.mark.parametrize("page", PAGES)
def test_code_blocks_have_a_language(page):
    opened = re.findall(r"^ *```(\w*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert set(opened[::2]) <= {"python", "sh", "text", "toml"}
