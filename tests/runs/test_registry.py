"""An experiment is a folder: nothing else knows of it."""

import json
import textwrap

import pytest
from typer.testing import CliRunner

import vertax.experiments
from vertax.runs import _registry, find_experiment
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
    """A folder with the experiment `count`, next to all others."""
    (tmp_path / "count").mkdir()
    (tmp_path / "count/__init__.py").write_text(textwrap.dedent(TOY).lstrip())
    monkeypatch.setattr(
        vertax.experiments, "__path__", [*vertax.experiments.__path__, str(tmp_path)]
    )
    for name in set(_registry._found()) - set(_registry.EXPERIMENTS):
        monkeypatch.setitem(_registry.EXPERIMENTS, name, _registry._found()[name])
    return tmp_path


def test_a_folder_and_a_file_make_an_experiment(toy, monkeypatch):
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
