"""A layer of tensions for napari (https://napari.org), inferred from a layer of labels."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize

from vertax._base.compilation_cache import enable_compilation_cache
from vertax._base.pixels import pixel_sides
from vertax.inference import InferredTensions, infer_tensions

_POINTS = 13
_UNKNOWN = (0.5, 0.5, 0.5, 1.0)


def tension_layer(inferred: InferredTensions, *, colours: str = "viridis") -> tuple[Any, dict, str]:
    """The edges of an image, coloured by their tension, as a layer for napari.

    ```python
    data, options, kind = vx.plotting.tension_layer(inferred)
    viewer.add_shapes(data, **options)
    ```

    **Arguments:**

    - `inferred`: the tensions inferred from an image.
    - `colours`: name of a colour map. Edges that are not determined are grey.

    **Returns:** points on each edge in pixels, row and column; options of the layer, with the table of edges
    as `features`; and its kind, `"shapes"`.

    **Raises:**

    - `ValueError` for tensions of a tissue without an image.
    """
    if inferred.pixel_size is None:
        raise ValueError(
            "Argument `inferred` must come from an image, but has no pixels. "
            "vx.plot_tissue draws it."
        )
    fractions = jnp.linspace(0.0, 1.0, _POINTS, dtype=inferred.tissue.vertices.dtype)
    course = np.asarray(inferred.tissue.edge_points(fractions), float) / pixel_sides(
        inferred.pixel_size
    )
    determined = inferred.tensions[inferred.determined]
    scale = Normalize(*(determined.min(), determined.max()) if determined.size else (0.0, 1.0))
    colour = colormaps[colours](scale(np.where(inferred.determined, inferred.tensions, 0.0)))
    colour[~inferred.determined] = _UNKNOWN
    # In napari the middle of a pixel has integer coordinates, in vertax its corner; and rows come first.
    options = {
        "name": "tensions",
        "shape_type": "path",
        "edge_color": colour,
        "face_color": "transparent",
        "edge_width": 2,
        "features": inferred.edge_table(),
        "metadata": {"vertax": inferred},
    }
    return list(course[..., ::-1] - 0.5), options, "shapes"


def napari_tensions(
    cells: "napari.layers.Labels",  # pyright: ignore[reportUndefinedVariable]
) -> "list[napari.types.LayerDataTuple]":  # pyright: ignore[reportUndefinedVariable]
    """Tensions of the edges between labels: the widget of napari.

    **Arguments:**

    - `cells`: a layer of labels.

    **Returns:** a layer of edges, and one of labels with the table of cells.
    """
    import napari.utils.notifications as notifications  # pyright: ignore[reportMissingImports]
    from napari.utils import progress  # pyright: ignore[reportMissingImports]

    enable_compilation_cache()
    # A stack of one plane is an image: the last two axes are rows and columns.
    mask, plane = np.asarray(cells.data), tuple(cells.scale[-2:])
    # The size of a pixel matters only where it is not square: tensions are relative.
    pixels: dict[str, Any] = {}
    if not np.isclose(*plane):
        n_labels = np.count_nonzero(np.unique(mask) > 0)
        side = np.sqrt(n_labels / np.count_nonzero(mask > 0) / np.prod(plane))
        pixels["pixel_size"] = tuple((side * np.array(plane)).tolist())
    # The activity dock is drawn before the computation, which blocks the window.
    with progress(total=1, desc="vertax: tensions (first compiles for this size)"):
        inferred = infer_tensions(mask, kind="labels", **pixels)
    for warning in inferred.warnings:
        notifications.show_warning(warning)
    placed = {"scale": cells.scale, "translate": cells.translate}
    in_plane = {"scale": cells.scale[-2:], "translate": cells.translate[-2:]}
    edges, options, kind = tension_layer(inferred)
    # Row 0 of the table of a layer of labels is the background.
    table = inferred.cell_table()
    cells_only = inferred.labels > 0  # holes are background
    column = {"index": np.append(0, inferred.labels[cells_only])}
    column |= {
        name: np.concatenate([[np.nan], np.asarray(table[name], float)[cells_only]])
        for name in ("pressure", "pressure_deviation", "area")
    }
    pressures = {"name": "pressures", "features": column, "opacity": 0.3, "visible": False}
    return [(mask, pressures | placed, "labels"), (edges, options | in_plane, kind)]
