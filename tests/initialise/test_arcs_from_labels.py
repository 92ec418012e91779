"""Arcs of all edges of a label image."""

import numpy as np
import pytest
from label_helpers import SHAPE, clear_seeds, rasterise

from vertax.initialise import from_labels


@pytest.mark.parametrize(
    "boundary",
    ["free", *(pytest.param(b, marks=pytest.mark.thorough) for b in ("periodic", "mirrored"))],
)
def test_arcs_of_all_edges_hold_the_areas_of_the_pixels(boundary):
    labels = rasterise(clear_seeds(20, SHAPE, 1), SHAPE, periodic=boundary == "periodic")
    if boundary == "free":
        rows, columns = np.indices(labels.shape)
        labels = np.where(np.hypot(rows - 60, columns - 80) < 55, labels, 0)
    result = from_labels(labels, boundary=boundary, inner_arcs=True, softening=0.0)
    assert result.tissue.inner_arcs
    pixels = np.bincount(labels.ravel())[result.labels]
    areas = np.asarray(result.tissue.areas) / np.square(result.pixel_size)
    assert result.inflated.size == 0
    if boundary == "mirrored":
        areas, pixels = areas[result.complete], pixels[result.complete]
    # Single pixels off their cell were given to a neighbour.
    np.testing.assert_allclose(areas, pixels, rtol=0, atol=3)
