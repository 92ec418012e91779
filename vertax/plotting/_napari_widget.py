"""The widget of napari: tensions and pressures of a layer of labels, computed in a thread."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
from magicgui import widgets  # pyright: ignore[reportMissingImports]
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from napari.layers import Labels  # pyright: ignore[reportMissingImports]
from napari.qt.threading import thread_worker  # pyright: ignore[reportMissingImports]
from napari.utils import DirectLabelColormap  # pyright: ignore[reportMissingImports]
from napari.utils.notifications import (  # pyright: ignore[reportMissingImports]
    show_error,
    show_info,
    show_warning,
)

from vertax._base.compilation_cache import enable_compilation_cache
from vertax.plotting._napari import limits, tension_colours, tension_layer
from vertax.plotting._tension_map import PRESSURE_COLOURS
from vertax.tensions import InferredTensions, MaskFrame, TensionsOfMasks

_TENSIONS = "plasma"
# Width and height of the colour bars in pixels.
_BARS = 320, 150


class TensionsWidget(widgets.Container):
    """Choices, progress, colour bars and export.

    **Arguments:**

    - `napari_viewer`: the viewer, which napari passes by this name.
    """

    def __init__(self, napari_viewer: Any):
        self.viewer = napari_viewer
        self.worker: Any = None
        self.tensions: TensionsOfMasks | None = None
        self.cells = widgets.create_widget(annotation=Labels, label="labels")
        self.frames = widgets.ComboBox(label="frames", choices=["current", "all"])
        self.square = widgets.ComboBox(label="pixels", choices=["scale of the layer", "square"])
        self.gap_width = widgets.FloatSpinBox(
            label="gap width", max=1000.0, tooltip="largest width of lines, in pixels; 0: measured"
        )
        self.prior = widgets.FloatSpinBox(
            label="prior", max=10.0, step=0.05, tooltip="spread of the tensions; 0: from the data"
        )
        self.start = widgets.PushButton(text="Infer tensions")
        self.progress = widgets.ProgressBar(visible=False)
        self.bars = widgets.Image(visible=False)
        self.file = widgets.FileEdit(label="tables", mode="d", tooltip="folder of the tables")
        self.export = widgets.PushButton(text="Export tables", enabled=False)
        self.start.changed.connect(self.infer)
        self.export.changed.connect(self.write)
        choices = [self.cells, self.frames, self.square, self.gap_width, self.prior, self.start]
        super().__init__(widgets=[*choices, self.progress, self.bars, self.file, self.export])

    def infer(self) -> None:
        """Begin to infer the chosen frames in a thread."""
        layer = self.cells.value
        if layer is None:
            show_warning("Open a layer of labels first.")
            return
        masks = self._masks(layer)
        options = {"kind": "labels", "pixel_size": self._pixel_size(layer)}
        options |= {"gap_width": self.gap_width.value or None, "prior": self.prior.value or None}

        def note(item: tuple[int, str | None]) -> None:
            number, error = item
            if error is not None:
                show_error(f"frame {number}: {error}" if len(masks) > 1 else error)
            if len(masks) > 1:
                self.progress.value += 1

        def end() -> None:
            self.start.enabled, self.progress.visible = True, False

        self.start.enabled, self.progress.visible = False, True
        # A bar that moves while the only frame is computed, or one step for each frame.
        self.progress.range = (0, len(masks) if len(masks) > 1 else 0)
        self.progress.value = 0
        self.worker = _infer(masks, options)
        self.worker.yielded.connect(note)
        self.worker.returned.connect(lambda content: content and self._show(layer, content))
        self.worker.finished.connect(end)
        self.worker.start()

    def write(self) -> None:
        """Write the tables to the chosen folder."""
        assert self.tensions is not None
        if not self.file.line_edit.value:
            show_warning("Choose a folder for the tables first.")
            return
        files = self.tensions.write(self.file.value)
        show_info(f"Wrote {', '.join(file.name for file in files)} to {self.file.value}.")

    def _masks(self, layer: Labels) -> dict[int, np.ndarray]:
        """The planes to infer by their numbers."""
        planes = np.asarray(layer.data)
        planes = planes.reshape(-1, *planes.shape[-2:])
        if self.frames.value == "all" or len(planes) == 1:
            return dict(enumerate(planes))
        steps = [round(float(x)) for x in layer.world_to_data(self.viewer.dims.point)[:-2]]
        shape = layer.data.shape[:-2]
        number = int(np.ravel_multi_index(tuple(np.clip(steps, 0, np.array(shape) - 1)), shape))
        return {number: planes[number]}

    def _pixel_size(self, layer: Labels) -> tuple[float, float] | None:
        """Height and width of a pixel; None where the layer has no scale."""
        height, width = (float(x) for x in layer.scale[-2:])
        if self.square.value == "square" or height == width == 1:
            return None
        return height, width

    def _show(self, layer: Labels, content: _Content) -> None:
        """Replace the layers of tensions and pressures, and the colour bars."""
        self.tensions, self.export.enabled = content.tensions, True
        edges, cells = content.edges, content.cells
        tension = np.where(edges["determined"], edges["tension"], np.nan)
        pressure = np.where(cells["determined"], cells["pressure"], np.nan)
        for name in ("tensions", "pressures"):
            if name in self.viewer.layers:
                self.viewer.layers.remove(name)
        shape = layer.data.shape
        picture = np.zeros((int(np.prod(shape[:-2])), *shape[-2:]), np.int32)
        paths, options = [], {}
        for number, frame in content.frames.items():
            picture[number] = frame.rows
            place = np.unravel_index(number, shape[:-2]) if len(shape) > 2 else ()
            for path in frame.paths:
                paths.append(np.hstack([np.tile(np.array(place, float), (len(path), 1)), path]))
            options = frame.options
        options = options | tension_colours(tension, _TENSIONS)
        options |= {"features": edges | {"determined_tension": tension}, "metadata": {}}
        where = {"scale": layer.scale, "translate": layer.translate}
        table = {name: np.append(column[:1], column) for name, column in cells.items()}
        table["index"] = np.arange(len(cells["label"]) + 1)  # row 0 is the background
        self.viewer.add_labels(
            picture.reshape(shape),
            name="pressures",
            opacity=1.0,
            features=table,
            colormap=_label_colours(pressure),
            **where,
        )
        self.viewer.add_shapes(paths, **options, **where)
        layer.visible = False
        self.bars.set_data(_colour_bars(limits(tension), limits(pressure)))
        self.bars.min_width, self.bars.min_height = _BARS
        self.bars.visible = True
        for number, frame in content.frames.items():
            for warning in frame.warnings:
                show_warning(f"frame {number}: {warning}" if len(content.frames) > 1 else warning)


class _Frame(NamedTuple):
    """What the layers show of a frame."""

    paths: Any
    options: dict[str, Any]
    rows: np.ndarray
    """The row of each pixel's cell in the table of cells, from 1."""
    warnings: tuple[str, ...]


class _Content(NamedTuple):
    """What the layers show."""

    tensions: TensionsOfMasks
    edges: dict[str, np.ndarray]
    cells: dict[str, np.ndarray]
    frames: dict[int, _Frame]


# The tables and paths too: JAX compiles functions for them, which would block the window.
@thread_worker
def _infer(
    masks: dict[int, np.ndarray], options: dict[str, Any]
) -> Generator[tuple[int, str | None], None, _Content | None]:
    """Infer masks in a thread; yields the number of each, and the message of its error."""
    enable_compilation_cache()
    results: dict[str | int, InferredTensions] = {}
    failures: dict[str | int, str] = {}
    frames, first = {}, 1
    for number, mask in masks.items():
        try:
            result = MaskFrame(number, mask).infer(**options)
            paths, layer_options, _ = tension_layer(result)
            rows = _rows(mask, result.labels, first)
            frames[number] = _Frame(paths, layer_options, rows, result.warnings)
            first += len(result.labels)
            results[number] = result
        except Exception as error:
            failures[number] = str(error)
        yield number, failures.get(number)
    if not results:
        return None
    scaled = options["pixel_size"] is not None
    unit = {"length_unit": "unit of the scale of the layer"} if scaled else {}
    tensions = TensionsOfMasks(results, failures, **unit)
    return _Content(tensions, tensions.edge_table(), tensions.cell_table(), frames)


def _rows(mask: np.ndarray, labels: np.ndarray, first: int) -> np.ndarray:
    """The row of each pixel's cell in the table of cells, from `first`; 0 for no cell."""
    cells = np.flatnonzero(labels > 0)
    order = cells[np.argsort(labels[cells])]
    place = np.clip(np.searchsorted(labels[order], mask), 0, len(order) - 1)
    return np.where(labels[order][place] == mask, order[place] + first, 0)


def _label_colours(pressure: np.ndarray) -> DirectLabelColormap:
    """A colour for each row of the table of cells, grey where the pressure is not determined."""
    colour = PRESSURE_COLOURS(Normalize(*limits(pressure))(np.nan_to_num(pressure)))
    colour[~np.isfinite(pressure)] = (0.5, 0.5, 0.5, 1.0)
    colours: dict[int | None, Any] = {row + 1: each for row, each in enumerate(colour)}
    return DirectLabelColormap(color_dict=colours | {None: np.zeros(4), 0: np.zeros(4)})


def _colour_bars(tension: tuple[float, float], pressure: tuple[float, float]) -> np.ndarray:
    """Two colour bars as pixels."""
    figure = Figure(figsize=(_BARS[0] / 100, _BARS[1] / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for ax, name, span, colours in zip(
        figure.subplots(2, 1),
        ("tension / mean tension", "pressure less the mean"),
        (tension, pressure),
        (colormaps[_TENSIONS], PRESSURE_COLOURS),
        strict=True,
    ):
        figure.colorbar(
            ScalarMappable(Normalize(*span), colours),
            cax=ax,
            orientation="horizontal",
            ticks=MaxNLocator(4),
        )
        ax.set_title(name, fontsize=9)
        ax.tick_params(labelsize=8)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()
