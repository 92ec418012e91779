"""Moduli, tuning, trained stresses: what is computed from what was measured, and tiny runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue
from run_helpers import run, table

import vertax as vx
from experiments.double_optimisation import TunedCells
from experiments.shear_stiffening import Config, branch, compare
from vertax.costs import aspect_ratio

pytestmark = pytest.mark.experiments

TRAINED = """
experiment = "trained_stresses"
trained = [1, 3]
rules = ["gradient", "propagation", "coupled"]
replicates = 1
tissue = { n_cells = 9, lloyd_steps = 2 }
fit = { learning_rate = 0.1, epochs = 40 }
"""
TUNED = """
experiment = "double_optimisation"
tuned = ["perimeter"]
spreads = [0.03]
shape_factors = [3.4, 3.5, 3.6]
replicates = 2
tissue = { n_cells = 9 }
relaxation = { contacts = false, transitions = false }
fit = { learning_rate = 0.1, epochs = 10 }
"""
STIFFER = """
experiment = "design_mechanics"
quantity = "shear_modulus"
target = 0.3
accuracy = 0.02
tissue = { n_cells = 9, lloyd_steps = 2 }
start = { mean = 3.6, deviation = 0.05 }
relaxation = { contacts = false, transitions = false }
fit = { learning_rate = 1e-2, epochs = 30 }
"""
LONGER = """
experiment = "convergent_extension"
measure = "box"
n_cells = [9]
targets = [1.15]
start_ratio = 1.05
replicates = 1
accuracy = 0.02
relaxation = { contacts = false, transitions = false }
start = { learning_rate = 0.2, epochs = 8 }
fit = { learning_rate = 0.2, epochs = 20 }
"""


def test_the_factor_of_a_perimeter_that_grows_with_the_square_of_the_strain_is_three():
    strains, centre, critical, k = np.linspace(0, 0.4, 401), 0.03, 0.1, 2.3
    off = np.stack([strains - centre, strains + centre])
    beyond = np.maximum(off**2 - critical**2, 0)
    curves = {
        "stress": np.stack([1.0, -1.0])[:, None] * 2 * k * off * beyond,
        "modulus": np.where(beyond > 0, 2 * k * (3 * off**2 - critical**2), 0),
        "converged": np.ones_like(off, bool),
    }
    right, left = (branch(strains, curves, side, Config(window=0.01)) for side in (0, 1))
    assert right is not None
    assert left is not None
    assert right.onset == pytest.approx(critical + centre, abs=1e-5)
    factors = compare(right, left)
    assert factors["critical_strain"] == pytest.approx(critical, abs=1e-5)
    assert factors["centre"] == pytest.approx(centre, abs=1e-5)
    assert factors["jump"] == pytest.approx(4 * k * critical**2, rel=1e-3)
    assert factors["factor"] == pytest.approx(3, rel=1e-3)
    # Solid at zero strain, or at no strain: there is no onset.
    rigid = curves | {"stress": curves["stress"] + 1.0}
    assert branch(strains, rigid, 0, Config()) is None
    assert branch(strains, curves | {"stress": 0 * off}, 0, Config()) is None


@pytest.mark.parametrize("tuned", ["stiffness", "perimeter", "area"])
def test_factors_of_tuned_cells_keep_their_mean_whatever_is_tuned(tuned):
    tissue, z = random_tissue(9, 1), jnp.linspace(-3, 5, 9)
    cells = TunedCells(z, jnp.array(3.6), jnp.array(0.2), tuned)
    assert float(jnp.mean(cells.factors)) == pytest.approx(1)
    np.testing.assert_allclose(cells.factors, TunedCells(7 * z + 2, *cells_of(cells)).factors)
    assert float(jnp.std(jnp.log(cells.factors))) == pytest.approx(0.2)
    f = {
        name: cells.factors if name == tuned else 1.0 for name in ("stiffness", "perimeter", "area")
    }
    energy = vx.energies.AreaElasticity(1.0, f["area"]) + vx.energies.PerimeterElasticity(
        f["stiffness"], 3.6 * f["perimeter"]
    )
    np.testing.assert_allclose(cells(tissue), energy(tissue), rtol=1e-12)


def cells_of(cells):
    return cells.shape_factor, cells.spread, cells.tuned


@pytest.mark.slow
def test_stresses_are_trained_by_each_rule(tmp_path):
    (tmp_path / "tiny.toml").write_text(TRAINED)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    for rule in ("gradient", "propagation", "coupled"):
        assert max(metrics[rule]["distance"]) < 0.3
    # The gradient and equilibrium propagation are the same direction, coupled learning nearly so.
    assert metrics["propagation"]["cosine"] == pytest.approx(1, abs=1e-6)
    assert 0.5 < metrics["coupled"]["cosine"] < 0.9999
    assert table(folder / "distances.csv")["cells"] == ["1", "3"]
    assert (folder / "figures" / "training.png").stat().st_size > 10_000


@pytest.mark.slow
def test_tuned_perimeters_lower_the_energy(tmp_path):
    (tmp_path / "tiny.toml").write_text(TUNED)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    columns = {n: np.array(c, float) for n, c in table(folder / "energies.csv").items()}
    assert (columns["perimeter_tuned"] < columns["perimeter_drawn"]).all()
    assert metrics["perimeter"]["energy_share_left"] < 0.99
    assert (folder / "figures" / "transition.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_shear_modulus_is_designed(tmp_path):
    (tmp_path / "tiny.toml").write_text(STIFFER)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    assert metrics["final"] == pytest.approx(0.3, abs=0.02)
    history = np.array(table(folder / "history.csv")["shear_modulus"], float)
    assert history[0] == pytest.approx(metrics["initial"])
    assert abs(history[0] - 0.3) > 0.02


@pytest.mark.slow
def test_a_box_is_extended(tmp_path):
    (tmp_path / "tiny.toml").write_text(LONGER)
    folder, metrics = run(tmp_path / "tiny.toml", tmp_path / "out")
    (ratio,) = metrics["9 cells"]["targets"]["1.15"]["ratios"]
    assert ratio == pytest.approx(1.15, abs=0.03)
    tissue = vx.load(folder / "designed.npz", vx.Tissue)
    assert float(aspect_ratio(tissue, "box")) == pytest.approx(ratio)
    assert float(tissue.boundary.area) == pytest.approx(9)
