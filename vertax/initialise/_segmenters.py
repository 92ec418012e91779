"""Segmenters: from a membrane image to a label for each pixel."""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int, Shaped
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from vertax._base.checks import check_number
from vertax._base.extras import requires_extra

_SMALLEST_SIDE = 16


Segmenter: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""A function from an image to the label of each pixel, shape `(rows, columns)`, 0 where there is no cell:
`Watershed()`, `Cellpose()`, or one of your own around another segmentation package."""


class Watershed(eqx.Module):
    r"""Watershed of the membrane intensity, one basin a cell; needs no training and no network.

    The logarithm of the image is freed from uneven illumination (its local mean and standard
    deviation over a cell) and smoothed. Each minimum at least `depth` below its lowest way out
    marks a cell (h-minima: Soille 2003, doi:10.1007/978-3-662-05088-0), and the markers are flooded
    (Beucher and Lantuéjoul 1979). Basins smaller than `min_area` go to the neighbour across their
    lowest membrane.

    All lengths are in pixels; whatever is left out follows from the image. Set `cell_size` if the
    automatic estimate misses; more cells come with a smaller `smoothing` or `depth`, fewer with
    larger.

    **Arguments:**

    - `cell_size`: typical diameter of a cell; by default the wavelength at which the spectrum of
        the image peaks.
    - `smoothing`: standard deviation of the Gaussian filter; by default `cell_size / 15`.
    - `depth`: how much darker than its membranes a cell must be, in local standard deviations of
        the image.
    - `min_area`: smallest area of a cell, in square pixels; by default `cell_size**2 / 20`.
    - `dark_membranes`: whether membranes are dark on bright cells instead.

    **Raises:**

    - `ValueError` for sizes that are not positive (`smoothing` and `min_area` may be 0).
    - `ImportError` at the call if scikit-image is missing.
    """

    cell_size: float | None = None
    smoothing: float | None = None
    depth: float = 0.3
    min_area: float | None = None
    dark_membranes: bool = False

    def __check_init__(self):
        for name in ("cell_size", "depth"):
            _check_size(name, getattr(self, name), zero=False)
        for name in ("smoothing", "min_area"):
            _check_size(name, getattr(self, name), zero=True)

    def __call__(
        self, image: Shaped[np.ndarray | Array, " *shape"]
    ) -> Int[np.ndarray, "rows columns"]:
        with requires_extra("image", "Watershed"):
            from skimage import measure, morphology, segmentation
        pixels = check_image(image)
        for name in ("cell_size", "smoothing"):
            length = getattr(self, name)
            if length is not None and length > max(pixels.shape):
                raise ValueError(
                    f"Argument `{name}` of Watershed is in pixels and must be at most the side of the image, "
                    f"{max(pixels.shape)}, but is {length}."
                )
        # The logarithm makes bright and faint membranes comparable; the mean sets where it bends.
        pixels = pixels - pixels.min()
        pixels = np.log1p(pixels / pixels.mean())
        if self.dark_membranes:
            pixels = -pixels
        cell_size = estimate_cell_size(pixels) if self.cell_size is None else self.cell_size
        smoothing = cell_size / 15 if self.smoothing is None else self.smoothing
        min_area = cell_size**2 / 20 if self.min_area is None else self.min_area

        flat = pixels - gaussian_filter(pixels, cell_size / 2)
        spread = np.sqrt(gaussian_filter(flat**2, cell_size))
        # A tenth of the overall spread at least: where there is no membrane, noise stays noise.
        flat = gaussian_filter(flat / np.maximum(spread, 0.1 * np.std(flat)), smoothing)
        markers = np.asarray(measure.label(morphology.h_minima(flat, self.depth)))
        while True:
            labels = np.asarray(segmentation.watershed(flat, markers))
            areas = np.bincount(labels.ravel())
            small = (areas > 0) & (areas < min_area)
            if not small.any() or np.count_nonzero(areas) < 2:
                return labels.astype(np.int64)
            # Only the smallest fifth a round: what it leaves may make its neighbours large enough.
            small &= areas <= np.quantile(areas[small], 0.2)
            markers = np.where(small[markers], 0, markers)


class Cellpose(eqx.Module):
    """The neural network Cellpose-SAM (Pachitariu et al. 2025, doi:10.1101/2025.04.28.651001).

    Needs cellpose 4, which downloads the weights of its model on first use, and is slow without a
    GPU.

    **Arguments:**

    - `model`: name of a model of cellpose, or path of one you trained.
    - `diameter`: typical diameter of a cell in pixels, for images of cells far from 30 pixels.
    - `flow_threshold`: largest error of the flow field of a cell; higher finds more cells.
    - `cellprob_threshold`: lowest score of a pixel of a cell; lower finds more and larger cells.
    - `gpu`: use a GPU if there is one.

    **Raises:**

    - `ValueError` for a diameter that is not positive, and at the call for a model that does not exist.
    - `ImportError` at the call if cellpose 4 or later is missing.
    """

    model: str = "cpsam"
    diameter: float | None = None
    flow_threshold: float = 0.4
    cellprob_threshold: float = 0.0
    gpu: bool = True

    def __check_init__(self):
        _check_size("diameter", self.diameter, zero=False)

    def __call__(
        self, image: Shaped[np.ndarray | Array, " *shape"]
    ) -> Int[np.ndarray, "rows columns"]:
        with requires_extra("cellpose", "Cellpose"):
            models = importlib.import_module("cellpose.models")
        _check_version("cellpose", 4)
        pixels = check_image(image)
        network = models.CellposeModel(gpu=self.gpu, pretrained_model=self.model)
        # (Cellpose replaces a model that does not exist by its default one.)
        used = network.pretrained_model
        if self.model not in (used, Path(used).name):
            raise ValueError(
                f"Argument `model` must be a file or the name of a model of cellpose, but is {self.model!r}, "
                f"which does not exist: cellpose would use {used!r}."
            )
        labels, *_ = network.eval(
            pixels.astype(np.float32),
            diameter=self.diameter,
            flow_threshold=self.flow_threshold,
            cellprob_threshold=self.cellprob_threshold,
        )
        return np.asarray(labels).astype(np.int64)


def check_image(image: Shaped[np.ndarray | Array, " *shape"]) -> Float[np.ndarray, "rows columns"]:
    """The image as floats, if it can be segmented.

    **Raises:**

    - `ValueError` for an image that is not a 2-D array of finite real numbers, has a side shorter
        than 16 pixels, or is constant.
    """
    pixels = np.asarray(image)
    if pixels.ndim != 2:
        raise ValueError(
            "Argument `image` must have shape (rows, columns), but its shape is "
            f"{pixels.shape}. Choose one plane and channel (vertax.io.read_image does it)."
        )
    if pixels.dtype.kind not in "buif":
        raise ValueError(
            f"Argument `image` must hold real numbers, but its dtype is {pixels.dtype}."
        )
    if min(pixels.shape) < _SMALLEST_SIDE:
        raise ValueError(
            f"Argument `image` must have at least {_SMALLEST_SIDE} rows and columns, but its shape "
            f"is {pixels.shape}."
        )
    pixels = pixels.astype(float)
    if not np.isfinite(pixels).all():
        raise ValueError(
            "Argument `image` must be finite, but holds NaN or infinity. Replace such pixels, for "
            "instance by numpy.nan_to_num."
        )
    if pixels.min() == pixels.max():
        raise ValueError(
            f"Argument `image` must show membranes, but all its pixels are {pixels.min():g}."
        )
    return pixels


def estimate_cell_size(image: Float[np.ndarray, "rows columns"]) -> float:
    r"""Typical diameter of the cells of a membrane image, in pixels.

    Cells of diameter $d$ are an almost periodic pattern: the power in each ring $|k|$ of the
    spectrum peaks at $1/d$. Uneven illumination falls off from the lowest frequencies: the peak is
    sought beyond the first minimum. White noise adds a constant power density, which is seen at the
    highest frequencies and subtracted. The image should be at least five cells wide; with fewer the
    peak and the illumination can merge.
    """
    side = min(image.shape)
    window = np.hanning(image.shape[0])[:, None] * np.hanning(image.shape[1])
    power = np.abs(np.fft.rfft2((image - image.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1]))
    ring = np.round(frequency * side).astype(int).ravel()
    density = np.bincount(ring, power.ravel()) / np.maximum(np.bincount(ring), 1)
    noise = density[int(0.4 * side) : side // 2].mean()
    number = np.arange(side // 2)
    # A logarithmic scale, smoothed over a sixth of the frequency: peaks are as wide as that.
    scale = np.geomspace(2, side // 2 - 1, 128)
    total = np.interp(scale, number, (density[: len(number)] - noise) * number)
    total = gaussian_filter1d(total, 0.15 / np.log(scale[1] / scale[0]))
    rising = np.flatnonzero(np.diff(total) > 0)
    start = rising[0] if len(rising) else 0
    return side / float(scale[start + np.argmax(total[start:])])


def _check_size(name: str, value: float | None, *, zero: bool) -> None:
    if value is None:
        return
    check_number(name, value, at_least=0) if zero else check_number(name, value, above=0)


def _check_version(package: str, least: int) -> None:
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # on the path without being installed
        return
    if int(version.split(".")[0]) < least:
        raise ImportError(
            f"Cellpose needs {package} {least} or later, but {version} is installed: "
            f'pip install --upgrade "{package}>={least}".'
        )
