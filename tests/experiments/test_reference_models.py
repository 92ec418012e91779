"""The reference models of OpenVT return the parameters with which they were simulated."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments import proliferation, random_walk, wound_healing
from vertax.runs import RunFolder
from vertax.runs._execution import new_folder

pytestmark = pytest.mark.experiments


def test_growth_rate_is_recovered_from_times_of_divisions():
    config = proliferation.Config(duration=50, frames=500, division_area=2.0)
    rng, queue, rows = np.random.default_rng(0), [(-1, 0.0, 1.0)] * 3, []
    for mother, begun, size in queue:
        divides = max(rng.normal(2, 0.2), 1.2 * size)
        crossed = begun + (divides - size) / config.growth_rate
        ended = 0.05 * np.ceil(crossed / 0.05)
        if ended <= 50:
            half = (size + config.growth_rate * (ended - begun)) / 2
            queue += 2 * [(len(rows), ended, half)]
        rows.append((mother, begun, ended, ended <= 50))
    names, columns = ("mother", "begun", "ended", "fate"), np.array(rows).T
    lineage = dict(zip(names, columns, strict=True)) | {"mother": columns[0].astype(int)}
    value, error = proliferation.recover_growth_rate(config, lineage, 50.0)
    assert abs(value - config.growth_rate) < 3 * error
    assert error < 0.02 * config.growth_rate


@pytest.mark.slow
def test_persistence_of_a_walk_is_recovered(tmp_path):
    config = random_walk.Config(experiment="random_walk", frames=100, replicates=20)
    result = SimpleNamespace(**random_walk.run(config, RunFolder(new_folder(tmp_path / "run"))))
    for each in (result.drift_over_speed, result.persistence, result.bias):
        assert abs(each["value"] - each["true"]) < 4 * each["error"]
    assert result.squared_displacement_over_theory == pytest.approx(1, abs=0.2)


@pytest.mark.slow
def test_pressure_closes_a_wound_and_is_recovered(tmp_path):
    config = wound_healing.Config(experiment="wound_healing", columns=8, rows=10, target_area=1.7)
    result = wound_healing.run(config, RunFolder(new_folder(tmp_path / "run")))
    assert result["area_at_the_end"] < 0.1 * result["area"]
    assert result["target_area"]["value"] == pytest.approx(1.7, rel=0.05)
