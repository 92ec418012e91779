"""All planes of image files."""

import importlib.util

import numpy as np
import pytest
from PIL import Image

from vertax.io import read_stack

tifffile = pytest.importorskip("tifffile")
MOVIE = np.arange(3 * 5 * 7, dtype=np.uint16).reshape(3, 5, 7)


@pytest.mark.parametrize(
    "options",
    [{"imagej": True, "metadata": {"axes": "TYX"}}, {"photometric": "minisblack"}],
)
def test_the_frames_of_a_movie_are_planes_in_their_order(tmp_path, options):
    tifffile.imwrite(tmp_path / "movie.tif", MOVIE, **options)
    stack = read_stack(tmp_path / "movie.tif")
    assert stack.dtype == MOVIE.dtype
    np.testing.assert_array_equal(stack, MOVIE)


def test_several_axes_of_planes_are_joined_in_the_order_of_the_file(tmp_path):
    deep = np.stack([MOVIE, MOVIE + 500])
    tifffile.imwrite(tmp_path / "deep.tif", deep, imagej=True, metadata={"axes": "TZYX"})
    np.testing.assert_array_equal(read_stack(tmp_path / "deep.tif"), deep.reshape(6, 5, 7))


def test_a_single_image_is_one_plane(tmp_path):
    tifffile.imwrite(tmp_path / "one.tif", MOVIE[1])
    np.testing.assert_array_equal(read_stack(tmp_path / "one.tif"), MOVIE[1:2])
    grey = MOVIE[0].astype(np.uint8)
    Image.fromarray(grey).save(tmp_path / "one.png")
    np.testing.assert_array_equal(read_stack(tmp_path / "one.png"), grey[None])


def test_a_channel_is_chosen_in_all_planes(tmp_path):
    channels = np.stack([MOVIE, MOVIE + 500], axis=1)
    file = tmp_path / "channels.tif"
    tifffile.imwrite(file, channels, imagej=True, metadata={"axes": "TCYX"})
    np.testing.assert_array_equal(read_stack(file, channel=1), MOVIE + 500)
    with pytest.raises(
        ValueError, match=r"holds 2 channels: choose one with the argument `channel`"
    ):
        read_stack(file)
    with pytest.raises(ValueError, match=r"`channel` must lie in 0 … 1"):
        read_stack(file, channel=2)


def test_files_without_an_image_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"Argument `path`.*none\.tif does not exist"):
        read_stack(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("no image")
    with pytest.raises(ValueError, match=r"text\.tif cannot be read as one"):
        read_stack(tmp_path / "text.tif")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.float32])
def test_compressed_pages_are_read(tmp_path, dtype):
    first, *more = [Image.fromarray(plane.astype(dtype)) for plane in MOVIE]
    file = tmp_path / "movie.tif"
    first.save(file, compression="tiff_lzw", save_all=True, append_images=more)
    stack = read_stack(file)
    assert stack.dtype == dtype
    np.testing.assert_array_equal(stack, MOVIE)


def test_compressed_pages_that_pillow_changes_need_imagecodecs(tmp_path):
    file = tmp_path / "inverted.tif"
    Image.fromarray(MOVIE[0].astype(np.uint8)).save(file, compression="tiff_lzw")
    with tifffile.TiffFile(file, mode="r+b") as tiff:
        tiff.pages[0].tags["PhotometricInterpretation"].overwrite(0)
    if importlib.util.find_spec("imagecodecs"):
        pytest.skip("imagecodecs is installed")
    with pytest.raises(ValueError, match=r"inverted\.tif cannot be read as one.*'imagecodecs'"):
        read_stack(file)
