"""Jobs and experiments are found by the names of their modules."""

import json
import shutil
import textwrap

import pytest
from typer.testing import CliRunner

import vertax.jobs
from vertax.runs import _registry
from vertax.runs._registry import find_experiment
from vertax.runs.command_line import app

TOY = '''
"""Count to a number."""

from vertax.runs import ExperimentConfig


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    largest: int = 3
    """The last number."""


def run(config, folder, *, progress=True):
    folder.save_table("numbers", {"n": range(config.largest)})
    return {"sum": sum(range(config.largest))}
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A folder with the job `count`, next to all others."""
    (tmp_path / "count.py").write_text(textwrap.dedent(TOY).lstrip())
    monkeypatch.setattr(vertax.jobs, "__path__", [*vertax.jobs.__path__, str(tmp_path)])
    _registry.all_experiments.cache_clear()
    yield tmp_path
    _registry.all_experiments.cache_clear()


def test_a_module_and_a_configuration_make_a_job(toy, monkeypatch):
    monkeypatch.chdir(toy)
    command = lambda *arguments: CliRunner().invoke(app, list(arguments))
    assert "count" in command("list").output
    described = command("describe", "count").output
    assert 'experiment = "count"' in described
    assert "# The last number. (an integer)" in described
    (toy / "count.toml").write_text('experiment = "count"\nlargest = 5\n')
    outcome = command("run", "count.toml")
    assert outcome.exit_code == 0, outcome.output
    assert json.loads((toy / "runs/count/metrics.json").read_text()) == {"sum": 10}
    # The resolved configuration names the experiment, which its class does not.
    assert 'experiment = "count"' in (toy / "runs/count/config.toml").read_text()
    assert command("run", "runs/count/config.toml", "--output", "again").exit_code == 0


def test_a_configuration_is_of_one_experiment():
    config = find_experiment("infer_shape_factors").config
    assert config().experiment == "infer_shape_factors"
    assert find_experiment("infer_shape_factors").config is config
    with pytest.raises(ValueError, match="infer_shape_factors"):
        config(experiment="salt_and_pepper")


def test_modules_of_the_package_are_jobs_and_those_of_the_repository_are_experiments():
    assert find_experiment("infer_shape_factors").is_job
    assert not find_experiment("salt_and_pepper").is_job


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The state of an installed wheel: its configurations are in the package, the experiments are missing."""
    configs = _registry.PACKAGE.parent / "configs"
    shutil.copytree(configs, tmp_path / "vertax" / "configs")
    monkeypatch.setattr(_registry, "PACKAGE", tmp_path / "vertax")
    _registry.all_experiments.cache_clear()
    assert all(each.is_job for each in _registry.all_experiments().values())
    yield
    _registry.all_experiments.cache_clear()


@pytest.mark.usefixtures("installed")
def test_an_installed_package_runs_its_jobs_and_says_where_the_experiments_are():
    command = lambda *arguments: CliRunner().invoke(app, list(arguments))
    names = [line.split()[0] for line in command("list").output.splitlines() if line[:2] == "  "]
    assert {"infer_tensions", "demo"} < set(names)
    assert "salt_and_pepper" not in names
    for arguments in (("run", "salt_and_pepper"), ("describe", "salt_and_pepper")):
        outcome = command(*arguments)
        assert outcome.exit_code == 2
        assert "'salt_and_pepper' is not part of the installed package" in outcome.stderr
        assert "`experiments/` of the repository" in outcome.stderr
        assert "vertax run configs/salt_and_pepper.toml" in outcome.stderr
    assert command("describe", "infer_tensions").exit_code == 0
