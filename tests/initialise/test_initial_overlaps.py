"""No first tissue overlaps itself."""

import pytest
from brute_force_overlaps import faces_that_overlap

import vertax as vx


@pytest.mark.parametrize("options", [{}, {"random_angles": True}, {"inner_arcs": True}])
def test_no_cluster_overlaps(options):
    # Arcs that hold the area which is cut off may cross their neighbours.
    for seed in (6, 7, 19, 28):
        tissue = vx.initialise.free_voronoi(9, key=seed, **options)
        assert faces_that_overlap(tissue, 200) == []
