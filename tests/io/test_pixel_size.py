"""Sizes of pixels in TIFF files."""

import numpy as np
import pytest

from vertax.io import pixel_aspect, pixel_size

tifffile = pytest.importorskip("tifffile")
PIXELS = np.zeros((5, 7), np.uint16)


def ome(**sizes):
    return {"metadata": {"axes": "YX"} | {f"PhysicalSize{name}": s for name, s in sizes.items()}}


def per_cm(x, y):
    return {"resolution": (x, y), "resolutionunit": "CENTIMETER"}


CASES = {
    "OME": ("a.ome.tif", ome(X=0.2, Y=0.24), (0.24, 0.2), 1.2),
    "OME in two units": ("a.ome.tif", ome(X=0.2, Y=240.0, YUnit="nm"), (0.24, 0.2), 1.2),
    "OME without a length": (
        "a.ome.tif",
        ome(X=1.0, XUnit="pixel", Y=2.0, YUnit="pixel"),
        None,
        1.0,
    ),
    "OME before the dots of a screen": (
        "a.ome.tif",
        ome(X=0.2, Y=0.24) | {"resolution": (72, 72), "resolutionunit": "INCH"},
        (0.24, 0.2),
        1.2,
    ),
    "OME and equal tags": (
        "a.ome.tif",
        ome(X=0.2, Y=0.24) | per_cm(5e4, 1e4 / 0.24),
        (0.24, 0.2),
        1.2,
    ),
    "tags per cm": ("a.tif", per_cm(5e4, 4e4), (0.25, 0.2), 1.25),
    "screen, per cm": ("a.tif", per_cm(28.35, 37.8), None, 1.0),
    "screen, per inch": ("a.tif", {"resolution": (96, 72), "resolutionunit": "INCH"}, None, 1.0),
    "printer": ("a.tif", {"resolution": (300, 300), "resolutionunit": "INCH"}, None, 1.0),
    "ratio": ("a.tif", {"resolution": (1.0, 2.0)}, None, 0.5),
    "none": ("a.tif", {}, None, 1.0),
}
for unit, length in {"um": 1.0, "micron": 1.0, "\\u00B5m": 1.0, "nm": 1e-3, "pixel": None}.items():
    size = None if length is None else (length / 2.5, length / 5)
    options = {"imagej": True, "resolution": (5, 2.5), "metadata": {"unit": unit}}
    CASES[f"ImageJ, {unit}"] = ("a.tif", options, size, 2.0)


@pytest.mark.parametrize(("name", "options", "size", "ratio"), CASES.values(), ids=CASES)
def test_metadata_of_tiff_files(tmp_path, name, options, size, ratio):
    tifffile.imwrite(tmp_path / name, PIXELS, **options)
    read = pixel_size(tmp_path / name)
    assert read == (size if size is None else pytest.approx(size, rel=1e-4))
    assert pixel_aspect(tmp_path / name) == pytest.approx(ratio, rel=1e-4)


@pytest.mark.parametrize(
    "tags", [per_cm(5e4, 5e4), per_cm(5e5, 5e5 / 1.2), {"resolution": (1.0, 2.0)}]
)
def test_metadata_that_contradict_each_other_are_named(tmp_path, tags):
    tifffile.imwrite(tmp_path / "a.ome.tif", PIXELS, **ome(X=0.2, Y=0.24), **tags)
    with pytest.warns(
        UserWarning, match=r"a pixel are 0\.24 × 0\.2 µm by the OME.*, but .* `pixel_size`"
    ):
        assert pixel_aspect(tmp_path / "a.ome.tif") == pytest.approx(1.2)


def test_other_files_have_no_pixel_size(tmp_path):
    assert pixel_size(tmp_path / "a.png") is None
    assert pixel_aspect(tmp_path / "a.png") == 1
