"""Wounds close, and clusters move up gradients at the speed of theory."""

import numpy as np
import pytest

from experiments import chemotaxis, wound_signal
from vertax.runs import RunFolder
from vertax.runs._execution import new_folder

pytestmark = pytest.mark.slow


def test_a_purse_string_that_a_signal_contracts_closes_a_wound(tmp_path):
    config = wound_signal.Config(experiment="wound_signal", duration=4, frames=12, diffusion=[1.0])
    result = wound_signal.run(config, RunFolder(new_folder(tmp_path / "run")))
    assert np.isfinite(result["times_of_closure"]).all()
    assert "warnings" not in result


def test_the_speed_of_a_cluster_is_that_of_the_balance_of_forces(tmp_path):
    config = chemotaxis.Config(
        experiment="chemotaxis",
        n_cells=7,
        duration=6,
        frames=6,
        factors=[0.0, 1.0],
        replicates=1,
        animation=False,
    )
    result = chemotaxis.run(config, RunFolder(new_folder(tmp_path / "run")))
    assert result["speed"] == pytest.approx(result["speed_of_theory"], rel=0.01)
    for name, moved in result["displacements"].items():
        assert moved == pytest.approx(result["displacements_of_theory"][name], rel=0.02)
