"""Tissues with spare slots in files and pictures."""

import equinox as eqx
import numpy as np
import pytest
from helpers import random_tissue
from matplotlib.collections import PolyCollection

import vertax as vx

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def tissue():
    roomy = random_tissue(6, 3, lloyd_steps=2).with_capacity(9)
    divided = vx.transitions.divide(roomy, 2).tissue
    return vx.transitions.remove(divided, 0).tissue


def test_files_keep_spare_slots_exactly(tissue, tmp_path):
    vx.save(tmp_path / "tissue.npz", tissue)
    assert eqx.tree_equal(vx.load(tmp_path / "tissue.npz", vx.Tissue), tissue)
    trajectory = vx.mesh.Trajectory()
    for frame in (random_tissue(6, 3).with_capacity(9), tissue):
        trajectory.append(frame, time=0.0)
    vx.save(tmp_path / "movie.npz", trajectory)
    assert eqx.tree_equal(vx.load(tmp_path / "movie.npz", vx.mesh.Trajectory)[1], tissue)


def test_tables_omit_spare_slots(tissue, tmp_path):
    alive = np.flatnonzero(np.asarray(tissue.alive))
    cells = vx.io.cell_table(tissue, number=np.arange(9))
    np.testing.assert_array_equal(cells["cell"], alive)
    np.testing.assert_array_equal(cells["number"], alive)
    assert np.isfinite(cells["x"]).all()
    edges = vx.io.edge_table(tissue)
    assert len(edges["edge"]) == 3 * len(alive)
    assert set(edges["left_cell"]) <= set(alive.tolist())
    vx.io.write_geojson(tmp_path / "cells.json", tissue, edges={})
    assert (tmp_path / "cells.json").exists()
    tables = vx.io.to_tables(tissue.without_spare())
    np.testing.assert_array_equal(vx.io.to_tables(tissue).he_table, tables.he_table)


def test_figures_omit_spare_slots(tissue):
    ax = vx.plot_tissue(tissue, tissue.neighbour_counts)
    (faces,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    assert len(faces.get_paths()) == int(tissue.alive.sum())
    before = random_tissue(6, 3, lloyd_steps=2).with_capacity(9)
    after = vx.transitions.divide(before, 2).tissue
    assert not vx.plotting.flipped_edges(before, after).any()
