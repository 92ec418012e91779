import re

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from vertax import Tissue
from vertax.initialise import from_labels, periodic_voronoi


def rasterise(seeds: np.ndarray, shape: tuple[int, int], periodic: bool = True) -> np.ndarray:
    """Label image of the Voronoi cells of `seeds` (x, y in pixels), labels from 1."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    tree = cKDTree(seeds, boxsize=shape[::-1] if periodic else None)
    return tree.query(np.stack([x.ravel(), y.ravel()], 1))[1].reshape(shape) + 1


def clear_seeds(n: int, shape: tuple[int, int], seed: int) -> np.ndarray:
    """Seeds of cells whose edges are long compared to a pixel."""
    box = np.diag(np.array(shape[::-1], float))
    rng = np.random.default_rng(seed)
    while True:
        points = rng.random((n, 2)) @ box
        for _ in range(4):
            tissue = periodic_voronoi(seeds=points, lattice=box, softening=0.0)
            if tissue.edge_lengths.min() > 3:
                return points
            points = np.asarray(tissue.centroids) % np.diag(box)


def make(mask: np.ndarray, boundary: str = "periodic"):
    """A tissue in pixels. (A given softening saves compiling the default for every new shape.)"""
    return from_labels(mask, boundary=boundary, pixel_size=1.0, softening=0.0)


def sides(tissue: Tissue) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of each half-edge, in NumPy: JAX would compile for every new shape."""
    m = tissue.topology
    frame = np.asarray(m.frame) @ np.asarray(tissue.boundary.lattice)
    corners = np.repeat(np.asarray(tissue.vertices), 3, axis=0) + frame
    twin = np.asarray(m.twin)
    return corners, corners[3 * (twin // 3) + (twin + 2) % 3]


def areas_of(tissue: Tissue) -> np.ndarray:
    """Shoelace areas."""
    (x, y), (u, v) = (ends.T for ends in sides(tissue))
    return 0.5 * np.bincount(np.asarray(tissue.topology.cell), x * v - y * u)


def sides_of(tissue: Tissue) -> np.ndarray:
    return np.bincount(np.asarray(tissue.topology.cell))


def neighbours(tissue: Tissue, names: np.ndarray) -> list[tuple[int, int]]:
    """The pair of cells at each edge, sorted."""
    m = tissue.topology
    one = np.asarray(m.half_edge)
    cell = names[np.asarray(m.cell)]
    pairs = np.sort(np.stack([cell[one], cell[np.asarray(m.twin)[one]]], axis=1), axis=1)
    return sorted(map(tuple, pairs.tolist()))


def touching_pairs(mask: np.ndarray) -> set[tuple[int, int]]:
    """Labels that share a pixel side in a periodic mask, pixel by pixel."""
    pairs = set()
    for shifted in (np.roll(mask, 1, 0), np.roll(mask, 1, 1)):
        pairs |= {(min(a, b), max(a, b)) for a, b in zip(mask.flat, shifted.flat, strict=True)}
    return {(int(a), int(b)) for a, b in pairs if a != b}


def polygon(segmentation, label: int) -> np.ndarray:
    """Corners, in pixels, of the first cell with a label."""
    m = segmentation.tissue.topology
    cell = int(np.flatnonzero(segmentation.labels == label)[0])
    h = int(np.flatnonzero(np.asarray(m.cell) == cell)[0])
    around = [h]
    while (h := int(m.next[h])) != around[0]:
        around.append(h)
    return np.asarray(segmentation.tissue.corners)[around] / segmentation.pixel_size


SHAPE = (120, 160)


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
    assert got.whole.all()
    assert got.absorbed.size == 0
    assert got.inflated.size == 0


@pytest.mark.parametrize("seed", range(12))
def test_neighbours_are_those_of_the_pixels(seed):
    rng = np.random.default_rng(100 + seed)
    shape = tuple(rng.integers(40, 70, 2).tolist())
    mask = rasterise(rng.random((15, 2)) * shape[::-1], shape)
    got = make(mask)
    assert np.all(areas_of(got.tissue) > 0)
    alone = np.ones(shape, bool)  # pixels that are pieces of their own, which are given away
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
    here = make(mask)
    there = make(np.roll(mask, shift, (0, 1)))
    assert neighbours(here.tissue, here.labels) == neighbours(there.tissue, there.labels)
    np.testing.assert_allclose(areas_of(here.tissue), areas_of(there.tissue), rtol=1e-10)


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
    np.testing.assert_array_equal(tissue.boundary.lattice, np.diag([2.0 * columns, 2.0 * rows]))
    vertices = np.asarray(tissue.vertices) % [2 * columns, 2 * rows]
    for mirrored in (vertices * [-1, 1], vertices * [1, -1]):
        tree = cKDTree(vertices, boxsize=[2 * columns, 2 * rows])
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
    whole = got.labels[got.whole].tolist()
    assert len(whole) == len(set(whole)) > 0
    assert inside - beside <= set(whole) <= inside
    first = len(np.unique(got.labels))
    assert np.all(np.diff(got.labels[:first]) > 0)  # originals first, in the order of their labels
    for cell in np.flatnonzero(got.whole):
        corners = np.asarray(got.tissue.corners)[np.asarray(got.tissue.topology.cell) == cell]
        assert np.all(corners >= 0)
        assert np.all(corners <= mask.shape[::-1])


def test_gaps_go_to_the_nearest_label():
    mask = rasterise(clear_seeds(20, SHAPE, 3), SHAPE)
    full = make(mask)
    outline = (mask != np.roll(mask, 1, 0)) | (mask != np.roll(mask, 1, 1))
    holed = np.where(outline, 0, mask)
    holed[5:9, 5:9] = -3
    filled = make(holed)
    assert neighbours(filled.tissue, filled.labels) == neighbours(full.tissue, full.labels)
    np.testing.assert_allclose(areas_of(filled.tissue), areas_of(full.tissue), rtol=0.1)


def test_gaps_are_filled_across_the_periodic_border():
    # A band of gaps at the right border, which belongs to the cells at the left border.
    mask = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((8, 8), int))
    mask[:, -6:] = 0
    got = make(mask)
    areas = dict(zip(got.labels.tolist(), areas_of(got.tissue).tolist(), strict=True))
    assert areas[11] == pytest.approx(8 * 11)
    assert areas[15] == pytest.approx(8 * 5)
    got = make(mask, "mirrored")
    assert polygon(got, 13)[:, 0].max() == 24
    cells = areas_of(got.tissue)[got.labels == 15]
    np.testing.assert_allclose(cells, 8 * 16)  # both its own half and the mirrored one


def test_small_pieces_of_a_label_go_to_their_neighbours():
    mask = rasterise(clear_seeds(20, SHAPE, 4), SHAPE)
    clean = make(mask)
    y, x = np.argwhere(mask == 7).mean(axis=0).astype(int)
    broken = mask.copy()
    broken[y : y + 2, x : x + 2] = 12  # a piece of 12 in the middle of 7
    broken[y, x] = 13  # and one of 13 beside it
    got = make(broken)
    assert neighbours(got.tissue, got.labels) == neighbours(clean.tissue, clean.labels)
    np.testing.assert_allclose(areas_of(got.tissue), areas_of(clean.tissue), rtol=1e-12)


def honeycomb() -> np.ndarray:
    """30 cells in brick rows, each with six neighbours around the torus."""
    rows = [np.roll(np.repeat(np.arange(5) + 5 * r + 1, 10), 5 * (r % 2)) for r in range(6)]
    return np.repeat(np.array(rows), 10, axis=0)


def test_bricks_are_hexagons():
    got = make(honeycomb())
    assert np.all(sides_of(got.tissue) == 6)
    np.testing.assert_allclose(areas_of(got.tissue), 100.0)


def test_an_island_is_absorbed_by_the_cell_around_it():
    mask = honeycomb()
    mask[13:16, 22:25] = 99  # inside a brick
    got = make(mask)
    assert got.absorbed.tolist() == [99]
    assert np.all(sides_of(got.tissue) == 6)
    np.testing.assert_allclose(areas_of(got.tissue), 100.0)


def test_a_group_of_islands_is_absorbed_with_its_own_islands():
    mask = np.kron(honeycomb(), np.ones((3, 3), int))
    block = np.array([[91, 91, 92, 92]] * 2 + [[93, 93, 93, 93]] * 2)
    block = np.kron(block, np.ones((5, 5), int))
    block[12, 4] = 94  # an island of an island
    y, x = np.argwhere(mask == 13).min(axis=0) + 5
    mask[y : y + 20, x : x + 20] = block
    got = make(mask)
    assert got.absorbed.tolist() == [91, 92, 93, 94]
    np.testing.assert_allclose(areas_of(got.tissue), 900.0)


def test_a_lens_is_absorbed_by_the_neighbour_it_touches_most():
    mask = honeycomb()
    # Between brick 7 (rows 10–19) above and its neighbours below; three of four sides in brick 7.
    y = 20
    x = int(np.argwhere(mask[19] == 7).min()) + 1
    mask[y - 3 : y, x : x + 3] = 99
    got = make(mask)
    assert got.absorbed.tolist() == [99]
    areas = areas_of(got.tissue)
    np.testing.assert_allclose(areas, 100.0)  # the corners of 7 are where they were


def test_two_lenses_that_touch_do_not_swallow_each_other():
    mask = np.kron(honeycomb(), np.ones((3, 3), int))
    y, x = np.argwhere(mask == 13).min(axis=0)
    mask[y : y + 4, x + 3 : x + 9] = 98
    mask[y + 1 : y + 3, x + 5 : x + 7] = 99  # an eye in a lens
    mask[y + 4 : y + 6, x + 5 : x + 7] = 97
    got = make(mask)
    assert got.absorbed.tolist() == [97, 98, 99]
    np.testing.assert_allclose(sides_of(got.tissue), 6)


def test_border_cells_with_two_sides_are_absorbed_when_mirrored():
    mask = np.kron(np.arange(1, 10).reshape(3, 3), np.ones((10, 10), int))
    mask[:3, 13:17] = 50  # a notch at the border, inside cell 2: mirrored it is enclosed
    mask[12:15, :3] = 51
    mask[:3, 9:12] = 52  # on the line between 1 and 2: mirrored it is a lens
    got = make(mask, "mirrored")
    assert got.absorbed.tolist() == [50, 51, 52]
    assert got.labels[got.whole].tolist() == [5]


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


@pytest.mark.parametrize("flip", [False, True])
def test_a_cell_meeting_itself_in_a_corner_is_kept_apart_there(flip):
    # Cell 113 (1 in the picture) meets itself in pixel corners, around small cells.
    mask = honeycomb() + 100
    mask = np.kron(mask, np.ones((4, 4), int))
    y, x = np.argwhere(mask == 113).min(axis=0)
    picture = [[1, 2, 3], [4, 1, 5], [1, 1, 1]]
    mask[y + 1 : y + 13, x + 20 : x + 32] = np.kron(picture, np.ones((4, 4)))
    mask[mask == 1] = 113
    # Pixels of 113 around corner (y + 5, x + 24): top left and bottom right.
    block = mask[y + 4 : y + 6, x + 23 : x + 25]
    assert block[0, 0] == block[1, 1] == 113
    mask = mask[:, ::-1] if flip else mask
    got = make(mask)
    assert np.all(areas_of(got.tissue) > 0)
    assert 113 in got.labels
    # Everything in the pocket has too few sides, and ends in 113.
    assert got.absorbed.tolist() == [2, 3, 4, 5]
    assert np.all(sides_of(got.tissue) == 6)


def test_a_pocket_behind_a_corner_stays_if_its_cells_have_three_sides():
    mask = np.kron(honeycomb(), np.ones((4, 4), int))
    y, x = np.argwhere(mask == 13).min(axis=0)
    # In a corner of brick 13 a pocket of three cells, which touches the neighbours on the left and
    # above (brick 12 and one of row 1) in one pixel corner each way round only.
    pocket = np.kron([[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 3, 3]], np.ones((4, 4), int))
    mask[y + 1 : y + 13, x + 1 : x + 17] = pocket + 200
    mask[y, x] = 12
    got = make(mask)
    assert got.absorbed.size == 0
    counts = dict(zip(got.labels.tolist(), sides_of(got.tissue).tolist(), strict=True))
    assert (counts[202], counts[203]) == (3, 3)
    assert counts[201] == 5  # one more corner on each side of the gate
    pairs = neighbours(got.tissue, got.labels)
    assert pairs.count((12, 201)) == 1
    assert (13, 13) not in pairs


def test_strongly_concave_cells_are_inflated():
    # Cell 50 is a U that opens to the row above, with 51 in it: its four corners lie on one line.
    mask = np.kron(honeycomb(), np.ones((4, 4), int))
    y, x = np.argwhere(mask == 13).min(axis=0)
    mask[y : y + 30, x + 5 : x + 35] = 50
    mask[y : y + 26, x + 9 : x + 31] = 51
    got = make(mask)
    areas = areas_of(got.tissue)
    assert got.absorbed.size == 0
    assert 50 in got.inflated
    assert areas.min() > 0
    np.testing.assert_allclose(areas.sum(), mask.size)
    # Only what is near has moved.
    far = ~np.isin(got.labels, [50, 51, 12, 13, 14, 7, 8, 9, 18, 19])
    assert np.count_nonzero(far) > 15
    np.testing.assert_allclose(areas[far], 1600.0)


def test_cell_touching_the_border_in_two_places_absorbs_what_it_cuts_off():
    mask = np.kron(np.arange(1, 17).reshape(4, 4), np.ones((10, 10), int))
    mask[8:32, 0:14] = 60  # reaches the left border at rows 8–14 and 25–31 …
    mask[15:25, 0:8] = 61  # … around this one
    got = make(mask, "mirrored")
    assert 61 in got.absorbed
    assert 60 in got.labels
    np.testing.assert_allclose(np.sum(areas_of(got.tissue)), 4 * mask.size)


def test_cell_spanning_the_image_is_refused_by_name():
    mask = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((6, 6), int))
    mask[13:17] = 77
    for boundary in ("mirrored", "periodic"):
        with pytest.raises(ValueError, match=r"Argument `mask` must .*the labels 77 do.*Crop"):
            from_labels(mask, boundary=boundary)


def test_background_label_around_everything_is_refused_by_name():
    mask = np.full((40, 40), 5)
    mask[10:30, 10:30] = np.kron([[1, 2], [3, 4]], np.ones((10, 10), int))
    with pytest.raises(ValueError, match=r"the labels 5 do"):
        from_labels(mask, boundary="periodic")


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
    with pytest.raises(ValueError, match=re.escape("'mirrored', 'periodic', but is 'free'")):
        from_labels(honeycomb(), boundary="free")


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_pixel_size_must_be_positive(size):
    with pytest.raises(ValueError, match="Argument `pixel_size` must be positive"):
        from_labels(honeycomb(), pixel_size=size)


@pytest.mark.parametrize("boundary", ["mirrored", "periodic"])
@pytest.mark.parametrize("seed", range(20))
def test_noisy_masks_are_repaired(seed, boundary):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(30, 50, 2).tolist())
    n = int(rng.integers(20, 50))
    mask = rasterise(rng.random((n, 2)) * shape[::-1], shape)
    noise = rng.random(shape) < rng.choice([0.02, 0.1, 0.3])
    mask[noise] = rng.integers(0, n + 1, np.count_nonzero(noise))
    got = make(mask, boundary)
    areas = areas_of(got.tissue)
    assert np.min(areas) > 0
    copies = 4 if boundary == "mirrored" else 1
    np.testing.assert_allclose(areas.sum(), copies * mask.size, rtol=1e-12)
    assert np.array_equal(np.union1d(got.labels, got.absorbed), np.unique(mask[mask > 0]))
    assert not set(got.labels.tolist()) & set(got.absorbed.tolist())


def test_works_in_single_precision():
    with jax.enable_x64(False):
        got = from_labels(honeycomb(), boundary="periodic")
        assert got.tissue.vertices.dtype == np.float32
        np.testing.assert_allclose(areas_of(got.tissue), 1.0, rtol=1e-5)
