"""From a membrane image to an inverse problem."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_CONTACT, relaxed

import vertax as vx
from vertax.inference import Microscope, PinnedEnergy, micrograph_problem


@pytest.fixture(scope="module")
def image():
    tissue, _ = relaxed(25, 2)
    return Microscope(pixels=160, psf_width=2.5, noise=0.03, background=0.1)(
        tissue, key=jax.random.key(0)
    )


@pytest.fixture(scope="module")
def pinned(image):
    return micrograph_problem(image, border="pinned", pixels=96, response=NO_CONTACT)


@pytest.mark.thorough
def test_a_pinned_border_does_not_move(pinned):
    problem = pinned.problem
    on_outline = np.asarray(problem.tissue.topology.on_outline)
    ends = np.unique(np.asarray(problem.tissue.topology.edge_vertices)[on_outline])
    before = np.asarray(pinned.segmentation.tissue.vertices)[ends]
    np.testing.assert_array_equal(np.asarray(pinned.first.tissue.vertices)[ends], before)
    assert 1 <= pinned.complete.sum() < problem.tissue.n_cells
    assert pinned.image.shape == (96, 96)
    assert pinned.pixel_size == pytest.approx(pinned.segmentation.pixel_size * 160 / 96)


@pytest.mark.thorough
def test_parameters_of_a_pinned_border(pinned):
    shape_factors, areas = pinned.parameters(pinned.problem.energy)
    np.testing.assert_allclose(shape_factors, 3.7)
    np.testing.assert_allclose(areas[pinned.complete], 1)
    with pytest.raises(TypeError, match="that of a fit of `problem`"):
        pinned.parameters(vx.energies.LineTension(1.0))


@pytest.mark.thorough
def test_correlation_and_contrast_fall_when_the_mesh_is_moved(pinned):
    tissue = pinned.segmentation.tissue
    moved = tissue.with_vertices(tissue.vertices + jnp.array([0.15, 0.1]))
    assert pinned.correlation(tissue) > 0.6
    assert pinned.correlation(moved) < pinned.correlation(tissue) - 0.05
    assert pinned.membrane_contrast(moved) < pinned.membrane_contrast(tissue) - 0.1
    value = float(jax.jit(lambda t: pinned.problem.cost(t, pinned.problem.energy))(tissue))
    assert pinned.correlation(tissue) == pytest.approx(np.sqrt(1 - 2 * value))


def test_the_rest_area_of_an_inner_cell_is_one():
    energy = PinnedEnergy(
        jnp.full(2, 3.7), jnp.log(jnp.array([0.5, 0.5])), jnp.array([True, False])
    )
    np.testing.assert_allclose(energy.mean_area, [1.0, 0.5])


def test_unknown_choices_are_refused(image):
    with pytest.raises(ValueError, match="`border` must be one of 'mirrored', 'pinned'"):
        micrograph_problem(image, border="open")
    with pytest.raises(ValueError, match="`rest_areas` must be one of"):
        micrograph_problem(image, rest_areas="none")


@pytest.mark.thorough
def test_a_cell_of_two_sides_on_a_pinned_outline_is_left_out(image):
    class Sliver(vx.initialise.Watershed):
        def __call__(self, image):
            labels = super().__call__(image)
            rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
            labels = np.where(np.isin(labels, rim), 0, labels)
            # A bump outside of a cell, on the lowest row of all cells.
            bottom = int(np.flatnonzero((labels > 0).any(axis=1)).max())
            middle = int(np.median(np.flatnonzero(labels[bottom] > 0)))
            labels[bottom + 1 : bottom + 5, middle - 4 : middle + 5] = labels.max() + 1
            return labels

    segmented = np.asarray(Sliver()(image))
    sliver = segmented.max()
    free = vx.initialise.from_labels(segmented, boundary="free", holes="close")
    assert sliver in free.labels
    read = micrograph_problem(
        image, segmenter=Sliver(), border="pinned", pixels=96, response=NO_CONTACT
    )
    assert set(read.segmentation.labels) == set(free.labels) - {sliver}
    assert not read.problem.tissue.overlaps.any
