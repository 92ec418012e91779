"""From a membrane image to the inverse problem of its shape factors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_choice, check_number
from vertax._base.pixels import pixel_length
from vertax.costs import MeshImage, mirror
from vertax.energies import AbstractEnergy, ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem, Uncertainty, uncertainty
from vertax.inference._preparation import away_from_outline, best_psf_width, in_even_light
from vertax.initialise import (
    Segmentation,
    Segmenter,
    Watershed,
    from_labels,
    from_microscopy,
)
from vertax.initialise._mask_arguments import check_zero
from vertax.mesh import Tissue
from vertax.relax import Equilibrium, Relaxation

_POINTS_PER_EDGE = 48


class PinnedEnergy(AbstractEnergy):
    """E1 with rest area 1 for inner cells, and free rest areas for cells at the border of the image.

    The forces on a cell at the border from beyond it are unknown, so its rest area is a parameter.
    """

    target_shape_factor: Float[Array, " cells"]
    """Target shape factor of each cell."""
    log_border_area: Float[Array, " cells"]
    """Logarithm of the rest area; ignored for inner cells."""
    inner: Bool[Array, " cells"]
    """Cells that do not touch the border."""

    @property
    def mean_area(self) -> Float[Array, " cells"]:
        """Rest areas."""
        return jnp.where(self.inner, 1.0, jnp.exp(self.log_border_area))

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy."""
        return ShapeFactorEnergy(self.target_shape_factor, self.mean_area)(tissue)


class Micrograph(eqx.Module):
    """A membrane image, the cells found in it, and the inverse problem of their shape factors.

    Made by [`micrograph_problem`][vertax.inference.micrograph_problem].
    """

    problem: InverseProblem[Any]
    """The inverse problem; it starts from the relaxed tissue of the first guess."""
    segmentation: Segmentation
    """The segmented cells."""
    complete: Bool[np.ndarray, " cells"]
    """Cells to report: all of them and of their neighbours is in the image."""
    image: Float[np.ndarray, "rows columns"]
    """The image in even light that the model is compared with."""
    psf_width: float
    """Width of its blur, in units of length."""
    first: Equilibrium
    """The relaxed tissue of the first guess."""

    @property
    def pixel_size(self) -> float:
        """Length of a pixel side of `image`, which may be coarser than the file, in units of the tissue."""
        columns = self.segmentation.image_shape[1]
        return pixel_length(self.segmentation.pixel_size) * columns / self.image.shape[1]

    def parameters(
        self, energy: AbstractEnergy
    ) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
        """The fitted parameters.

        **Arguments:**

        - `energy`: of a fit of `problem`.

        **Returns:** target shape factor and rest area of each cell.

        **Raises:**

        - `TypeError` for an energy of another problem.
        """
        if not isinstance(energy, ShapeFactorEnergy | PinnedEnergy):
            raise TypeError(
                "Argument `energy` must be that of a fit of `problem`, but is "
                f"{type(energy).__name__}."
            )
        return np.asarray(energy.target_shape_factor, float), np.asarray(energy.mean_area, float)

    def correlation(self, tissue: Tissue) -> float:
        r"""Correlation of the blurred mesh with the image.

        **Arguments:**

        - `tissue`: the mesh.

        **Returns:** $\rho$; the cost of the problem is $\tfrac12(1 - \rho^2)$.
        """
        value = eqx.filter_jit(lambda t: self.problem.cost(t, self.problem.energy))(tissue)
        return float(np.sqrt(max(0.0, 1 - 2 * float(value))))

    def membrane_contrast(self, tissue: Tissue) -> float:
        """How much brighter the image is along the edges of a mesh than elsewhere.

        **Arguments:**

        - `tissue`: the mesh; mirrored parts of it, beyond the image, do not count.

        **Returns:** the mean along the edges minus that of the image, in standard deviations of the image.
        """
        start, vector = (np.asarray(x, float) for x in tissue.edge_segments)
        steps = (np.arange(32) + 0.5) / 32
        points = (start[:, None] + steps[:, None] * vector[:, None]).reshape(-1, 2)
        length = np.repeat(np.linalg.norm(vector, axis=1), 32)
        column, row = np.floor(points / self.pixel_size).astype(int).T
        rows, columns = self.image.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        values = (self.image - self.image.mean()) / self.image.std()
        return float(np.average(values[row[inside], column[inside]], weights=length[inside]))

    def uncertainty(self, fit: Fit[Any], *, prior: float | None = None) -> Uncertainty:
        """How well the image determines the parameters.

        The residual is correlated over the blur, so the pixels within it count as one observation.

        **Arguments:**

        - `fit`: of `problem`.
        - `prior`: standard deviation of the prior of the parameters.

        **Returns:** the [`Uncertainty`][vertax.Uncertainty].

        **Raises:** as [`uncertainty`][vertax.uncertainty].
        """
        width = self.psf_width / self.pixel_size
        blurred = max(1.0, 4 * np.pi * width**2)
        fitted = eqx.filter(fit.energy, self.problem.trainable)
        n_fitted = sum(x.size for x in jax.tree.leaves(fitted))
        independent = max(self.image.size / blurred, 2.0 * n_fitted)
        return uncertainty(self.problem, fit, prior=prior, n_independent=independent)


def micrograph_problem(
    image: Float[np.ndarray, "rows columns"],
    *,
    segmenter: Segmenter | None = None,
    target_shape_factor: float = 3.7,
    border: str = "mirrored",
    rest_areas: str = "fitted",
    pixel_size: float | None = None,
    pixels: int = 256,
    background_width: float = 0.5,
    psf_width: float | None = None,
    response: Relaxation | None = None,
) -> Micrograph:
    """Segment a membrane image, and set up the inverse problem of the shape factors of its cells.

    ```python
    image = vx.io.read_image("membranes.tif")
    micrograph = vx.inference.micrograph_problem(image)
    fit = vx.fit(micrograph.problem, optax.adam(2e-2), 150)
    shape_factors, rest_areas = micrograph.parameters(fit.energy)
    shape_factors[micrograph.complete]
    ```

    The energy is E1 with a rest area for each cell, the cost that of
    [`MeshImage`][vertax.costs.MeshImage] (paper, "Inference of mechanical parameters from microscopy
    image").

    **Arguments:**

    - `image`: intensities, bright membranes on dark cells.
    - `segmenter`: how cells are found, [`Watershed`][vertax.initialise.Watershed]`()` by default.
    - `target_shape_factor`: first guess for every cell.
    - `border`: what holds the tissue at the border of the image: it is `"mirrored"`, cells that the border
        cuts included (as in the paper); or the outline of the cells that lie whole in it is `"pinned"`. Cells
        on this outline that overlap without their arcs (those with two sides) are left out.
    - `rest_areas`: of the cells: `"fitted"` too, beginning with those of the segmented cells; as those are
        `"observed"`; or `"equal"` to the mean area in all cells but those that the border cuts, which
        determines shape factors best where it is true. A pinned border goes with equal ones in any case.
    - `pixel_size`: length of a pixel, where rest areas are 1 (of a pinned border only); left out, the mean
        area of the cells not cut by the border is 1. In a rigid tissue all shape factors depend on it.
    - `pixels`: longer side of the image that the model is compared with; finer ones are made coarser.
    - `background_width`: width of the filter that evens out the light, in mean cell diameters.
    - `psf_width`: standard deviation of the blur, in pixels of `image`; left out, the one that fits best.
    - `response`: how tissues are relaxed, [`Relaxation`][vertax.Relaxation]`()` by default.

    **Returns:** a [`Micrograph`][vertax.inference.Micrograph].

    **Raises:**

    - `ValueError` for an image that cannot be used, and for an unknown `border` or `rest_areas`.
    """
    check_choice("border", border, ("mirrored", "pinned"))
    check_choice("rest_areas", rest_areas, ("fitted", "observed", "equal"))
    if pixel_size is not None:
        check_number("pixel_size", pixel_size, above=0)
    segmenter = Watershed() if segmenter is None else segmenter
    response = Relaxation() if response is None else response
    intensities = np.asarray(image, float)
    prepare = functools.partial(
        in_even_light, intensities, background_width=background_width, longest_side=pixels
    )
    if border == "mirrored":
        read = _mirrored(intensities, segmenter, target_shape_factor, rest_areas, prepare)
    else:
        read = _pinned(intensities, segmenter, target_shape_factor, pixel_size, prepare)
    tissue = read.segmentation.tissue
    width = (
        best_psf_width(tissue, read.options, read.image.shape)
        if psf_width is None
        else psf_width * pixel_length(read.segmentation.pixel_size)
    )
    first = response(tissue, read.guess, throw=False)
    # Mirror planes or pins hold the tissue in its place: there is no position to fit.
    problem = InverseProblem(
        first.tissue,
        read.guess,
        MeshImage(psf_width=width, **read.options),
        read.trainable,
        response=response,
    )
    return Micrograph(problem, read.segmentation, read.reported, read.image, width, first)


class _Read(NamedTuple):
    """The segmented cells, the initial energy and the image of a micrograph."""

    segmentation: Segmentation
    guess: AbstractEnergy
    trainable: Any
    reported: Bool[np.ndarray, " cells"]
    image: Float[np.ndarray, "rows columns"]
    options: dict[str, Any]


def _mirrored(
    image: Float[np.ndarray, "rows columns"],
    segmenter: Segmenter,
    target_shape_factor: float,
    rest_areas: str,
    prepare: Callable[[float], np.ndarray],
) -> _Read:
    """All cells, and their mirror images."""
    segmentation = from_microscopy(image, segmenter=segmenter)
    even = prepare(pixel_length(segmentation.pixel_size))
    areas, uncut = segmentation.tissue.areas, np.asarray(segmentation.complete)
    if rest_areas == "equal":
        # Cells and their mirror images have one label; the mean area is the unit.
        labels = np.asarray(segmentation.labels)
        areas = jnp.where(np.isin(labels, labels[uncut]), 1.0, areas)
    guess = ShapeFactorEnergy(jnp.full(segmentation.tissue.n_cells, target_shape_factor), areas)
    trainable = eqx.tree_at(
        lambda e: (e.target_shape_factor, e.mean_area), guess, (True, rest_areas == "fitted")
    )
    options = {"image": mirror(even), "points_per_edge": _POINTS_PER_EDGE}
    return _Read(segmentation, guess, trainable, uncut, even, options)


def _pinned(
    image: Float[np.ndarray, "rows columns"],
    segmenter: Segmenter,
    target_shape_factor: float,
    pixel_size: float | None,
    prepare: Callable[[float], np.ndarray],
) -> _Read:
    """The cells not cut by the border of the image, as a free tissue with a pinned outline."""
    labels = np.asarray(segmenter(image))
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    check_zero("segmenter(image)", labels, None)
    labels = np.maximum(np.where(np.isin(labels, rim), 0, labels), 0)
    segmentation, cluster, labels = _with_straight_edges(labels, pixel_size)
    on_outline = np.asarray(cluster.topology.on_outline)
    outline = np.asarray(cluster.topology.edge_cells)[on_outline]
    inner = ~np.isin(np.arange(cluster.n_cells), outline)
    ends = np.asarray(cluster.topology.edge_vertices)[on_outline]
    pinned = np.isin(np.arange(cluster.n_vertices), ends)
    tissue = eqx.tree_at(lambda t: t.pinned, cluster, pinned, is_leaf=lambda x: x is None)
    side = pixel_length(segmentation.pixel_size)
    even = prepare(side)
    pixel = side * segmentation.image_shape[1] / even.shape[1]
    weight = away_from_outline(tissue, on_outline, labels > 0, pixel, even.shape)
    # Straight edges cut off the corners of cells on the outline, of some nearly all of the cell.
    areas = jnp.log(jnp.maximum(tissue.areas, 0.2))
    guess = PinnedEnergy(jnp.full(cluster.n_cells, target_shape_factor), areas, jnp.asarray(inner))
    options = {
        "image": even,
        "points_per_edge": _POINTS_PER_EDGE,
        "weight": weight,
        "pixel_size": pixel,
    }
    segmentation = eqx.tree_at(
        lambda s: s.tissue, segmentation, tissue, is_leaf=lambda x: isinstance(x, Tissue)
    )
    return _Read(segmentation, guess, eqx.is_inexact_array, inner, even, options)


def _with_straight_edges(
    labels: Int[np.ndarray, "rows columns"], pixel_size: float | None
) -> tuple[Segmentation, Tissue, Int[np.ndarray, "rows columns"]]:
    """The cells of a mask, their free tissue with straight edges, and the labels that are left.

    Cells on the outline that overlap without their arcs are left out, until there are none.
    """
    while True:
        segmentation = from_labels(labels, boundary="free", pixel_size=pixel_size, holes="close")
        curved = segmentation.tissue
        m = curved.topology
        tissue = Tissue(curved.vertices, m, curved.boundary, curved.softening)
        overlaps = tissue.overlaps
        if not overlaps.any:
            return segmentation, tissue, labels
        cell = np.asarray(m.cell)
        crossed = cell[np.asarray(m.twin)[np.asarray(overlaps.sides) & (cell == m.n_cells)]]
        bad = np.union1d(np.flatnonzero(overlaps.cells), crossed)
        left_out = np.isin(labels, segmentation.labels[bad]) & (labels > 0)
        if not left_out.any():
            raise ValueError(
                f"Cells of the image overlap if their edges are straight: {overlaps.describe()}. Use "
                "border='mirrored', or another segmenter."
            )
        labels = np.where(left_out, 0, labels)
