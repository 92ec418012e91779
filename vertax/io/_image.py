"""Microscopy images from files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Integer, Shaped

from vertax._base.checks import check_integer
from vertax._base.extras import requires_extra

TIFF_ENDINGS = (".tif", ".tiff")


def read_image(
    path: str | os.PathLike[str], *, channel: int | None = None, plane: int | None = None
) -> Shaped[np.ndarray, "rows columns"]:
    """Read one two-dimensional image from a TIFF, PNG, JPEG, … file, with the number type of the file.

    A grey image stored as a colour image (three equal channels) needs no `channel`. A constant alpha
    channel is ignored.

    **Arguments:**

    - `path`: the file.
    - `channel`: which channel of a colour or multi-channel image, from 0.
    - `plane`: which plane of a stack (of depths, times or pages), from 0; if it has several such
        axes, the planes are counted in the order of the file.

    **Returns:** the pixels, shape (rows, columns).

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` if it is not an image of real numbers, if it has several channels or planes and the
        argument is missing, or if there is no such channel or plane.
    - `TypeError` for a channel or plane that is not an integer.
    - `ImportError` if the package that reads the file is not installed: the extra `[image]`.
    """
    file = Path(path)
    pixels = _planes_and_channels(file, channel=channel, plane=plane)
    chosen_plane = _choose("plane", plane, len(pixels), file)
    return _one_channel(pixels[chosen_plane : chosen_plane + 1], channel, file)[0]


def read_stack(
    path: str | os.PathLike[str], *, channel: int | None = None
) -> Shaped[np.ndarray, "planes rows columns"]:
    """Read all planes of an image file: the frames of a movie (TYX), depths or pages.

    **Arguments:**

    - `path`: the file.
    - `channel`: which channel of a colour or multi-channel image, from 0.

    **Returns:** the pixels, shape (planes, rows, columns); one plane for a single image. Several axes of
    planes are joined in the order of the file.

    **Raises:** as [`read_image`][vertax.io.read_image].
    """
    file = Path(path)
    return _one_channel(_planes_and_channels(file, channel=channel), channel, file)


def _planes_and_channels(
    file: Path, **choices: int | None
) -> Shaped[np.ndarray, "planes channels rows columns"]:
    """All pixels of a file."""
    if not file.exists():
        raise FileNotFoundError(
            f"Argument `path` must name an image file, but {file} does not exist."
        )
    for name, index in choices.items():
        if index is not None:
            check_integer(name, index)
    pixels, axes = _read(file)
    if pixels.dtype.kind not in "biuf":
        raise ValueError(
            f"Argument `path` must name an image of real numbers, but {file} holds {pixels.dtype}. Save "
            "real numbers, such as numpy.abs of complex ones, as another file."
        )
    rows, columns = axes.index("Y"), axes.index("X")
    channels = [i for i, axis in enumerate(axes) if axis in "CS"]
    planes = [i for i in range(len(axes)) if i not in (rows, columns, *channels)]
    pixels = pixels.transpose(*planes, *channels, rows, columns)
    image = pixels.shape[-2:]
    n_planes = int(np.prod(pixels.shape[: len(planes)], dtype=int))
    return pixels.reshape(n_planes, -1, *image)


def _one_channel(
    pixels: Shaped[np.ndarray, "planes channels rows columns"], channel: int | None, file: Path
) -> Shaped[np.ndarray, "planes rows columns"]:
    """The chosen channel; of several that are equal, the first."""
    first = pixels[:, 0]
    if channel is None and all(np.array_equal(other, first) for other in pixels.swapaxes(0, 1)[1:]):
        return first
    return pixels[:, _choose("channel", channel, pixels.shape[1], file)]


def _read(file: Path) -> tuple[np.ndarray, str]:
    """All pixels of the file, and a letter for each axis."""
    try:
        pixels, axes = (_read_tiff if file.suffix.lower() in TIFF_ENDINGS else _read_picture)(file)
        if pixels.ndim != len(axes) or not {"Y", "X"} <= set(axes):
            raise ValueError(f"its axes are {axes} with shape {pixels.shape}")
    except ImportError:
        raise
    except Exception as error:  # of another type for each reader
        raise ValueError(
            f"Argument `path` must name an image file, but {file} cannot be read as one: {error}"
        ) from error
    return pixels, axes


def _read_tiff(file: Path) -> tuple[np.ndarray, str]:
    with requires_extra("image", "Reading TIFF files"):
        import tifffile
    with tifffile.TiffFile(file) as tiff:
        series = tiff.series[0]
        axes = series.axes
        try:
            pixels = series.asarray()
        except (ValueError, ImportError) as error:  # a compression for imagecodecs
            try:
                pixels = _decoded_by_pillow(file, series)
            except Exception:
                raise ValueError(str(error)) from error
        extra = len(getattr(series.keyframe, "extrasamples", ()))
    if axes.endswith("S") and extra == 1:
        pixels = _without_transparency(pixels)
    return pixels, axes


def _decoded_by_pillow(file: Path, series: Any) -> np.ndarray:
    """The pixels of a series of a TIFF file, decompressed by Pillow (LZW, JPEG, CCITT)."""
    from PIL import Image

    pages = []
    with Image.open(file) as picture:
        for page in series.pages:
            picture.seek(page.index)
            pages.append(np.asarray(picture))
            # Pillow reduces colours of 16 bits to 8, and inverts grey values of which 0 is white.
            if pages[-1].itemsize < series.dtype.itemsize or page.photometric == 0:
                raise ValueError("Pillow changes the pixels")
    return np.reshape(pages, series.shape).astype(series.dtype)


def _read_picture(file: Path) -> tuple[np.ndarray, str]:
    with requires_extra("image", "Reading pictures"):
        from PIL import Image

    with Image.open(file) as picture:
        # Palette indices are not intensities.
        pixels = np.asarray(picture.convert("RGB") if picture.mode == "P" else picture)
        transparent = pixels.ndim == 3 and picture.mode.endswith(("A", "a"))
    if transparent:
        pixels = _without_transparency(pixels)
    return pixels, "YX" if pixels.ndim == 2 else "YXS"


def read_colours(file: Path, plane: int | None) -> Shaped[np.ndarray, "rows columns *colours"]:
    """One plane of an image of labels, with three colours if it has several channels.

    Of a picture with a palette the indices, if they are labels.

    **Raises:** as [`read_image`][vertax.io.read_image], and `ValueError` for two channels.
    """
    pixels = _planes_and_channels(file, plane=plane)
    channels = pixels[_choose("plane", plane, len(pixels), file)]
    indices = _palette_indices(file)
    if indices is not None:
        return indices
    if all(np.array_equal(channel, channels[0]) for channel in channels[1:]):
        return channels[0]
    if len(channels) == 2:
        raise ValueError(
            f"Argument `path` must name a file of labels or colours, but {file} has two channels. Pass one: "
            "vx.io.read_image(file, channel=0)."
        )
    return np.moveaxis(channels[:3], 0, -1)


def _palette_indices(file: Path) -> Integer[np.ndarray, "rows columns"] | None:
    """The indices of a picture with a palette, where they are labels: where index 0 is black, or two indices
    have one colour. None for another file."""
    if file.suffix.lower() in TIFF_ENDINGS:  # its indices are its pixels
        return None
    from PIL import Image

    with Image.open(file) as picture:
        if picture.mode != "P":
            return None
        indices, palette = np.asarray(picture), picture.getpalette("RGB") or []
    colours = np.reshape(palette, (-1, 3))[np.unique(indices)]
    repeat = len(np.unique(colours, axis=0)) < len(colours)
    return indices if repeat or not any(palette[:3]) else None


def _without_transparency(
    pixels: Shaped[np.ndarray, "*shape samples"],
) -> Shaped[np.ndarray, "*shape fewer_samples"]:
    """Drop the last channel if it is constant."""
    alpha = pixels[..., -1]
    return pixels[..., :-1] if np.all(alpha == alpha.flat[0]) else pixels


def _choose(name: str, index: int | None, n: int, file: Path) -> int:
    if index is None:
        if n == 1:
            return 0
        raise ValueError(
            f"{file} holds {n} {name}s: choose one with the argument `{name}`, 0 … {n - 1}."
        )
    if not 0 <= index < n:
        raise ValueError(f"Argument `{name}` must lie in 0 … {n - 1} for {file}, but is {index}.")
    return index
