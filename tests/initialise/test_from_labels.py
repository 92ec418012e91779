import re

import jax
import numpy as np
import pytest
from label_helpers import (
    SHAPE,
    areas_of,
    clear_seeds,
    honeycomb,
    make,
    neighbours,
    polygon,
    rasterise,
    sides,
    sides_of,
    touching_pairs,
)
from scipy.spatial import KDTree

from vertax import Periodic
from vertax.initialise import from_labels, periodic_voronoi


@pytest.mark.parametrize("seed", range(4))
def test_periodic_mask_gives_back_the_voronoi_tissue(seed):
    n = 20
    seeds = clear_seeds(n, SHAPE, seed)
    voronoi = periodic_voronoi(seeds=seeds, lattice=np.diag([160.0, 120.0]), softening=0.0)
    got = make(rasterise(seeds, SHAPE))
    names = np.arange(1, n + 1)
    assert np.array_equal(got.labels, names)
    assert neighbours(got.tissue, got.labels) == neighbours(voronoi, names)
    assert np.array_equal(got.tissue.neighbour_counts, voronoi.neighbour_counts)
    np.testing.assert_allclose(got.tissue.areas, voronoi.areas, rtol=0.08)
    assert np.abs(got.tissue.areas / voronoi.areas - 1).mean() < 0.03
    np.testing.assert_allclose(np.sum(areas_of(got.tissue)), 120 * 160, rtol=1e-13)
    shift = np.array(got.tissue.centroids - voronoi.centroids)
    shift -= np.round(shift / [160, 120]) * [160, 120]
    assert np.abs(shift).max() < 1
    assert got.complete.all()
    assert got.absorbed.size == 0
    assert got.inflated.size == 0


@pytest.mark.parametrize("seed", range(12))
def test_neighbours_are_those_of_the_pixels(seed):
    rng = np.random.default_rng(100 + seed)
    shape = tuple(rng.integers(40, 70, 2).tolist())
    mask = rasterise(rng.random((15, 2)) * shape[::-1], shape)
    got = make(mask)
    assert np.all(areas_of(got.tissue) > 0)
    alone = np.ones(shape, bool)  # pixels that are separate pieces, which join other cells
    for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        alone &= mask != np.roll(mask, step, axis)
    if got.absorbed.size == 0 and not alone.any():
        pairs = neighbours(got.tissue, got.labels)
        start, end = sides(got.tissue)
        corner_contacts = np.count_nonzero((start == end).all(axis=1)) // 2
        touching = touching_pairs(mask)
        assert touching <= set(pairs)
        # What is not a shared pixel side can only be the edge of length 0 of a four-fold corner.
        assert len(set(pairs) - touching) <= corner_contacts


def test_default_pixel_size_makes_the_mean_area_one():
    got = from_labels(rasterise(clear_seeds(20, SHAPE, 0), SHAPE), boundary="periodic")
    np.testing.assert_allclose(np.mean(got.tissue.areas), 1.0, rtol=1e-12)
    np.testing.assert_allclose(got.pixel_size, np.sqrt(20 / (120 * 160)), rtol=1e-12)
    assert got.image_shape == SHAPE


@pytest.mark.thorough
def test_pixel_size_and_softening_are_passed_on():
    mask = rasterise(clear_seeds(20, SHAPE, 0), SHAPE)
    got = from_labels(mask, boundary="periodic", pixel_size=0.25, softening=0.01)
    np.testing.assert_allclose(np.sum(areas_of(got.tissue)), 120 * 160 / 16, rtol=1e-12)
    assert float(got.tissue.softening) == 0.01
    assert got.pixel_size == 0.25


def test_x_is_the_column_and_y_the_row():
    mask = np.kron(np.arange(1, 31).reshape(5, 6), np.ones((10, 20), int))
    got = make(mask, "mirrored")
    corners = polygon(got, 9)  # row 1, column 2 of the blocks
    assert corners[:, 0].min() == 40
    assert corners[:, 0].max() == 60
    assert corners[:, 1].min() == 10
    assert corners[:, 1].max() == 20


def test_labels_may_be_any_positive_integers():
    mask = rasterise(clear_seeds(20, SHAPE, 1), SHAPE)
    names = np.random.default_rng(0).choice(60000, 20, replace=False) + 1
    plain = make(mask)
    renamed = make(names[mask - 1].astype(np.uint16))
    assert np.array_equal(renamed.labels, np.sort(names))
    assert neighbours(renamed.tissue, renamed.labels) == neighbours(
        plain.tissue, names[plain.labels - 1]
    )


@pytest.mark.parametrize("shift", [(0, 40), (33, 0), (50, 70)])
def test_periodic_mask_may_start_anywhere(shift):
    mask = rasterise(clear_seeds(20, SHAPE, 2), SHAPE)
    original = make(mask)
    shifted = make(np.roll(mask, shift, (0, 1)))
    assert neighbours(original.tissue, original.labels) == neighbours(
        shifted.tissue, shifted.labels
    )
    np.testing.assert_allclose(areas_of(original.tissue), areas_of(shifted.tissue), rtol=1e-10)


def mirrored_cases() -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    cases = ((12, (50, 60)), (30, (80, 61)), (40, (70, 90)))
    return [rasterise(rng.random((n, 2)) * shape[::-1], shape, False) for n, shape in cases]


@pytest.mark.parametrize("mask", mirrored_cases())
def test_mirrored_tissue_is_symmetric_and_four_times_the_image(mask):
    got = make(mask, "mirrored")
    rows, columns = mask.shape
    tissue = got.tissue
    assert np.all(areas_of(tissue) > 0)
    np.testing.assert_allclose(np.sum(areas_of(tissue)), 4 * mask.size, rtol=1e-12)
    assert isinstance(tissue.boundary, Periodic)
    np.testing.assert_array_equal(tissue.boundary.lattice, np.diag([2.0 * columns, 2.0 * rows]))
    vertices = np.asarray(tissue.vertices) % [2 * columns, 2 * rows]
    for mirrored in (vertices * [-1, 1], vertices * [1, -1]):
        tree = KDTree(vertices, boxsize=[2 * columns, 2 * rows])
        assert tree.query(mirrored % [2 * columns, 2 * rows])[0].max() < 1e-9
    # Each label in 1, 2 or 4 copies, all with the same neighbours and area.
    names, copies = np.unique(got.labels, return_counts=True)
    assert set(copies.tolist()) <= {1, 2, 4}
    counts, areas = sides_of(tissue), areas_of(tissue)
    for name in names:
        same = got.labels == name
        assert len(set(counts[same].tolist())) == 1
        np.testing.assert_allclose(areas[same], areas[same][0], rtol=1e-9)
    assert sorted([*names.tolist(), *got.absorbed.tolist()]) == np.unique(mask).tolist()


@pytest.mark.parametrize("mask", mirrored_cases())
def test_whole_cells_are_the_originals_away_from_the_border(mask):
    got = make(mask, "mirrored")
    border = set(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).tolist())
    # A cell that absorbs one at the border touches the border from then on.
    beside = {
        b
        for a, b in (*touching_pairs(mask), *map(reversed, touching_pairs(mask)))
        if a in got.absorbed
    }
    inside = set(mask.ravel().tolist()) - border - set(got.absorbed.tolist())
    labels = got.labels[got.complete].tolist()
    assert len(labels) == len(set(labels)) > 0
    assert inside - beside <= set(labels) <= inside
    first = len(np.unique(got.labels))
    assert np.all(np.diff(got.labels[:first]) > 0)  # originals first, in the order of their labels
    for cell in np.flatnonzero(got.complete):
        corners = np.asarray(got.tissue.corners)[np.asarray(got.tissue.topology.cell) == cell]
        assert np.all(corners >= 0)
        assert np.all(corners <= mask.shape[::-1])


def test_bricks_are_hexagons():
    got = make(honeycomb())
    assert np.all(sides_of(got.tissue) == 6)
    np.testing.assert_allclose(areas_of(got.tissue), 100.0)


@pytest.mark.parametrize("boundary", ["periodic", "mirrored"])
def test_checkerboard_of_squares_splits_every_four_fold_corner(boundary):
    mask = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((7, 7), int))
    got = make(mask, boundary)
    tissue = got.tissue
    lengths = np.linalg.norm(np.subtract(*sides(tissue)), axis=1)
    assert np.count_nonzero(lengths == 0) == tissue.n_vertices
    assert np.all(lengths[lengths > 0] >= 7)
    copies = 1 if boundary == "periodic" else 4
    np.testing.assert_allclose(np.sum(areas_of(tissue)), copies * 35 * 35)
    # The smallest label at a corner touches its opposite: there, top left and bottom right.
    pairs = neighbours(tissue, got.labels)
    assert (7, 13) in pairs
    assert (8, 12) not in pairs
    counts = sides_of(tissue)
    assert counts[got.labels == 13].tolist() == [6] * np.count_nonzero(got.labels == 13)


def test_cell_spanning_the_image_is_refused_by_name():
    mask = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((6, 6), int))
    mask[13:17] = 77
    for boundary in ("mirrored", "periodic"):
        with pytest.raises(ValueError, match=r"Argument `mask` must .*the labels 77 do.*Crop"):
            from_labels(mask, boundary=boundary)


@pytest.mark.parametrize("boundary", ["mirrored", "periodic", "free"])
def test_a_label_around_all_others_is_the_background(boundary):
    mask = np.pad(honeycomb(), 12)
    plain = from_labels(mask, boundary=boundary)
    assert plain.background is None
    labelled = from_labels(np.where(mask == 0, 77, mask), boundary=boundary)
    assert labelled.background == 77
    assert 77 not in labelled.labels
    assert 77 not in labelled.absorbed
    np.testing.assert_array_equal(labelled.labels, plain.labels)
    np.testing.assert_array_equal(labelled.tissue.vertices, plain.tissue.vertices)


def test_a_background_that_cells_cross_is_named():
    mask = np.pad(honeycomb(), 12)
    mask[:, :20] = mask[:, 20:40]  # the outermost cells are at the border
    cut = np.where(mask == 0, 77, mask)
    assert 77 in from_labels(cut, boundary="free").labels
    plain, named = (
        from_labels(mask, boundary="free"),
        from_labels(cut, boundary="free", background=77),
    )
    assert named.background == 77
    np.testing.assert_array_equal(named.tissue.vertices, plain.tissue.vertices)
    ring = np.pad(honeycomb(), 12, constant_values=77)
    ring[0, 0] = 1
    with pytest.raises(ValueError, match=r"labels 77 do.*name it by the argument `background`"):
        from_labels(ring, boundary="periodic")
    with pytest.raises(ValueError, match=r"too few remain.*name it by the argument `background`"):
        from_labels(ring, boundary="free")


@pytest.mark.parametrize(
    ("background", "error", "message"),
    [
        (99, ValueError, "`background` must be a label of the mask, but no pixel has 99"),
        (1.0, TypeError, "`background` must be a whole number"),
        ("1", TypeError, "`background` must be a whole number"),
    ],
)
def test_a_wrong_background_is_refused(background, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        from_labels(honeycomb(), background=background)


@pytest.mark.parametrize("dtype", [np.int64, np.uint8, np.uint16])
def test_labels_from_which_1_was_subtracted_are_refused(dtype):
    mask = np.pad(honeycomb(), 12).astype(dtype)
    shifted = mask - dtype(1)  # the background is -1, or the largest number; one cell is 0
    other = shifted[0, 0]
    with pytest.raises(ValueError, match=rf"label 0 beside {other}.*pass mask \+ 1; if it is none"):
        from_labels(shifted, boundary="free")
    with pytest.raises(ValueError, match=rf"label 0 beside {other}"):
        from_labels(shifted, boundary="free", background=int(other))
    again = from_labels(shifted + dtype(1), boundary="free")
    np.testing.assert_array_equal(again.labels, from_labels(mask, boundary="free").labels)
    # What the message says where 0 is no cell.
    fewer = np.where(shifted == other, 0, shifted)
    assert 0 not in from_labels(fewer, boundary="free").labels
    if dtype is np.int64:
        named = from_labels(shifted, boundary="free", background=0)
        np.testing.assert_array_equal(
            named.labels, from_labels(np.maximum(shifted, 0), boundary="free").labels
        )


def test_one_cell_besides_the_background_is_too_few():
    mask = np.pad(np.full((10, 10), 2), 5, constant_values=1)
    with pytest.raises(ValueError, match="but holds 1 besides the background, 1"):
        from_labels(mask, boundary="free")


def test_what_is_masked_is_no_cell():
    mask = np.pad(honeycomb(), 12, constant_values=3)
    hidden = np.zeros(mask.shape, bool)
    hidden[:12], hidden[-12:], hidden[:, :12], hidden[:, -12:] = True, True, True, True
    plain = from_labels(np.where(hidden, 0, mask), boundary="free")
    masked = from_labels(np.ma.masked_array(mask, hidden), boundary="free")
    np.testing.assert_array_equal(masked.tissue.vertices, plain.tissue.vertices)


def test_labels_beyond_63_bits_are_refused():
    mask = honeycomb().astype(np.uint64)
    mask[mask == 7] = 2**64 - 1
    with pytest.raises(ValueError, match="labels of at most 63 bits"):
        from_labels(mask)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"gap_width": 1e9, "boundary": "free"}, ValueError, "at most as many pixels .*, 60, but"),
        ({"gap_width": "wide"}, TypeError, "`gap_width` must be one real number, but is 'wide'"),
        ({"gap_width": np.nan}, ValueError, "`gap_width` must be at least 0, but is nan"),
        ({"pixel_size": "0.5"}, TypeError, "`pixel_size` must be one real number, but is '0.5'"),
        ({"pixel_size": [1.0, 2.0, 3.0]}, ValueError, "`pixel_size` must be one number or"),
        ({"pixel_size": (1.0, 0.0)}, ValueError, "`pixel_size` must be positive"),
        ({"holes": "fill"}, ValueError, "`holes` must be one of 'keep', 'close'"),
        ({"pixel_size": 1j}, TypeError, "`pixel_size` must be one real number"),
    ],
)
def test_wrong_sizes_are_named(options, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        from_labels(honeycomb(), **options)


def test_error_under_vmap_names_the_remedy():
    with pytest.raises(TypeError, match=r"from_labels needs arrays.*Call it outside"):
        jax.vmap(lambda mask: from_labels(mask).tissue.areas)(honeycomb()[None])


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.full((20, 20), 3), "at least two cells"),
        (np.zeros((20, 20), int), "at least two cells"),
        (np.zeros((0, 5), int), "must have shape (rows, columns)"),
        (np.ones((4, 4, 3), int), "must have shape (rows, columns)"),
        (np.arange(9), "must have shape (rows, columns)"),
        (np.full((5, 5), np.nan), "must hold integer labels"),
        (np.ones((5, 5)), "mask.astype(int)"),
        (np.eye(5, dtype=bool), "scipy.ndimage.label"),
    ],
)
def test_what_is_not_a_label_image_is_refused(mask, message):
    with pytest.raises(ValueError, match=r"Argument `mask` must") as error:
        from_labels(mask)
    assert message in str(error.value)


def test_too_few_cells_are_refused():
    mask = np.ones((20, 20), int)
    mask[:10, :10] = 2
    with pytest.raises(ValueError, match="Argument `mask` must hold"):
        from_labels(mask)


def test_unknown_boundary_lists_the_valid_ones():
    with pytest.raises(
        ValueError, match=re.escape("'mirrored', 'periodic', 'free', but is 'open'")
    ):
        from_labels(honeycomb(), boundary="open")


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_pixel_size_must_be_positive(size):
    with pytest.raises(ValueError, match="Argument `pixel_size` must be positive"):
        from_labels(honeycomb(), pixel_size=size)


def test_works_in_single_precision():
    with jax.enable_x64(False):
        got = from_labels(honeycomb(), boundary="periodic")
        assert got.tissue.vertices.dtype == np.float32
        np.testing.assert_allclose(areas_of(got.tissue), 1.0, rtol=1e-5)
