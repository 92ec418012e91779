"""Tensions and pressures in balance, and the angles nearest to those observed."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import block_diag, coo_array, csc_array, csr_array, diags_array, eye_array, hstack

from vertax._base.sparse_normal import SparseNormal
from vertax.tensions._balance import Equations, force_slopes, forces
from vertax.tensions._errors import Errors, Patch, most_evident
from vertax.tensions._observability import Observability

# Smallest tension in the covariance of the forces, and standard deviation of the unknown force of an edge
# without a direction, in mean tensions.
_SMALL, _UNKNOWN = 0.2, 10.0
# Initial standard deviations; the pressures of arcs keep theirs, because the evidence underestimates it where
# arcs lag behind the pressures.
_FIRST = Errors(junction=0.05, arc=0.1, noise=1.0, tension=0.3, region=0.3, pressure=1.0)
# The errors of arcs are forces of friction along the edges. Only their sums around junctions contradict a
# balance; the rest, of the same variance, changes pressures and is not in the residual.
HIDDEN = 2**0.5
# Centre of the prior of the part of tensions that is similar in regions, of arcs. A small tissue determines
# it to a factor of 2 or 3 only, and without it errors that many edges have in common would be left out.
_REGION = 0.15
# Range of the correlation of tensions: κ² in the covariance (L + κ²)⁻², with L the Laplacian of edges that
# meet at junctions. The correlation decreases over about √8 / κ edges.
_KAPPA = 0.2
# Iterations of the first and of the second estimate of the errors.
_STEPS = (25, 10)
# Changes of all but 1 % of the tensions are below this in the last adjustment of the angles.
_TOLERANCE = 1e-3
# Largest adjustment of an angle, in radians, and smallest slope of the force of an arc by its angle.
_REACH, _SLOPE = 0.5, 1e-3
# Weight of a tension at its constraint relative to the prior, and number of changes of the set of these.
_STIFF, _CONSTRAINTS = 1e8, 20


class Posterior(NamedTuple):
    """Covariances of tensions and pressures at a fixed mean tension."""

    normal: SparseNormal
    """All unknowns, with a free mean tension."""
    unknowns: Int[np.ndarray, " unknowns"]
    """Places of tensions and pressures."""
    towards: Float[np.ndarray, " all_unknowns"]
    """Covariances with the mean tension if that is free."""
    freedom: float
    """Variance of the mean tension if that is free."""

    def covariances(self, vectors: Float[np.ndarray, "unknowns columns"]) -> np.ndarray:
        """The covariance matrix of tensions and pressures times vectors."""
        right = np.zeros((len(self.towards), vectors.shape[1]))
        right[self.unknowns] = vectors
        free = self.normal.covariances(right)
        return (free - np.outer(self.towards, self.towards @ right) / self.freedom)[self.unknowns]

    def variances(self) -> Float[np.ndarray, " unknowns"]:
        """Variances of tensions and pressures."""
        rows = csr_array(eye_array(len(self.towards)))[self.unknowns]
        free = self.normal.variances(rows)
        return np.maximum(free - self.towards[self.unknowns] ** 2 / self.freedom, 0)


class Balance(NamedTuple):
    """The solution of the balance of forces."""

    tension: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    posterior: Posterior
    """Covariances of tensions and pressures that may be negative (Laplace approximation)."""
    errors: Errors
    """Errors of the model, noise relative to that of the points, and widths of the priors."""
    loose: Bool[np.ndarray, " edges"]
    """Edges too short for a direction."""


class _Iterate(NamedTuple):
    """Tensions and pressures, and the angles less those observed."""

    x: Float[np.ndarray, " unknowns"]
    change: Float[np.ndarray, " angles"]
    zero: Bool[np.ndarray, " edges"]
    """Tensions at the constraint."""
    normal: csc_array | None = None
    """Hessian of half the sum of squares without the constraint."""


# Observed are angles a with the covariance C, from the noise of points. Where the tissue is not in balance,
# angles differ from those of a balance as well.
# Forces r(x, a) = A(a) x + B f are linear in the unknowns x and in the forces f of edges without a direction.
# Least squares with fixed a would shrink the unknowns, because the noise of A and of r is the same. So a is
# adjusted as well (total least squares: Britt & Luecke 1973, doi:10.1080/00401706.1973.10489060). With
# d = a - a_observed and J = ∂r/∂a at the last x and d₀, the angles that balance are those with
#
#     J d = J d₀ - A x - B f,      d = J⁺ (J d₀ - A x - B f) + N ω,
#
# with one rotation ω for each junction, which changes no force. The coordinates v of vertices have the
# inverse covariance V / ν², and angles that follow them, d = M v + e, the covariance Σ of e: a block for each
# edge. So
#
#     -2 ln p = (d - M v)ᵀ Σ⁻¹ (d - M v) + vᵀ V v / ν² + |f|² / 10² + prior of x
#
# is a sum of terms with few unknowns, and its Hessian is sparse.
class System:
    """The sum of squares of a tissue or a part of it."""

    def __init__(self, shape: Observability, which: Equations, *, regional: bool):
        """Collect what does not depend on the unknowns.

        **Arguments:**

        - `shape`, `which`: the observed angles and the equations.
        - `regional`: whether tensions have a part that is similar in regions.
        """
        self.shape, self.which, self.regional = shape, which, regional
        n, n_junctions = len(which.edges), len(which.junctions)
        self.n_edges, self.n_cells = n, len(which.cells)
        coordinates, junctions, edges, cells = shape.place
        loose = np.repeat(edges[shape.loose], 2, axis=0)
        regions = edges if regional else edges[:0]
        parts = coordinates, junctions, loose, edges, cells, regions
        self.place = np.concatenate(parts)
        ends = np.cumsum([len(part) for part in parts])
        self.tensions, self.pressures = slice(ends[2], ends[3]), slice(ends[3], ends[4])
        self.unknowns = np.arange(ends[2], ends[4])
        self.mean = np.zeros(ends[-1])
        self.mean[self.tensions] = 1 / n
        self.root, self.scale = _regions(which, edges) if regional else (csr_array((0, 0)), 1.0)
        first = _Iterate(
            np.append(np.ones(n), np.zeros(self.n_cells)),
            np.zeros(len(shape.angle)),
            np.zeros(n, bool),
        )
        self.first, self.n_rotations = first, n_junctions

    @cached_property
    def covariance(self) -> Float[np.ndarray, "angles angles"]:
        """Covariance of the angles due to noise, a dense matrix, of a patch."""
        return self.shape.covariance()

    def linearised(self, last: _Iterate) -> tuple[csr_array, csr_array]:
        """The matrix of the forces, and their slopes by the angles."""
        angle = self.shape.angle + last.change
        matrix = forces(angle, self.which, self.shape.loose)
        pull = np.maximum(last.x[: self.n_edges], _SMALL)
        return matrix, force_slopes(angle, self.which, pull)

    def step(self, last: _Iterate, errors: Errors) -> _Iterate:
        """The solution of the problem linearised at the last one."""
        shape = self.shape
        matrix, slope = self.linearised(last)
        inverse, rotation = self._inverse(slope)
        offset = inverse @ (slope @ last.change)
        n = len(shape.place[0])
        empty = csr_array((len(offset), self.n_edges if self.regional else 0))
        # Changes of the angles by all unknowns but the vertices.
        changes = hstack([rotation, -inverse @ shape.loose_forces, -inverse @ matrix, empty])
        rows = csr_array(hstack([-shape.slopes, changes]))
        weight = shape.precision(errors._replace(arc=HIDDEN * errors.arc))
        weighted = rows.T @ weight
        prior, expected = self._prior(errors)
        normal = csc_array(weighted @ rows + prior)
        right = expected - weighted @ offset
        zero, z = last.zero, right
        for _ in range(_CONSTRAINTS):
            # Tensions that would be negative are held at 0 (active set, a semi-smooth Newton method).
            stiff = np.zeros(len(right))
            stiff[self.tensions] = zero * _STIFF * normal.diagonal()[self.tensions]
            held = csc_array(normal + diags_array(stiff)) if zero.any() else normal
            posterior = self.posterior(held)
            z = posterior.normal.covariances(right)
            z -= posterior.towards * (self.mean @ z - 1) / posterior.freedom
            negative = z[self.tensions] < 0
            if np.all(negative == zero):
                break
            zero = negative
        z[self.tensions] = np.maximum(z[self.tensions], 0)
        change = offset + changes @ z[n:]
        change *= min(1.0, _REACH / max(float(np.max(np.abs(change))), 1e-300))
        return _Iterate(z[self.unknowns], change, zero, normal)

    def posterior(self, normal: csc_array) -> Posterior:
        """The posterior with this Hessian of half the sum of squares."""
        distribution = SparseNormal(normal, self.place)
        towards = distribution.covariances(self.mean)
        return Posterior(distribution, self.unknowns, towards, float(self.mean @ towards))

    def _inverse(self, slope: csr_array) -> tuple[csr_array, csr_array]:
        """Changes of angles that change the forces by 1, the smallest; and those that change none."""
        n, n_angles = self.n_rotations, len(self.shape.angle)
        entries = coo_array(slope[: 2 * n])
        block = np.zeros((n, 2, 3))
        block[entries.row // 2, entries.row % 2, entries.col % 3] = entries.data
        free = np.cross(block[:, 0], block[:, 1])
        free /= np.maximum(np.linalg.norm(free, axis=1), 1e-300)[:, None]
        square = block @ block.transpose(0, 2, 1)
        # Where all three edges are parallel, one component of the force has no slope.
        square += 1e-9 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        inverse = block.transpose(0, 2, 1) @ np.linalg.inv(square)
        angle, junction = np.arange(3 * n), np.repeat(np.arange(n), 3)
        arcs = np.arange(n_angles - 3 * n)
        arc_slope = slope[2 * n :, 3 * n :].diagonal() if len(arcs) else np.zeros(0)
        arc_slope = np.where(arc_slope < 0, -1, 1) * np.maximum(np.abs(arc_slope), _SLOPE)
        row = np.concatenate([np.repeat(angle, 2), 3 * n + arcs])
        column = (2 * junction[:, None] + [0, 1]).ravel()
        column = np.concatenate([column, 2 * n + arcs])
        values = np.concatenate([inverse.ravel(), 1 / arc_slope])
        shape = (n_angles, self.which.n_rows)
        return (
            csr_array(coo_array((values, (row, column)), shape=shape)),
            csr_array(coo_array((free.ravel(), (angle, junction)), shape=(n_angles, n))),
        )

    def _prior(self, errors: Errors) -> tuple[csc_array, Float[np.ndarray, " unknowns"]]:
        """Inverse covariance of all unknowns in the prior, and that times their mean."""
        n, shape = self.n_edges, self.shape
        weight = errors.tension**-2
        blocks = [
            shape.vertices / errors.noise**2,
            csr_array((self.n_rotations,) * 2),
            eye_array(2 * int(shape.loose.sum())) / _UNKNOWN**2,
        ]
        tension = weight * eye_array(n)
        pressure = (shape.size / errors.pressure) ** 2 * eye_array(self.n_cells)
        matrix = block_diag([*blocks, tension, pressure], format="csr")
        if self.regional:
            # Tensions are 1, plus an independent part, plus one that is similar in regions.
            smooth = self.root.T @ self.root / (errors.region * self.scale) ** 2
            matrix = block_diag([matrix, smooth + weight * eye_array(n)], format="csr")
            first = len(self.place) - n
            each = np.arange(n)
            row, column = first + each, self.tensions.start + each
            cross = coo_array((np.full(n, -weight), (row, column)), shape=matrix.shape)
            matrix = matrix + cross + cross.T
        right = np.zeros(len(self.place))
        right[self.tensions] = weight
        if self.regional:
            right[-n:] = -weight
        return csc_array(matrix), right

    def patch(self, last: _Iterate) -> Patch:
        """Residual forces at the prior mean, and their covariance for each standard deviation of 1."""
        matrix, slope = self.linearised(last)
        n = self.n_edges
        direction, arc = (((slope * d) @ slope.T).toarray() for d in self.shape.shares())
        pull, push = matrix[:, :n].toarray(), matrix[:, n:].toarray() / self.shape.size
        # The mean tension is 1.
        centred = pull - pull.mean(axis=1, keepdims=True)
        region = np.zeros(direction.shape)
        if self.regional:
            smooth = centred @ np.linalg.inv(self.root.toarray()) * self.scale
            region = smooth @ smooth.T
        parts = Errors(
            junction=direction,
            arc=arc,
            noise=slope @ (slope @ self.covariance).T,
            tension=centred @ centred.T,
            region=region,
            pressure=push @ push.T,
        )
        unknown = _UNKNOWN**2 * (self.shape.loose_forces @ self.shape.loose_forces.T).toarray()
        unknown += ((slope * self.shape.unknown_arcs) @ slope.T).toarray()
        return Patch(pull @ np.ones(n) - slope @ last.change, parts, unknown)


def choose_errors(systems: list[System], prior: float | None) -> tuple[Errors, float]:
    """Errors of the model and widths of the priors of the largest evidence, and the evidence.

    **Arguments:**

    - `systems`: the tissue, or some parts of a large one.
    - `prior`: standard deviation of tensions about 1; by default chosen by the evidence.
    """
    bounds = systems[0].shape.bounds
    errors = _FIRST if "arc" in bounds else _FIRST._replace(arc=0.0)
    if prior is not None:
        errors = errors._replace(tension=prior, region=0.0)
    last, evidence = [system.first for system in systems], np.nan
    for attempt in range(5):
        if attempt in (2, 4):
            parts = [system.patch(each) for system, each in zip(systems, last, strict=True)]
            errors, evidence = _chosen(parts, bounds, errors, prior, _STEPS[attempt // 4])
        if attempt < 4:
            last = [system.step(each, errors) for system, each in zip(systems, last, strict=True)]
    return errors, evidence


def _chosen(
    patches: list[Patch],
    bounds: dict[str, tuple[float, float]],
    errors: Errors,
    prior: float | None,
    steps: int,
) -> tuple[Errors, float]:
    centres = {"noise": 1.0}
    if "arc" in bounds:
        centres["region"] = _REGION
        # With wide priors, this is restricted maximum likelihood: the errors do not depend on how well the
        # prior describes the tensions.
        wide = errors._replace(tension=prior or 1.0, region=0.0 if prior else 1.0, pressure=10.0)
        free = {name: bounds[name] for name in ("junction", "arc", "noise")}
        first, _ = most_evident(patches, wide, free, steps=steps, centres=centres)
        errors = errors._replace(junction=first.junction, arc=first.arc, noise=first.noise)
        bounds = {name: bounds[name] for name in bounds if name not in free}
    return most_evident(patches, errors, bounds, steps=steps, centres=centres)


def solve(system: System, errors: Errors, *, rounds: int = 12) -> Balance:
    """Tensions and pressures in balance.

    **Arguments:**

    - `system`: the sum of squares.
    - `errors`: errors of model and noise, and widths of priors.
    - `rounds`: largest number of adjustments of the angles.

    **Returns:** the [`Balance`][vertax.tensions._solve.Balance].
    """
    last, n, before = system.first, system.n_edges, np.inf
    for attempt in range(rounds):
        new = system.step(last, errors)
        moved = float(np.quantile(np.abs(new.x - last.x)[:n], 0.99))
        # Half steps where full ones go back and forth.
        part = 0.5 if attempt > 3 and moved > 0.5 * before else 1.0
        x, change = (
            old + part * (to - old) for old, to in ((last.x, new.x), (last.change, new.change))
        )
        last, before = new._replace(x=x, change=change), moved
        if attempt > 1 and moved < _TOLERANCE:
            break
    assert last.normal is not None
    return Balance(
        tension=last.x[:n],
        pressure=last.x[n:],
        posterior=system.posterior(last.normal),
        errors=errors,
        loose=system.shape.loose,
    )


def _regions(which: Equations, place: Float[np.ndarray, "edges 2"]) -> tuple[csr_array, float]:
    """The root of the precision of tensions that are similar in regions, and its factor for a mean variance
    of 1."""
    n = len(which.edges)
    row, column = which.half_edge.ravel(), np.roll(which.half_edge, 1, axis=1).ravel()
    meet = csr_array(coo_array((np.ones(len(row)), (row, column)), shape=(n, n)))
    meet = meet + meet.T
    root = csr_array(diags_array(meet.sum(axis=1) + _KAPPA) - meet)
    variance = SparseNormal(csc_array(root @ root), place).variances(csr_array(eye_array(n)))
    return root, float(1 / np.sqrt(np.mean(variance)))
