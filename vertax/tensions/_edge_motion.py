"""Relative tensions of a moving cluster, from the motion of the points of its edges."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.optimize import least_squares

from vertax._base.checks import check_integer
from vertax.mesh import Free, Tissue

Chain = Float[np.ndarray, "_ 2"]


class MovingTensions(eqx.Module):
    """Tensions inferred from the motion of a cluster, relative to their mean."""

    tension: Float[np.ndarray, " edges"]
    """Tension of each edge of the first frame; those between two cells have the mean 1, those of edges on the
    outline are NaN."""
    deviation: Float[np.ndarray, " edges"]
    """Their standard deviations."""
    mobility: float
    """Velocity of a point over the force on it, in units of the mean tension."""
    misfit: Float[np.ndarray, " intervals"]
    """Root mean square distance, across edges, of the points at the end of each interval from their predicted
    positions."""
    moved: Float[np.ndarray, " intervals"]
    """Root mean square displacement of the points in each interval, across edges."""


class EdgeMotion:
    r"""A moving cluster of edges that are chains of points, each with a velocity proportional to its force:

    $$\zeta \dot x_i = - \frac{\partial}{\partial x_i} \sum_e \gamma_e \ell_e
      + \sum_c p_c \frac{\partial A_c}{\partial x_i}$$

    The pressures $p_c$ change the areas at a constant rate from one frame to the next. Points on the outline
    are interpolated linearly between their observed positions, because other forces than tensions may act
    there. In each interval the others start at their observed positions and are integrated up to the next
    frame; a fit of the tensions minimises their distances from the curves observed there. That needs no
    velocities, which differences between frames approximate badly where junctions are fast.

    ```python
    foams = [vx.io.read_surface_evolver(path) for path in paths]
    motion = vx.tensions.EdgeMotion(
        [f.tissue for f in foams], [f.chains for f in foams], [f.time for f in foams]
    )
    motion.tensions().tension
    ```

    **Arguments:**

    - `tissues`: a free cluster in two frames or more, with the same neighbours in all.
    - `chains`: for each frame the points of each edge from one end to the other, equally many in all frames.
        Each has the friction $\zeta$. Displacements along the edge are ignored.
    - `times`: times of the frames, increasing.
    - `substeps`: steps from one frame to the next (Heun's method, of second order). They must be shorter than
        the distance of two points over twice a relative tension.

    **Raises:**

    - `ValueError` for fewer than two frames, for times that do not increase, for tissues that have other
        neighbours, no exterior, or two cells that share two edges, and for chains of other sizes.
    """

    def __init__(
        self,
        tissues: Sequence[Tissue],
        chains: Sequence[Sequence[Chain]],
        times: Sequence[float | int],
        *,
        substeps: int = 50,
    ):
        check_integer("substeps", substeps, at_least=1)
        if not len(tissues) == len(chains) == len(times) >= 2:
            raise ValueError(
                "Arguments `tissues`, `chains` and `times` must hold two frames or more, and as many of "
                f"each, but hold {len(tissues)}, {len(chains)} and {len(times)}."
            )
        steps = np.diff(np.asarray(times, float))
        if not (steps > 0).all():
            raise ValueError(f"Argument `times` must increase, but is {list(times)}.")
        first = tissues[0]
        if not isinstance(first.boundary, Free):
            raise ValueError(
                "Argument `tissues` must hold free clusters, but the boundary of the first is "
                f"{type(first.boundary).__name__}."
            )
        courses = [
            _as_in_first(number, first, tissue, frame)
            for number, (tissue, frame) in enumerate(zip(tissues, chains, strict=True))
        ]
        rows = _numbered(first, [len(course) for course in courses[0]])
        points = np.zeros((len(courses), 1 + max(map(max, rows)), 2))
        for number, (frame, places) in enumerate(zip(courses, points, strict=True)):
            for edge, (row, course) in enumerate(zip(rows, frame, strict=True)):
                if len(row) != len(course):
                    raise ValueError(
                        "Argument `chains` must hold as many points of an edge in all frames, but edge "
                        f"{edge} has {len(row)} in frame 0 and {len(course)} in frame {number}."
                    )
                places[np.array(row)] = course
        self.n_cells, self.n_vertices = first.n_cells, first.n_vertices
        self.inner = ~np.asarray(first.topology.on_outline)
        self.substeps = substeps
        self._dt, self._points, self._rows = steps, points, rows
        sizes = [len(row) - 1 for row in rows]
        self._pieces = np.concatenate([np.stack([row[:-1], row[1:]], axis=1) for row in rows])
        self._edge = np.repeat(np.arange(len(rows)), sizes)
        n_pieces, n_points = len(self._pieces), points.shape[1]
        free = np.ones(n_points, bool)
        free[self._pieces[~self.inner[self._edge]]] = False
        self._free = np.flatnonzero(np.repeat(free, 2))
        # Coordinates are x and y of one point after the other; a piece goes from its first to its second.
        one = sp.kron(self._ends(1) - self._ends(0), sp.identity(2))
        self._difference = one.tocsr()
        each = np.arange(n_pieces)
        left, right = np.asarray(first.topology.edge_cells)[self._edge].T
        side = lambda cells: sp.csr_array(
            (np.ones(n_pieces), (cells, each)), (self.n_cells + 1, n_pieces)
        )
        self._sides = sp.csr_array(side(left) - side(right))[: self.n_cells].tocsr()

    def residuals(
        self, tension: Float[np.ndarray, " edges"]
    ) -> Float[np.ndarray, "intervals coordinates"]:
        r"""Distances of the predicted points at the end of each interval from the observed ones.

        Both components for junctions, and the one across the edge for other points; without points on the
        outline.

        **Arguments:**

        - `tension`: $\gamma / \zeta$ of each edge; values of edges on the outline are ignored.
        """
        return self._left(np.asarray(tension, float), False)[0]

    def predicted(self, tension: Float[np.ndarray, " edges"]) -> list[list[Chain]]:
        r"""The chains at the end of each interval, integrated from the observed chains at its start.

        **Arguments:**

        - `tension`: $\gamma / \zeta$ of each edge; values of edges on the outline are ignored.

        **Returns:** for each interval the points of each edge, in the order of the first tissue.
        """
        ends = [
            self._followed(number, np.asarray(tension, float), False)[0].reshape(-1, 2)
            for number in range(len(self._dt))
        ]
        return [[end[row] for row in self._rows] for end in ends]

    def tensions(self) -> MovingTensions:
        r"""The tensions that explain the motion best, by least squares.

        Their standard deviations are those of the Laplace approximation, with the residuals as noise,
        independent for each coordinate of a junction and for each edge.

        **Raises:**

        - `RuntimeError` if the fit does not converge.
        """
        which = np.flatnonzero(self.inner)
        on_all_edges = lambda inner: np.bincount(which, inner, len(self.inner))
        pace = self._pace(self.inner.astype(float))
        fit = least_squares(
            lambda relative: self._left(pace * on_all_edges(relative), False)[0].ravel(),
            np.ones(len(which)),
            lambda relative: pace * self._left(pace * on_all_edges(relative), True)[1][:, which],  # pyright: ignore[reportArgumentType]
            ftol=1e-4,
            xtol=1e-5,
            max_nfev=50,
        )
        if not fit.success:
            raise RuntimeError(
                "The tensions could not be found: after 50 steps they still change. Are the points the same "
                "in all frames, and the times right?"
            )
        estimate, slopes = pace * fit.x, fit.jac / pace
        # Points of one edge move together, and count as one.
        junctions = np.sum(self._free < 2 * self.n_vertices)
        n_independent = len(self._dt) * (junctions + len(which))
        variance = np.sum(fit.fun**2) / max(n_independent - len(which), 1)
        covariance = variance * np.linalg.pinv(slopes.T @ slopes, hermitian=True)
        mean = estimate.mean()
        # Jacobian of the relative tensions, γ over the mean.
        relative = (np.eye(len(which)) - estimate[:, None] / mean / len(which)) / mean
        tension, deviation = np.full((2, len(self.inner)), np.nan)
        tension[which] = estimate / mean
        deviation[which] = np.sqrt(np.diag(relative @ covariance @ relative.T))
        rms = lambda away: np.sqrt(2 * np.mean(np.square(away), axis=1))
        went = [
            self._across(end) @ (end - start).ravel()[self._free]
            for start, end in zip(self._points, self._points[1:], strict=False)
        ]
        left = fit.fun.reshape(len(self._dt), -1)
        return MovingTensions(tension, deviation, float(mean), rms(left), rms(went))

    def _left(
        self, tension: Float[np.ndarray, " edges"], sensitive: bool
    ) -> tuple[Float[np.ndarray, "intervals coordinates"], Float[np.ndarray, "all parameters"]]:
        """The residuals and, if `sensitive`, their Jacobian with respect to the tensions."""
        left, slopes = [], []
        for number, end in enumerate(self._points[1:]):
            x, dx = self._followed(number, tension, sensitive)
            across = self._across(end)
            left.append(across @ (x - end.ravel())[self._free])
            slopes.append(across @ dx)
        return np.stack(left), np.concatenate(slopes)

    def _followed(
        self, number: int, tension: Float[np.ndarray, " edges"], sensitive: bool
    ) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "free parameters"]]:
        """The predicted points at the end of an interval."""
        x = self._points[number].ravel()
        dx = np.zeros((len(self._free), len(tension) if sensitive else 0))
        drive = self._observed_rates(number)
        h = self._dt[number] / self.substeps
        for _ in range(self.substeps):  # Heun
            one, d_one = self._velocity(x, dx, tension, *drive)
            two, d_two = self._velocity(x + h * one, dx + h * d_one, tension, *drive)
            x, dx = x + 0.5 * h * (one + two), dx + 0.5 * h * (d_one + d_two)
        return x, dx

    def _observed_rates(
        self, number: int
    ) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, " cells"]]:
        """Observed velocities of points, and rates of the areas, in an interval."""
        start, end = self._points[number : number + 2].reshape(2, -1)
        dt = self._dt[number]
        return (end - start) / dt, (self._areas(end) - self._areas(start)) / dt

    def _velocity(
        self,
        x: Float[np.ndarray, " coordinates"],
        dx: Float[np.ndarray, "free parameters"],
        tension: Float[np.ndarray, " edges"],
        observed: Float[np.ndarray, " coordinates"],
        growth: Float[np.ndarray, " cells"],
    ) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "free parameters"]]:
        """Velocities of the points, and their derivatives by the tensions if those of `x` are `dx`."""
        free = self._free
        way = (self._difference @ x).reshape(-1, 2)
        length = np.linalg.norm(way, axis=1)
        along = way / length[:, None]
        pull = tension[self._edge]
        v = observed.copy()
        v[free] = -(self._difference.T @ (pull[:, None] * along).ravel())[free]
        area = self._area_slopes(x)
        loose = area[:, free]
        gram = (loose @ loose.T).toarray()
        # A uniform pressure causes no motion within a given outline: the sum of the pressures is 0.
        inverse = np.linalg.inv(gram + np.trace(gram) / len(gram) ** 2)
        pressure = inverse @ (growth - area @ v)
        v[free] += loose.T @ pressure
        if dx.shape[1] == 0:
            return v, dx
        # Derivatives of the pulls (only across pieces), of the pressures, and of the velocities.
        stretched = self._difference[:, free]
        ways = (stretched @ dx).reshape(len(way), 2, -1)
        turned = np.stack([-along[:, 1], along[:, 0]], axis=1)
        swing = turned[:, :1] * ways[:, 0] + turned[:, 1:] * ways[:, 1]
        swing *= (pull / length)[:, None]
        pulls = (turned[:, :, None] * swing[:, None]).reshape(2 * len(way), -1)
        dv = -(stretched.T @ pulls)
        each = np.arange(along.size)
        by_edge = sp.csr_array(
            (along.ravel(), (each, np.repeat(self._edge, 2))), (along.size, dx.shape[1])
        )
        dv -= (stretched.T @ by_edge).toarray()
        dv += self._area_curvature(pressure)[free][:, free] @ dx
        dv += loose.T @ -(inverse @ (self._area_slopes(v)[:, free] @ dx + loose @ dv))
        return v, dv

    def _pace(self, tension: Float[np.ndarray, " edges"]) -> float:
        """The factor of the tensions that fits the observed velocities of the junctions best."""
        junctions = self._free[self._free < 2 * self.n_vertices]
        no_slopes = np.zeros((len(self._free), 0))
        sums = np.zeros(2)
        for number, start in enumerate(self._points[:-1].reshape(len(self._dt), -1)):
            observed, growth = self._observed_rates(number)
            rest, _ = self._velocity(start, no_slopes, 0 * tension, observed, growth)
            pulled, _ = self._velocity(start, no_slopes, tension, observed, growth)
            pulled, observed = (pulled - rest)[junctions], (observed - rest)[junctions]
            sums += pulled @ observed, pulled @ pulled
        return sums[0] / sums[1]

    def _ends(self, which: int) -> sp.csr_array:
        """The matrix that selects the first or second point of each piece."""
        n = len(self._pieces)
        places = (np.arange(n), self._pieces[:, which])
        return sp.csr_array((np.ones(n), places), (n, self._points.shape[1]))

    def _areas(self, x: Float[np.ndarray, " coordinates"]) -> Float[np.ndarray, " cells"]:
        a, b = x.reshape(-1, 2)[self._pieces.T]
        return self._sides @ (0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))

    def _area_slopes(self, x: Float[np.ndarray, " coordinates"]) -> sp.csr_array:
        """Derivatives of areas, which are linear in `x`."""
        a, b = x.reshape(-1, 2)[self._pieces.T]
        columns = np.stack([2 * self._pieces, 2 * self._pieces + 1], axis=2).reshape(-1, 4)
        values = 0.5 * np.stack([b[:, 1], -b[:, 0], -a[:, 1], a[:, 0]], axis=1)
        rows = 4 * np.arange(len(a) + 1)
        swept = sp.csr_array((values.ravel(), columns.ravel(), rows), (len(a), len(x)))
        return (self._sides @ swept).tocsr()

    def _area_curvature(self, pressure: Float[np.ndarray, " cells"]) -> sp.csr_array:
        """Second derivatives of the areas, times pressures."""
        share = 0.5 * (self._sides.T @ pressure)
        a, b = 2 * self._pieces.T
        rows = np.concatenate([a, b + 1, a + 1, b])
        columns = np.concatenate([b + 1, a, b, a + 1])
        values = np.concatenate([share, share, -share, -share])
        n = 2 * self._points.shape[1]
        return sp.csr_array((values, (rows, columns)), (n, n))

    def _across(self, end: Float[np.ndarray, "points 2"]) -> sp.csr_array:
        """The matrix that removes the components along edges from displacements of free points."""
        n = len(end)
        # Each point within an edge is the second of one piece and the first of the next.
        before, after = np.arange(n), np.arange(n)
        before[self._pieces[:, 1]], after[self._pieces[:, 0]] = self._pieces.T
        along = end[after] - end[before]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
        blocks = across[:, :, None] * across[:, None]
        blocks[: self.n_vertices] = np.eye(2)
        matrix = sp.bsr_array((blocks, np.arange(n), np.arange(n + 1))).tocsr()
        return matrix[self._free][:, self._free]


def _numbered(tissue: Tissue, sizes: Sequence[int]) -> list[list[int]]:
    """Numbers of the points of each edge; vertices first."""
    m = tissue.topology
    half_edge = np.asarray(m.half_edge)
    first, last = np.asarray(m.source)[half_edge], np.asarray(m.target)[half_edge]
    ends = tissue.n_vertices + np.cumsum(np.array(sizes) - 2)
    return [
        [int(a), *range(end - size + 2, end), int(b)]
        for a, b, end, size in zip(first, last, ends.tolist(), sizes, strict=True)
    ]


def _as_in_first(
    number: int, first: Tissue, tissue: Tissue, chains: Sequence[Chain]
) -> list[Chain]:
    """The chains of a frame in the order, and the directions, of the edges of the first tissue."""
    if len(chains) != tissue.n_edges:
        raise ValueError(
            f"Argument `chains` must hold a chain for each of {tissue.n_edges} edges, but frame {number} "
            f"holds {len(chains)}."
        )
    by_cells: dict[tuple[int, ...], Chain] = {}
    for cells, chain in zip(np.asarray(tissue.topology.edge_cells).tolist(), chains, strict=True):
        by_cells[tuple(cells)] = np.asarray(chain)
        by_cells[tuple(cells[::-1])] = np.asarray(chain)[::-1]
    if len(by_cells) != 2 * tissue.n_edges:
        raise ValueError(
            f"In frame {number} two cells share two edges, which cannot be told apart. Leave out such frames."
        )
    wanted = [tuple(cells) for cells in np.asarray(first.topology.edge_cells).tolist()]
    if not set(wanted) <= set(by_cells):
        missing = next(cells for cells in wanted if cells not in by_cells)
        raise ValueError(
            f"Cells {missing[0]} and {missing[1]} are neighbours in frame 0 and not in frame {number}: "
            "tensions are those of edges that stay. Begin after the transition, or end before it."
        )
    return [by_cells[cells] for cells in wanted]
