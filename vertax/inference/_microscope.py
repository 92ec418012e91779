"""Synthetic data: images of the membranes of a tissue, and the label image of its cells."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from vertax._base.checks import check_integer
from vertax.costs import render
from vertax.io import Foam
from vertax.mesh import Drawing, Free, Periodic, Tissue


class Microscope(eqx.Module):
    """Synthetic images of the membranes of a periodic tissue in a square box, with adjustable errors.

    ```python
    image = vx.inference.Microscope(pixels=256, noise=0.1)(tissue, key=jax.random.key(0))
    ```

    Blurred membranes on a background, under uneven light, with faint stretches and noise. Intensities are
    relative to the brightest membrane.

    **Arguments:**

    - `pixels`: side of the image in pixels.
    - `psf_width`: standard deviation of the blur in pixels.
    - `noise`: standard deviation of the noise of a pixel.
    - `background`: intensity where there is no membrane.
    - `uneven_gain`: amplitude of a slow variation of brightness over the image, periodic as the tissue is.
    - `vignetting`: how much darker the image is at its corners than in its middle.
    - `faint`: share of the edges with a faint stretch.

    **Raises:**

    - `ValueError` for a setting out of its range.
    """

    pixels: int = eqx.field(default=128, static=True)
    psf_width: float = 2.0
    noise: float = 0.0
    background: float = 0.0
    uneven_gain: float = 0.0
    vignetting: float = 0.0
    faint: float = 0.0

    def __check_init__(self):
        ranges = {
            "pixels": (self.pixels >= 16, "at least 16"),
            "psf_width": (self.psf_width > 0, "positive"),
            "noise": (self.noise >= 0, "at least 0"),
            "background": (self.background >= 0, "at least 0"),
            "uneven_gain": (0 <= self.uneven_gain < 1, "in [0, 1)"),
            "vignetting": (0 <= self.vignetting < 1, "in [0, 1)"),
            "faint": (0 <= self.faint <= 1, "in [0, 1]"),
        }
        for name, (holds, range_) in ranges.items():
            if not holds:
                raise ValueError(
                    f"Argument `{name}` of Microscope must be {range_}, but is {getattr(self, name)}."
                )

    def pixel_size(self, tissue: Tissue) -> float:
        """Length of the side of a pixel.

        **Arguments:**

        - `tissue`: a tissue in a square periodic box.

        **Returns:** the length, in units of the tissue.

        **Raises:**

        - `ValueError` for another boundary.
        """
        boundary = tissue.boundary
        lattice = (
            np.asarray(boundary.lattice) if isinstance(boundary, Periodic) else np.zeros((2, 2))
        )
        side = lattice[0, 0]
        if side <= 0 or not np.allclose(lattice, side * np.eye(2)):
            raise ValueError(
                "Argument `tissue` must lie in a square periodic box, of which the image shows one "
                "period, but it does not. See vertax.costs.render for other boundaries."
            )
        return float(side) / self.pixels

    def __call__(self, tissue: Tissue, *, key: Key[Array, ""]) -> Float[np.ndarray, "rows columns"]:
        """The image of one period of the tissue.

        **Arguments:**

        - `tissue`: a tissue in a square periodic box.
        - `key`: of the noise and of the faint stretches.

        **Returns:** the image, rows along y.

        **Raises:**

        - `ValueError` for another boundary.
        """
        shape, pixel = (self.pixels, self.pixels), self.pixel_size(tissue)
        width = self.psf_width * pixel
        membranes = np.asarray(eqx.filter_jit(render)(tissue, shape, width), float)
        membranes = self._faded(membranes / membranes.max(), tissue, jax.random.fold_in(key, 1))
        noise = np.asarray(jax.random.normal(key, shape), float)
        return self._light() * (membranes + self.background) + self.noise * noise

    def _faded(
        self, membranes: Float[np.ndarray, "rows columns"], tissue: Tissue, key: Key[Array, ""]
    ) -> Float[np.ndarray, "rows columns"]:
        """Membranes with faint stretches, half as long as their edges, in places drawn at random."""
        start, vector = (np.asarray(x, float) for x in tissue.edge_segments)
        chosen = np.asarray(jax.random.uniform(key, (len(start),))) < self.faint
        y, x = (np.indices(membranes.shape) + 0.5) * self.pixel_size(tissue)
        lengths = np.linalg.norm(vector, axis=1)
        for middle, length in zip((start + vector / 2)[chosen], lengths[chosen], strict=True):
            away = jnp.stack([x - middle[0], y - middle[1]], axis=-1)
            squared = np.sum(np.asarray(tissue.boundary.shortest(away)) ** 2, axis=-1)
            membranes = membranes * (1 - 0.9 * np.exp(-squared / (2 * (length / 4) ** 2)))
        return membranes

    def _light(self) -> Float[np.ndarray, "rows columns"]:
        """Brightness of the light; its slow waves have their crest off the centre."""
        place = (np.arange(self.pixels) + 0.5) / self.pixels
        sine, cosine = np.sin(2 * np.pi * place), np.cos(2 * np.pi * place)
        waves = 1 + 0.5 * self.uneven_gain * (sine[:, None] + cosine[None, :])
        away = (place - 0.5) ** 2
        return waves * (1 - self.vignetting * 2 * (away[:, None] + away[None, :]))


def label_image(tissue: Tissue | Foam, pixels: int) -> Int[np.ndarray, "rows columns"]:
    """The label image of a free cluster, with a margin, as of a perfect segmentation.

    **Arguments:**

    - `tissue`: a tissue with a [`Free`][vertax.Free] boundary; or a [`Foam`][vertax.io.Foam], with edges
        along their chains of pieces and not along arcs.
    - `pixels`: longer side of the image.

    **Returns:** for each pixel the number of its cell, from 1, or 0 outside. Rows are along y.

    **Raises:**

    - `ValueError` for another boundary, or fewer than 16 pixels.
    """
    foam = tissue if isinstance(tissue, Foam) else None
    drawn = tissue.tissue if isinstance(tissue, Foam) else tissue
    if not isinstance(drawn.boundary, Free):
        raise ValueError(
            "Argument `tissue` must have a free boundary, but its boundary is "
            f"{type(drawn.boundary).__name__}."
        )
    check_integer("pixels", pixels, at_least=16)
    if foam is None:
        polygons, sizes = Drawing(drawn, 60).polygons()
        outlines = [polygon[:size] for polygon, size in zip(polygons, sizes, strict=True)]
    else:
        outlines = _outlines(foam)
    corners = np.concatenate(outlines)
    low, extent = corners.min(axis=0), np.ptp(corners, axis=0)
    scale = 0.9 * pixels / extent.max()
    offset = 0.05 * pixels - low * scale
    shape = tuple(np.ceil(extent[::-1] * scale + 0.1 * pixels).astype(int).tolist())
    labels = np.zeros(shape, np.int32)
    for number, outline in enumerate(outlines, start=1):
        labels[_inside(outline * scale + offset, shape)] = number
    return labels


def _outlines(foam: Foam) -> list[Float[np.ndarray, "_ 2"]]:
    """The points around each cell."""
    m = foam.tissue.topology
    following, cell, edge, forward = (np.asarray(x) for x in (m.next, m.cell, m.edge, m.forward))
    outlines = []
    for number in range(foam.tissue.n_cells):
        first = current = int(np.flatnonzero(cell == number)[0])
        sides = []
        while not sides or current != first:
            chain = foam.chains[edge[current]]
            sides.append((chain if forward[current] else chain[::-1])[:-1])
            current = int(following[current])
        outlines.append(np.concatenate(sides))
    return outlines


def _inside(
    polygon: Float[np.ndarray, "corners 2"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "rows columns"]:
    """Which pixels have their centre inside: the outline crosses their row oddly often before them."""
    (x, y), (next_x, next_y) = polygon.T, np.roll(polygon, -1, axis=0).T
    centres = np.arange(shape[0])[:, None] + 0.5
    row, side = np.nonzero((y <= centres) != (next_y <= centres))
    share = (row + 0.5 - y[side]) / (next_y - y)[side]
    crossing = x[side] + share * (next_x - x)[side]
    column = np.clip(np.ceil(crossing - 0.5).astype(int), 0, shape[1])
    crossings = np.zeros((shape[0], shape[1] + 1), int)
    np.add.at(crossings, (row, column), 1)
    return np.cumsum(crossings, axis=1)[:, : shape[1]] % 2 == 1
