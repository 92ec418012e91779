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
    sides_of,
)

from vertax.initialise import from_labels


def test_gaps_go_to_the_nearest_label():
    mask = rasterise(clear_seeds(20, SHAPE, 3), SHAPE)
    full = make(mask)
    outline = (mask != np.roll(mask, 1, 0)) | (mask != np.roll(mask, 1, 1))
    holed = np.where(outline, 0, mask)
    holed[5:9, 5:9] = -3
    filled = from_labels(holed, boundary="periodic", pixel_size=1.0, softening=0.0, background=0)
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


def test_a_piece_goes_to_the_neighbour_with_the_longest_interface():
    mask = np.kron(honeycomb(), np.ones((2, 2), int))
    y = np.argwhere(mask == 13)[:, 0].max() + 1  # below 13 two bricks meet at x
    below = mask[y]
    x = next(x for x in np.argwhere(mask[y - 1] == 13)[1:, 0] if below[x] != below[x - 1])
    # 10 pixel sides with 13, 7 with the brick on the lower left, 3 with that on the lower right.
    mask[y - 2 : y + 2, x - 5 : x + 1] = 1
    got = make(mask)
    assert [x, y + 2] in np.asarray(got.tissue.vertices).tolist()
    assert [x, y] not in np.asarray(got.tissue.vertices).tolist()


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


def test_two_adjacent_lenses_are_absorbed_by_other_cells():
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


# Where four different cells meet, labels decide which pair touches. Here they must not.
@pytest.mark.parametrize("name", [1, 113, 999])
def test_a_pocket_behind_a_corner_stays_if_its_cells_have_three_sides(name):
    mask = np.kron(honeycomb() + 100, np.ones((4, 4), int))
    y, x = np.argwhere(mask == 113).min(axis=0)
    # In a corner of brick 113 a pocket of three cells, which touches the neighbours on the left and
    # above (brick 112 and one of row 1) in one pixel corner each way round only.
    pocket = np.kron([[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 3, 3]], np.ones((4, 4), int))
    mask[y + 1 : y + 13, x + 1 : x + 17] = pocket + 200
    mask[y, x] = 112
    mask[mask == 113] = name
    got = make(mask)
    assert got.absorbed.size == 0
    counts = dict(zip(got.labels.tolist(), sides_of(got.tissue).tolist(), strict=True))
    assert (counts[202], counts[203]) == (3, 3)
    assert counts[201] == 5  # one more corner on each side of the gate
    pairs = neighbours(got.tissue, got.labels)
    assert pairs.count((112, 201)) == 1
    assert (name, name) not in pairs


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
    # Large pieces that noise cuts off are cells with new labels.
    given = got.labels[got.labels <= mask.max()]
    assert got.report is not None
    new = {change.into for change in got.report.of_kind("new cell")}
    assert set(got.labels.tolist()) - set(given.tolist()) <= new
    assert np.array_equal(np.union1d(given, got.absorbed), np.unique(mask[mask > 0]))
    assert not set(got.labels.tolist()) & set(got.absorbed.tolist())
