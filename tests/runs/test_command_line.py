"""The command `vertax`: options, exit codes and messages."""

import importlib
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

import vertax as vx
from vertax.runs import RunFolder, _registry
from vertax.runs._execution import CONFIG, new_folder, write_config
from vertax.runs.command_line import app

ROOT = Path(__file__).parents[2]

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 3
relaxation = { contacts = false, transitions = false }  # which compiles less
"""


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The working directory holds tiny.toml."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    return tmp_path


@pytest.fixture
def same_precision():
    """A run sets the precision of JAX; the tests go on with theirs."""
    yield
    jax.config.update("jax_enable_x64", True)


def vertax(*arguments):
    return CliRunner().invoke(app, list(arguments))


@pytest.mark.thorough
def test_run_writes_results_and_says_where(tiny):
    outcome = vertax("run", "tiny.toml", "--set", "fit.epochs=2", "--set", "seed=3")
    assert outcome.exit_code == 0, outcome.output
    metrics = json.loads((tiny / "runs/tiny/metrics.json").read_text())
    assert metrics["epochs"] == 2
    assert "pearson" in outcome.output
    assert "runs/tiny/figures/recovery.png" in outcome.output


def test_a_second_run_gets_a_new_folder(tiny, instead):
    instead(lambda config, folder, *, progress: {"epochs": 3})
    (tiny / "runs" / "tiny").mkdir(parents=True)
    (tiny / "runs" / "tiny" / "metrics.json").write_text("precious")
    outcome = vertax("run", "tiny.toml", "--quiet")
    assert outcome.exit_code == 0
    assert outcome.output == ""
    assert (tiny / "runs/tiny/metrics.json").read_text() == "precious"
    assert (tiny / "runs/tiny-2/metrics.json").is_file()


def test_a_folder_is_overwritten_only_with_the_option(tiny, instead):
    instead(lambda config, folder, *, progress: {"epochs": 3})
    (tiny / "out").mkdir()
    (tiny / "out" / "config.toml").write_text("")
    (tiny / "out" / "metrics.json").write_text("precious")
    outcome = vertax("run", "tiny.toml", "--output", "out")
    assert outcome.exit_code == 2
    assert "--overwrite" in outcome.stderr
    assert (tiny / "out/metrics.json").read_text() == "precious"
    assert vertax("run", "tiny.toml", "--output", "out", "--overwrite").exit_code == 0
    assert json.loads((tiny / "out/metrics.json").read_text())["epochs"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.toml"], "There is no configuration file none.toml"),
        (["tiny.toml", "--set", "fit.epochs=x"], "`fit.epochs` must be a valid integer"),
        (
            ["tiny.toml", "--set", "data="],
            "'data=' has none: is a variable unset? An empty text is",
        ),
        (
            ["tiny.toml", "--set", f"seed={2**63}"],
            "`seed` must be less than 9223372036854775808, but is 9223372036854775808.",
        ),
        (["tiny.toml", "--set", f"seed={'9' * 5000}"], "`seed` must be a valid integer"),
        (
            ["tiny.toml", "--set", "precision=float32", "--set", f"seed={2**32}"],
            "with precision float32, `seed` must be below 2**32, but is 4294967296.",
        ),
        (["tiny.toml", "--set", f"seed={'[' * 5000}"], "is nested too deeply"),
        (["tiny.toml", "--output", "/proc/run"], "Cannot use /proc/run as a folder"),
        (["tiny.toml", "--output", "x" * 5000], "as a folder: File name too long. Choose another"),
        (["tiny.toml", "--figures", "gif"], "'gif' is not one of 'png', 'pdf', 'svg'"),
    ],
)
def test_a_wrong_configuration_is_a_message_and_exit_code_2(tiny, arguments, message):
    outcome = vertax("run", *arguments)
    assert outcome.exit_code == 2
    assert message in outcome.stderr
    assert "Traceback" not in outcome.output
    assert not (tiny / "runs").exists()


@pytest.fixture
def instead(monkeypatch):
    """Puts another function in the place of the experiment: nothing to compile."""

    def instead(run):
        monkeypatch.setattr(importlib.import_module("vertax.jobs.infer_shape_factors"), "run", run)

    return instead


@pytest.mark.parametrize("error", [vx.FitError("It broke.", None), OSError("It broke.")])
def test_a_failed_run_is_a_message_and_exit_code_1(tiny, instead, error):
    def fail(config, folder, *, progress):
        raise error

    instead(fail)
    outcome = vertax("run", "tiny.toml")
    assert outcome.exit_code == 1
    assert outcome.stderr == "Error: It broke.\n"
    assert not (tiny / "runs/tiny").exists()
    assert vertax("run", "tiny.toml", "--debug").exception is error


@pytest.mark.parametrize("missing", [FileNotFoundError("no image"), ImportError("pip install it")])
def test_a_run_that_fails_at_its_start_leaves_no_folder(tiny, instead, missing):
    def fail(config, folder, *, progress):
        (folder.path / "unfinished").mkdir()
        raise missing

    instead(fail)
    for _ in range(2):
        outcome = vertax("run", "tiny.toml", "--output", "out")
        assert outcome.exit_code == 1
        assert str(missing) in outcome.stderr + str(outcome.exception)
        assert not (tiny / "out").exists()
    instead(lambda config, folder, *, progress: {"cost": 1.0})
    assert vertax("run", "tiny.toml", "--output", "out").exit_code == 0
    assert (tiny / "out/metrics.json").is_file()


def test_a_failed_run_keeps_its_files_and_does_not_block_the_same_command(tiny, instead):
    def fail(config, folder, *, progress):
        folder.save_array("positions", np.ones(3))
        raise OSError("It broke.")

    instead(fail)
    for _ in range(2):
        assert vertax("run", "tiny.toml", "--output", "out").exit_code == 1
        # A folder without metrics is one of a run that did not end.
        files = sorted(path.name for path in (tiny / "out").iterdir())
        assert files == ["config.toml", "failed.txt", "positions.npy"]
        assert (tiny / "out/failed.txt").read_text() == "It broke.\n"
    instead(lambda config, folder, *, progress: {"cost": 1.0})
    assert vertax("run", "tiny.toml", "--output", "out").exit_code == 0
    assert sorted(path.name for path in (tiny / "out").iterdir()) == ["config.toml", "metrics.json"]
    assert vertax("run", "tiny.toml", "--output", "out").exit_code == 2


def test_a_resumed_run_that_fails_keeps_its_configuration(tiny, instead):
    def fail(config, folder, *, progress):
        raise OSError("It broke.")

    folder = new_folder(tiny / "runs" / "tiny")
    write_config(folder, _registry.find_experiment("infer_shape_factors").config())
    instead(fail)
    assert vertax("run", str(folder / CONFIG), "--resume", str(folder)).exit_code == 1
    assert (folder / CONFIG).is_file()


def test_configurations_come_with_vertax(tiny, instead):
    instead(lambda config, folder, *, progress: {"n_cells": config.tissue.n_cells})
    outcome = vertax("run", "demo")
    assert outcome.exit_code == 0, outcome.output
    assert json.loads((tiny / "runs/demo/metrics.json").read_text()) == {"n_cells": 20}
    # A file of that name comes first, a folder does not.
    (tiny / "demo").mkdir()
    assert vertax("run", "demo").exit_code == 0
    (tiny / "demo").rmdir()
    (tiny / "demo").write_text(TINY)
    assert vertax("run", "demo", "--output", "own").exit_code == 0
    assert json.loads((tiny / "own/metrics.json").read_text()) == {"n_cells": 6}
    outcome = vertax("run", "demoo")
    assert outcome.exit_code == 2
    assert "There is no configuration file demoo. Did you mean demo, which comes" in outcome.stderr


def test_the_wheel_holds_the_configurations(tmp_path, monkeypatch):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {"configs": "vertax/configs"}
    # As it is installed: the folder is in the package.
    (tmp_path / "vertax" / "configs").mkdir(parents=True)
    (tmp_path / "vertax" / "configs" / "mine.toml").write_text("# What it\n# does. More.\n")
    monkeypatch.setattr(_registry, "PACKAGE", tmp_path / "vertax")
    assert list(_registry.shipped_configurations()) == ["mine"]
    assert _registry.summary_of(_registry.shipped_configurations()["mine"]) == "What it does"


@pytest.mark.parametrize("command", [[], ["run"], ["sweep"], ["list"], ["describe"], ["show"]])
def test_help_shows_no_type_for_flags(command):
    shown = vertax(*command, "--help").output
    assert "--help" in shown
    assert "bool" not in shown


def test_an_empty_file_name_is_refused(tiny):
    (tiny / "empty.toml").write_text('experiment = "infer_tensions"\nimage.path = ""\n')
    outcome = vertax("run", "empty.toml")
    assert outcome.exit_code == 2
    assert "`image.path` must have at least 1 character" in outcome.stderr
    for config, key in (("infer_tensions", "image.path"), ("external_tensions", "foam.file")):
        for value in ("", " "):
            outcome = vertax("run", config, "--set", f"{key}={value}")
            assert outcome.exit_code == 2
            assert "has none: is a variable unset?" in outcome.stderr
        outcome = vertax("run", config, "--set", f"{key}=''")
        assert outcome.exit_code == 2
        assert "must have at least 1 character" in outcome.stderr
    assert not (tiny / "runs").exists()


def test_a_run_that_is_too_large_is_a_message_and_exit_code_1(tiny, instead):
    instead(lambda config, folder, *, progress: np.empty((2**40, 2**10)))
    outcome = vertax("run", "tiny.toml")
    assert outcome.exit_code == 1
    assert "Error: The run is too large for this machine" in outcome.stderr


def test_the_formats_of_the_figures_are_chosen(tiny, instead):
    def draw(config, folder, *, progress):
        for name in ("a", "b"):
            figure = Figure()
            figure.subplots().plot([0, 1])
            folder.save_figure(name, figure)
        return {"cost": 1.0}

    instead(draw)
    outcome = vertax("run", "tiny.toml", "--figures", "pdf", "--figures", "svg", "--output", "out")
    assert outcome.exit_code == 0, outcome.output
    files = sorted(path.name for path in (tiny / "out/figures").iterdir())
    assert files == ["a.pdf", "a.svg", "b.pdf", "b.svg"]
    assert "out/figures/b.pdf" in outcome.output
    first = [(tiny / "out/figures" / name).read_bytes() for name in files]
    assert first[0].startswith(b"%PDF")
    assert b"<svg" in first[1]
    again = vertax("run", "tiny.toml", "--figures", "svg", "--output", "out", "--overwrite")
    assert again.exit_code == 0, again.output
    # What is no longer asked for is gone, and the same picture is the same file.
    assert sorted(path.name for path in (tiny / "out/figures").iterdir()) == ["a.svg", "b.svg"]
    assert (tiny / "out/figures/a.svg").read_bytes() == first[1]
    assert vertax("run", "tiny.toml").exit_code == 0
    assert (tiny / "runs/tiny/figures/a.png").is_file()


def test_a_run_prints_its_steps_unless_it_is_quiet(tiny, instead):
    def run(config, folder, *, progress):
        folder.print_step("counting")
        return {"n": folder.part("cells 1", lambda: {"n": np.arange(3)})["n"]}

    instead(run)
    assert vertax("run", "tiny.toml").stderr == "  counting …\n  cells 1 …\n"
    assert vertax("run", "tiny.toml", "--quiet").stderr == ""


def test_an_unexpected_error_keeps_its_traceback(tiny, instead):
    instead(lambda config, folder, *, progress: {}["missing"])
    assert isinstance(vertax("run", "tiny.toml").exception, KeyError)


@pytest.mark.usefixtures("same_precision")
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_configuration_decides_the_precision(tiny, instead, precision):
    instead(lambda config, folder, *, progress: {"precision": str(jnp.ones(1).dtype)})
    outcome = vertax("run", "tiny.toml", "--set", f"precision={precision}")
    assert outcome.exit_code == 0, outcome.output
    assert json.loads((tiny / "runs/tiny/metrics.json").read_text()) == {"precision": precision}


def test_help_version_list_and_describe(tiny):
    assert "Exit codes: 0 success, 1 the run failed" in vertax("--help").output
    assert vertax("--version").output.startswith("vertax ")
    listed = vertax("list").output
    # However many there are, and however wide their names.
    names = [line.split()[0] for line in listed.splitlines() if line.startswith("  ")]
    assert names == [
        *_registry.all_experiments(),
        *sorted(path.stem for path in ROOT.glob("configs/*.toml")),
    ]
    described = vertax("describe", "infer_shape_factors")
    (tiny / "described.toml").write_text(described.output)
    assert vertax("run", "described.toml", "--set", "fit.epochs=0").exit_code == 2
    unknown = vertax("describe", "infer")
    assert unknown.exit_code == 2
    assert "There is no experiment 'infer'" in unknown.stderr


METRICS = {"initial": {"cost": 2.5, "epochs": 3}, "fitted": {"cost": 0.125, "epochs": 3}}


@pytest.fixture
def done(tmp_path, monkeypatch):
    """The working directory holds a finished run in runs/done."""
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(new_folder(Path("runs/done")))
    (folder.path / "config.toml").write_text("")
    folder.save_table("cells", {"cell": [0, 1]})
    (folder.path / "figures").mkdir()
    (folder.path / "figures" / "recovery.png").write_bytes(b"")
    folder.save_metrics(METRICS)
    return folder.path


def test_show_prints_the_metrics_and_lists_figures_and_files(done):
    outcome = vertax("show", str(done))
    assert outcome.exit_code == 0, outcome.output
    assert outcome.output == (
        "        initial  fitted\n"
        "cost        2.5   0.125\n"
        "epochs        3       3\n"
        "Results: runs/done\n  runs/done/cells.csv\n  runs/done/config.toml\n"
        "  runs/done/figures/recovery.png\n  runs/done/metrics.json\n"
    )


def test_show_prints_the_summary_of_the_run(tiny, instead):
    instead(lambda config, folder, *, progress: METRICS | {"note": "text"})
    ran = vertax("run", "tiny.toml")
    shown = vertax("show", "runs/tiny")
    table = ran.output.split("runs/tiny\n")[1].split("Results:")[0]
    assert shown.output.startswith(table)


def test_show_of_an_unfinished_run_is_exit_code_1(done):
    (done / "metrics.json").unlink()
    outcome = vertax("show", str(done))
    assert outcome.exit_code == 1
    assert outcome.stdout == ""
    assert "The run in runs/done is unfinished: it has no metrics.json" in outcome.stderr
    assert "vertax run runs/done/config.toml" in outcome.stderr


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda run: (run / "config.toml").unlink(), "it has no config.toml"),
        (lambda run: (run / "metrics.json").write_text("{"), "metrics.json is not valid JSON"),
        (lambda run: (run / "metrics.json").write_bytes(b"\xff"), "metrics.json is not valid JSON"),
        (
            lambda run: (run / "metrics.json").write_text("[1]"),
            "must hold metrics by name, but holds [1]",
        ),
    ],
)
def test_show_of_a_folder_that_is_no_run_is_exit_code_2(done, broken, message):
    broken(done)
    outcome = vertax("show", str(done))
    assert outcome.exit_code == 2
    assert message in outcome.stderr
    assert "Traceback" not in outcome.output


def test_show_of_no_folder_is_exit_code_2(done):
    assert "it does not exist" in vertax("show", "runs/none").stderr
    assert "it is a file" in vertax("show", "runs/done/cells.csv").stderr
    assert vertax("show", "runs/none").exit_code == 2
    assert vertax("show").exit_code == 2


def test_the_program_runs_as_a_process():
    command = [sys.executable, "-m", "vertax", "run", "none.toml"]
    outcome = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert outcome.returncode == 2
    assert outcome.stderr == (
        "Error: There is no configuration file none.toml. `vertax list` prints those that come with vertax.\n"
    )


# An interrupt that arrives during a compilation is raised when the compilation returns; here it is sent then.
# After it JAX crashes in most processes, not in all, when Python destroys its modules: `Crash` does in each.
COMPILES = """
import os, signal, sys
import jax, jax.numpy as jnp
import vertax.jobs.infer_shape_factors as experiment
from vertax.__main__ import main

# (A shell without job control starts its background processes with this signal ignored.)
signal.signal(signal.SIGINT, signal.default_int_handler)

class Crash:
    def __del__(self, kill=os.kill, process=os.getpid(), crash=signal.SIGSEGV):
        kill(process, crash)

sys.crash = Crash()

def run(config, folder, *, progress):
    jax.jit(lambda x: jnp.sin(x @ x.T)).lower(jnp.ones((4, 4))).compile()
    signal.raise_signal(signal.SIGINT)
    print("not interrupted", flush=True)
    return {}

experiment.run = run
main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGINT cannot be sent to a process")
@pytest.mark.thorough
def test_an_interrupt_while_compiling_ends_with_its_exit_code(tiny):
    # Without the cache that other tests share, or it would not compile.
    cached = ("JAX_COMPILATION_CACHE_DIR", "VERTAX_CACHE")
    environment = {name: value for name, value in os.environ.items() if name not in cached}
    path = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", COMPILES, "run", "tiny.toml", "--no-cache", "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment | {"PYTHONPATH": path},
    )
    rest, errors = process.communicate(timeout=120)
    assert rest == ""
    assert errors == (
        "Interrupted. The results so far are in runs/tiny. To continue: "
        "vertax run tiny.toml --resume runs/tiny\n"
    )
    assert process.returncode == 130
    assert [path.name for path in (tiny / "runs/tiny").iterdir()] == ["config.toml"]
