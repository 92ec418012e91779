"""Tissues side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, SupportsFloat, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Real
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from vertax._base.checks import check_choice
from vertax._base.pixels import PixelSizeLike
from vertax.mesh import Drawing, Tissue
from vertax.plotting import _style
from vertax.plotting._colours import EDGES_ON_DARK, EDGES_ON_PALE, Colours, add_bar
from vertax.plotting._image import extent_of, plot_image
from vertax.plotting._tissue import checked, draw, single, view_of

Values: TypeAlias = (
    Callable[[Tissue], Real[Array | np.ndarray, " ..."]]
    | Sequence[Real[Array | np.ndarray, " ..."] | None]
    | Real[Array | np.ndarray, "panels _"]
)


def plot_tissues(
    tissues: Mapping[str, Tissue | None],
    cells: Values | None = None,
    edges: Values | None = None,
    *,
    axes: Sequence[Axes] | np.ndarray | None = None,
    figure: Figure | None = None,
    mask: Bool[Array | np.ndarray, " ..."] | None = None,
    cmap: str | Colormap = "viridis",
    vmin: SupportsFloat | None = None,
    vmax: SupportsFloat | None = None,
    label: str | None = None,
    edge_cmap: str | Colormap | None = None,
    edge_vmin: SupportsFloat | None = None,
    edge_vmax: SupportsFloat | None = None,
    edge_label: str | None = None,
    colorbar: bool | str = True,
    linewidth: SupportsFloat | None = None,
    image: Real[np.ndarray, " ..."] | None = None,
    pixel_size: PixelSizeLike = 1.0,
) -> list[Axes]:
    """Draw tissues side by side with one colour scale and one length scale.

    ```python
    vx.plotting.plot_tissues({"start": start, "fitted": fit.tissue}, lambda t: t.shape_factors)
    vx.plotting.plot_tissues({"image": None, "fitted": fit.tissue}, image=membranes, pixel_size=0.2)
    ```

    **Arguments:**

    - `tissues`: the tissue of each panel by its title; None: only the image.
    - `cells`, `edges`: the values of the cells and of the edges, in the order of the panels; or a function
        of the tissue. None for a panel: not coloured.
    - `axes`: where to draw, one for each panel; by default a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `image`, `pixel_size`: an image under all panels, as for [`plot_tissue`][vertax.plot_tissue].
    - `vmin`, `vmax`, `edge_vmin`, `edge_vmax`: limits of the colours; by default those of the finite values
        of all panels together.
    - `colorbar`: whether to draw a bar for the cells of all panels and one for their edges; or `"cells"` or
        `"edges"` for one of them.
    - others as for [`plot_tissue`][vertax.plot_tissue].

    **Returns:** the axes of the panels.

    **Raises:**

    - `ValueError`, naming the argument, if there is no panel, for values or axes that do not match the
        panels, for None without an image, and as `plot_tissue`.
    """
    _style.one_of(axes, figure, "axes")
    _check(tissues, axes, image, colorbar)
    drawings = {name: None if t is None else Drawing(single(t)) for name, t in tissues.items()}
    # Check before making a figure: one of pyplot would stay open after an error.
    cell_values = _values("cells", cells, tissues)
    edge_values = _values("edges", edges, tissues)
    for drawing in filter(None, drawings.values()):
        checked("mask", mask, drawing.n_cells)
    cell_colours, all_cells = _common(Colours(cmap, vmin, vmax, label), cell_values)
    edge_map = edge_cmap or (EDGES_ON_PALE if image is None else EDGES_ON_DARK)
    edge_colours, all_edges = _common(
        Colours(edge_map, edge_vmin, edge_vmax, edge_label), edge_values
    )
    bars = [
        (colours, values)
        for name, colours, values in (
            ("cells", cell_colours, all_cells),
            ("edges", edge_colours, all_edges),
        )
        if values is not None and colorbar in (True, name)
    ]
    views = _views(drawings, mask) if image is None else [None] * len(drawings)
    with _style.house_style():
        if axes is None:
            view = views[0]
            extent = (
                view[1] - view[0] if view is not None else extent_of(np.asarray(image), pixel_size)
            )
            height = 2.4 * float(np.clip(extent[1] / extent[0], 0.25, 2))
            room = 0.75 * len(bars)
            axes = _style.new_axes(
                len(tissues), width=2.4, height=height + 0.25, room=room, figure=figure
            )
        for k, (ax, name) in enumerate(zip(axes, tissues, strict=True)):
            drawing = drawings[name]
            if drawing is None:
                assert image is not None
                plot_image(image, pixel_size=pixel_size, ax=ax)
            else:
                draw(
                    drawing,
                    cell_values[k],
                    edge_values[k],
                    ax=ax,
                    view=views[k],
                    mask=mask,
                    cell_colours=cell_colours,
                    edge_colours=edge_colours,
                    colorbar=False,
                    linewidth=linewidth,
                    image=image,
                    pixel_size=pixel_size,
                )
            ax.set_title(name)
        # Matplotlib puts each new bar between the axes and the previous bar.
        for colours, values in reversed(bars):
            assert values is not None
            add_bar(
                list(axes),
                colours.scale(values),
                values,
                colours.label,
                fraction=0.05,
                pad=0.02,
                shrink=0.8,
                aspect=25,
            )
    return list(axes)


def _check(
    tissues: Mapping[str, Tissue | None], axes: Any, image: np.ndarray | None, colorbar: bool | str
) -> None:
    check_choice("colorbar", colorbar, (True, False, "cells", "edges"))
    if not tissues:
        raise ValueError("Argument `tissues` must have at least one panel, but is empty.")
    if image is None and None in tissues.values():
        raise ValueError(
            "Argument `tissues` must have a tissue in each panel, unless an `image` is given."
        )
    if axes is not None and len(axes) != len(tissues):
        raise ValueError(
            f"Argument `axes` must have one entry for each of the {len(tissues)} panels, but has "
            f"{len(axes)}."
        )


def _values(
    name: str, values: Values | None, tissues: Mapping[str, Tissue | None]
) -> list[np.ndarray | None]:
    if values is None:
        return [None] * len(tissues)
    if not callable(values) and len(values) != len(tissues):
        raise ValueError(
            f"Argument `{name}` must have values for each of the {len(tissues)} panels, but has "
            f"{len(values)}."
        )
    panels = []
    for k, tissue in enumerate(tissues.values()):
        panel = None
        if tissue is not None:
            panel = values(tissue) if callable(values) else values[k]
            panel = checked(name, panel, tissue.n_cells if name == "cells" else tissue.n_edges)
        panels.append(panel)
    return panels


def _common(colours: Colours, values: list[np.ndarray | None]) -> tuple[Colours, np.ndarray | None]:
    """Colours with common limits for all panels, and all values."""
    some = [np.asarray(panel, float).ravel() for panel in values if panel is not None]
    if not some:
        return colours, None
    together = np.concatenate(some)
    low, high = colours.limits(together)
    return colours._replace(low=low, high=high), together


def _views(
    drawings: Mapping[str, Drawing | None], mask: Any
) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """The part of the plane that each panel shows: of one size, centred on the tissue."""
    views = []
    for drawing in drawings.values():
        assert drawing is not None
        polygons = drawing.polygons()[0]
        shown = polygons if mask is None else polygons[np.asarray(mask, bool)]
        views.append(view_of(shown, drawing.box))
    half = np.max([high - low for low, high in views], axis=0) / 2
    return [((low + high) / 2 - half, (low + high) / 2 + half) for low, high in views]
