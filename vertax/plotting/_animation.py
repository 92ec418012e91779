"""Animations of trajectories."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, SupportsFloat, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Real
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from vertax._base.atomic import atomic_draft
from vertax._base.checks import check_number
from vertax.mesh import Drawing, Tissue
from vertax.plotting import _style
from vertax.plotting._colours import Colours, add_bar
from vertax.plotting._tissue import draw, line_width, view_of

CellValues: TypeAlias = (
    Callable[[Tissue], Real[Array | np.ndarray, " cells"]]
    | Real[Array | np.ndarray, "frames cells"]
)


def animate(
    trajectory: Sequence[Tissue],
    path: str | os.PathLike[str],
    cells: CellValues | None = None,
    *,
    fps: SupportsFloat = 10.0,
    mark_t1: int = 6,
    cmap: str | Colormap = "viridis",
    vmin: SupportsFloat | None = None,
    vmax: SupportsFloat | None = None,
    label: str | None = None,
    captions: Sequence[str] | None = None,
    last_frame_seconds: SupportsFloat = 1.5,
    dpi: int = 120,
) -> None:
    """Draw a trajectory as an animation, one picture a frame.

    The part of the plane that is shown and the limits of the colours are the same in all frames. Edges that
    have just flipped (T1 transitions) are marked.

    ```python
    _, way = vx.relax.record_relaxation(tissue, energy)
    vx.animate(way, "relaxation.gif", lambda t: t.shape_factors, label="shape factor")
    ```

    **Arguments:**

    - `trajectory`: the tissues, of one size: a [`Trajectory`][vertax.mesh.Trajectory] of a relaxation
        or of a fit, or a list.
    - `path`: the file: a GIF if it ends in `.gif`; a video if it ends in `.mp4`, for which Matplotlib has to
        find the program ffmpeg. It is written atomically.
    - `cells`: the value of each cell: a function of the tissue, or an array of shape `(frames, cells)`.
        By default the cells are pale.
    - `fps`: frames a second.
    - `mark_t1`: number of frames for which flipped edges are marked; 0: none.
    - `cmap`, `label`: colour map of the cells, and label of its bar.
    - `vmin`, `vmax`: limits of the colours; by default those of all frames together. Where values lie
        beyond, the bar has an arrow with the extreme value.
    - `captions`: a text above each frame.
    - `last_frame_seconds`: additional duration of the last frame in seconds.
    - `dpi`: pixels an inch; the tissue is about three inches wide.

    **Raises:**

    - `ValueError`, naming the argument, for no frame or frames of different sizes, values or captions that
        do not match the frames, `fps` or `dpi` that are not positive, or a path with another ending.
    - `RuntimeError` for a video without ffmpeg.
    - `OSError` if the file cannot be written.
    """
    frames = list(trajectory)
    fps, last_frame_seconds = float(fps), float(last_frame_seconds)
    _check(frames, fps, mark_t1, captions, last_frame_seconds, dpi)
    _check_path(path)
    values = _cell_values(cells, frames)
    pictures = _pictures(frames, values, Colours(cmap, vmin, vmax, label), captions, mark_t1, dpi)
    with atomic_draft(path) as draft:
        _write(draft, pictures, fps, last_frame_seconds)


def animate_figures(
    figures: Iterable[Figure],
    path: str | os.PathLike[str],
    *,
    fps: SupportsFloat = 10.0,
    last_frame_seconds: SupportsFloat = 1.5,
    dpi: int = 100,
) -> None:
    """Write figures as an animation, one picture each; smaller ones have a white margin.

    **Arguments:**

    - `figures`: the figures, drawn one after the other.
    - `path`, `fps`, `last_frame_seconds`, `dpi`: see [`animate`][vertax.animate].

    **Raises:** as [`animate`][vertax.animate].
    """
    fps, last_frame_seconds = float(fps), float(last_frame_seconds)
    _check_timing(fps, last_frame_seconds, dpi)
    _check_path(path)
    pictures = []
    for figure in figures:
        figure.set_dpi(dpi)
        pictures.append(_pixels(figure))
    if not pictures:
        raise ValueError("Argument `figures` must have at least one figure, but is empty.")
    rows, columns = np.max([picture.shape[:2] for picture in pictures], axis=0)
    padded = (
        np.pad(p, ((0, rows - p.shape[0]), (0, columns - p.shape[1]), (0, 0)), constant_values=255)
        for p in pictures
    )
    with atomic_draft(path) as draft:
        _write(draft, padded, fps, last_frame_seconds)


def flipped_edges(before: Tissue, after: Tissue) -> Bool[np.ndarray, " edges"]:
    """Edges with other cells on their sides than before: those of T1 transitions.

    ```python
    vx.plot_tissue(after, highlight=vx.plotting.flipped_edges(before, after))
    ```

    **Arguments:**

    - `before`, `after`: two states of one tissue.

    **Returns:** a boolean for each edge. Edges of cells that appeared or vanished in between are False.

    **Raises:**

    - `ValueError` if they differ in size.
    """
    if before.n_edges != after.n_edges or before.n_cells != after.n_cells:
        raise ValueError(
            "Argument `after` must be another state of the same tissue, but has "
            f"{after.n_cells} cells and {after.n_edges} edges instead of {before.n_cells} and "
            f"{before.n_edges}."
        )
    then, now = (np.sort(np.asarray(t.topology.edge_cells), axis=1) for t in (before, after))
    stayed = np.append(np.asarray(before.alive & after.alive), [True, False])
    return np.any(then != now, axis=1) & stayed[then].all(axis=1) & stayed[now].all(axis=1)


def _check(
    frames: list[Tissue],
    fps: float,
    mark_t1: int,
    captions: Sequence[str] | None,
    last_frame_seconds: float,
    dpi: int,
) -> None:
    if not frames:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    sizes = {tissue.vertices.shape for tissue in frames}
    if len(sizes) > 1 or frames[0].vertices.ndim != 2:
        raise ValueError(
            "Argument `trajectory` must hold single tissues of one size, but their vertices have the "
            f"shapes {sorted(sizes)}."
        )
    _check_timing(fps, last_frame_seconds, dpi)
    check_number("mark_t1", mark_t1, at_least=0)
    if captions is not None and len(captions) != len(frames):
        raise ValueError(
            f"Argument `captions` must have one text for each of the {len(frames)} frames, but has "
            f"{len(captions)}."
        )


def _check_timing(fps: float, last_frame_seconds: float, dpi: int) -> None:
    check_number("fps", fps, above=0)
    check_number("dpi", dpi, above=0)
    check_number("last_frame_seconds", last_frame_seconds, at_least=0)


def _cell_values(cells: CellValues | None, frames: list[Tissue]) -> np.ndarray | None:
    if cells is None:
        return None
    if callable(cells):
        values = np.stack([np.asarray(cells(tissue), float) for tissue in frames])
    else:
        values = np.asarray(cells, float)
    wanted = (len(frames), frames[0].n_cells)
    if values.shape != wanted:
        raise ValueError(
            f"Argument `cells` must give one value for each frame and cell, shape {wanted}, but gives "
            f"{values.shape}."
        )
    return values


def _marks(frames: list[Tissue], duration: int) -> Iterator[np.ndarray]:
    """Edges to mark in each frame: those that flipped within the last `duration` frames."""
    left = np.zeros(frames[0].n_edges, int)
    for before, after in zip([frames[0], *frames], frames, strict=False):
        left = np.where(flipped_edges(before, after), duration, np.maximum(left - 1, 0))
        yield left > 0


def _pictures(
    frames: list[Tissue],
    values: np.ndarray | None,
    colours: Colours,
    captions: Sequence[str] | None,
    mark_t1: int,
    dpi: int,
) -> Iterator[np.ndarray]:
    """Pixels of each frame, all of one size."""
    drawings = _placed(frames)
    views = [view_of(drawing.polygons()[0], drawing.box) for drawing in drawings]
    low, high = np.min([v[0] for v in views], axis=0), np.max([v[1] for v in views], axis=0)
    with _style.house_style():
        width, height = _style.size_of(high - low)
        height += 0.25 * (captions is not None) + 0.1
        room = 0.8 * (values is not None) + 0.1
        figure, ((ax,),) = _style.new_figure(width=width, height=height, room=room)
        figure.set_dpi(dpi)
        if values is not None:
            low_colour, high_colour = colours.limits(values)  # of all frames together
            colours = colours._replace(low=low_colour, high=high_colour)
            add_bar(ax, colours.scale(values), values, colours.label, aspect=22, shrink=0.9)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        width = line_width(drawings[0], ax)
    for k, (drawing, marked) in enumerate(zip(drawings, _marks(frames, mark_t1), strict=True)):
        ax.clear()
        frame_values = None if values is None else values[k]
        with _style.house_style():
            draw(
                drawing,
                frame_values,
                ax=ax,
                highlight=marked,
                cell_colours=colours,
                colorbar=False,
                linewidth=width,
            )
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            if captions is not None:
                ax.set_title(captions[k])
            yield _pixels(figure)


def _placed(frames: list[Tissue]) -> list[Drawing]:
    """The drawings of all frames; each cell is drawn in the periodic image nearest to the previous frame."""
    drawings: list[Drawing] = []
    for tissue in frames:
        near = drawings[-1].centroids if drawings else None
        drawings.append(Drawing(tissue, near=near))
    return drawings


def _pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    # The video format needs even numbers of rows and columns.
    rows, columns = (2 * (n // 2) for n in pixels.shape[:2])
    return pixels[:rows, :columns].copy()


_WRITERS = {".gif": PillowWriter, ".mp4": FFMpegWriter}


def _check_path(path: str | os.PathLike[str]) -> None:
    """Raise an error for a path that cannot be written."""
    ending = Path(path).suffix.lower()
    if ending not in _WRITERS:
        raise ValueError(
            f"Argument `path` must end in {' or '.join(_WRITERS)}, but is {os.fspath(path)!r}."
        )
    if not _WRITERS[ending].isAvailable():
        raise RuntimeError(
            "Cannot write a video: Matplotlib finds no program ffmpeg. Install ffmpeg, or set "
            'matplotlib.rcParams["animation.ffmpeg_path"] to where it is, or write a GIF (a path that ends '
            "in .gif)."
        )


def _write(
    path: Path, pictures: Iterator[np.ndarray], fps: float, last_frame_seconds: float
) -> None:
    """Write pictures of one size by the writers of Matplotlib."""
    rows, columns = (first := next(pictures)).shape[:2]
    figure = Figure(figsize=(columns / 100, rows / 100), dpi=100)
    shown = figure.figimage(first)
    gif = path.suffix.lower() == ".gif"
    # Viewers slow down frames of a GIF that are shorter than two hundredths of a second.
    rate: Any = min(fps, 50) if gif else fps
    # A pixel format that every player supports.
    video: Any = {"codec": "h264", "extra_args": ["-pix_fmt", "yuv420p", "-crf", "18"]}
    writer = PillowWriter(fps=rate) if gif else FFMpegWriter(fps=rate, **video)
    with writer.saving(figure, str(path), 100):
        writer.grab_frame()
        for pixels in pictures:
            shown.set_data(pixels)
            writer.grab_frame()
        for _ in range(round(last_frame_seconds * rate)):
            writer.grab_frame()
