"""A layer of tensions for napari (https://napari.org), inferred from a layer of labels."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib import colormaps

from vertax._base.pixels import pixel_sides
from vertax.plotting._colours import Colours
from vertax.tensions import InferredTensions

_POINTS = 13
_UNKNOWN = (0.5, 0.5, 0.5, 1.0)
# Width of edges, relative to the diameter of a cell.
_WIDTH = 0.08


def tension_layer(inferred: InferredTensions, *, colours: str = "plasma") -> tuple[Any, Any, str]:
    """The edges of an image, coloured by their tension, as a layer for napari.

    ```python
    data, options, kind = vx.plotting.tension_layer(inferred)
    viewer.add_shapes(data, **options)
    ```

    **Arguments:**

    - `inferred`: the tensions inferred from an image.
    - `colours`: name of a colour map of Matplotlib. Edges that are not determined are grey.

    **Returns:** points on each edge in pixels, row and column; options of the layer, with the table of edges
    as `features`, of which `determined_tension` gives the colours; and its kind, `"shapes"`.

    **Raises:**

    - `ValueError` for tensions of a tissue without an image.
    """
    sides = sides_of_pixels(inferred)
    course = edge_courses(inferred) / sides
    tensions = np.where(inferred.determined, inferred.tensions, np.nan)
    diameter = np.sqrt(np.mean(np.asarray(inferred.tissue.areas)) / sides.prod())
    options = {
        "name": "tensions",
        "shape_type": "path",
        "face_color": "transparent",
        "opacity": 1.0,
        "edge_width": max(1.0, _WIDTH * float(diameter)),
        "features": inferred.edge_table() | {"determined_tension": tensions},
        "metadata": {"vertax": inferred},
        **tension_colours(tensions, colours),
    }
    # In napari the middle of a pixel has integer coordinates, in vertax its corner; and rows come first.
    return list(course[..., ::-1] - 0.5), options, "shapes"


def edge_courses(inferred: InferredTensions) -> Float[np.ndarray, "edges points 2"]:
    """Points on each edge, in units of length."""
    fractions = jnp.linspace(0.0, 1.0, _POINTS, dtype=inferred.tissue.vertices.dtype)
    return np.asarray(inferred.tissue.edge_points(fractions), float)


def sides_of_pixels(inferred: InferredTensions) -> Float[np.ndarray, " xy"]:
    """Width and height of the pixels; a `ValueError` for tensions of a tissue without an image."""
    if inferred.pixel_size is None:
        raise ValueError(
            "Argument `inferred` must come from an image, but has no pixels. "
            "vx.plot_tissue draws it."
        )
    return pixel_sides(inferred.pixel_size)


def tension_colours(tensions: np.ndarray, colours: str) -> dict[str, Any]:
    """Options of a layer of shapes that colour edges by their feature `determined_tension`."""
    return {
        "edge_color": "determined_tension",
        "edge_colormap": {
            "colors": colormaps[colours](np.linspace(0, 1, 256)),
            "name": f"tension ({colours})",
            "nan_color": _UNKNOWN,
        },
        "edge_contrast_limits": limits(tensions),
    }


def limits(values: np.ndarray) -> tuple[float, float]:
    """Limits of the colours: the smallest and the largest finite value, or 0 and 1."""
    low, high = Colours().limits(values)
    return low, max(high, low + 1e-6)
