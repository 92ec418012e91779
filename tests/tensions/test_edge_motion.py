"""Tensions from the motion of the points of edges."""

import functools
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.tensions import EdgeMotion

DATA = Path(os.environ.get("VERTAX_DATA", Path(__file__).parents[3] / "shared/data"))


@functools.cache
def drawn():
    """A cluster with chains as edges, and tensions out of balance."""
    cluster = vx.initialise.free_voronoi(7, key=3, lloyd_steps=2)
    chains = list(np.asarray(cluster.edge_points(jnp.linspace(0, 1, 6))))
    rng = np.random.default_rng(0)
    return cluster, chains, rng.uniform(0.7, 1.3, cluster.n_edges)


def held(*times, substeps=20):
    cluster, chains, _ = drawn()
    n = len(times)
    return EdgeMotion([cluster] * n, [chains] * n, times, substeps=substeps)


def areas(chains):
    """Areas of the cells within chains."""
    cluster, _, _ = drawn()
    total = np.zeros(cluster.n_cells + 1)
    for course, (left, right) in zip(chains, cluster.topology.edge_cells, strict=True):
        x, y = np.asarray(course).T
        swept = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
        total[left] += swept
        total[right] -= swept
    return total[:-1]


def movie(substeps=20):
    """Three frames: the outline holds."""
    cluster, chains, tension = drawn()
    frames = [chains]
    for number in (1, 2):
        frames += held(0, 0.02 * number, substeps=substeps * number).predicted(tension)
    return EdgeMotion([cluster] * 3, frames, [0, 0.02, 0.04], substeps=substeps), frames


def test_areas_are_constant_and_energy_decreases():
    cluster, chains, tension = drawn()
    length = lambda frame: sum(
        t * np.linalg.norm(np.diff(c, axis=0), axis=1).sum()
        for t, c in zip(tension, frame, strict=True)
    )
    frames = movie()[1]
    for frame in frames:
        np.testing.assert_allclose(areas(frame), areas(chains), atol=1e-5)
        np.testing.assert_allclose(areas(chains), cluster.areas, atol=0.05)
    lengths = [length(frame) for frame in frames]
    assert lengths[0] > lengths[1] > lengths[2]


def test_initial_velocity_of_a_junction_is_its_force():
    # In a short time a junction of straight edges moves along the sum of the tensions; pressures push
    # across. Here all are equal and every edge is straight, so its neighbours on the way do not move.
    _, chains, tension = drawn()
    motion = held(0, 1e-6, substeps=1)
    (after,) = motion.predicted(tension)
    speed = np.concatenate([(b - a) / 1e-6 for a, b in zip(chains, after, strict=True)])
    along = [
        np.einsum("px,x->p", b[1:-1] - a[1:-1], (a[-1] - a[0]) / np.linalg.norm(a[-1] - a[0]))
        for a, b, inner in zip(chains, after, motion.inner, strict=True)
        if inner
    ]
    np.testing.assert_allclose(np.concatenate(along) / 1e-6, 0, atol=1e-3)
    assert np.abs(speed).max() > 0.1


def test_its_sensitivities_match_finite_differences():
    motion, _ = movie()
    _, _, tension = drawn()
    rng = np.random.default_rng(1)
    direction = rng.normal(size=len(tension)) * motion.inner
    slopes = np.stack([motion._left(k, 1.1 * tension, sensitive=True) for k in range(2)])[..., 1:]
    step = 1e-5 * direction
    difference = motion.residuals(1.1 * tension + step) - motion.residuals(1.1 * tension - step)
    np.testing.assert_allclose(slopes @ direction[motion.inner], difference / 2e-5, atol=1e-8)


def test_tensions_of_a_movie_agree_within_their_errors():
    cluster, _, tension = drawn()
    motion, frames = movie()
    inner = motion.inner
    true = tension[inner] / tension[inner].mean()
    result = motion.tensions()
    np.testing.assert_allclose(result.tensions[inner], true, rtol=1e-3)
    assert np.isnan(result.tensions[~inner]).all()
    assert result.motion is not None
    np.testing.assert_allclose(result.motion.mobility, tension[inner].mean(), rtol=1e-3)
    assert (result.motion.misfit < 1e-3 * result.motion.moved).all()
    rng = np.random.default_rng(2)
    blurred = [[c + 1e-4 * rng.normal(size=c.shape) for c in frame] for frame in frames]
    noisy = EdgeMotion([cluster] * 3, blurred, [0, 0.02, 0.04], substeps=20).tensions()
    off = np.abs(noisy.tensions[inner] - true)
    assert np.mean(off < 2 * noisy.tension_deviations[inner]) > 0.8
    assert 0 < noisy.tension_deviations[inner].max() < 0.3
    off = np.abs(noisy.pressures - result.pressures)
    assert np.mean(off < 2 * noisy.pressure_deviations) > 0.6
    assert np.median(noisy.pressure_deviations) < 3 * np.median(off)


def test_edges_may_be_numbered_otherwise_in_another_frame():
    cluster, _, _ = drawn()
    motion, frames = movie()
    m = cluster.topology
    # The same cells around vertices in reverse order.
    place = np.arange(m.n_half_edges).reshape(-1, 3)[::-1].ravel()
    twin = np.argsort(place)[np.asarray(m.twin)[place]]
    topology = vx.Topology(
        twin, np.asarray(m.cell)[place], np.asarray(m.frame)[place], exterior=True
    )
    other = vx.Tissue(np.asarray(cluster.vertices)[::-1], topology, vx.Free())
    by_cells = {}
    for (left, right), course in zip(np.asarray(m.edge_cells).tolist(), frames[1], strict=True):
        by_cells[left, right], by_cells[right, left] = course, course[::-1]
    turned = [by_cells[tuple(cells)] for cells in np.asarray(topology.edge_cells).tolist()]
    again = EdgeMotion(
        [cluster, other, cluster], [frames[0], turned, frames[2]], [0, 0.02, 0.04], substeps=20
    )
    assert not np.array_equal(topology.edge_cells, m.edge_cells)
    ones = np.ones(cluster.n_edges)
    np.testing.assert_array_equal(again.residuals(ones), motion.residuals(ones))


@pytest.mark.thorough
@pytest.mark.skipif(not DATA.exists(), reason="the data of Surface Evolver are not here")
@pytest.mark.parametrize("first", [1, 2])
def test_the_movie_of_surface_evolver(first):
    # An edge between the frames has a length of 0.05, and cells one of 21.
    paths = [DATA / f"surface_evolver/movie_{i}.dmp" for i in (first, first + 1)]
    foams = [vx.io.read_surface_evolver(path) for path in paths]
    motion = EdgeMotion(
        [f.tissue for f in foams], [f.chains for f in foams], [f.time for f in foams]
    )
    result = motion.tensions()
    true = np.asarray(foams[0].tensions)[motion.inner]
    relative = result.tensions[motion.inner] / (true / true.mean())
    assert np.corrcoef(result.tensions[motion.inner], true)[0, 1] > 0.9999
    assert np.mean(np.abs(relative - 1)) < 0.01
    assert result.warnings == ()
    assert result.cell_table()["pressure"].shape == (37,)
    unresolved = ~motion.inner & ~np.asarray(foams[0].tissue.topology.on_outline)
    assert set(result.reasons[unresolved]) == {"no junction that moves"}
    if first == 2:  # the pressures of frame 1 are those before the tensions changed
        assert np.corrcoef(result.pressures, foams[0].pressures)[0, 1] > 0.98


@pytest.mark.usefixtures("without_type_checks")
class TestBadInput:
    def test_frames(self):
        cluster, chains, _ = drawn()
        with pytest.raises(ValueError, match="two frames or more"):
            EdgeMotion([cluster], [chains], [0.0])
        with pytest.raises(ValueError, match="`times` must increase"):
            held(0.0, 0.0)
        with pytest.raises(ValueError, match="has 6 in frame 0 and 5 in frame 1"):
            EdgeMotion([cluster] * 2, [chains, [chains[0][:-1], *chains[1:]]], [0, 1])
        with pytest.raises(ValueError, match="frame 1 holds"):
            EdgeMotion([cluster] * 2, [chains, chains[1:]], [0, 1])

    def test_tissues(self):
        cluster, chains, _ = drawn()
        periodic = vx.initialise.periodic_voronoi(9, key=0)
        with pytest.raises(ValueError, match="free clusters"):
            EdgeMotion([periodic] * 2, [chains] * 2, [0, 1])
        other = vx.initialise.free_voronoi(7, key=5, lloyd_steps=2)
        others = list(np.asarray(other.edge_points(jnp.linspace(0, 1, 6))))
        with pytest.raises(ValueError, match=r"neighbours in frame 0 and not|share two edges"):
            EdgeMotion([cluster, other], [chains, others], [0, 1])
