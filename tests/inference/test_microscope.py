"""Synthetic images, and label images of clusters."""

import jax
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue

import vertax as vx
from vertax.inference import Microscope, label_image


def take(**options):
    return Microscope(pixels=64, **options)(random_tissue(6), key=jax.random.key(1))


def test_an_image_has_the_noise_and_background_asked_for():
    clean = take()
    assert clean.max() == pytest.approx(1)
    np.testing.assert_allclose(take(background=0.3), clean + 0.3)
    assert np.std(take(noise=0.1) - clean) == pytest.approx(0.1, rel=0.05)
    ratio = take(background=0.3, uneven_gain=0.2) / (clean + 0.3)
    assert ratio.max() == pytest.approx(1.2, rel=1e-3)
    assert ratio.min() == pytest.approx(0.8, rel=1e-3)


def test_image_is_darker_at_the_corners():
    ratio = take(background=0.3, vignetting=0.4) / take(background=0.3)
    assert ratio[32, 32] == pytest.approx(1, abs=1e-3)
    assert ratio[0, 0] == pytest.approx(0.6, abs=0.02)


def test_faint_stretches_are_on_membranes_only():
    clean, faint = take(), take(faint=1.0)
    assert (np.abs(faint) <= np.abs(clean)).all()
    # Every edge has one in its middle.
    tissue = random_tissue(6)
    start, vector = (np.asarray(x) for x in tissue.edge_segments)
    pixel = Microscope(pixels=64).pixel_size(tissue)
    long = np.linalg.norm(vector, axis=1) > 4 * pixel
    column, row = (np.floor((start + vector / 2)[long] / pixel).astype(int) % 64).T
    assert (faint[row, column] < 0.35 * clean[row, column]).all()
    # Their number is the share asked for: none of none.
    np.testing.assert_array_equal(take(faint=0.0), clean)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="`vignetting` of Microscope must be in"):
        Microscope(vignetting=1.0)
    with pytest.raises(ValueError, match="`pixels` of Microscope must be at least 16"):
        Microscope(pixels=2)
    with pytest.raises(ValueError, match="square periodic box"):
        Microscope()(cluster(5), key=jax.random.key(0))


def test_a_label_image_gives_the_cluster_back():
    tissue = cluster(7, lloyd_steps=3)
    labels = label_image(tissue, 400)
    result = vx.initialise.from_labels(labels, boundary="free")
    np.testing.assert_array_equal(result.labels, np.arange(1, 8))
    assert vx.inference.same_neighbours(result.tissue, tissue)
    counts = np.bincount(labels.ravel())[1:]
    areas = np.asarray(tissue.areas)
    np.testing.assert_allclose(counts / counts.sum(), areas / areas.sum(), rtol=5e-3)


def test_only_clusters_have_label_images():
    with pytest.raises(ValueError, match="must have a free boundary"):
        label_image(random_tissue(6), 200)
    with pytest.raises(ValueError, match="`pixels` must be at least 16"):
        label_image(cluster(5), 3)
