
@pytest.mark.parametrize("options", [{}, {"random_angles": True}, {"inner_arcs": True}])
def test_no_cluster_overlaps(options):
    # As they are cut out, arcs of the seeds 6, 7, 19 and 28 cross each other.
    for seed in (6, 7, 19, 28):
        tissue = vx.initialise.free_voronoi(9, key=seed, **options)
        assert faces_that_overlap(tissue, 200) == []
