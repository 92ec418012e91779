"""Optional dependencies: imports without them, messages, and import time."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# The extra of each optional module.
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
    "blackjax": "bayes",
    "arviz": "bayes",
    "numpyro": "bayes",
    "diffrax": "signals",
}


def python(code: str, *arguments: str, hide=()) -> subprocess.CompletedProcess[str]:
    """Run code in another interpreter; imports of the modules in `hide` fail."""
    hidden = f"import sys; sys.modules.update(dict.fromkeys({list(hide)!r}))\n"
    command = [sys.executable, "-c", hidden + code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def test_optional_packages_are_in_their_extras():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = {"PIL": "pillow", "tomli_w": "tomli-w", "skimage": "scikit-image"}
    for module, extra in EXTRAS.items():
        name = packages.get(module, module)
        listed = project["optional-dependencies"][extra]
        assert any(entry.startswith(name) for entry in listed), module
        assert not any(entry.startswith(name) for entry in project["dependencies"]), module


def test_commands_that_install_vertax_run_in_a_copy_and_name_its_extras():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    folders = [ROOT / name for name in ("docs", "notebooks", "vertax", "configs")]
    for file in [ROOT / "README.md", *(file for each in folders for file in each.rglob("*.*"))]:
        if file.suffix in {".md", ".ipynb", ".py", ".toml"}:
            text = file.read_text(encoding="utf-8")
            for extras in re.findall(r"pip install [^`\n]*?\.\[([\w,]+)\]", text):
                assert set(extras.split(",")) <= project["optional-dependencies"].keys(), file
            assert not re.search(r"pip install (-\S+ )*\\?[\"']?vertax\b", text), file


def test_library_works_without_extras():
    code = """
import jax, optax, vertax as vx
for package in (vx.adjoints, vx.costs, vx.energies, vx.fitting, vx.initialise, vx.io, vx.mesh, vx.solvers):
    assert package
assert vx.fit and vx.equilibrate and vx.T1 and vx.load and vx.runs
assert vx.initialise.hexagonal(2, 2).n_cells == 4
for name in ("plot_tissue", "plotting", "bayes"):
    try:
        getattr(vx, name)
    except ImportError as error:
        print(error)
try:
    vx.signals.Signals(None, [0.1], initial=[1.0])
except ImportError as error:
    print(error)
try:
    vx.io.read_image("README.md")
except ImportError as error:
    print(error)
"""
    process = python(code, hide=EXTRAS)
    assert process.returncode == 0, process.stderr
    lines = process.stdout.splitlines()
    assert len(lines) == 5
    assert all('Drawing needs matplotlib: pip install -e ".[plot]"' in line for line in lines[:2])
    assert lines[2].startswith('Sampling a posterior needs blackjax: pip install -e ".[bayes]"')
    assert lines[3].startswith('Signals needs diffrax: pip install -e ".[signals]"')
    assert lines[4].startswith('Reading pictures needs pillow: pip install -e ".[image]"')


OTHERS = [pytest.param(name, marks=pytest.mark.thorough) for name in ("tomli_w", "matplotlib")]


@pytest.mark.parametrize("missing", ["typer", *OTHERS])
def test_command_line_names_the_missing_extra(missing, tmp_path):
    (tmp_path / "tiny.toml").write_text('experiment = "infer_shape_factors"\n')
    code = "from vertax.__main__ import main; main()"
    process = python(code, "run", str(tmp_path / "tiny.toml"), hide=[missing])
    assert process.returncode == 1
    assert f'needs {missing.replace("_", "-")}: pip install -e ".[run]"' in process.stderr
    assert process.stderr.startswith("Error: ")
    assert "Traceback" not in process.stderr


@pytest.mark.thorough
def test_run_names_the_missing_extra_of_its_experiment(tmp_path):
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
    process = python(code, *arguments, hide=["skimage", "tifffile"])
    assert process.returncode == 1
    assert 'pip install -e ".[image]"' in process.stderr
    assert "Traceback" not in process.stderr


def loaded(code: str) -> set[str]:
    """The modules that some code imports."""
    process = python(f"import sys\n{code}\nprint(*sys.modules)")
    assert process.returncode == 0, process.stderr
    return set(process.stdout.splitlines()[-1].split())


@pytest.mark.thorough
def test_import_does_not_load_plotting_or_experiments():
    everything = "import vertax as vx; vx.fit; vx.equilibrate; vx.io; vx.initialise"
    for code, unwanted in (("import vertax", {"jax", "matplotlib"}), (everything, {"matplotlib"})):
        modules = loaded(code)
        assert "vertax" in modules
        assert not {name for name in modules if re.match(r"vertax\.(jobs|plotting)", name)}
        assert not unwanted & modules


@pytest.mark.parametrize("command", ["--help", "--version", "list", "run --help"])
def test_help_and_lists_do_not_load_jax(command):
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


def test_error_of_a_failed_import_includes_the_original_message():
    from vertax._base.extras import requires_extra

    message = r"VTK needs what the extra \[files\] brings.*broken library"
    with pytest.raises(ImportError, match=message), requires_extra("files", "VTK"):
        raise ImportError("broken library")
    with pytest.raises(ImportError, match=r"^a bug in vertax$"), requires_extra("files", "VTK"):
        raise ImportError("a bug in vertax", name="vertax.io")
