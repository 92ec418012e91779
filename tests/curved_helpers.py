"""A foam with known tensions, and the published cells of a curved epithelium."""

import jax
import jax.numpy as jnp
import numpy as np

import vertax as vx
from vertax.energies import AreaElasticity, LineTension

# Centre x and y in micrometres, and area in space, of the sample of DeProj.
_PUBLISHED = np.array(
    [
        [3.5615, 3.6656, 12.317],
        [2.4705, 11.183, 8.0176],
        [2.6884, 26.749, 5.141],
        [3.6096, 14.773, 13.812],
        [5.0077, 8.8491, 40.057],
    ]
)


def foam_at_rest(cluster):
    """A foam in the plane, and the tensions of its edges."""
    tension = 1 + 0.2 * jax.random.normal(jax.random.key(4), (cluster.n_edges,))
    energy = AreaElasticity(20.0, 1.0) + LineTension(0.5 * jnp.clip(tension, 0.5))
    arcs = vx.Tissue(
        cluster.vertices,
        cluster.topology,
        cluster.boundary,
        angles=np.zeros(cluster.n_edges),
        inner_arcs=True,
    )
    return vx.equilibrate(arcs, energy).tissue, np.asarray(jnp.clip(tension, 0.5))


def check_published_areas(centroids, areas):
    """The five published cells are there, with their areas within 3 %."""
    away = np.linalg.norm(np.asarray(centroids)[:, None] - _PUBLISHED[:, :2], axis=-1)
    assert away.min(axis=0).max() < 0.3
    np.testing.assert_allclose(areas[np.argmin(away, axis=0)], _PUBLISHED[:, 2], rtol=0.03)
