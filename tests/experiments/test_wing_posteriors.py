"""The posteriors of wings, on a tissue with known parameters."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_helpers import run

import vertax as vx

pytest.importorskip("blackjax")
from experiments import _wings, wing_posteriors as experiment

pytestmark = pytest.mark.experiments

CONFIG = Path(__file__).parents[2] / "configs" / "wing_posteriors.toml"
TRUTH = {name: jnp.asarray(value) for name, value in experiment.Parameters()}


@pytest.fixture(scope="module")
def wing():
    """An equilibrium with the true parameters and different target areas."""
    first = _wings.pinned(vx.initialise.free_voronoi(40, key=0, lloyd_steps=2))
    areas = 1 + 0.3 * jax.random.normal(jax.random.key(1), first.model.areas.shape)
    unlike = _wings.Wing(first.tissue, _wings.Model(areas, first.model.perimeter))
    return _wings.synthetic(unlike, TRUTH, noise=0.0, seed=0)


def test_the_outer_cells_do_not_act_on_free_vertices(wing):
    tissue, model = wing
    assert 0 < np.sum(~tissue.pinned) < tissue.n_vertices
    outer = np.unique(
        np.asarray(tissue.topology.edge_cells)[np.asarray(tissue.topology.on_outline)]
    )
    outer = outer[outer < tissue.n_cells]
    other = _wings.Model(model.areas.at[outer].set(5.0), model.perimeter)
    forces = [
        jax.grad(lambda x, m=m: m(TRUTH)(tissue.with_vertices(x)))(tissue.vertices)
        for m in (model, other)
    ]
    free = ~np.asarray(tissue.pinned)
    np.testing.assert_allclose(forces[0][free], 0, atol=1e-9)
    np.testing.assert_array_equal(forces[0][free], forces[1][free])
    assert not np.allclose(forces[0], forces[1])


def test_exact_forces_determine_contrast_and_share(wing):
    config = experiment.Config(experiment="wing_posteriors")
    tissue, model = wing
    errors = 1e-4 * jax.random.normal(jax.random.key(2), tissue.vertices.shape)
    noisy = _wings.Wing(tissue.with_vertices(tissue.vertices + errors), model)
    row = experiment.summary(experiment.force_balance(config, [noisy]))
    for name, truth in (("contrast", 5.0), ("share", 0.5)):
        assert abs(row[name] - truth) < 4 * row[f"{name}_deviation"]
    assert row["share_deviation"] < 0.1


def test_a_folder_without_wings_is_named(tmp_path):
    with pytest.raises(ValueError, match="Key `data`"):
        run(CONFIG, tmp_path / "run", f"data={tmp_path}")
