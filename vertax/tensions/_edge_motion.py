"""Relative tensions of a moving cluster, from the motion of the points of its edges."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from vertax._base.blas import one_blas_thread
from vertax._base.checks import as_times, check_integer
from vertax.mesh import Free, Tissue
from vertax.tensions._curves import Points, correlation_length
from vertax.tensions._inferred import InferredTensions, MotionFit
from vertax.tensions._outcome import Relative, assembled, is_determined

Chain = Float[np.ndarray, "_ 2"]

# Largest relaxation rate of an edge, over that of frames, at which its motion is integrated.
_FASTEST = 20.0
# Distance of points, relative to the median, below which the force of a trial decreases with it, so that an
# edge may shrink to a point.
_SOFT = 0.005
# Largest number of Gauss-Newton steps, and mean square of the change over the standard deviation at which
# they end.
_ROUNDS, _DECREASE = 30, 1e-2
# Number of samples of the noise of points.
_SAMPLES = 16
# Factor of the estimated spectral radius, because lengths change within a step.
_SAFETY = 1.2
# Second derivatives of the area ½ (a × b) swept by a piece from a to b.
_CURVATURE = 0.5 * np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, -1, 0, 0], [1, 0, 0, 0]])


class EdgeMotion:
    r"""A moving cluster of edges that are chains of points, each with a velocity proportional to its force:

    $$\zeta \dot x_i = - \frac{\partial}{\partial x_i} \sum_e \gamma_e \ell_e
      + \sum_c p_c \frac{\partial A_c}{\partial x_i}$$

    The pressures $p_c$ change the areas at a constant rate from one frame to the next. Points on the outline
    are interpolated linearly between their observed positions, because other forces than tensions may act
    there. So are those of edges that shrink to a point or grow from one: edges so short that they relax more
    than 20 times between two frames. In each interval the other points start at their observed positions and
    are integrated up to the next frame; a fit of the tensions minimises their distances from the curves
    observed there. That needs no velocities, which differences between frames approximate badly where
    junctions are fast.

    ```python
    foams = [vx.io.read_surface_evolver(path) for path in paths]
    motion = vx.tensions.EdgeMotion(
        [f.tissue for f in foams], [f.chains for f in foams], [f.time for f in foams]
    )
    motion.tensions().tensions
    ```

    **Arguments:**

    - `tissues`: a free cluster in two frames or more, with the same neighbours in all.
    - `chains`: for each frame the points of each edge from one end to the other, equally many in all frames.
        Each has the friction $\zeta$. Displacements along the edge are ignored.
    - `times`: times of the frames, increasing.
    - `substeps`: steps from one frame to the next, of a Runge–Kutta–Legendre method of second order (Meyer,
        Balsara & Aslam 2014, doi:10.1016/j.jcp.2013.08.021), with as many stages as stability requires.

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
        substeps: int = 10,
    ):
        check_integer("substeps", substeps, at_least=1)
        if not len(tissues) == len(chains) == len(times) >= 2:
            raise ValueError(
                "Arguments `tissues`, `chains` and `times` must hold two frames or more, and as many of "
                f"each, but hold {len(tissues)}, {len(chains)} and {len(times)}."
            )
        as_times(times)
        first = tissues[0]
        if not isinstance(first.boundary, Free):
            raise ValueError(
                "Argument `tissues` must hold free clusters, but the boundary of the first is "
                f"{type(first.boundary).__name__}."
            )
        frames = [
            _as_in_first(number, first, tissue, frame)
            for number, (tissue, frame) in enumerate(zip(tissues, chains, strict=True))
        ]
        rows = _numbered(first, [len(chain) for chain in frames[0]])
        points = np.zeros((len(frames), 1 + max(map(max, rows)), 2))
        for number, (frame, places) in enumerate(zip(frames, points, strict=True)):
            for edge, (row, chain) in enumerate(zip(rows, frame, strict=True)):
                if len(row) != len(chain):
                    raise ValueError(
                        "Argument `chains` must hold as many points of an edge in all frames, but edge "
                        f"{edge} has {len(row)} in frame 0 and {len(chain)} in frame {number}."
                    )
                places[np.array(row)] = chain
        self.tissue, self.substeps = first, substeps
        self._dt, self._points, self._rows = np.diff(np.asarray(times, float)), points, rows
        self._pieces = np.concatenate([np.stack([row[:-1], row[1:]], axis=1) for row in rows])
        self._edge = np.repeat(np.arange(len(rows)), [len(row) - 1 for row in rows])
        # Coordinates are x and y of one point after the other; a piece has four, and two cells.
        place = (2 * self._pieces[:, :, None] + np.array([0, 1])).reshape(-1, 4)
        self._place: Int[np.ndarray, "pieces 4"] = place.astype(int)
        self._cells = np.asarray(first.topology.edge_cells)[self._edge]
        shape = (len(self._place), 4, 4)
        row, column = (
            np.broadcast_to(x, shape) for x in (self._place[..., None], self._place[:, None])
        )
        self._stiffness = _Pattern(row, column, 2 * (points[0].size,))
        sides, places = np.broadcast_arrays(self._cells[:, :, None], self._place[:, None])
        self._areas = _Pattern(sides, places, (first.n_cells, points[0].size))
        self._spacing = 0.0
        lengths = np.stack([self._ways(x.ravel())[1] for x in points])
        self._spacing = float(np.median(lengths))
        within = ~np.asarray(first.topology.on_outline)
        self._use(np.tile(within, (len(self._dt), 1)))
        # Edges that shrink to a point, or grow from one, move as observed.
        rate = 4 * self._pace() * self._dt[:, None] / np.minimum(lengths[1:], lengths[:-1])
        mean = [np.bincount(self._edge, each) / np.bincount(self._edge) for each in rate]
        self._use(within & (np.stack(mean) < _FASTEST))

    def _use(self, resolved: Bool[np.ndarray, "intervals edges"]) -> None:
        """Integrate the motion of these edges only."""
        self._free = np.ones((len(resolved), self._points.shape[1]), bool)
        for free, used in zip(self._free, resolved, strict=True):
            free[self._pieces[~used[self._edge]]] = False
        moves = np.any(self._free[:, self._pieces], axis=(0, 2))
        self.inner = np.bincount(self._edge, moves) > 0
        column = np.where(self.inner, np.cumsum(self.inner) - 1, -1)[self._edge]
        columns = np.broadcast_to(column[:, None], self._place.shape)
        shape = self._points[0].size, int(self.inner.sum())
        self._pulls = _Pattern(self._place, columns, shape)

    def residuals(
        self, tension: Float[np.ndarray, " edges"]
    ) -> Float[np.ndarray, "intervals points 2"]:
        r"""Distances of the predicted points at the end of each interval from the observed ones.

        Of points within an edge, the component across it; without points on the outline.

        **Arguments:**

        - `tension`: $\gamma / \zeta$ of each edge; values of edges on the outline are ignored.
        """
        tension = np.asarray(tension, float)
        return np.stack([self._left(k, tension)[..., 0] for k in range(len(self._dt))])

    def predicted(self, tension: Float[np.ndarray, " edges"]) -> list[list[Chain]]:
        r"""The chains at the end of each interval, integrated from the observed chains at its start.

        **Arguments:**

        - `tension`: $\gamma / \zeta$ of each edge; values of edges on the outline are ignored.

        **Returns:** for each interval the points of each edge, in the order of the first tissue.
        """
        tension = np.asarray(tension, float)
        ends = [self._end(k, tension)[:, 0].reshape(-1, 2) for k in range(len(self._dt))]
        return [[end[row] for row in self._rows] for end in ends]

    @one_blas_thread()
    def tensions(self) -> InferredTensions:
        r"""The tensions that explain the motion best, by least squares, and the pressures in frame 1.

        Their standard deviations are those of the Laplace approximation, with the residuals as noise.
        Points of an edge within their correlation length count as one. For pressures, which depend on the
        positions of points too, the noise is also sampled.

        **Returns:** the [`InferredTensions`][vertax.tensions.InferredTensions], with `motion`.

        **Raises:**

        - `RuntimeError` if the fit does not converge.
        """
        tension, last, damping = self._pace() * self.inner, None, 0.0
        for _ in range(_ROUNDS):
            new = self._squares(tension)
            # Levenberg-Marquardt.
            worse = last is not None and new.value > last.value
            damping = 10 * damping + 1e-3 if worse else 0.1 * damping
            last = last if last is not None and worse else new
            normal = last.normal + damping * np.diag(np.diag(last.normal))
            step = np.linalg.lstsq(normal, -last.slope, rcond=1e-14)[0]
            tension = last.tension.copy()
            tension[self.inner] += step
            if -step @ last.slope < _DECREASE * last.value * len(step) / self._n_residuals:
                return self._inferred(last._replace(tension=tension))
        raise RuntimeError(
            f"The tensions could not be found: after {_ROUNDS} steps they still change. Are the points the "
            "same in all frames, and the times right?"
        )

    def _inferred(self, fit: _Squares) -> InferredTensions:
        """The result: relative tensions and pressures, with their covariance."""
        tissue, n = self.tissue, len(fit.normal)
        edges, cells = np.flatnonzero(self.inner), np.arange(tissue.n_cells)
        alike = self._points_alike(fit.residual)
        variance = fit.value / max(self._n_residuals / alike - n, 1.0)
        covariance = variance * np.linalg.pinv(fit.normal, hermitian=True)
        rate, mean = self._at_second_frame(fit.tension, True), float(fit.tension[edges].mean())
        # Jacobian of the tensions and pressures relative to the mean tension.
        values = np.append(fit.tension[edges], rate.pressure[:, 0]) / mean
        jacobian = np.concatenate([np.eye(n), rate.pressure[:, 1:]])
        jacobian = (jacobian - np.outer(values, np.full(n, 1 / n))) / mean
        covariance = jacobian @ covariance @ jacobian.T
        # Noise of the points of the first two frames.
        noise, random = np.sqrt(fit.value / self._n_residuals), np.random.default_rng(0)
        other, samples = copy.copy(self), []
        for _ in range(_SAMPLES):
            other._points = self._points[:2] + noise * random.normal(size=self._points[:2].shape)
            samples.append(other._at_second_frame(fit.tension, False).pressure[:, 0] / mean)
        covariance[n:, n:] += np.cov(samples, rowvar=False)
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0))
        sure = is_determined(deviation[:n])
        beside = np.isin(cells, np.asarray(tissue.topology.edge_cells)[edges[sure]])
        ways = np.stack([self._across(k, x) for k, x in enumerate(np.diff(self._points, axis=0))])
        count = np.maximum(self._free.sum(axis=1), 1)
        rms = lambda away: np.sqrt(np.sum(away**2, axis=(1, 2)) / count)
        return assembled(
            tissue,
            (edges, cells),
            Relative(
                values[:n], values[n:], deviation[:n], deviation[n:], beside, sure, 0 * values
            ),
            lambda vectors: covariance @ vectors,
            labels=cells + 1,
            noise=float(noise),
            correlation=alike * self._spacing,
            bending=0.0,
            edges="points",
            errors={},
            pixel_size=None,
            four_fold=np.zeros(tissue.n_edges, bool),
            motion=MotionFit(mean, rms(fit.residual), rms(ways)),
        )

    def _at_second_frame(self, tension: Float[np.ndarray, " edges"], sensitive: bool) -> _Rate:
        """Velocities and pressures predicted at the end of the first interval."""
        end = self._end(0, tension, sensitive=sensitive)
        return self._velocity(end, tension, *self._drive(0))

    def _squares(self, tension: Float[np.ndarray, " edges"]) -> _Squares:
        """The sum of squared residuals, with half its derivatives by the tensions of inner edges."""
        n = int(self.inner.sum())
        normal, slope, residuals = np.zeros((n, n)), np.zeros(n), []
        for number in range(len(self._dt)):
            left = self._left(number, tension, sensitive=True)
            rows = left.reshape(-1, n + 1)
            normal += rows[:, 1:].T @ rows[:, 1:]
            slope += rows[:, 1:].T @ rows[:, 0]
            residuals.append(left[..., 0])
        residual = np.stack(residuals)
        return _Squares(float(np.sum(residual**2)), slope, normal, tension, residual)

    def _left(
        self, number: int, tension: Float[np.ndarray, " edges"], *, sensitive: bool = False
    ) -> Float[np.ndarray, "points 2 columns"]:
        """The residuals of an interval and, if `sensitive`, their derivatives by the tensions."""
        away = self._end(number, tension, sensitive=sensitive)
        away[:, 0] -= self._points[number + 1].ravel()
        return self._across(number, away.reshape(self._free.shape[1], 2, -1))

    def _end(
        self, number: int, tension: Float[np.ndarray, " edges"], *, sensitive: bool = False
    ) -> Float[np.ndarray, "coordinates columns"]:
        """The predicted points at the end of an interval, and their derivatives."""
        state, drive = self._start(number, sensitive), self._drive(number)
        h = self._dt[number] / self.substeps
        velocity = lambda state: self._velocity(state, tension, *drive).state
        for _ in range(self.substeps):
            # A bound of the rate of the fastest mode: the Laplacian of the chains.
            _, length = self._ways(state[:, 0].copy())
            stiffness = np.repeat(np.abs(tension[self._edge]) / length, 2)
            at_points = np.bincount(self._pieces.ravel(), stiffness)
            rate = _SAFETY * 2 * np.max(at_points[self._free[number]], initial=0.0)
            stages = max(3, int(np.ceil(0.5 * (np.sqrt(9 + 8 * h * rate) - 1))))
            state = _legendre_step(velocity, state, h, stages)
        return state

    def _start(self, number: int, sensitive: bool) -> Float[np.ndarray, "coordinates columns"]:
        """The observed coordinates and, if `sensitive`, their derivatives by the tensions, which are 0."""
        state = np.zeros((self._points[0].size, 1 + self.inner.sum() * sensitive))
        state[:, 0] = self._points[number].ravel()
        return state

    def _drive(
        self, number: int
    ) -> tuple[
        Bool[np.ndarray, " coordinates"],
        Float[np.ndarray, " coordinates"],
        Float[np.ndarray, " cells"],
    ]:
        """Free coordinates, observed velocities, and rates of the areas, in an interval."""
        start, end = self._points[number : number + 2].reshape(2, -1)
        first, last = (0.5 * (self._area_slopes(x) @ x) for x in (start, end))
        mobile, dt = np.repeat(self._free[number], 2), self._dt[number]
        return mobile, (end - start) / dt, (last - first) / dt

    def _velocity(
        self,
        state: Float[np.ndarray, "coordinates columns"],
        tension: Float[np.ndarray, " edges"],
        mobile: Bool[np.ndarray, " coordinates"],
        observed: Float[np.ndarray, " coordinates"],
        growth: Float[np.ndarray, " cells"],
    ) -> _Rate:
        """Velocities and pressures, and their derivatives if the other columns are those of the points."""
        x, dx = state[:, 0].copy(), state[:, 1:]
        way, length = self._ways(x)
        along = way / length[:, None]
        pulls = self._pulls(np.concatenate([along, -along], axis=1) * mobile[self._place])
        v = np.where(mobile, pulls @ tension[self.inner], observed)
        area, loose = self._area_slopes(x), self._area_slopes(x, mobile)
        gram = (loose @ loose.T).toarray()
        # A uniform pressure causes no motion within a given outline: the sum of the pressures is 0.
        inverse = np.linalg.inv(gram + np.trace(gram) / len(gram) ** 2)
        pressure = inverse @ (growth - area @ v)
        v += loose.T @ pressure
        if dx.shape[1] == 0:
            return _Rate(v[:, None], pressure[:, None])
        # Pulls change across pieces.
        block = np.eye(2) - along[:, :, None] * along[:, None]
        block *= (tension[self._edge] / length)[:, None, None]
        blocks = np.kron([[-1, 1], [1, -1]], block)
        blocks += (np.append(pressure, 0)[self._cells] @ [1, -1])[:, None, None] * _CURVATURE
        dv = self._stiffness(blocks * mobile[self._place][:, :, None]) @ dx + pulls.toarray()
        # Areas are quadratic in the coordinates.
        d_pressure = -inverse @ (self._area_slopes(v) @ dx + area @ dv)
        dv += loose.T @ d_pressure
        return _Rate(*(np.column_stack(pair) for pair in ((v, dv), (pressure, d_pressure))))

    def _area_slopes(
        self,
        x: Float[np.ndarray, " coordinates"],
        chosen: Bool[np.ndarray, " coordinates"] | float = 1.0,
    ) -> sp.csr_array:
        """Derivatives of the areas by the `chosen` coordinates, which are linear in `x`."""
        swept = x[self._place] @ _CURVATURE * np.broadcast_to(chosen, x.shape)[self._place]
        return self._areas(np.stack([swept, -swept], axis=1))

    def _pace(self) -> float:
        """The tension of all edges with velocities of the junctions as large as those observed."""
        sums = np.zeros(2)
        for number in range(len(self._dt)):
            drive = self._drive(number)
            junctions = np.flatnonzero(drive[0][: 2 * self.tissue.n_vertices])
            rest, pulled = (
                self._velocity(self._start(number, False), tension, *drive).state[junctions, 0]
                for tension in (0.0 * self.inner, 1.0 * self.inner)
            )
            pulled, observed = pulled - rest, drive[1][junctions] - rest
            sums += observed @ observed, pulled @ pulled
        return float(np.sqrt(sums[0] / sums[1]))

    def _ways(
        self, x: Float[np.ndarray, " coordinates"]
    ) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, " pieces"]]:
        """Vectors from the first to the second point of each piece, and their lengths."""
        way = x[self._place[:, 2:]] - x[self._place[:, :2]]
        return way, np.sqrt(np.sum(way**2, axis=1) + (_SOFT * self._spacing) ** 2)

    def _normals(self, number: int) -> Float[np.ndarray, "points 2"]:
        """Unit vectors across the edges at the points within them at the end of an interval."""
        end = self._points[number + 1]
        # Each point within an edge is the second of one piece and the first of the next.
        before, after = np.tile(np.arange(len(end)), (2, 1))
        before[self._pieces[:, 1]], after[self._pieces[:, 0]] = self._pieces.T
        along = end[after] - end[before]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        return across / np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]

    def _across(
        self, number: int, away: Float[np.ndarray, "points 2 *columns"]
    ) -> Float[np.ndarray, "points 2 *columns"]:
        """Displacements of free points in an interval; those within edges across the edge."""
        first = self.tissue.n_vertices
        normal, away = self._normals(number)[first:], away.copy()
        size = np.einsum("pi,pi...->p...", normal, away[first:])
        away[first:] = np.einsum("pi,p...->pi...", normal, size)
        away[~self._free[number]] = 0
        return away

    @property
    def _n_residuals(self) -> int:
        """Number of residuals: two components of junctions, and one of other points."""
        return int(self._free.sum() + self._free[:, : self.tissue.n_vertices].sum())

    def _points_alike(self, residual: Float[np.ndarray, "intervals points 2"]) -> float:
        """Number of points of an edge with residuals that are alike."""
        parts = []
        for number, left in enumerate(residual):
            size = np.sum(left * self._normals(number), axis=1)
            for row in self._rows:
                row = [point for point in row[1:-1] if self._free[number, point]]
                edge = np.full(len(row), len(parts))
                parts.append((edge, self._points[number + 1][row], size[row]))
        edge, away, size = (np.concatenate(x) for x in zip(*parts, strict=True))
        return max(correlation_length(Points(edge, away), size) / self._spacing, 1.0)


class _Squares(NamedTuple):
    """A sum of squared residuals, with half its derivatives by the tensions of inner edges."""

    value: float
    slope: Float[np.ndarray, " inner"]
    normal: Float[np.ndarray, "inner inner"]
    tension: Float[np.ndarray, " edges"]
    residual: Float[np.ndarray, "intervals points 2"]


class _Rate(NamedTuple):
    """Velocities and pressures in the first column; derivatives by the tensions of inner edges."""

    state: Float[np.ndarray, "coordinates columns"]
    pressure: Float[np.ndarray, "cells columns"]


class _Pattern:
    """Sparse matrices of other values at the same places, which may repeat or lie outside."""

    def __init__(
        self, row: Int[np.ndarray, "..."], column: Int[np.ndarray, "..."], shape: tuple[int, int]
    ):
        row, column = row.ravel(), column.ravel()
        order = np.lexsort((column, row))
        self._order = order[(row[order] < shape[0]) & (column[order] >= 0)]
        row, column = row[self._order], column[self._order]
        self._first = np.flatnonzero(np.diff(row, prepend=-1) | np.diff(column, prepend=-1))
        ends = np.searchsorted(row[self._first], np.arange(shape[0] + 1))
        data = np.zeros(len(self._first))
        self._matrix = sp.csr_array((data, column[self._first], ends), shape)

    def __call__(self, values: Float[np.ndarray, "..."]) -> sp.csr_array:
        matrix = copy.copy(self._matrix)  # shares the places, which are checked once
        matrix.data = np.add.reduceat(values.ravel()[self._order], self._first)
        return matrix


def _legendre_step(
    velocity: Callable[[np.ndarray], np.ndarray], start: np.ndarray, h: float, stages: int
) -> np.ndarray:
    """One step of the second-order Runge-Kutta-Legendre method, stable up to (s² + s - 2) / 2 over the
    largest rate with s stages (Meyer, Balsara & Aslam 2014, doi:10.1016/j.jcp.2013.08.021, eqs 16-17)."""
    j = np.arange(stages + 1)
    b = np.where(j < 2, 1 / 3, (j**2 + j - 2) / np.maximum(2 * j * (j + 1), 1))
    scale, first = 4 / (stages**2 + stages - 2), h * velocity(start)
    before, last = start, start + scale / 3 * first
    for k in range(2, stages + 1):
        mu, nu = (2 * k - 1) / k * b[k] / b[k - 1], -(k - 1) / k * b[k] / b[k - 2]
        rate = mu * scale * (h * velocity(last) - (1 - b[k - 1]) * first)
        before, last = last, mu * last + nu * before + (1 - mu - nu) * start + rate
    return last


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
