"""The library needs little, starts quickly, and says what is missing and how to install it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# What extras bring, by the name of the module.
EXTRAS = {
    "matplotlib": "plot",
    "PIL": "plot",
    "typer": "run",
    "pydantic": "run",
    "tomli_w": "run",
    "skimage": "image",
    "tifffile": "image",
    "meshio": "files",
    "cellpose": "cellpose",
}


def python(code: str, *arguments: str, hide=()) -> subprocess.CompletedProcess[str]:
    """Another interpreter, in which some packages are as if they were not installed."""
    hidden = f"import sys; sys.modules.update(dict.fromkeys({list(hide)!r}))\n"
    command = [sys.executable, "-c", hidden + code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def test_every_optional_package_is_in_the_extra_that_messages_name():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = {"PIL": "pillow", "tomli_w": "tomli-w", "skimage": "scikit-image"}
    for module, extra in EXTRAS.items():
        name = packages.get(module, module)
        listed = project["optional-dependencies"][extra]
        assert any(entry.startswith(name) for entry in listed), module
        assert not any(entry.startswith(name) for entry in project["dependencies"]), module


def test_the_library_works_with_nothing_but_what_it_asks_for():
    code = """
import jax, optax, vertax as vx
for package in (vx.adjoints, vx.costs, vx.energies, vx.fitting, vx.initialise, vx.io, vx.mesh, vx.solvers):
    assert package
assert vx.fit and vx.equilibrate and vx.T1 and vx.load_tissue and vx.runs
assert vx.initialise.hexagonal(2, 2).n_cells == 4
for name in ("plot_tissue", "plotting"):
    try:
        getattr(vx, name)
    except ImportError as error:
        print(error)
try:
    vx.io.read_image("README.md")
except ImportError as error:
    print(error)
"""
    outcome = python(code, hide=EXTRAS)
    assert outcome.returncode == 0, outcome.stderr
    lines = outcome.stdout.splitlines()
    assert len(lines) == 3
    assert all(
        line.startswith('Drawing needs matplotlib: pip install "vertax[plot]"')
        for line in lines[:2]
    )
    assert lines[2].startswith('Reading pictures needs pillow: pip install "vertax[image]"')


@pytest.mark.parametrize("missing", ["typer", "tomli_w", "matplotlib"])
def test_the_command_says_what_it_misses(missing, tmp_path):
    (tmp_path / "tiny.toml").write_text('experiment = "infer_shape_factors"\n')
    code = "from vertax.__main__ import main; main()"
    outcome = python(code, "run", str(tmp_path / "tiny.toml"), hide=[missing])
    assert outcome.returncode == 1
    assert f'needs {missing.replace("_", "-")}: pip install "vertax[run]"' in outcome.stderr
    assert outcome.stderr.startswith("Error: ")
    assert "Traceback" not in outcome.stderr


def test_a_run_says_which_extra_its_experiment_misses(tmp_path):
    (tmp_path / "image.tif").write_bytes(b"II*\0")
    (tmp_path / "image.toml").write_text('experiment = "infer_from_microscopy"\n')
    code = "from vertax.__main__ import main; main()"
    image = f"image.path={tmp_path / 'image.tif'}"
    arguments = [
        "run",
        str(tmp_path / "image.toml"),
        "--set",
        image,
        "--output",
        str(tmp_path / "out"),
    ]
    outcome = python(code, *arguments, hide=["skimage", "tifffile"])
    assert outcome.returncode == 1
    assert 'pip install "vertax[image]"' in outcome.stderr
    assert "Traceback" not in outcome.stderr


def loaded(code: str) -> set[str]:
    """The packages that some code imports."""
    outcome = python(f"import sys\n{code}\nprint(*sys.modules)")
    assert outcome.returncode == 0, outcome.stderr
    return set(outcome.stdout.splitlines()[-1].split())


def test_importing_the_library_imports_no_pictures_and_no_experiment():
    everything = "import vertax as vx; vx.fit; vx.equilibrate; vx.io; vx.initialise"
    for code, unwanted in (("import vertax", {"jax", "matplotlib"}), (everything, {"matplotlib"})):
        modules = loaded(code)
        assert "vertax" in modules
        assert not {name for name in modules if re.match(r"vertax\.(jobs|plotting)", name)}
        assert not unwanted & modules


@pytest.mark.parametrize("command", ["--help", "--version", "list", "run --help"])
def test_what_answers_at_once_imports_nothing_heavy(command):
    code = f"""
import contextlib
from vertax.__main__ import main
sys.argv = ["vertax", *{command.split()!r}]
with contextlib.suppress(SystemExit):
    main()
"""
    modules = loaded(code)
    assert "typer" in modules
    # Newer versions of Typer import Pydantic themselves.
    assert not {"jax", "matplotlib", "numpy", "equinox", "vertax.runs._config"} & modules


def test_an_import_that_fails_for_another_reason_says_so():
    from vertax._base.extras import needing

    said = r"VTK needs what the extra \[files\] brings.*broken library"
    with pytest.raises(ImportError, match=said), needing("files", "VTK"):
        raise ImportError("broken library")
    with pytest.raises(ImportError, match=r"^a fault of ours$"), needing("files", "VTK"):
        raise ImportError("a fault of ours", name="vertax.io")
