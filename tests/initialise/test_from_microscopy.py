import dataclasses
import importlib.metadata
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from vertax import Periodic
from vertax.initialise import (
    Cellpose,
    Watershed,
    from_labels,
    from_microscopy,
    labels_from_skeleton,
    periodic_voronoi,
)
from vertax.initialise._segmenters import estimate_cell_size
from vertax.io import read_image

skimage_io = pytest.importorskip("skimage.io", reason="scikit-image is not installed")
tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")

REAL_IMAGE = Path(__file__).parents[3] / "shared" / "data" / "epithelium_membrane.tif"


def synthetic_image(
    n: int, size: int, photons: float = 1.0, blur: float = 2.0
) -> tuple[np.ndarray, np.ndarray]:
    """Membranes of a periodic Voronoi tissue, blurred, unevenly lit and noisy; and its mask."""
    key = jax.random.key(n)
    tissue = periodic_voronoi(n, key=key, lattice=size * np.eye(2), lloyd_steps=3, softening=0.0)
    y, x = np.mgrid[:size, :size] + 0.5
    tree = KDTree(np.asarray(tissue.centroids) % size, boxsize=size)
    mask = tree.query(np.stack([x.ravel(), y.ravel()], 1))[1].reshape(size, size) + 1
    membrane = (mask != np.roll(mask, 1, 0)) | (mask != np.roll(mask, 1, 1))
    image = gaussian_filter(membrane.astype(float), blur, mode="wrap")
    image = (20 + 100 * image / image.max()) * (1 + 0.6 * np.sin(2 * np.pi * x / size))
    return np.random.default_rng(0).poisson(photons * image).astype(np.uint16), mask


@pytest.fixture(scope="module")
def small():
    return synthetic_image(30, 200)


@pytest.mark.parametrize(
    ("n", "size", "photons", "blur"),
    [(12, 128, 1.0, 2.0), (100, 256, 0.5, 1.5), (60, 400, 0.1, 4.0)],
)
def test_watershed_recovers_the_cells_without_tuning(n, size, photons, blur):
    image, truth = synthetic_image(n, size, photons, blur)
    got = from_microscopy(image, boundary="periodic", softening=0.0)
    assert got.tissue.n_cells == n
    want = from_labels(truth, boundary="periodic", softening=0.0)
    # Match cells by their centres: there is one of each near one of the other, of about its area.
    tree = KDTree(np.asarray(want.tissue.centroids) % np.sqrt(n), boxsize=np.sqrt(n))
    distance, cell = tree.query(np.asarray(got.tissue.centroids) % np.sqrt(n))
    assert len(np.unique(cell)) == n
    assert distance.max() < 0.15
    ratio = np.asarray(got.tissue.areas) / np.asarray(want.tissue.areas)[cell]
    assert np.abs(ratio - 1).mean() < 0.1


@pytest.mark.parametrize("n", [25, 60, 150])
def test_cell_size_is_estimated_from_the_spectrum(n):
    image, _ = synthetic_image(n, 300)
    assert estimate_cell_size(image.astype(float)) == pytest.approx(300 / np.sqrt(n), rel=0.2)


def test_result_does_not_depend_on_the_brightness(small):
    image = small[0].astype(float)
    assert np.array_equal(Watershed()(image), Watershed()(1e-3 * image))
    assert np.array_equal(Watershed()(image), Watershed()(image - 1000.0))


def test_dark_membranes(small):
    image, truth = small
    inverted = image.max() - image.astype(float)

    def agreement(labels):  # of each true cell, how much lies in a single region
        both = np.stack([truth, labels]).reshape(2, -1)
        pairs, counts = np.unique(both, axis=1, return_counts=True)
        return sum(counts[pairs[0] == c].max() for c in range(1, 31)) / truth.size

    # (Cells that cross the border are in several regions.)
    assert agreement(Watershed()(image)) > 0.8
    assert agreement(Watershed(dark_membranes=True)(inverted)) > 0.8
    assert agreement(Watershed()(inverted)) < 0.6


def test_min_area_merges_small_regions(small):
    image, _ = small
    many = Watershed(smoothing=1.0, depth=0.02, min_area=0.0)(image)
    areas = np.bincount(many.ravel())
    assert areas[areas > 0].min() < 100  # there is something to merge
    merged = Watershed(smoothing=1.0, depth=0.02, min_area=100.0)(image)
    areas = np.bincount(merged.ravel())
    assert areas[areas > 0].min() >= 100
    assert merged.min() > 0


def test_cell_size_sets_the_scale(small):
    image, _ = small
    by_default = len(np.unique(Watershed()(image)))
    assert len(np.unique(Watershed(cell_size=300 / np.sqrt(30))(image))) == pytest.approx(
        by_default, abs=6
    )
    assert len(np.unique(Watershed(cell_size=200.0)(image))) < by_default / 2


def test_mirrored_by_default_and_options_are_passed_on(small):
    got = from_microscopy(small[0], pixel_size=0.5, softening=0.01)
    assert isinstance(got.tissue.boundary, Periodic)
    np.testing.assert_array_equal(got.tissue.boundary.lattice, np.diag([200.0, 200.0]))
    assert float(got.tissue.softening) == 0.01
    assert got.image_shape == (200, 200)
    assert 5 < got.complete.sum() < 25


def test_a_custom_segmenter(small):
    image, truth = small
    got = from_microscopy(image, segmenter=lambda _: truth, softening=0.0)
    want = from_labels(truth, softening=0.0)
    assert np.array_equal(got.labels, want.labels)
    np.testing.assert_array_equal(got.tissue.vertices, want.tissue.vertices)


@pytest.mark.parametrize(
    "labels", [np.ones((200, 200)), np.ones((3, 3), int), np.ones((200, 200, 1), int)]
)
def test_a_segmenter_must_return_integer_labels(small, labels):
    with pytest.raises(ValueError, match=r"Argument `segmenter` must .* <lambda> returned"):
        from_microscopy(small[0], segmenter=lambda _: labels)


def test_error_for_unusable_labels_names_the_segmenter(small):
    labels = np.repeat(np.arange(1, 5), 50)[:, None] + np.zeros((200, 200), int)
    message = (
        r"The labels that <lambda> found in `image` make no tissue\..* the labels 1, 2, 3, 4 do"
    )
    with pytest.raises(ValueError, match=message):
        from_microscopy(small[0], segmenter=lambda _: labels)


@pytest.mark.parametrize("value", [0, 1])
def test_fewer_than_two_cells_found(small, value):
    def fixed(_):
        return np.full((200, 200), value)

    with pytest.raises(ValueError, match=f"at least two cells, but fixed found {value}"):
        from_microscopy(small[0], segmenter=fixed)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((50, 50)), "must show membranes"),
        (np.full((50, 50), np.nan), "must be finite"),
        (np.ones((50, 50, 3)), "must have shape (rows, columns)"),
        (np.ones(50), "must have shape (rows, columns)"),
        (np.eye(15), "at least 16 rows and columns"),
        (np.eye(50) * 1j, "must hold real numbers"),
    ],
)
@pytest.mark.parametrize("use", [from_microscopy, Watershed()])
def test_what_is_not_an_image_is_refused(use, image, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        use(image)


@pytest.mark.parametrize("name", ["cell_size", "smoothing", "depth", "min_area"])
def test_watershed_sizes_must_not_be_negative(name):
    with pytest.raises(ValueError, match=f"Argument `{name}` must be .*, but is -1"):
        Watershed(**{name: -1.0})  # pyright: ignore[reportArgumentType]


def test_unknown_boundary_is_refused(small):
    with pytest.raises(ValueError, match="'mirrored', 'periodic'"):
        from_microscopy(small[0], boundary="open")


def test_missing_scikit_image_is_named(small, monkeypatch):
    for module in ("skimage", "skimage.measure", "skimage.morphology", "skimage.segmentation"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        ImportError, match=re.escape('needs scikit-image: pip install -e ".[image]"')
    ):
        from_microscopy(small[0])


# Cellpose is large and fetches its weights: a stand-in with the same interface.


@pytest.fixture
def fake_cellpose(monkeypatch, small):
    calls = SimpleNamespace(model={}, evaluate={}, image=None)

    class CellposeModel:
        def __init__(self, **options):
            calls.model = options
            name = options["pretrained_model"]
            self.pretrained_model = "models/" + (name if name in ("mine", "cpsam") else "cpsam_v2")

        def eval(self, image, **options):
            calls.image, calls.evaluate = image, options
            return small[1].astype(np.uint16), ["flows"], ["styles"]

    package, models = ModuleType("cellpose"), ModuleType("cellpose.models")
    models.CellposeModel = CellposeModel  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "cellpose", package)
    monkeypatch.setitem(sys.modules, "cellpose.models", models)
    return calls


def test_cellpose_is_called_with_the_options(fake_cellpose, small):
    image, truth = small
    segmenter = Cellpose(model="mine", diameter=40.0, flow_threshold=0.5, gpu=False)
    got = from_microscopy(image, segmenter=segmenter, softening=0.0)
    assert fake_cellpose.model == {"gpu": False, "pretrained_model": "mine"}
    assert fake_cellpose.evaluate == {
        "diameter": 40.0,
        "flow_threshold": 0.5,
        "cellprob_threshold": 0.0,
    }
    np.testing.assert_array_equal(fake_cellpose.image, image)
    # (Cells that cross the border of this periodic image are two cells of the mirrored one.)
    np.testing.assert_array_equal(got.labels, from_labels(truth, softening=0.0).labels)


def test_cellpose_uses_its_own_model_by_default(fake_cellpose, small):
    labels = Cellpose()(small[0])
    assert fake_cellpose.model["pretrained_model"] == "cpsam"
    np.testing.assert_array_equal(labels, small[1])


@pytest.mark.parametrize("model", ["absent", "absent/cpsam_v2"])
def test_a_model_that_cellpose_replaces_is_refused(fake_cellpose, small, model):
    with pytest.raises(ValueError, match=rf"Argument `model` must be a file .* is '{model}'"):
        Cellpose(model=model)(small[0])


def test_a_file_of_a_model_is_taken(fake_cellpose, small):
    np.testing.assert_array_equal(Cellpose(model="models/cpsam_v2")(small[0]), small[1])


def test_missing_cellpose_is_named(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "cellpose", None)
    monkeypatch.setitem(sys.modules, "cellpose.models", None)
    with pytest.raises(ImportError, match=re.escape('pip install -e ".[cellpose]"')):
        from_microscopy(small[0], segmenter=Cellpose())


def test_old_cellpose_is_refused(fake_cellpose, small, monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "3.1.1")
    with pytest.raises(ImportError, match=r"needs cellpose 4 or later, but 3\.1\.1"):
        Cellpose()(small[0])


def test_cellpose_diameter_must_be_positive():
    with pytest.raises(ValueError, match="Argument `diameter` must be positive, but is -5"):
        Cellpose(diameter=-5.0)


# Image files.


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_read_image_gives_back_the_pixels(tmp_path, small, suffix):
    path = tmp_path / f"image{suffix}"
    skimage_io.imsave(path, small[0], check_contrast=False)
    got = read_image(path)
    assert got.dtype == np.uint16
    np.testing.assert_array_equal(got, small[0])


def test_read_image_wants_a_choice_of_channel_and_plane(tmp_path):
    stack = np.random.default_rng(0).integers(0, 255, (4, 3, 20, 30)).astype(np.uint8)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, stack, imagej=True, metadata={"axes": "ZCYX"})
    with pytest.raises(ValueError, match="holds 4 planes: choose one with the argument `plane`"):
        read_image(path)
    with pytest.raises(ValueError, match=r"holds 3 channels: choose .* `channel`, 0 … 2"):
        read_image(path, plane=1)
    np.testing.assert_array_equal(read_image(path, plane=3, channel=2), stack[3, 2])
    with pytest.raises(ValueError, match=r"Argument `channel` must lie in 0 … 2 .* but is 3"):
        read_image(path, plane=1, channel=3)


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_read_image_takes_a_channel_of_a_colour_image(tmp_path, suffix):
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3)).astype(np.uint8)
    path = tmp_path / f"colour{suffix}"
    skimage_io.imsave(path, image, check_contrast=False)
    with pytest.raises(ValueError, match="holds 3 channels"):
        read_image(path)
    np.testing.assert_array_equal(read_image(path, channel=1), image[..., 1])


@pytest.mark.parametrize("suffix", [".tif", ".png"])
@pytest.mark.parametrize("n_channels", [2, 3, 4])
def test_read_image_takes_grey_in_colours_as_it_is(tmp_path, suffix, n_channels):
    grey = np.random.default_rng(0).integers(0, 255, (20, 30)).astype(np.uint8)
    image = np.stack([grey] * n_channels, axis=-1)
    if n_channels in (2, 4):
        image[..., -1] = 255
    path = tmp_path / f"grey{suffix}"
    if suffix == ".png":
        Image.fromarray(image).save(path)
    else:
        photometric = "minisblack" if n_channels == 2 else "rgb"
        extra = ["unassalpha"] if n_channels in (2, 4) else []
        tifffile.imwrite(
            path, image, photometric=photometric, planarconfig="contig", extrasamples=extra
        )
    np.testing.assert_array_equal(read_image(path), grey)
    # Transparency that differs from place to place is a channel.
    if n_channels == 4 and suffix == ".png":
        image[3, 4, -1] = 0
        Image.fromarray(image).save(path)
        with pytest.raises(ValueError, match="holds 4 channels"):
            read_image(path)
        np.testing.assert_array_equal(read_image(path, channel=3), image[..., 3])


def test_read_image_refuses_complex_numbers(tmp_path):
    path = tmp_path / "complex.tif"
    tifffile.imwrite(path, np.full((20, 30), 1 + 2j, np.complex64))
    with pytest.raises(ValueError, match=r"image of real numbers, but .* holds complex64"):
        read_image(path)


@pytest.mark.parametrize("name", ["channel", "plane"])
@pytest.mark.parametrize("index", ["red", 1.5, True])
def test_read_image_refuses_an_index_that_is_none(
    tmp_path, small, name, index, without_type_checks
):
    path = tmp_path / "image.png"
    skimage_io.imsave(path, small[0], check_contrast=False)
    with pytest.raises(TypeError, match=f"`{name}` must be a whole number"):
        read_image(path, **{name: index})


@pytest.mark.parametrize("segmenter", ["watershed", Watershed])
def test_what_is_no_segmenter_is_refused(small, segmenter, without_type_checks):
    with pytest.raises(TypeError, match=r"`segmenter` must be a segmenter, such as Watershed\(\)"):
        from_microscopy(small[0], segmenter=segmenter)


def test_the_smoothing_by_default_is_what_its_documentation_says(small):
    match = re.search(r"by default `cell_size / (\d+)`.\n    - `depth`", Watershed.__doc__ or "")
    assert match is not None
    size = 20.0
    explicit = Watershed(cell_size=size, smoothing=size / int(match[1]))
    np.testing.assert_array_equal(Watershed(cell_size=size)(small[0]), explicit(small[0]))


def test_read_image_names_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.tif does not exist"):
        read_image(tmp_path / "nowhere.tif")


@pytest.mark.parametrize("suffix", [".tif", ".png", ".txt"])
def test_read_image_names_a_file_that_is_no_image(tmp_path, suffix):
    path = tmp_path / f"letter{suffix}"
    path.write_text("Dear reader, this is not an image.")
    with pytest.raises(ValueError, match=rf"letter\{suffix} cannot be read as one"):
        read_image(path)


# The real image.


@pytest.fixture(scope="module")
def real():
    if not REAL_IMAGE.exists():
        pytest.skip("the data folder with epithelium_membrane.tif is not beside the repository")
    return from_microscopy(read_image(REAL_IMAGE))


@pytest.mark.thorough
def test_real_image_shows_as_many_cells_as_the_eye_counts(real):
    # By eye: 75 cells, of which 45 do not touch the border.
    assert 72 <= len(np.unique(real.labels)) <= 78
    assert 42 <= real.complete.sum() <= 48
    assert real.absorbed.size <= 3


def test_real_image_makes_a_sound_tissue(real):
    areas = np.asarray(real.tissue.areas)
    assert areas.min() > 0.05
    assert areas[real.complete].max() < 3 * np.median(areas[real.complete])
    np.testing.assert_allclose(areas.mean(), 1.0, rtol=1e-12)
    counts = np.asarray(real.tissue.neighbour_counts)
    assert counts.mean() == 6
    assert counts[real.complete].min() >= 4
    assert counts[real.complete].max() <= 9
    assert real.inflated.size == 0


def test_real_image_edges_lie_on_membranes(real):
    """The image is brighter along the edges of the tissue than in the middle of its cells."""
    image = gaussian_filter(read_image(REAL_IMAGE).astype(float), 2)
    m = real.tissue.topology
    corners, cell = np.asarray(real.tissue.corners), np.asarray(m.cell)
    inside = real.complete[cell]
    middles = 0.5 * (corners + corners[np.asarray(m.next)])[inside] / real.pixel_size
    centres = np.asarray(real.tissue.centroids)[cell][inside] / real.pixel_size
    at = lambda points: image[tuple(points[:, ::-1].astype(int).T)]
    assert np.mean(at(middles) > at(centres)) > 0.97


@pytest.mark.parametrize("name", ["cell_size", "smoothing"])
def test_lengths_beyond_the_image_are_refused(small, name):
    with pytest.raises(
        ValueError, match=f"`{name}` of Watershed is in pixels .* 200, but is 1000000000"
    ):
        dataclasses.replace(Watershed(), **{name: 1e9})(small[0])


def test_a_segmenter_that_is_a_function_is_called_by_its_name(small):
    def nothing(image):
        return np.zeros(image.shape, int)

    with pytest.raises(ValueError, match="but nothing found 0"):
        from_microscopy(small[0], segmenter=nothing)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.eye(9) * 1j, "must hold real numbers, but its dtype is complex128"),
        (np.full((9, 9), np.nan), "must be finite"),
        (np.full((9, 9), "a"), "must hold real numbers"),
    ],
)
def test_what_is_no_skeleton_is_refused(image, message):
    with pytest.raises(ValueError, match=f"Argument `image` {message}"):
        labels_from_skeleton(image)


@pytest.mark.parametrize("boundary", ["mirrored", "periodic"])
def test_a_segmenter_whose_label_0_may_be_a_cell_is_refused(small, boundary):
    def shifted(image):
        return np.arange(image.size).reshape(image.shape) // (image.size // 8) - 1

    with pytest.raises(ValueError, match="label 0 beside -1"):
        from_microscopy(small[0], segmenter=shifted, boundary=boundary)
