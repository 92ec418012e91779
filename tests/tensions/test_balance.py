"""Tensions and pressures from masks and exact shapes, by the balance of forces."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from foam_helpers import against_truth
from free_helpers import cluster

import vertax as vx
from vertax.inference import label_image, pearson
from vertax.tensions import infer_tensions, read_mask

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="the data beside the repository, ../shared/data, are not there"
)


def test_tensions_and_pressures_of_an_exact_shape(foam):
    tissue, tension, pressure = foam
    result = infer_tensions(tissue)
    sure = result.determined
    assert sure.sum() > 10
    np.testing.assert_allclose(
        result.tensions[sure], tension[sure] / tension[sure].mean(), rtol=1e-2
    )
    cells = result.pressures_determined
    wanted = pressure[cells] / tension[sure].mean()
    np.testing.assert_allclose(result.pressures[cells], wanted - wanted.mean(), atol=1e-2)
    assert not result.determined[np.asarray(tissue.topology.on_outline)].any()
    assert np.isnan(result.tensions[np.asarray(tissue.topology.on_outline)]).all()
    assert result.warnings == ()


# Three cells around the vertex 1; the outline of each has a vertex in its middle.
TRIPLET = """SPACE_DIMENSION 2
STRING
vertices
1 0 0
2 0 1
3 -0.866 -0.5
4 0.866 -0.5
5 -1 0.6
6 0 -1.2
7 1 0.6
edges
1 1 2
2 1 3
3 1 4
4 2 5
5 5 3
6 3 6
7 6 4
8 4 7
9 7 2
faces
1 1 4 5 -2
2 2 6 7 -3
3 3 8 9 -1
bodies
3 1
7 2
9 3
"""


@pytest.mark.thorough
def test_labels_of_cells_differ_from_that_of_the_exterior(foam, tmp_path):
    (tmp_path / "triplet.fe").write_text(TRIPLET, encoding="utf-8")
    from_dump, from_tissue = infer_tensions(tmp_path / "triplet.fe"), infer_tensions(foam[0])
    np.testing.assert_array_equal(from_dump.labels, [3, 7, 9])
    np.testing.assert_array_equal(from_tissue.labels, np.arange(1, 15))
    for result in (from_dump, from_tissue):
        edges, cells = result.edge_table(), result.cell_table()
        label = dict(zip(cells["cell"], cells["label"], strict=True)) | {-1: 0}
        for side in ("left", "right"):
            np.testing.assert_array_equal(
                edges[f"{side}_label"], [label[cell] for cell in edges[f"{side}_cell"]]
            )
        outside = (edges["left_label"] == 0) | (edges["right_label"] == 0)
        np.testing.assert_array_equal(outside, edges["on_outline"])


@pytest.mark.thorough
def test_edges_where_four_cells_meet_name_no_pair():
    """On a square lattice the numbers of the cells decide which two share an edge of length 0."""
    place, tables = np.kron(np.arange(36).reshape(6, 6), np.ones((20, 20), int)), []
    for numbers in (np.arange(36), np.random.default_rng(1).permutation(36)):
        result = infer_tensions(np.pad(numbers[place] + 1, 10))
        table = result.edge_table()
        assert table["four_fold"].sum() == 25
        assert not table["determined"][table["four_fold"]].any()
        position = {0: -1, -1: -2} | {int(label) + 1: k for k, label in enumerate(numbers)}
        pairs = [
            tuple(sorted((position[int(left)], position[int(right)])))
            for left, right in zip(table["left_label"], table["right_label"], strict=True)
        ]
        tables.append(sorted(pairs))
    assert tables[0] == tables[1]
    assert tables[0].count((-2, -2)) == 25


def test_inference_is_invariant_under_rotation_translation_and_scaling(foam):
    tissue, *_ = foam
    turn = jnp.array([[0.6, -0.8], [0.8, 0.6]])
    moved = tissue.with_vertices(3.0 * tissue.vertices @ turn.T + 5.0)
    result, again = infer_tensions(tissue), infer_tensions(moved)
    np.testing.assert_allclose(result.tensions, again.tensions, atol=1e-6)
    np.testing.assert_allclose(result.tension_deviations, again.tension_deviations, atol=1e-6)
    np.testing.assert_allclose(result.pressures, 3 * again.pressures, atol=1e-6)
    np.testing.assert_allclose(
        result.stresses, 3 * np.einsum("ai,nij,bj->nab", turn.T, again.stresses, turn.T), atol=1e-5
    )


def test_tensions_of_a_mask_agree_within_their_deviations(foam):
    result = infer_tensions(label_image(foam[0], 500))
    true, inferred, deviation = against_truth(result, foam)
    assert pearson(true, inferred) > 0.9
    assert np.mean(np.abs(inferred - true) < 2 * deviation) > 0.85
    # Not by deviations that are too large.
    assert np.mean(np.abs(inferred - true) < 0.5 * deviation) < 0.7
    assert np.median(deviation) < 0.1
    assert isinstance(result.pixel_size, float)
    assert result.noise < result.pixel_size


def test_stresses_are_the_tensions_less_the_pressure(foam):
    tissue, *_ = foam
    result = infer_tensions(tissue)
    inside = np.isfinite(result.stresses).all(axis=(1, 2))
    assert inside.any()
    half = 0.5 * np.where(np.isfinite(result.tensions), result.tensions, 0) * tissue.edge_lengths
    pull = np.zeros(tissue.n_cells + 1)
    for side in np.asarray(tissue.topology.edge_cells).T:
        np.add.at(pull, side, half)
    trace = pull[:-1] / np.asarray(tissue.areas) - 2 * result.pressures
    found_trace = np.trace(result.stresses, axis1=1, axis2=2)
    np.testing.assert_allclose(found_trace[inside], trace[inside], rtol=1e-3, atol=1e-4)


def test_imbalance_is_distinguished_from_noise(foam):
    tissue, *_ = foam
    noise = 0.06 * jax.random.normal(jax.random.key(5), tissue.vertices.shape)
    result = infer_tensions(tissue.with_vertices(tissue.vertices + noise))
    at_rest = infer_tensions(tissue)
    assert result.errors["junction"] > 5 * at_rest.errors["junction"]
    assert np.nanmedian(result.tension_deviations) > 3 * np.nanmedian(at_rest.tension_deviations)


@pytest.mark.thorough
def test_polygons_have_straight_edges():
    """A Voronoi tissue, which is in balance with straight edges."""
    tissue = vx.initialise.free_voronoi(30, key=jax.random.key(4), lloyd_steps=1)
    result = infer_tensions(label_image(tissue, 900))
    assert result.edges == "straight"
    assert result.errors["arc"] == 0


def test_results_are_written_as_tables_and_shapes(foam, tmp_path):
    result = infer_tensions(foam[0])
    for name in ("cells.csv", "cells.geojson", "cells.vtu"):
        for path in result.write(tmp_path / name):
            assert path.stat().st_size > 500
    header = (tmp_path / "cells-edges.csv").read_text().splitlines()[0]
    assert {"tension", "tension_deviation", "determined", "reason"} <= set(header.split(","))
    with pytest.raises(ValueError, match=r"must end in \.csv"):
        result.write(tmp_path / "cells.xlsx")


def outlines(labels, width=1):
    """The lines of a label image, `width` pixels wide."""
    lines = np.zeros(labels.shape, bool)
    for shift in range(1, width + 1):
        lines[:, shift:] |= labels[:, shift:] != labels[:, :-shift]
        lines[shift:] |= labels[shift:] != labels[:-shift]
    return lines


@pytest.mark.parametrize("width", [1, 4])
def test_outlines_of_any_kind_give_the_cells(foam, width):
    labels = label_image(foam[0], 300)
    lines = outlines(labels, width)
    red = np.stack([255 * lines, 0 * lines, 0 * lines], axis=-1).astype(np.uint8)
    grey = np.where(lines, 0, 200).astype(np.uint8)
    n = foam[0].n_cells
    for image in (lines, red, grey):
        result = read_mask(image)
        assert len(np.unique(result)) == n + 1
        inside = (labels > 0) & (result > 0)
        # One label for one label.
        assert len(np.unique(np.stack([labels, result])[:, inside & ~lines], axis=1).T) == n


def test_cells_that_the_border_cuts_are_cells(foam):
    labels = label_image(foam[0], 300)
    cut = labels[90:210, 90:210]
    assert (cut > 0).all()
    result = read_mask(outlines(cut))
    assert (result > 0).all()
    assert len(np.unique(result)) == len(np.unique(cut))


def test_masks_of_cellpose_and_of_other_backgrounds_are_read(foam, tmp_path):
    labels = label_image(foam[0], 200)
    of_cellpose = np.array({"masks": labels, "diams": 30.0}, object)
    np.save(tmp_path / "a_seg.npy", of_cellpose, allow_pickle=True)
    np.save(tmp_path / "a.npy", labels)
    np.testing.assert_array_equal(read_mask(tmp_path / "a_seg.npy"), labels)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.npy"), labels)
    np.testing.assert_array_equal(read_mask(labels + 7, background=7) > 0, labels > 0)
    colours = np.stack([labels % 4, labels // 4, 0 * labels], axis=-1).astype(np.uint8)
    assert len(np.unique(read_mask(colours))) == len(np.unique(labels))


def test_a_boolean_mask_of_cells_apart_gives_the_cells(foam):
    labels = label_image(foam[0], 300)
    n = foam[0].n_cells
    for mask in (labels, np.pad(labels, 80)):
        cells = (mask > 0) & ~outlines(mask, 2)
        result = read_mask(cells)
        assert len(np.unique(result)) == n + 1
        # The surroundings are no cell, and lines go to both sides.
        wrong = (result > 0) != (mask > 0)
        assert wrong.mean() < 0.02


def test_a_binary_mask_without_lines_is_refused(foam):
    inside = label_image(foam[0], 300) > 0
    rows, columns = np.indices(inside.shape)
    holes = inside.copy()
    for row, column in ((100, 100), (150, 200), (200, 120)):
        holes &= (rows - row) ** 2 + (columns - column) ** 2 >= 64
    for mask in (holes, holes[60:240, 60:240], (255 * holes).astype(np.uint8)):
        with pytest.raises(ValueError, match=r"lines that are thinner than cells.*ndimage\.label"):
            read_mask(mask)
    assert len(np.unique(read_mask(holes, kind="outlines"))) > 1
    with pytest.raises(ValueError, match="one region"):
        read_mask(inside)


@pytest.mark.parametrize("dtype", [np.int32, np.uint8])
@pytest.mark.parametrize("read", [read_mask, infer_tensions])
def test_labels_from_which_1_was_subtracted_are_refused(foam, dtype, read):
    labels = label_image(foam[0], 200).astype(dtype)
    shifted = labels - dtype(1)  # the background is -1 or 255, one cell is 0
    with pytest.raises(ValueError, match=r"has the label 0 beside (-1|255).*pass mask \+ 1"):
        read(shifted)
    np.testing.assert_array_equal(shifted + dtype(1), labels)
    if dtype is np.int32:
        np.testing.assert_array_equal(
            read_mask(np.maximum(shifted, 0)) > 0, read_mask(shifted, background=0) > 0
        )


def test_what_cannot_be_used_is_refused(foam):
    tissue, *_ = foam
    with pytest.raises(ValueError, match="`noise`"):
        infer_tensions(tissue, noise=0.0)
    with pytest.raises(ValueError, match="must be one of 'auto', 'labels', 'outlines'"):
        read_mask(np.eye(5, dtype=int), kind="skeleton")
    with pytest.raises(ValueError, match="no pixel has 9"):
        read_mask(np.eye(5, dtype=int), background=9)
    with pytest.raises(ValueError, match="whole numbers"):
        read_mask(np.full((4, 4), 0.5))
    with pytest.raises(ValueError, match="enclose"):
        read_mask(np.eye(9, dtype=bool)[:, ::-1] & False | (np.arange(81).reshape(9, 9) == 3))
    with pytest.raises(ValueError, match="inner_arcs=True"):
        infer_tensions(cluster(6, 0), edges="arcs")
    with pytest.raises(ValueError, match="'arcs', 'straight', None"):
        infer_tensions(tissue, edges="bent")
    mask = label_image(tissue, 200)
    mirrored = vx.initialise.from_labels(np.maximum(mask, 1), inner_arcs=True)
    with pytest.raises(ValueError, match="must not be mirrored"):
        infer_tensions(mirrored)


@needs_data
@pytest.mark.parametrize(
    ("name", "least", "error"),
    [("movie_0.dmp", 0.998, 0.005), ("cells100.dmp", 0.9995, 0.02), ("movie_6.dmp", 0.997, 0.06)],
)
def test_foams_with_known_tensions(name, least, error):
    path = DATA / "surface_evolver" / name
    result, foam = infer_tensions(path), vx.io.read_surface_evolver(path)
    sure = result.determined
    true = np.asarray(foam.tensions)[sure]
    true = true / true.mean()
    assert pearson(true, result.tensions[sure]) > least
    assert np.mean(np.abs(result.tensions[sure] - true) / true) < error
    # Edges too short for a direction have no arc either: only the prior and neighbours determine them.
    assert np.all(result.tension_deviations[result.short & np.isfinite(result.tensions)] > 0.1)


@needs_data
@pytest.mark.parametrize("ending", [".fe.txt", ""])
def test_dumps_are_recognised_by_their_content(tmp_path, ending):
    dump = DATA / "surface_evolver" / "movie_0.dmp"
    copy = tmp_path / f"foam{ending}"
    copy.write_text(
        dump.read_text(encoding="utf-8").replace("vertices", "Vertices"), encoding="utf-8"
    )
    np.testing.assert_array_equal(infer_tensions(copy).tensions, infer_tensions(dump).tensions)


@pytest.mark.thorough
@needs_data
def test_bends_are_inferred_from_an_image():
    """A foam in motion: the ends of edges determine tensions, arcs through them do not."""
    foam = vx.io.read_surface_evolver(DATA / "surface_evolver" / "movie_6.dmp")
    errors = []
    for shape in (foam, foam.tissue):
        result = infer_tensions(label_image(shape, 1000))
        number = np.append(np.arange(1, foam.tissue.n_cells + 1), 0)
        pairs = np.sort(number[np.asarray(foam.tissue.topology.edge_cells)], axis=1).tolist()
        table = result.edge_table()
        between = np.sort(np.stack([table["left_label"], table["right_label"]], 1), 1).tolist()
        edge = np.array([pairs.index(p) if p in pairs else -1 for p in between])
        use = result.determined & (edge >= 0)
        true = np.asarray(foam.tensions)[edge[use]]
        true, inferred = true / true.mean(), result.tensions[use] / result.tensions[use].mean()
        errors.append(np.mean(np.abs(inferred - true) / true))
        if shape is foam:
            assert pearson(true, inferred) > 0.98
            assert any("the tissue moves" in text for text in result.warnings)
    assert errors[0] < 0.15 < errors[1]


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((20, 20), int), "at least two cells"),
        (np.zeros((2, 2, 2, 2), int), "Pass one plane of a stack"),
        (np.full((9, 9), np.nan), "at least two cells"),
        (np.full((9, 9), np.inf), "whole numbers"),
        (np.pad(np.ones((9, 9), int), 5), "one region"),
        (np.pad(np.repeat([[1, 2]], 9, 0).repeat(9, 1), 5), "three of its cells meet"),
        ("nowhere.tif", "nowhere.tif does not exist"),
        ("nowhere.dmp", "nowhere.dmp"),
    ],
    ids=["zeros", "four axes", "nan", "infinite", "one", "two", "no image", "no dump"],
)
def test_unusable_masks_are_refused(mask, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        infer_tensions(mask)


def test_a_label_in_two_pieces_keeps_the_largest_and_lone_pixels_are_absorbed(foam):
    labels = label_image(foam[0], 300)
    changed = labels.copy()
    # In the middle of other cells.
    for inside, new in ((5, 99), (9, 5)):
        middle = np.rint(np.argwhere(labels == inside).mean(axis=0)).astype(int)
        assert labels[tuple(middle)] == inside
        changed[tuple(middle)] = new
    result = infer_tensions(changed)
    assert result.labels.tolist() == np.unique(labels)[1:].tolist()


@needs_data
@pytest.mark.slow
def test_a_segmented_wing_cut_out_of_a_tissue():
    result = infer_tensions(DATA / "segmentations" / "wing_t0.tif")
    assert result.tissue.n_cells >= 45
    # Outlines are so rough that most are not determined.
    assert 0 < result.determined.sum() < np.isfinite(result.tensions).sum()
    assert result.warnings


def test_the_mean_tension_is_the_unit_and_the_rest_has_a_reason(foam):
    result = infer_tensions(label_image(foam[0], 50))
    assert 0 < result.determined.sum() < np.isfinite(result.tensions).sum()
    assert np.nanmean(result.tensions) == pytest.approx(1)
    assert np.nanmean(result.pressures) == pytest.approx(0, abs=1e-9)
    for table in (result.edge_table(), result.cell_table()):
        np.testing.assert_array_equal(table["reason"] == "", table["determined"])
    assert sum(result.reason_counts.values()) == result.tissue.n_edges
    assert result.reason_counts["too short for a direction"] > 0
