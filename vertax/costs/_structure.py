"""Who is next to whom, as a cost: the index-aware structural (IAS) cost."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from vertax._base.checks import check_number
from vertax._base.minimum_maximum import maximum
from vertax.costs._cost import AbstractCost
from vertax.costs._positions import check_equal, check_target
from vertax.costs._transport import entropic_transport
from vertax.energies import AbstractEnergy
from vertax.energies._units import cell_size
from vertax.mesh import Tissue
from vertax.mesh._arcs import length_factor


class IndexAwareStructural(AbstractCost):
    r"""How differently the cells of two tissues are connected (paper, "IAS cost").

    From the adjacency $A$ of the cells of each tissue, its structure $S = 2I - A - \tfrac12 A^2$; from
    the rows of the two structures the distances $C_{ij} = \|S_i - S^\mathrm{target}_j\|$; and from
    these the entropic optimal transport between the cells of both, each of weight $1/N$:

    $$L = \min_P \sum_{ij} P_{ij} C_{ij}
      + \varepsilon \Bigl(\sum_{ij} P_{ij} \log P_{ij} + \log N\Bigr)$$

    The constant makes $L = 0$ for equal tissues, as far as $\varepsilon$ is small against the distances
    between different cells (some units). Rows are compared entry by entry, so cells keep their numbers:
    hence "index-aware".

    A matrix of zeros and ones has no derivative. Here $A_{ij} = \sum \ell / (\ell + \ell_0)$ over the
    interfaces of the two cells: it vanishes with the interface, is continuous through a T1 transition
    and has a slope at length zero that goes on pushing. The exterior of a free tissue is no cell.

    The first derivatives are those of the envelope theorem, $\partial L / \partial C = P$, and need no
    derivative of the solver; second derivatives are right too (implicit differentiation of the
    transport potentials).

    Spare slots count for nothing. A cell that only one of the tissues has costs as much as a cell without
    neighbours would.

    Paper: M. Cuturi (2013), "Sinkhorn distances", for the entropic transport.

    **Arguments:**

    - `target`: the target tissue, with as many cells.
    - `interface_length`: $\ell_0$, in units of length; left out, a tenth of the root of the mean cell
        area of the target.
    - `epsilon`: strength $\varepsilon$ of the entropy, in units of the entries of $S$.
    - `softening`: distances below this count quadratically, so that $L$ is smooth where tissues agree:
        $\sqrt{d^2 + s^2} - s$ in place of $d$.

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
        """Cost of the optimal transport between the structures."""
        distances = self.distances(tissue)
        cost = entropic_transport(distances, jnp.asarray(self.epsilon, distances.dtype))
        if not (tissue.topology.spare or self.target.topology.spare):
            return cost
        # Spare slots are transported to spare slots for nothing: what they add is weight alone.
        living = jnp.maximum(jnp.sum(tissue.alive), jnp.sum(self.target.alive))
        return cost * tissue.n_cells / living

    def distances(self, tissue: Tissue) -> Float[Array, "cells cells"]:
        """Distance of each cell's structure (first axis) from that of each cell of the target."""
        check_equal(type(self).__name__, tissue, self.target, "cells")
        length = self.interface_length
        if length is None:
            length = 0.1 * cell_size(self.target)
        rows = structure(adjacency(tissue, length))
        columns = structure(adjacency(self.target, length))
        spare = tissue.topology.spare or self.target.topology.spare
        none, gone = ~tissue.alive, ~self.target.alive
        if spare:
            rows, columns = (
                jnp.where(x[:, None], 0, y) for x, y in ((none, rows), (gone, columns))
            )
        squared = _squared_distances(rows, columns)
        # √(d² + s²) - s, without the difference, which cancels for d far below s.
        distances = squared / (jnp.sqrt(squared + self.softening**2) + self.softening)
        if not spare:
            return distances
        # The first spare slot belongs to the first, and so on, so that there is nothing to choose.
        same = jnp.cumsum(none)[:, None] == jnp.cumsum(gone)
        far = jax.lax.stop_gradient(jnp.max(distances))
        return jnp.where(none[:, None] & gone, jnp.where(same, 0, far), distances)


def adjacency(
    tissue: Tissue, interface_length: Float[Array, ""] | float | None = None
) -> Float[Array, "cells cells"]:
    r"""Which cells touch: symmetric, with zeros on the diagonal.

    **Arguments:**

    - `tissue`: the tissue.
    - `interface_length`: $\ell_0$: each interface of length $\ell$ counts $\ell / (\ell + \ell_0)$;
        left out, cells that touch count 1, however often they do.

    **Returns:** the matrix; the exterior of a free tissue is left out.

    **Raises:**

    - `ValueError` for an interface length that is not positive.
    """
    if interface_length is not None:
        check_number("interface_length", interface_length, above=0)
    m = tissue.topology
    left, right = m.edge_cells.T
    weights = jnp.ones(tissue.n_edges, tissue.vertices.dtype)
    if interface_length is not None:
        # Softened lengths do not vanish with their edge: what is left of them is taken away.
        rest = tissue.softening
        if tissue.angles is not None:
            rest = rest * length_factor(tissue.edge_angles)
        lengths = tissue.edge_lengths - rest
        weights = lengths / (lengths + interface_length)
    weights = jnp.where(left == right, 0, weights)
    matrix = jnp.zeros((m.n_faces, m.n_faces), weights.dtype)
    matrix = matrix.at[left, right].add(weights).at[right, left].add(weights)
    matrix = matrix[: m.n_cells, : m.n_cells]
    return matrix if interface_length is not None else jnp.minimum(matrix, 1)


def structure(adjacency: Float[Array, "cells cells"]) -> Float[Array, "cells cells"]:
    r"""The structure $2I - A - \tfrac12 A^2$ of an adjacency: neighbours, and theirs."""
    return 2 * jnp.eye(len(adjacency)) - adjacency - 0.5 * adjacency @ adjacency


def mismatched_neighbours(tissue: Tissue, target: Tissue) -> int:
    """How many neighbourships differ between two tissues (the paper's discrete IAS error).

    Cells are assigned to each other so that the distances of their structures, from who touches whom
    alone, have the smallest sum (Hungarian method); then the neighbours that only one of two assigned
    cells has are counted, and divided by two, because two cells take part in each. One T1 between
    otherwise equal tissues gives 2: a neighbourship lost and one gained.

    **Arguments:**

    - `tissue`, `target`: the tissues, with equally many cells.

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
    """Squared distance of each row of one matrix from each row of another."""
    squares = jnp.sum(rows**2, axis=1)[:, None] + jnp.sum(columns**2, axis=1)[None, :]
    return maximum(squares - 2 * rows @ columns.T, 0)
