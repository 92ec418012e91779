"""Relative tensions of a cluster on its way, from how the points of its edges move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_whole
from vertax.mesh import Tissue

Chain = Float[np.ndarray, "_ 2"]


class MovingTensions(eqx.Module):
    """What the motion of a cluster says of its tensions, relative to their mean."""

    tension: Float[np.ndarray, " edges"]
    """Tension of each edge of the first frame; those between two cells have the mean 1, and of those on the
    outline nothing is said: NaN."""
    deviation: Float[np.ndarray, " edges"]
    """Their standard deviations."""
    mobility: float
    """Velocity of a point over the force on it, where the mean tension is 1."""
    misfit: Float[np.ndarray, " intervals"]
    """How far points are at the end of each interval from where the tensions would have them: the root mean
    square."""
    moved: Float[np.ndarray, " intervals"]
    """How far they went in it: the root mean square."""


class _Ring(eqx.Module):
    """What is around each point: two or three others, in places of which the third may be empty."""

    neighbours: Int[Array, "points 3"]
    edges: Int[Array, "points 3"]
    """The edges that lead there."""
    cells: Int[Array, "points 3"]
    """The cells on the left of the way there; the number of cells for the exterior and empty places."""
    after: Int[Array, "points 3"]
    """The place whose way has that cell on its right."""
    empty: Bool[Array, "points 3"]
    ways: Int[Array, "cells most"]
    """The places (of all, one after the other) with a cell on the left; one too many where there are fewer."""

    def per_cell(self, values: Float[Array, "points 3"]) -> Float[Array, " cells"]:
        """The sum of what is in the places of each cell."""
        return jnp.sum(jnp.append(values, 0)[self.ways], axis=1)


class EdgeMotion(eqx.Module):
    r"""A cluster in motion whose edges are chains of points, each of which goes where the force on it points:

    $$\zeta \dot x_i = - \frac{\partial}{\partial x_i} \sum_e \gamma_e \ell_e
      + \sum_c p_c \frac{\partial A_c}{\partial x_i}$$

    The pressures $p_c$ are such that areas go evenly from those of one frame to those of the next, so they
    stay if they are the same. Points on the outline are where they were seen, in between on a straight line:
    what pulls there need not be tensions alone. In each interval the others begin where they were seen and
    are followed up to the next frame, and how far they end from the curves that were seen there is what a
    fit of the tensions minimises. That needs no velocities, which differences between frames tell badly
    where junctions are fast.

    ```python
    foams = [vx.io.read_surface_evolver(path) for path in paths]
    motion = vx.inference.EdgeMotion(
        [f.tissue for f in foams], [f.chains for f in foams], [f.time for f in foams]
    )
    motion.tensions().tension
    ```

    **Arguments:**

    - `tissues`: a free cluster in two frames or more, with the same neighbours in all.
    - `chains`: for each frame the points of each edge from one end to the other, as many in all frames. Each
        has the friction $\zeta$. Where it is along its edge does not count.
    - `times`: of the frames; they increase.
    - `substeps`: steps from one frame to the next (Heun's method, of second order). They must be shorter than
        the distance of two points over twice a relative tension.

    **Raises:**

    - `ValueError` for fewer than two frames, for times that do not increase, for tissues that have other
        neighbours, no exterior, or two cells that share two edges, and for chains of other sizes.
    """

    start: Float[Array, "intervals points 2"]
    end: Float[Array, "intervals points 2"]
    dt: Float[Array, " intervals"]
    ring: _Ring
    seen: Bool[Array, " points"]
    """Which points are on the outline."""
    inner: Bool[np.ndarray, " edges"]
    """Which edges are not."""
    n_vertices: int = eqx.field(static=True)
    n_cells: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        tissues: Sequence[Tissue],
        chains: Sequence[Sequence[Chain]],
        times: Sequence[float],
        *,
        substeps: int = 50,
    ):
        check_whole("substeps", substeps, least=1)
        if not len(tissues) == len(chains) == len(times) >= 2:
            raise ValueError(
                "Arguments `tissues`, `chains` and `times` must hold two frames or more, and as many of "
                f"each, but hold {len(tissues)}, {len(chains)} and {len(times)}."
            )
        steps = np.diff(np.asarray(times, float))
        if not (steps > 0).all():
            raise ValueError(f"Argument `times` must increase, but is {list(times)}.")
        first = tissues[0]
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
        cells = np.asarray(first.topology.edge_cells)
        self.inner = ~np.asarray(first.topology.on_outline)
        seen = np.zeros(points.shape[1], bool)
        for edge in np.flatnonzero(~self.inner):
            seen[np.array(rows[edge])] = True
        self.seen = jnp.asarray(seen)
        self.ring = _ring(rows, cells, points.shape[1], first.n_cells)
        self.n_vertices, self.n_cells, self.substeps = first.n_vertices, first.n_cells, substeps
        places = jnp.asarray(points)
        self.start, self.end, self.dt = places[:-1], places[1:], jnp.asarray(steps, places.dtype)

    def residuals(self, tension: Float[Array, " edges"]) -> Float[Array, "intervals points 2"]:
        r"""How far points are at the end of each interval from what was seen.

        Junctions from where they were seen, points of edges across the edge, and 0 on the outline.

        **Arguments:**

        - `tension`: $\gamma / \zeta$ of each edge; of those on the outline it does not matter.
        """
        ends = jax.vmap(lambda *one: self._followed(tension, *one))(self.start, self.end, self.dt)
        return jax.vmap(self._across)(ends - self.end, self.end)

    def tensions(self) -> MovingTensions:
        r"""The tensions that explain the motion best, by least squares.

        Their standard deviations are those of the Laplace approximation, where what is left over is taken
        for independent noise.

        **Raises:**

        - `RuntimeError` (of Equinox) if the fit comes to no end.
        """
        which = np.flatnonzero(self.inner)
        found, left, gram, ns = (np.asarray(x) for x in _fitted(self, jnp.asarray(which)))
        print('steps',ns)
        free = ~np.asarray(self.seen)
        n_numbers = len(left) * (free.sum() + free[: self.n_vertices].sum())
        variance = np.sum(left**2) / max(n_numbers - len(which), 1)
        covariance = variance * np.linalg.pinv(gram, hermitian=True)
        mean = found.mean()
        # Slopes of relative tensions, γ over the mean.
        slopes = (np.eye(len(which)) - found[:, None] / mean / len(which)) / mean
        tension, deviation = np.full((2, len(self.inner)), np.nan)
        tension[which] = found / mean
        deviation[which] = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
        rms = lambda x: np.sqrt(np.mean(np.sum(x[:, free] ** 2, axis=-1), axis=-1))
        went = jax.vmap(self._across)(self.end - self.start, self.end)
        return MovingTensions(tension, deviation, float(mean), rms(left), rms(np.asarray(went)))

    def pace(self, tension: Float[Array, " edges"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The factor of some tensions with which junctions set out as fast as they were seen to go on average,
        and how far all points went."""
        velocity = jax.vmap(lambda *one: self._velocity(tension, *one)(one[0]))
        set_out = velocity(self.start, self.end, self.dt)
        went = self.end - self.start
        seen = went / self.dt[:, None, None]
        junctions = lambda x: jnp.where(self.seen[:, None], 0, x)[:, : self.n_vertices]
        squared = jnp.sum(junctions(set_out) ** 2)
        pace = jnp.sum(junctions(set_out) * junctions(seen)) / squared
        return pace, jnp.sqrt(jnp.sum(jax.vmap(self._across)(went, self.end) ** 2))

    def _across(
        self, away: Float[Array, "points 2"], x: Float[Array, "points 2"]
    ) -> Float[Array, "points 2"]:
        """Displacements without what is along an edge."""
        along = x[self.ring.neighbours[:, 0]] - x[self.ring.neighbours[:, 1]]
        across = jnp.stack([-along[:, 1], along[:, 0]], axis=-1)
        squared = jnp.sum(across**2, axis=-1, keepdims=True)
        share = jnp.sum(across * away, axis=-1, keepdims=True) / squared
        inside = jnp.arange(len(x))[:, None] >= self.n_vertices
        return jnp.where(self.seen[:, None], 0, jnp.where(inside, share * across, away))

    def _followed(
        self,
        tension: Float[Array, " edges"],
        start: Float[Array, "points 2"],
        end: Float[Array, "points 2"],
        dt: Float[Array, ""],
    ) -> Float[Array, "points 2"]:
        """Where points are at the end of an interval."""
        velocity = self._velocity(tension, start, end, dt)
        h = dt / self.substeps

        def step(x: Float[Array, "points 2"], _: None) -> tuple[Float[Array, "points 2"], None]:
            one = velocity(x)
            return x + 0.5 * h * (one + velocity(x + h * one)), None

        return jax.lax.scan(step, start, None, self.substeps)[0]

    def _velocity(
        self,
        tension: Float[Array, " edges"],
        start: Float[Array, "points 2"],
        end: Float[Array, "points 2"],
        dt: Float[Array, ""],
    ) -> Callable[[Float[Array, "points 2"]], Float[Array, "points 2"]]:
        """How fast points go, as a function of where they are, in an interval."""
        ring, seen = self.ring, self.seen[:, None]
        as_seen = (end - start) / dt
        growth = (self._areas(end) - self._areas(start)) / dt

        def velocity(x: Float[Array, "points 2"]) -> Float[Array, "points 2"]:
            outward = x[ring.neighbours] - x[:, None]
            length = jnp.sqrt(jnp.sum(outward**2, axis=-1) + ring.empty)
            pull = jnp.where(ring.empty, 0, tension[ring.edges]) / length
            v = jnp.where(seen, as_seen, jnp.sum(pull[..., None] * outward, axis=1))
            turned = 0.5 * jnp.stack([outward[..., 1], -outward[..., 0]], axis=-1)
            # Derivatives of the areas of the cells around each point.
            slopes = turned - jnp.take_along_axis(turned, ring.after[..., None], axis=1)
            free = jnp.where(seen[..., None], 0, slopes)
            short = growth - ring.per_cell(jnp.sum(slopes * v[:, None], axis=-1))

            def push(pressure: Float[Array, " cells"]) -> Float[Array, "points 2"]:
                return jnp.sum(jnp.append(pressure, 0)[ring.cells][..., None] * free, axis=1)

            # One pressure for all moves nothing within a given outline: their sum is 0.
            size = jax.lax.stop_gradient(jnp.sum(free**2)) / self.n_cells

            def grown(pressure: Float[Array, " cells"]) -> Float[Array, " cells"]:
                grows = jnp.sum(free * push(pressure)[:, None], axis=-1)
                return ring.per_cell(grows) + size * jnp.mean(pressure)

            matrix = jax.vmap(grown)(jnp.eye(self.n_cells, dtype=x.dtype))
            factors = jax.scipy.linalg.cho_factor(jax.lax.stop_gradient(matrix))
            # A derivative needs no more than the product with the matrix, which is much cheaper.
            solve = lambda _, b: jax.scipy.linalg.cho_solve(factors, b)
            pressure = jax.lax.custom_linear_solve(grown, short, solve, symmetric=True)
            return v + push(pressure)

        return velocity

    def _areas(self, x: Float[Array, "points 2"]) -> Float[Array, " cells"]:
        next_ = x[self.ring.neighbours]
        swept = 0.5 * (x[:, None, 0] * next_[..., 1] - x[:, None, 1] * next_[..., 0])
        return self.ring.per_cell(swept)


@eqx.filter_jit
def _fitted(
    motion: EdgeMotion, which: Int[Array, " inner"]
) -> tuple[Float[Array, " inner"], Float[Array, "intervals points 2"], Float[Array, "inner inner"], Any]:
    """Tensions of inner edges, what they leave over, and JᵀJ."""

    ones = jnp.zeros(len(motion.inner)).at[which].set(1)
    pace, moved = motion.pace(ones)

    def residuals(relative: Float[Array, " inner"], _: None = None) -> Array:
        return motion.residuals(pace * jnp.zeros_like(ones).at[which].set(relative)) / moved

    # The motion is nearly linear in the tensions, so few of these steps are needed.
    solver = optx.Dogleg(rtol=1e-4, atol=1e-4)
    options = {"jac": "fwd"}
    solution = optx.least_squares(residuals, solver, ones[which], options=options, max_steps=30)
    slopes = jax.jacfwd(residuals)(solution.value) / pace
    gram = jnp.tensordot(slopes, slopes, ((0, 1, 2), (0, 1, 2)))
    left = moved * residuals(solution.value)
    return pace * solution.value, left, moved**2 * gram, solution.stats["num_steps"]


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


def _ring(
    rows: list[list[int]], cells: Int[np.ndarray, "edges 2"], n_points: int, n_cells: int
) -> _Ring:
    """What is around each point."""
    own = np.arange(n_points)[:, None].repeat(3, axis=1)
    edges, left, right = (np.full_like(own, value) for value in (0, n_cells, -1))
    neighbours, filled = own.copy(), np.zeros(n_points, int)
    for edge, row in enumerate(rows):
        ways = [*zip(row[:-1], row[1:], strict=True)]
        for (a, b), sides in (
            *((way, cells[edge]) for way in ways),
            *((way[::-1], cells[edge][::-1]) for way in ways),
        ):
            place = (a, filled[a])
            neighbours[place], edges[place] = b, edge
            left[place], right[place] = sides
            filled[a] += 1
    after = np.argmax(right[:, None, :] == left[:, :, None], axis=2)
    of_cells = [np.flatnonzero(left == cell) for cell in range(n_cells)]
    ways = np.full((n_cells, max(map(len, of_cells))), left.size)
    for cell, places in enumerate(of_cells):
        ways[cell, : len(places)] = places
    empty = np.arange(3) >= filled[:, None]
    return _Ring(*map(jnp.asarray, (neighbours, edges, left, after, empty, ways)))


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
