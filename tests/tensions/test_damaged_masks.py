"""Masks as segmentation programs leave them: holes, repeated labels, lines between cells, other pixels."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from damage_helpers import contacts, damaged, random_cells, with_gaps
from foam_helpers import against_truth, invented
from label_helpers import honeycomb
from scipy.ndimage import gaussian_filter, zoom

from vertax.inference import label_image, pearson
from vertax.initialise import free_voronoi, from_labels
from vertax.tensions import infer_tensions, read_mask


@pytest.fixture(scope="module")
def mask(foam):
    return np.asarray(label_image(foam[0], 500))


@pytest.fixture(scope="module")
def inner(foam, mask):
    """The label of the cell nearest to the middle of the cluster."""
    centres = np.asarray(foam[0].centroids)
    return int(np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1))) + 1


def infer(mask, **options) -> Any:
    """Tensions, with the report that they have for a mask."""
    return infer_tensions(mask, **options)


def segment(mask, **options) -> Any:
    return from_labels(mask, **options)


def edges_of(inferred, label):
    """Edges beside the cells of a label."""
    labels = np.append(inferred.labels, -1)
    return np.any(labels[np.asarray(inferred.tissue.topology.edge_cells)] == label, axis=1)


def agree(inferred, foam):
    true, tensions, deviation = against_truth(inferred, foam)
    tensions = tensions / tensions.mean()
    return (
        pearson(true, tensions) > 0.85
        and np.sqrt(np.mean(((tensions - true) / deviation) ** 2)) < 2
    )


def test_a_missing_cell_is_a_hole_with_undetermined_sides(foam, mask, inner):
    inferred = infer(np.where(mask == inner, 0, mask))
    assert np.sum(inferred.labels == 0) == 1
    assert inferred.tissue.n_cells == foam[0].n_cells
    assert not inferred.determined[edges_of(inferred, 0)].any()
    assert not inferred.pressures_determined[inferred.labels == 0].any()
    assert invented(inferred, foam) == []
    assert agree(inferred, foam)
    (hole,) = inferred.mask_report.of_kind("hole")
    assert hole.pixels == pytest.approx(np.sum(mask == inner), rel=0.002)  # without its corners
    row, column = np.argwhere(mask == inner).mean(axis=0)
    assert hole.row == pytest.approx(row, abs=0.1)
    assert hole.column == pytest.approx(column, abs=0.1)
    assert any(
        f"a hole of {hole.pixels} pixels at row {hole.row:.0f}" in d for d in inferred.warnings
    )
    table = inferred.cell_table()
    np.testing.assert_array_equal(table["hole"], table["label"] == 0)


def test_contacts_across_a_closed_hole_are_not_determined(foam, mask, inner):
    inferred = infer(np.where(mask == inner, 0, mask), holes="close")
    assert inferred.tissue.n_cells == foam[0].n_cells - 1
    assert inferred.mask_report.closed.any()
    assert inferred.edge_table()["contact_closed"].any()
    assert invented(inferred, foam) == []
    assert len(inferred.mask_report.of_kind("closed hole")) == 1
    assert any("holes that were closed" in text for text in inferred.warnings)


@pytest.mark.parametrize("boundary", ["periodic", "mirrored"])
def test_a_hole_closed_in_a_periodic_mask_is_reported(boundary):
    mask = honeycomb()
    hole = np.where(mask == 13, 0, mask)
    report = segment(np.kron(hole, np.ones((2, 2), int)), boundary=boundary).report
    (change,) = report.of_kind("closed hole")
    assert change.pixels == 400
    assert report.closed.any()
    clean = segment(mask, boundary=boundary).report
    assert not clean.closed.any()
    assert not clean.of_kind("closed hole")
    if boundary == "periodic":
        assert clean.changes == ()


def test_distant_cells_with_one_label_are_two_cells(foam, mask, inner):
    centres = np.asarray(foam[0].centroids)
    far = int(np.argmax(np.linalg.norm(centres - centres[inner - 1], axis=1))) + 1
    inferred = infer(np.where(mask == far, inner, mask))
    assert inferred.tissue.n_cells == foam[0].n_cells
    (change,) = inferred.mask_report.of_kind("new cell")
    assert change.label == inner
    assert change.into == 15  # the first number that is free
    assert any(f"label {inner} is in several pieces" in text for text in inferred.warnings)
    pixels = [np.sum(mask == label) for label in (inner, far)]
    split = np.isin(inferred.labels, [inner, change.into])
    assert sorted(inferred.mask_report.cell_pixels[split]) == sorted(pixels)


def test_stray_pixels_join_their_surroundings_and_are_listed(mask, inner):
    changed = mask.copy()
    row, column = np.rint(np.argwhere(mask == inner).mean(axis=0)).astype(int)
    other = 1 if inner != 1 else 2
    changed[row, column] = other
    changed[row + 5 : row + 7, column] = 99
    report = segment(changed, boundary="free", inner_arcs=True).report
    kinds = {change.kind: change for change in report.changes}
    fate = {kind: (each.label, each.into, each.pixels) for kind, each in kinds.items()}
    assert fate == {"piece": (other, inner, 1), "absorbed": (99, inner, 2)}
    assert report.became[report.labels == 99] == inner
    assert report.became[report.labels == other] == other


@pytest.mark.parametrize("width", [4, 6, 8])
def test_the_width_of_lines_between_cells_is_measured(foam, mask, width):
    lines = with_gaps(mask, width)
    inferred = infer(lines)
    assert inferred.tissue.n_cells == foam[0].n_cells
    assert inferred.mask_report.line_width == pytest.approx(width, abs=1)
    assert inferred.mask_report.gap_width > width
    assert invented(inferred, foam) == []
    assert agree(inferred, foam)
    with pytest.raises(ValueError, match=r"pixels apart .*pass gap_width="):
        infer(lines, gap_width=1.0)


@pytest.mark.thorough
def test_pixels_that_are_not_square_have_a_height_and_a_width(foam, mask, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    narrow = infer(mask[:, ::2], pixel_size=(1.0, 2.0))
    assert narrow.pixel_size == (1.0, 2.0)
    assert agree(narrow, foam)
    areas = np.asarray(narrow.tissue.areas)[np.argsort(narrow.labels)]
    np.testing.assert_allclose(areas, np.bincount(mask.ravel())[1:], rtol=0.02)
    # From the metadata of a file: pixels per length along x and along y, or lengths.
    sizes = {"PhysicalSizeX": 0.4, "PhysicalSizeY": 0.2}
    for name, options in (
        ("narrow.tif", {"resolution": (1.0, 2.0)}),
        ("narrow.ome.tif", {"metadata": {"axes": "YX"} | sizes}),
    ):
        tifffile.imwrite(tmp_path / name, mask[:, ::2].astype(np.uint16), **options)
        read = infer(tmp_path / name)
        height, width = read.pixel_size
        assert width == pytest.approx(2 * height)
        np.testing.assert_allclose(read.tensions, narrow.tensions, rtol=1e-3)
        assert np.mean(read.tissue.areas) == pytest.approx(1, rel=0.01)


def test_a_stack_needs_the_choice_of_a_plane(mask, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    moved = np.roll(mask, 3, axis=0)
    frames = np.stack([mask, moved]).astype(np.uint16)
    np.testing.assert_array_equal(read_mask(mask[None]), mask)
    np.testing.assert_array_equal(read_mask(mask[..., None]), mask)
    np.testing.assert_array_equal(read_mask(frames, plane=1), moved)
    with pytest.raises(ValueError, match=r"argument `plane`, 0 … 1"):
        infer(frames)
    with pytest.raises(ValueError, match=r"`plane` must lie in 0 … 1"):
        infer(frames, plane=2)
    file = tmp_path / "movie.tif"
    tifffile.imwrite(file, frames, metadata={"axes": "TYX"}, imagej=True)
    with pytest.raises(ValueError, match=r"argument `plane`, 0 … 1"):
        infer(file)
    np.testing.assert_array_equal(read_mask(file, plane=1), moved)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_label_planes_are_not_colours(mask, dtype):
    frames = np.stack([mask, np.roll(mask, 5, 0), np.roll(mask, 5, 1)], axis=-1).astype(dtype)
    with pytest.raises(ValueError, match=r"Label planes are not colours: pass one"):
        infer(frames)
    colours = np.random.default_rng(0).integers(1, 255, (15, 3)).astype(dtype)
    colours[0] = 0
    assert len(np.unique(read_mask(colours[mask]))) == 15


def test_two_labels_that_fill_the_image_are_two_cells():
    halves = np.ones((40, 60), int)
    halves[:, 30:] = 2
    np.testing.assert_array_equal(read_mask(halves), halves)
    assert segment(halves, boundary="free").tissue.n_cells == 2


def test_nan_is_no_cell(mask):
    np.testing.assert_array_equal(read_mask(np.where(mask == 0, np.nan, mask)), mask)
    with pytest.raises(ValueError, match=r"numpy\.nan_to_num\(mask, nan=0\)"):
        segment(np.where(mask == 0, np.nan, mask))


@pytest.mark.parametrize(
    ("dtype", "label", "message"),
    [
        (np.uint64, 2**63 + 5, "labels of at most 63 bits"),
        (np.float64, 2.0**63, "at most 53 bits, as float64 holds exactly"),
        (np.float32, 2.0**25, "at most 24 bits, as float32 holds exactly"),
        (np.float64, np.inf, "whole numbers"),
    ],
)
def test_labels_too_large_for_their_type_are_refused(mask, dtype, label, message):
    large = mask.astype(dtype)
    large[mask == 3] = label
    with pytest.raises(ValueError, match=message):
        infer(large)


@pytest.mark.parametrize("step", [1, 2])
def test_cells_have_the_areas_and_outlines_of_their_pixels(mask, step):
    """Vertices on the outline move along the edges that end there; the arcs of the outline have to follow."""
    result = infer(mask[:, ::step], pixel_size=(1.0, float(step)))
    assert np.max(np.abs(result.area_errors)) < 0.02
    assert np.max(result.outline_errors) < 2
    table = result.cell_table()
    np.testing.assert_array_equal(table["area_error"], result.area_errors)
    np.testing.assert_array_equal(table["outline_error"], result.outline_errors)


def test_a_cell_smaller_than_its_pixels_is_named(mask):
    result = infer(mask)
    assert not any("areas of" in text for text in result.warnings)
    report = result.mask_report
    pixels = report.cell_pixels * np.where(result.labels == 3, 1.09, 1)
    smaller = dataclasses.replace(
        result, mask_report=dataclasses.replace(report, cell_pixels=pixels.astype(int))
    )
    (text,) = [text for text in smaller.warnings if "areas of" in text]
    assert "areas of 1 cells differ by more than 5 % from those of their pixels: label 3" in text


def test_overlaps_on_the_outline_cost_little_area():
    mask = random_cells(np.random.default_rng(8))
    result = segment(mask, boundary="free", inner_arcs=True)
    pixels = result.report.cell_pixels * float(result.pixel_size) ** 2
    assert not result.tissue.overlaps.any
    assert np.max(np.abs(np.asarray(result.tissue.areas) / pixels - 1)) < 0.02


@pytest.mark.thorough
def test_a_resized_mask_with_new_labels_at_its_outlines_is_named(mask):
    large = zoom(mask.astype(float), 1.3, order=1).astype(np.int64)
    (text,) = [text for text in infer(large).warnings if "stray regions" in text]
    assert "resize masks with order 0" in text
    nearest = zoom(mask, 1.3, order=0)
    assert not any("stray regions" in text for text in infer(nearest).warnings)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("smooth", [0, 1.5])
def test_a_picture_is_no_mask(tmp_path, dtype, smooth):
    noise = gaussian_filter(np.random.default_rng(0).random((100, 100)), smooth)
    picture = (np.iinfo(dtype).max * (noise - noise.min()) / np.ptp(noise)).astype(dtype)
    with pytest.raises(
        ValueError, match=r"labels in \d{4} pieces of median 1 pixel: a picture, not"
    ):
        infer(picture)
    with pytest.raises(ValueError, match="a picture, not a mask"):
        segment(picture, boundary="mirrored")
    np.save(tmp_path / "picture.npy", picture)
    with pytest.raises(ValueError, match="a picture, not a mask"):
        read_mask(tmp_path / "picture.npy")


def coloured(mask, n_colours):
    """Labels 1, 2, …, of which no two at adjacent cells are the same (Brélaz 1979)."""
    colour, near = {}, {cell: set() for cell in range(1, int(mask.max()) + 1)}
    for one, other in contacts(mask):
        near[one].add(other)
        near[other].add(one)
    used = lambda cell: {colour[k] for k in near[cell] if k in colour}
    while len(colour) < len(near):
        cell = max(near.keys() - colour, key=lambda k: (len(used(k)), len(near[k])))
        free = set(range(1, n_colours + 1)) - used(cell)
        colour[cell] = min(free, key=lambda k: n_colours > 4 and list(colour.values()).count(k))
    return np.array([0, *(colour[k] for k in sorted(colour))])[mask]


@pytest.mark.parametrize("n_colours", [4, 6])
@pytest.mark.parametrize("lines", [False, True])
def test_repeating_colours_are_as_many_cells_as_pieces(n_colours, lines):
    clean = np.asarray(label_image(voronoi_of_60_cells(), 400))
    colours = np.random.default_rng(0).integers(1, 255, (n_colours + 1, 3))
    colours[0] = 0
    picture = colours[coloured(clean, n_colours)].astype(np.uint8)
    if lines:
        picture[thin_lines(clean)] = 255
    repeated = segment(read_mask(picture), boundary="free")
    assert np.sum(repeated.labels > 0) == 60
    assert repeated.tissue.n_edges == segment(clean, boundary="free").tissue.n_edges


def thin_lines(mask):
    """Lines of one pixel between cells and around all."""
    line = np.zeros(mask.shape, bool)
    line[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    line[1:] |= mask[1:] != mask[:-1]
    return line


@pytest.mark.parametrize("line", [65535, 15, 1])
@pytest.mark.parametrize("width", [1, 2, 5])
def test_lines_with_a_label_are_no_cell(mask, line, width):
    cells = np.where(mask > 0, mask + 1, 0) if line == 1 else mask
    drawn = thin_lines(cells) if width == 1 else with_gaps(cells, width) != cells
    result = segment(np.where(drawn, line, cells), boundary="free", inner_arcs=True)
    assert result.background == line
    same = segment(np.where(drawn, 0, cells), boundary="free", inner_arcs=True)
    np.testing.assert_array_equal(result.labels, same.labels)
    np.testing.assert_array_equal(
        result.tissue.topology.edge_cells, same.tissue.topology.edge_cells
    )


def test_lines_beside_a_background_with_a_label_are_no_cell(mask):
    cells = np.where(mask > 0, mask, 99)
    result = segment(np.where(thin_lines(mask), 65535, cells), boundary="free")
    same = segment(np.where(thin_lines(mask), 0, mask), boundary="free")
    assert result.background == 99
    np.testing.assert_array_equal(result.labels, same.labels)


def test_indices_of_a_palette_are_labels(mask, tmp_path):
    image_module = pytest.importorskip("PIL.Image")
    picture = image_module.fromarray(mask.astype(np.uint8), mode="P")
    palette = np.random.default_rng(1).integers(1, 255, (256, 3))
    palette[0], palette[5] = 0, palette[9]
    picture.putpalette(palette.astype(np.uint8).ravel().tolist())
    picture.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), mask)


def three_meet(clean, mask):
    """Whether any three cells that are left in a mask touch each other in the clean one."""
    left = contacts(np.where(np.isin(clean, mask), clean, 0))
    return any((a, c) in left for a, b in left for d, c in left if d == b)


def check_contacts(seed):
    """Every contact with a determined tension exists in the mask before it was damaged."""
    rng = np.random.default_rng(seed)
    clean = random_cells(rng)
    mask, pixel_size = damaged(clean, rng)
    if not three_meet(clean, mask):
        with pytest.raises(ValueError, match="where three of its cells meet"):
            infer(mask, kind="labels", pixel_size=pixel_size)
        return
    inferred = infer(mask, kind="labels", pixel_size=pixel_size)
    column, row = np.floor(np.asarray(inferred.tissue.centroids)).astype(int).T
    rows, columns = clean.shape
    true = np.append(clean[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)], 0)
    pairs = np.sort(true[np.asarray(inferred.tissue.topology.edge_cells)], axis=1)
    existing = contacts(clean)
    assert [p for p in map(tuple, pairs[inferred.determined].tolist()) if p not in existing] == []
    # Every label is a cell, or the report says what became of it.
    report = inferred.mask_report
    gone = report.labels[report.became != report.labels]
    assert set(gone.tolist()) <= {change.label for change in report.changes}
    assert set(report.labels.tolist()) - set(gone.tolist()) <= set(inferred.labels.tolist())


@pytest.mark.parametrize("seed", range(3))
def test_determined_contacts_exist(seed):
    check_contacts(seed)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(20))
def test_determined_contacts_of_200_damaged_masks_exist(block):
    for seed in range(10 * block, 10 * block + 10):
        check_contacts(seed)


@pytest.mark.thorough
@pytest.mark.parametrize("step", [1, 2])
def test_pixels_that_are_not_square_are_named(step):
    """Angles at junctions show a mask with pixels of another shape than assumed."""
    clean = np.pad(label_image(voronoi_of_60_cells(), 500), 4)
    narrow = infer(clean[:, ::step])
    named = [warning for warning in narrow.warnings if "pixel_size=(height, width)" in warning]
    assert len(named) == step - 1
    assert not any(
        "height of a pixel" in warning
        for warning in infer(clean[:, ::step], pixel_size=(1.0, float(step))).warnings
    )
    for text in named:
        width = float(text.split("such as (1, ")[1].split(")")[0])
        assert width == pytest.approx(step, rel=0.15)


def voronoi_of_60_cells():
    return free_voronoi(60, key=jax.random.key(7), lloyd_steps=3)
