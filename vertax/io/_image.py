"""Microscopy images from files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from vertax._base.extras import needing

_TIFF = (".tif", ".tiff")


def read_image(
    path: str | os.PathLike[str], *, channel: int | None = None, plane: int | None = None
) -> Shaped[np.ndarray, "rows columns"]:
    """One two-dimensional image from a TIFF, PNG, JPEG, … file, in the numbers it is stored in.

    **Arguments:**

    - `path`: the file.
    - `channel`: which channel of a colour or multi-channel image, from 0.
    - `plane`: which plane of a stack (of depths, times or pages), from 0; if it has several such
        axes, the planes are counted in the order of the file.

    **Returns:** the pixels, shape (rows, columns).

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` if it is not an image, if it has channels or planes and none was chosen, or not
        the one that was.
    - `ImportError` if what reads the file is not installed: the extra `[image]`.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(
            f"Argument `path` must name an image file, but {file} does not exist."
        )
    pixels, axes = _read(file)
    rows, columns = axes.index("Y"), axes.index("X")
    channels = [i for i, axis in enumerate(axes) if axis in "CS"]
    planes = [i for i in range(len(axes)) if i not in (rows, columns, *channels)]
    pixels = pixels.transpose(*planes, *channels, rows, columns)
    image = pixels.shape[-2:]
    n_planes = int(np.prod(pixels.shape[: len(planes)], dtype=int))
    pixels = pixels.reshape(n_planes, -1, *image)
    chosen_plane = _choose("plane", plane, n_planes, file)
    chosen_channel = _choose("channel", channel, pixels.shape[1], file)
    return pixels[chosen_plane, chosen_channel]


def _read(file: Path) -> tuple[np.ndarray, str]:
    """The whole file, and a letter for each of its axes."""
    try:
        pixels, axes = (_read_tiff if file.suffix.lower() in _TIFF else _read_picture)(file)
        if pixels.ndim != len(axes) or not {"Y", "X"} <= set(axes):
            raise ValueError(f"its axes are {axes} with shape {pixels.shape}")
    except ImportError:
        raise
    except Exception as error:  # each reader has exceptions of its own for what it cannot decode
        raise ValueError(
            f"Argument `path` must name an image file, but {file} cannot be read as one: {error}"
        ) from error
    return pixels, axes


def _read_tiff(file: Path) -> tuple[np.ndarray, str]:
    with needing("image", "Reading TIFF files"):
        import tifffile
    with tifffile.TiffFile(file) as tiff:
        return tiff.series[0].asarray(), tiff.series[0].axes


def _read_picture(file: Path) -> tuple[np.ndarray, str]:
    with needing("image", "Reading pictures"):
        from PIL import Image

    with Image.open(file) as picture:
        # Palette indices are no intensities.
        pixels = np.asarray(picture.convert("RGB") if picture.mode == "P" else picture)
    return pixels, "YX" if pixels.ndim == 2 else "YXS"


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
