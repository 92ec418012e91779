"""A foam of known tensions, shared by the tests of this folder."""

import jax
import numpy as np
import pytest
from free_helpers import cluster

import vertax as vx
from vertax.energies import AreaElasticity, LineTension


@pytest.fixture(scope="session")
def foam():
    """A cluster in equilibrium, its tensions and pressures."""
    tissue = cluster(14, 3, lloyd_steps=3, inner_arcs=True)
    tension = jax.random.uniform(jax.random.key(1), (tissue.n_edges,), minval=0.7, maxval=1.3)
    area = AreaElasticity(
        20.0, jax.random.uniform(jax.random.key(2), (14,), minval=0.9, maxval=1.3)
    )
    relax = vx.Relaxation(tolerance=1e-11, contact_range=None)
    relaxed = relax(tissue, area + LineTension(tension)).tissue
    return relaxed, np.asarray(tension), np.asarray(area.pressures(relaxed))
