"""Sizes of pixels in the metadata of TIFF files."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from vertax._base.extras import requires_extra
from vertax.io._image import TIFF_ENDINGS

# Inches are those of screens and printers, which are not calibrated.
_MICROMETRES = {"m": 1e6, "cm": 1e4, "mm": 1e3, "µm": 1.0, "nm": 1e-3}
_NAMES = {"μm": "µm", "um": "µm", "micron": "µm", "microns": "µm", "micrometer": "µm"}
_INCH = 25400.0
# Dots per inch of screens.
_SCREENS = (72, 96)
# Values of the tag `ResolutionUnit`.
_UNIT_OF_TAG = {2: "inch", 3: "cm"}


class _Sides(NamedTuple):
    """Height and width of a pixel."""

    height: float
    width: float
    calibrated: bool
    """Whether they are micrometres; otherwise only their ratio is stated."""

    def __str__(self) -> str:
        return f"{self.height:g} × {self.width:g}{' µm' if self.calibrated else ''}"


def pixel_size(path: str | os.PathLike[str]) -> tuple[float, float] | None:
    """Height and width of the pixels of a TIFF file in micrometres, from OME metadata (`PhysicalSizeX`,
    `PhysicalSizeY`), the unit of ImageJ, or resolution tags per centimetre.

    A warning names resolution tags that contradict OME metadata, which then count.

    **Arguments:**

    - `path`: the file.

    **Returns:** (height, width), as the argument `pixel_size` of
    [`from_labels`][vertax.initialise.from_labels]; None for a file that states no size (resolutions per inch
    are those of screens and printers), and for other formats.
    """
    sides = _sides(Path(path))
    return (sides.height, sides.width) if sides is not None and sides.calibrated else None


def pixel_aspect(path: str | os.PathLike[str]) -> float:
    """Height over width of the pixels of a TIFF file, see [`pixel_size`][vertax.io.pixel_size].

    **Arguments:**

    - `path`: the file.

    **Returns:** the ratio, also where the unit is not stated; 1 where the file has none, or 72 and 96 dots
    per inch.
    """
    sides = _sides(Path(path))
    return 1.0 if sides is None else sides.height / sides.width


def _sides(file: Path) -> _Sides | None:
    if file.suffix.lower() not in TIFF_ENDINGS:
        return None
    with requires_extra("image", "Reading TIFF files"):
        import tifffile
    with tifffile.TiffFile(file) as tiff:
        ome = _of_ome(tiff.ome_metadata)
        tags = _of_tags(tiff)
    if ome is None or tags is None:
        return ome or tags
    ratios = [ome.height / tags.height, ome.width / tags.width]
    if not tags.calibrated:
        ratios = [ratios[0] / ratios[1]]
    if np.max(np.abs(np.log(ratios))) > 0.01:
        warnings.warn(
            f"{file}: the height and width of a pixel are {ome} by the OME metadata, but {tags} by the "
            "resolution tags. The former are used: pass `pixel_size` if they are wrong.",
            stacklevel=3,
        )
    return ome


def _of_ome(metadata: str | None) -> _Sides | None:
    pixels = None if metadata is None else ElementTree.fromstring(metadata).find(".//{*}Pixels")
    if pixels is None:
        return None
    sides = []
    for axis in "YX":
        unit = pixels.get(f"PhysicalSize{axis}Unit", "µm")
        length = _MICROMETRES.get(_NAMES.get(unit, unit), np.nan)
        sides.append(float(pixels.get(f"PhysicalSize{axis}", "nan")) * length)
    height, width = sides
    return _Sides(height, width, True) if min(sides) > 0 else None


def _of_tags(tiff: Any) -> _Sides | None:
    tags = tiff.pages.first.tags
    # Pixels per unit of length along y and x, as fractions.
    entries = [tags.get(name) for name in ("YResolution", "XResolution")]
    if any(tag is None or 0 in tag.value for tag in entries):
        return None
    height, width = [tag.value[1] / tag.value[0] for tag in entries]
    unit_tag = tags.get("ResolutionUnit")
    unit = _UNIT_OF_TAG.get(2 if unit_tag is None else int(unit_tag.value))
    unit = str((tiff.imagej_metadata or {}).get("unit", unit)).replace("\\u00B5", "µ")
    length = _MICROMETRES.get(_NAMES.get(unit, unit))
    per_inch = _INCH / (length or _INCH)
    dots = [per_inch / height, per_inch / width]
    if (length is None and height == width) or all(round(dot) in _SCREENS for dot in dots):
        return None
    return _Sides(height * (length or 1.0), width * (length or 1.0), length is not None)
