"""Mean stress of a tissue and its anisotropy, with standard deviations."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, csr_array

from vertax.mesh import Tissue, geometry_of


class MeanStress(eqx.Module):
    r"""Mean stress of the cells with inferred tensions of all their edges (Batchelor 1970,
    doi:10.1017/S0022112070000745),

    $$\sigma = \frac{1}{\sum_c A_c} \Big( \sum_e \frac{n_e}{2} \gamma_e \int_e t\,t^T \,dl
      - \sum_c p_c A_c\, I \Big),$$

    with the number $n_e$ of these cells beside the edge; tension is positive. Units: mean tension over the
    unit of length. Pressures are less their mean, so that only the deviator is determined.
    """

    tensor: Float[np.ndarray, "2 2"]
    """The stress; NaN if no cell has all its tensions."""
    tensor_deviations: Float[np.ndarray, "2 2"]
    """Standard deviations of its components."""
    anisotropy: float
    """Half the difference of the principal stresses."""
    anisotropy_deviation: float
    """Its standard deviation."""
    direction: float
    """Direction of the larger principal stress, in radians from x towards y, between -π/2 and π/2."""
    direction_deviation: float
    """Its standard deviation, radians."""
    n_cells: int
    """Number of cells in the mean."""


def fabric(tissue: Tissue) -> Float[np.ndarray, "edges 2 2"]:
    """Integral of t t over each arc, with the tangent t, a length."""
    # Along an arc the tangent t turns from -α to α; the mean of t t has an entry along the chord, `share`,
    # and one across.
    geometry = geometry_of(tissue)
    chord, angle, length = geometry.edge_vectors, geometry.edge_angles, geometry.edge_lengths
    unit = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-300)[:, None]
    aside = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    share = 0.5 * (1 + np.sinc(2 * angle / np.pi))
    outer = lambda x: x[:, :, None] * x[:, None, :]
    mean = share[:, None, None] * outer(unit) + (1 - share)[:, None, None] * outer(aside)
    return length[:, None, None] * mean


def stress_operators(
    tissue: Tissue, tangents: Float[np.ndarray, "edges 2 2"], areas: Float[np.ndarray, " cells"]
) -> list[csr_array]:
    """Matrices of the stresses xx, xy and yy of cells times their areas, by all tensions and pressures.

    `tangents` are the integrals of t t over the edges, see `fabric`.
    """
    beside = geometry_of(tissue).edge_cells
    edge, side = np.nonzero(beside < tissue.n_cells)
    cell, cells = beside[edge, side], np.arange(tissue.n_cells)
    row, column = np.append(cell, cells), np.append(edge, tissue.n_edges + cells)
    shape = tissue.n_cells, tissue.n_edges + tissue.n_cells
    pulls = [(0.5 * tangents[edge, i, j], -(i == j) * areas) for i, j in ((0, 0), (0, 1), (1, 1))]
    return [csr_array(coo_array((np.append(*x), (row, column)), shape=shape)) for x in pulls]


def mean_stress(
    values: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"], n_cells: int
) -> MeanStress:
    """The mean stress from its components xx, xy and yy, and their covariance."""
    if n_cells == 0:
        values, covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
    square = lambda x: np.array([[x[0], x[1]], [x[1], x[2]]])
    deviator = np.array([0.5 * (values[0] - values[2]), values[1]])
    reduce = np.array([[0.5, 0, -0.5], [0, 1, 0]])
    spread = reduce @ covariance @ reduce.T
    size = float(np.hypot(*deviator))
    along = deviator / max(size, 1e-300)
    across = np.array([-along[1], along[0]])
    return MeanStress(
        tensor=square(values),
        tensor_deviations=np.sqrt(square(np.diag(covariance))),
        anisotropy=size,
        anisotropy_deviation=float(np.sqrt(along @ spread @ along)),
        direction=float(0.5 * np.arctan2(deviator[1], deviator[0])),
        direction_deviation=float(0.5 * np.sqrt(across @ spread @ across) / max(size, 1e-300)),
        n_cells=n_cells,
    )
