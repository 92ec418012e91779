"""The index-aware structural (IAS) cost: the distance of two tissues by cell adjacency."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from vertax._base.arcs import length_factor
from vertax._base.checks import check_number
from vertax._base.minimum_maximum import maximum
from vertax.costs._cost import AbstractCost
from vertax.costs._positions import check_equal, check_target
from vertax.costs._transport import entropic_transport
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class IndexAwareStructural(AbstractCost):
    r"""Distance between the cell adjacencies of two tissues by optimal transport (paper, "IAS cost").

    1. The adjacency of two cells is $A_{ij} = \sum \ell / (\ell + \ell_0)$ over their interfaces of length
       $\ell$.
    2. The structure of a tissue is $S = 2I - A - \tfrac12 A^2$.
    3. The distance of cell $i$ of the tissue and cell $j$ of the target is
       $C_{ij} = \sqrt{d^2 + s^2} - s$ with $d = \|S_i - S^\mathrm{target}_j\|$.
    4. The cost is that of the entropic optimal transport between the cells, each of weight $1/N$
       (Cuturi 2013, "Sinkhorn distances"):

    $$L = \min_P \sum_{ij} P_{ij} C_{ij}
      + \varepsilon \Bigl(\sum_{ij} P_{ij} \log P_{ij} + \log N\Bigr)$$

    The constant $\log N$ makes $L \approx 0$ for equal tissues, if $\varepsilon$ is small compared with the
    distances between different cells (of order 1). Rows of $S$ are compared entry by entry, so $L$ depends
    on the indices of the cells ("index-aware").

    $A$ vanishes with the interface, is continuous through a T1 transition, and has a nonzero derivative at
    $\ell = 0$. The exterior of a free tissue is not a cell.

    First derivatives use the envelope theorem, $\partial L / \partial C = P$; second derivatives use implicit
    differentiation of the transport potentials.

    Spare slots contribute 0. A cell that exists in only one of the tissues is compared with a cell without
    neighbours.

    **Arguments:**

    - `target`: the target tissue, with the same number of cells.
    - `interface_length`: $\ell_0$, in units of length; by default 0.1 times the square root of the mean cell
        area of the target.
    - `epsilon`: strength $\varepsilon$ of the entropy, in units of the entries of $S$.
    - `softening`: $s$, in units of the entries of $S$; makes $L$ smooth at $d = 0$.

    **Raises:**

    - `ValueError` if the numbers of cells differ, or a setting is not positive.
    """

    target: Tissue
    interface_length: Float[Array, ""] | float | None = None
    epsilon: Float[Array, ""] | float = 0.1
    softening: Float[Array, ""] | float = 0.1

    def __check_init__(self):
        check_target("IndexAwareStructural", self.target)
        for name in ("interface_length", "epsilon", "softening"):
            value = getattr(self, name)
            if value is not None:
                check_number(name, value, above=0, many=True)

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Cost of the entropic optimal transport between the structures."""
        distances = self.distances(tissue)
        cost = entropic_transport(distances, jnp.asarray(self.epsilon, distances.dtype))
        if not (tissue.topology.spare or self.target.topology.spare):
            return cost
        # Spare slots are transported to spare slots at cost 0 and change only the weights 1/N.
        living = jnp.maximum(jnp.sum(tissue.alive), jnp.sum(self.target.alive))
        return cost * tissue.n_cells / living

    def distances(self, tissue: Tissue) -> Float[Array, "cells cells"]:
        """Distances $C$ between the cells of the tissue (rows) and of the target (columns)."""
        check_equal(type(self).__name__, tissue, self.target, "cells")
        length = self.interface_length
        if length is None:
            length = 0.1 * self.target.cell_size
        rows = structure(adjacency(tissue, length))
        columns = structure(adjacency(self.target, length))
        spare = tissue.topology.spare or self.target.topology.spare
        spare_rows, spare_columns = ~tissue.alive, ~self.target.alive
        if spare:
            rows, columns = (
                jnp.where(x[:, None], 0, y)
                for x, y in ((spare_rows, rows), (spare_columns, columns))
            )
        squared = _squared_distances(rows, columns)
        # √(d² + s²) - s = d² / (√(d² + s²) + s), which avoids the cancellation for d much smaller than s.
        distances = squared / (jnp.sqrt(squared + self.softening**2) + self.softening)
        if not spare:
            return distances
        # The k-th spare slot of the tissue has distance 0 only from the k-th spare slot of the target, which
        # makes the plan between spare slots unique.
        same = jnp.cumsum(spare_rows)[:, None] == jnp.cumsum(spare_columns)
        far = jax.lax.stop_gradient(jnp.max(distances))
        return jnp.where(spare_rows[:, None] & spare_columns, jnp.where(same, 0, far), distances)


def adjacency(
    tissue: Tissue, interface_length: Float[Array, ""] | float | None = None
) -> Float[Array, "cells cells"]:
    r"""Adjacency matrix of the cells: symmetric, with zeros on the diagonal.

    **Arguments:**

    - `tissue`: the tissue.
    - `interface_length`: $\ell_0$: the entries are $\sum \ell / (\ell + \ell_0)$ over the interfaces of two
        cells; by default they are 1 for cells that touch, and 0 otherwise.

    **Returns:** the matrix, without the exterior of a free tissue.

    **Raises:**

    - `ValueError` for an interface length that is not positive.
    """
    if interface_length is not None:
        check_number("interface_length", interface_length, above=0)
    m = tissue.topology
    left, right = m.edge_cells.T
    weights = jnp.ones(tissue.n_edges, tissue.vertices.dtype)
    if interface_length is not None:
        # A softened length does not vanish with the edge: subtract its value at length 0.
        length_at_zero = tissue.softening
        if tissue.angles is not None:
            length_at_zero = length_at_zero * length_factor(tissue.edge_angles)
        lengths = tissue.edge_lengths - length_at_zero
        weights = lengths / (lengths + interface_length)
    weights = jnp.where(left == right, 0, weights)
    matrix = jnp.zeros((m.n_faces, m.n_faces), weights.dtype)
    matrix = matrix.at[left, right].add(weights).at[right, left].add(weights)
    matrix = matrix[: m.n_cells, : m.n_cells]
    return matrix if interface_length is not None else jnp.minimum(matrix, 1)


def structure(adjacency: Float[Array, "cells cells"]) -> Float[Array, "cells cells"]:
    r"""The structure $2I - A - \tfrac12 A^2$ of an adjacency: first and second neighbours."""
    return (
        2 * jnp.eye(len(adjacency), dtype=adjacency.dtype) - adjacency - 0.5 * adjacency @ adjacency
    )


def mismatched_neighbours(tissue: Tissue, target: Tissue) -> int:
    """Number of neighbour pairs that differ between two tissues (the paper's discrete IAS error).

    1. Assign the cells of the target to those of the tissue, minimising the sum of the distances between
       their structures from binary adjacencies (Hungarian algorithm).
    2. Count the entries in which the rows of the adjacencies of assigned cells differ, and divide by two,
       because each pair has two cells.

    One T1 transition between otherwise equal tissues gives 2: one pair lost and one gained.

    **Arguments:**

    - `tissue`, `target`: the tissues, with the same number of cells.

    **Returns:** the number; divided by the number of interfaces it is a relative topological error.

    **Raises:**

    - `ValueError` if the numbers of cells differ.
    """
    check_equal("mismatched_neighbours", tissue, target, "cells")
    ours, theirs = adjacency(tissue), adjacency(target)
    distances = jnp.sqrt(_squared_distances(structure(ours), structure(theirs)))
    _, assigned = linear_sum_assignment(np.asarray(distances))
    return round(float(jnp.sum(jnp.abs(ours - theirs[assigned]))) / 2)


def _squared_distances(
    rows: Float[Array, "cells cells"], columns: Float[Array, "cells cells"]
) -> Float[Array, "cells cells"]:
    """Squared distances between the rows of two matrices."""
    squares = jnp.sum(rows**2, axis=1)[:, None] + jnp.sum(columns**2, axis=1)[None, :]
    return maximum(squares - 2 * rows @ columns.T, 0)
