"""Free tissues from images, in files and in pictures."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from free_helpers import cluster
from helpers import NO_CONTACT
from label_helpers import honeycomb
from matplotlib.collections import PolyCollection

import vertax as vx
from vertax.initialise import from_labels, from_microscopy, labels_from_skeleton
from vertax.plotting import cell_polygons, plot_tissue

SKELETON = Path(__file__).parents[3] / "shared" / "data" / "epithelium_skeleton.tif"


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


def round_cells(seed=0, n=12, size=200, radius=22):
    """Cells of a random cluster, cut at a radius about their seeds."""
    rng = np.random.default_rng(seed)
    seeds = rng.random((n, 2)) * size / 2 + size / 4
    y, x = np.mgrid[:size, :size] + 0.5
    distance = np.hypot(x[..., None] - seeds[:, 0], y[..., None] - seeds[:, 1])
    return np.where(distance.min(-1) < radius, distance.argmin(-1) + 1, 0)


def pairs_of(mask):
    """Labels that share a pixel side, background included."""
    pairs = set()
    for a, b in ((mask[1:], mask[:-1]), (mask[:, 1:], mask[:, :-1])):
        pairs |= {(min(p), max(p)) for p in zip(a.flat, b.flat, strict=True)}
    return {(int(a), int(b)) for a, b in pairs if a != b}


def pairs_in(segmentation):
    names = np.append(segmentation.labels, 0)
    pairs = names[np.asarray(segmentation.tissue.topology.edge_cells)]
    return {(min(p), max(p)) for p in pairs.tolist()}


@pytest.mark.parametrize("seed", [6, 10])  # without holes
def test_a_cluster_of_round_cells(seed):
    mask = round_cells(seed)
    made = from_labels(mask, boundary="free", pixel_size=1.0, gap_width=0.0)
    made.tissue.topology.validate()
    assert isinstance(made.tissue.boundary, vx.Free)
    # Isolated cells and smaller clusters are dropped.
    kept = set(made.labels.tolist()) | {0}
    assert len(kept) > 8
    assert pairs_in(made) == {(a, b) for a, b in pairs_of(mask) if {a, b} <= kept}
    assert set(made.absorbed) == set(range(1, 13)) - kept
    pixels = np.bincount(mask.ravel())[made.labels]
    np.testing.assert_allclose(made.tissue.areas, pixels, rtol=0.06, atol=25)
    np.testing.assert_allclose(made.tissue.areas.sum(), pixels.sum(), rtol=1e-3)
    assert made.complete.all()


def test_gaps_between_cells_and_holes_are_not_exterior():
    mask = round_cells(0)
    uncut = from_labels(mask, boundary="free", pixel_size=1.0)
    inner = np.zeros_like(mask, bool)
    for axis in (0, 1):
        other = np.roll(mask, 1, axis)
        inner |= (mask != other) & (mask > 0) & (other > 0)
    cut = from_labels(np.where(inner, 0, mask), boundary="free", pixel_size=1.0)
    assert pairs_in(cut) == pairs_in(uncut)
    y, x = np.argwhere(mask == uncut.labels[3]).mean(0).astype(int)
    holed = mask.copy()
    holed[y - 4 : y + 5, x - 4 : x + 5] = 0
    np.testing.assert_array_equal(
        from_labels(holed, boundary="free", pixel_size=1.0).tissue.topology.twin,
        uncut.tissue.topology.twin,
    )


def test_cells_at_the_border_of_the_image_are_not_whole():
    made = from_labels(honeycomb(), boundary="free")
    # (Cells that cross the border of this periodic mask are two cells.)
    assert made.report is not None
    new = made.report.of_kind("new cell")
    assert made.tissue.n_cells == 30 - len(made.absorbed) + len(new)
    assert not made.complete.all()
    assert made.complete.any()
    assert made.tissue.areas.mean() == pytest.approx(1, rel=0.02)


def test_masks_without_a_cluster_are_refused():
    one = np.zeros((30, 30), int)
    one[5:15, 5:15] = 1
    two = one.copy()
    two[20:25, 20:25] = 2  # apart
    for mask in (two, np.where(one, 1, np.pad(np.full((28, 28), 2), 1))):  # one inside the other
        with pytest.raises(ValueError, match="must hold enough cells"):
            from_labels(mask, boundary="free")
    with pytest.raises(ValueError, match="`gap_width` must be at least 0"):
        from_labels(two, boundary="free", gap_width=-1.0)


def test_labels_of_a_skeleton():
    image = np.zeros((9, 12), np.uint8)
    image[2, 2:9] = image[6, 2:9] = image[2:7, 2] = image[2:7, 5] = image[2:7, 8] = 255
    expected = np.zeros_like(image)
    expected[3:6, 3:5], expected[3:6, 6:8] = 1, 2
    np.testing.assert_array_equal(labels_from_skeleton(image), expected)
    framed = image.copy()
    framed[[0, -1]] = framed[:, [0, -1]] = 255
    np.testing.assert_array_equal(labels_from_skeleton(framed), expected)
    with pytest.raises(ValueError, match="closed lines"):
        labels_from_skeleton(0 * image)
    with pytest.raises(ValueError, match="at least 3 × 3"):
        labels_from_skeleton(image[0])


@pytest.mark.thorough
@pytest.mark.skipif(not SKELETON.is_file(), reason=f"{SKELETON.name} is not here")
def test_a_cluster_from_a_real_skeleton():
    pytest.importorskip("tifffile")
    labels = labels_from_skeleton(vx.io.read_image(SKELETON))
    made = from_labels(labels, boundary="free")
    tissue = made.tissue
    assert tissue.n_cells == 15
    assert len(made.absorbed) == 0
    pixels = np.bincount(labels.ravel())[made.labels] * np.prod(vx.io.pixel_sides(made.pixel_size))
    np.testing.assert_allclose(tissue.areas, pixels, rtol=0.15)
    energy = vx.energies.AreaElasticity(20.0, pixels) + vx.energies.LineTension(1.0)
    assert NO_CONTACT(tissue, energy).tissue.areas.min() > 0.3


def test_from_microscopy_passes_the_boundary_on():
    mask = round_cells(0)

    made = from_microscopy(mask.astype(float), segmenter=lambda _: mask, boundary="free")
    assert isinstance(made.tissue.boundary, vx.Free)


@pytest.mark.parametrize("inner_arcs", [False, True])
def test_file_round_trip_is_exact(tmp_path, inner_arcs):
    tissue = cluster(7, 2, inner_arcs=inner_arcs)
    tissue = eqx.tree_at(
        lambda t: t.pinned, tissue, jnp.arange(12) % 5 == 0, is_leaf=lambda x: x is None
    )
    vx.save(tmp_path / "free.npz", tissue)
    assert eqx.tree_equal(vx.load(tmp_path / "free.npz", vx.Tissue), tissue)
    straight = vx.Tissue(tissue.vertices, tissue.topology, vx.Free())
    vx.save(tmp_path / "straight.npz", straight)
    assert eqx.tree_equal(vx.load(tmp_path / "straight.npz", vx.Tissue), straight)


def test_polygons_follow_the_arcs():
    tissue = cluster(8, 1, random_angles=True)
    polygons, counts = cell_polygons(tissue)
    np.testing.assert_array_equal(counts, 24 * np.asarray(tissue.neighbour_counts))
    x, y = np.moveaxis(polygons, -1, 0)
    areas = 0.5 * np.sum(x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1), axis=1)
    np.testing.assert_allclose(areas, tissue.areas, rtol=5e-3)


def test_pictures_of_free_tissues():
    tissue = cluster(8, 1)
    ax = plot_tissue(tissue, cells=tissue.areas, edges=tissue.edge_lengths)
    faces = next(c for c in ax.collections if isinstance(c, PolyCollection))
    assert len(faces.get_paths()) == 8
    points = np.asarray(tissue.edge_points(jnp.linspace(0, 1, 30))).reshape(-1, 2)
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    assert (points > [x0, y0]).all()
    assert (points < [x1, y1]).all()
    ax = plot_tissue(tissue, mask=np.arange(8) < 3)
    assert len(next(c for c in ax.collections if isinstance(c, PolyCollection)).get_paths()) == 3
