"""Arcs with bends, fitted to the points of edges, and the covariance of the fit."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize, minimize_scalar
from scipy.sparse import coo_array, csc_array, csr_array, diags_array

from vertax._base.sparse_normal import factorised, spread_parts
from vertax.tensions._observed_geometry import ObservedGeometry

# Prior standard deviations, for parameters that no point determines, such as the angle of an edge of two
# pixels: of a vertex in grains (its initial position is the corner of a pixel) and of an angle in radians.
_VERTEX, _ANGLE = 2.0, 0.5
# Standard deviation of the bends, in radians: initial, smallest and largest.
_BENDING, _BENDINGS = 0.1, (1e-4, 0.3)
# Largest noise and correlation length, in grains, of edges with the grain of the pixels as their only error.
# (For middles of the sides of pixels along a smooth curve: 0.24 and 1.45.)
_CRISP = 0.26, 1.6
_PIXELS = 1.45
# Degrees of freedom of the distribution of the noise of an edge; number of estimates of noise and bends.
_FREEDOM, _PASSES = 4.0, 3
# Largest number of edges that are all used for these, and of those of each part of a larger tissue.
_WHOLE, _PART = 480, 120
# Edges shorter than this, in grains, have no weight.
_SHORT = 3.0
# Smallest mean length of edges, in grains, at which bends are fitted.
_LONG = 25.0


class Points(NamedTuple):
    """Points of edges."""

    edge: Int[np.ndarray, " points"]
    """The edge of each point, ascending; the points of each from its first vertex on."""
    away: Float[np.ndarray, "points 2"]
    """The points, each relative to the first vertex of its edge."""


class Fitted(NamedTuple):
    """Curves fitted to points, and the covariance of the fit over the square of the noise."""

    change: Float[np.ndarray, " geometry"]
    """Geometry of the fit less that of the tissue."""
    precision: csc_array
    """The inverse covariance of vertices, angles and bends, where a point has the standard deviation 1."""
    noise: float
    """Root mean square distance of the points from the curves."""
    rest: Float[np.ndarray, " points"]
    """The distance of each."""
    weighted: csc_array
    """The slopes of the distances, transposed, times the weights of the points."""
    weight: Float[np.ndarray, " points"]
    """The weights: an edge counts as its length over the correlation length, times its factor."""
    factor: Float[np.ndarray, " edges"]
    """Factors of the weights of edges, small for edges of other shapes than arcs with bends."""
    apart: float
    """Distance along an edge at which the errors of two points are independent, a length."""
    bending: float
    """Standard deviation of the bends, in radians."""
    crisp: bool = False
    """Whether the grain is the only error of the points."""
    bends: bool = False
    """Whether bends were fitted."""


def read_courses(
    tissue: ObservedGeometry,
    points: Points,
    grain: float,
    *,
    apart: float | None = None,
    noise: float | None = None,
) -> Fitted:
    """Curves through the points, with estimates of the noise, its correlation length and the bends.

    Bends and noise that is correlated along edges cannot be distinguished. So bends are fitted only if the
    grain of the pixels is the only error left with them; otherwise edges are arcs, and all residuals are
    noise.

    **Arguments:**

    - `tissue`: the initial geometry.
    - `points`: the points of its edges.
    - `grain`: resolution of a point: the side of a pixel.
    - `apart`: distance between points that are exact; by default the correlation length of the residuals.
    - `noise`: standard deviation of a point; by default that of the fit.

    **Returns:** the [`Fitted`][vertax.tensions._curves.Fitted] curves.
    """
    length = np.linalg.norm(tissue.chord, axis=1)
    used = np.unique(points.edge)
    # The residuals of a fit cannot be correlated along a whole edge.
    longest = 0.25 * float(np.mean(length[used]))
    fit = partial(fit_curves, tissue, points, grain)
    # A curve through a dozen pixels follows their noise.
    short = apart is None and np.mean(length[used]) < _LONG * grain
    start, alike, crisp, first = _BENDING, 0.0, False, None
    for start in _BENDINGS[:1] if short else (_BENDING, _BENDINGS[0]):
        first = fit(apart=apart or 2 * grain, bending=start, noise=noise or 0.4 * grain)
        alike = apart or min(correlation_length(points, first.rest), longest)
        alike = alike if apart else max(alike, _PIXELS * grain)
        crisp = first.noise < _CRISP[0] * grain and alike < _CRISP[1] * grain
        if crisp or apart is not None:
            break
    assert first is not None
    off, bending, factor, change = noise or first.noise, start, None, None
    if start == _BENDING:
        curves = fit(apart=alike, bending=bending, noise=off, change=first.change)
        for _ in range(_PASSES):
            factor = _reliability(curves, points, off)
            options = {"factor": factor, "change": curves.change}
            curves = fit(apart=alike, bending=bending, noise=off, **options)
            off, bending = _most_evident(tissue, points, curves, grain, noise)
        change = curves.change
    curves = fit(apart=alike, bending=bending, noise=off, factor=factor, change=change)
    if start != _BENDING and noise is None:
        # Parameters follow the noise of as many points.
        count = float(np.sum(curves.weight))
        fitted = len(used) + 2 * len(np.unique(tissue.ends[used]))
        off = curves.noise * np.sqrt(count / max(count - fitted, 0.25 * count))
    return curves._replace(noise=off, crisp=crisp, bends=start == _BENDING)


def fit_curves(
    tissue: ObservedGeometry,
    points: Points,
    grain: float,
    *,
    apart: float,
    bending: float,
    noise: float,
    factor: Float[np.ndarray, " edges"] | None = None,
    change: Float[np.ndarray, " geometry"] | None = None,
    rounds: int = 6,
) -> Fitted:
    r"""Vertices, angles and bends of the curves that fit the points best (weighted least squares).

    An arc from 0 with the chord $c$ and a tangent at 0 turned by $\varphi$ from the chord has the distance

    $$d = \frac{p \cdot (p - c)\, \sin\varphi + (c \times p) \cos\varphi}{|c|}$$

    from a point $p$, to first order in $d$, for every angle. A curve of the length $L$ departs from its arc,
    at the fraction $u$ of its length, by
    $L\,(b_1\,u(1 - u)(1 - 2u) + b_2\,u(1 - u)(1 - \tfrac{14}{3} u(1 - u)))$: two modes that turn its
    ends and change neither the chord nor, to first order, the arc that fits best.

    **Arguments:**

    - `tissue`: the initial geometry.
    - `points`: the points.
    - `grain`: resolution of a point.
    - `apart`: distance along an edge at which the errors of two points are independent.
    - `bending`: prior standard deviation of the bends.
    - `noise`: standard deviation of the points, relative to which the prior is weighted.
    - `factor`: factors of the weights of edges.
    - `change`: initial change of the geometry.
    - `rounds`: largest number of Gauss–Newton steps.

    **Returns:** the [`Fitted`][vertax.tensions._curves.Fitted] curves.
    """
    edge, away = points
    n_vertices, n_edges, n = tissue.n_vertices, len(tissue.angle), tissue.n_geometry
    angles, bends = 2 * n_vertices, 2 * n_vertices + n_edges
    start, end = tissue.ends[edge].T
    n_points = np.bincount(edge, minlength=n_edges)
    length = np.linalg.norm(tissue.chord, axis=1)
    # Each edge has the weight of length / apart independent points.
    weight = length / apart / np.maximum(n_points, 1)
    factor = np.ones(n_edges) if factor is None else factor
    weight = np.where(length > _SHORT * grain, factor * weight, 0.0)[edge]
    # Prior: parameters that the points do not determine stay at their initial values.
    held = noise**2 * _prior(tissue, grain, bending)
    bent = bends + 2 * edge, bends + 2 * edge + 1
    columns = np.stack(
        (2 * start, 2 * start + 1, 2 * end, 2 * end + 1, angles + edge, *bent), axis=1
    )
    rows = np.repeat(np.arange(len(edge)), columns.shape[1])
    moved = np.zeros(n) if change is None else change
    rest = np.zeros(len(edge))
    normal, weighted = csc_array(diags_array(held)), csc_array((n, len(edge)))
    for _ in range(rounds):
        current = tissue.moved(moved)
        p = away - moved[:angles].reshape(-1, 2)[start]
        c, angle = current.chord[edge], current.angle[edge]
        chord = np.maximum(np.linalg.norm(c, axis=1), 0.1 * grain)
        q, sine, cosine = p - c, -np.sin(angle), np.cos(angle)
        dot, cross = np.sum(p * q, axis=1), c[:, 0] * p[:, 1] - c[:, 1] * p[:, 0]
        turn = np.stack([-q[:, 1], q[:, 0], p[:, 1], -p[:, 0]], axis=1)
        slide = np.concatenate([q, p], axis=1)
        slopes = (cosine[:, None] * turn - sine[:, None] * slide) / chord[:, None]
        bulge = (cross * sine - dot * cosine) / chord
        modes = _modes(p, q, chord, angle)
        rest = (dot * sine + cross * cosine) / chord - np.sum(modes * current.bend[edge], axis=1)
        values = np.column_stack([slopes, bulge, -modes])
        jacobian = csc_array(
            coo_array((values.ravel(), (rows, columns.ravel())), shape=(len(edge), n))
        )
        weighted = jacobian.T * weight
        normal = csc_array(weighted @ jacobian + diags_array(held))
        step = factorised(normal).solve(weighted @ rest + held * moved)
        moved = moved - step
        moved[angles:bends] = np.clip(tissue.angle + moved[angles:bends], -3, 3) - tissue.angle
        if np.max(np.abs(step[angles:])) < 1e-4:
            break
    spread = float(np.sqrt(np.sum(weight * rest**2) / max(np.sum(weight), 1e-300)))
    spread = max(spread, 1e-12 * tissue.size)
    parts = rest, csc_array(weighted), weight, factor, apart, bending
    return Fitted(moved, normal, spread, *parts)


def arc_distances(
    chord: Float[np.ndarray, "points 2"],
    angle: Float[np.ndarray, " points"],
    p: Float[np.ndarray, "points 2"],
) -> Float[np.ndarray, " points"]:
    """Distance of points from arcs to first order, see `fit_curves`; both begin at 0."""
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-300)
    cross = chord[:, 0] * p[:, 1] - chord[:, 1] * p[:, 0]
    return (cross * np.cos(angle) - np.sum(p * (p - chord), axis=1) * np.sin(angle)) / length


# A few edges have other shapes than all others. So the points of an edge have the noise σ / √τ with τ from a
# gamma distribution of mean 1, together a Student distribution (Lange, Little & Taylor 1989,
# doi:10.1080/01621459.1989.10478852). Of an edge with the number m of points, their sum q of squares, and the
# number h of parameters that follow them, the expectation-maximisation algorithm has the steps
#
#     τ = (n + m) / (n + q / σ² + h),      σ² = Σ τ (q + σ² h) / Σ m.
def _reliability(curves: Fitted, points: Points, noise: float) -> Float[np.ndarray, " edges"]:
    """The factors τ of the weights of edges."""
    edge, weight = points.edge, curves.weight
    jacobian = csr_array(curves.weighted.T)
    columns = jacobian.indices.reshape(len(edge), -1)
    values = jacobian.data.reshape(columns.shape) / np.maximum(weight, 1e-300)[:, None]
    first = np.flatnonzero(np.diff(edge, prepend=-1))
    n = columns.shape[1]
    blocks = np.empty((len(first), n, n))
    for k in range(n):
        for j in range(n):
            blocks[:, k, j] = np.add.reduceat(weight * values[:, k] * values[:, j], first)
    block_columns = columns[first]
    places = np.repeat(block_columns, n, axis=1), np.tile(block_columns, n)
    normal = csr_array(curves.precision)[places].toarray().reshape(blocks.shape)
    # (Singular for an edge with too few points.)
    followed = np.trace(np.linalg.pinv(normal, hermitian=True) @ blocks, axis1=1, axis2=2)
    count = np.add.reduceat(weight / curves.factor[edge], first)
    squares = np.add.reduceat(weight / curves.factor[edge] * curves.rest**2, first)
    factor, variance = np.ones(len(first)), noise**2
    for _ in range(50):
        factor = (_FREEDOM + count) / (_FREEDOM + squares / variance + followed)
        variance = float(factor @ (squares + variance * followed)) / float(np.sum(count))
    all_edges = np.ones(len(curves.factor))
    all_edges[edge[first]] = factor
    return all_edges


def _modes(
    p: Float[np.ndarray, "points 2"],
    q: Float[np.ndarray, "points 2"],
    chord: Float[np.ndarray, " points"],
    angle: Float[np.ndarray, " points"],
) -> Float[np.ndarray, "points 2"]:
    """Displacement of a point of an arc by the two bends; the ends of the arc are at -p and -q from it."""
    # A point at the fraction u of an arc of the half angle α is at the distance 2 R sin(u α) from its end.
    wide = np.clip(np.abs(angle), 1e-3, 1.5)
    scale = np.sin(wide) / chord
    first, last = (np.arcsin(np.minimum(np.linalg.norm(x, axis=1) * scale, 1.0)) for x in (p, q))
    u = first / np.maximum(first + last, 1e-300)
    flat = u * (1 - u)
    shapes = np.stack([flat * (1 - 2 * u), flat * (1 - 14 / 3 * flat)], axis=1)
    return (wide / scale)[:, None] * shapes


# With the linearised distances y + J g of the points, of weights w and noise σ, and the prior precision Λ of
# vertices, angles and bends g, the density of the points with all g integrated out is
#
#     -2 ln p = Σ w ln σ² + ln det(A / σ²) - ln det Λ + (yᵀ w y - vᵀ A⁻¹ v) / σ²,
#     A = Jᵀ w J + σ² Λ,    v = Jᵀ w y.
#
# Bends that follow the noise decrease the last term and increase the first determinant.
def _most_evident(
    tissue: ObservedGeometry, points: Points, curves: Fitted, grain: float, given: float | None
) -> tuple[float, float]:
    """Noise of the points, and standard deviation of the bends, of the largest marginal likelihood in a few
    parts of the tissue; for a `given` noise only that of the bends."""
    held = _prior(tissue, grain, 1.0)
    bends = np.arange(len(held)) >= len(held) - 2 * len(tissue.angle)
    edges = np.unique(points.edge)
    parts = spread_parts(tissue.places[2 * tissue.n_vertices :][edges], _WHOLE, _PART)
    some = np.isin(points.edge, edges[np.concatenate(parts)])
    weight, weighted = curves.weight[some], curves.weighted[:, some]
    jacobian = csr_array(diags_array(1 / np.maximum(weight, 1e-300)) @ weighted.T)
    distance = curves.rest[some] - jacobian @ curves.change
    square, push = csc_array(weighted @ jacobian), weighted @ distance
    used = np.flatnonzero(square.diagonal() > 0)
    square, push, held, bends = square[used][:, used], push[used], held[used], bends[used]
    total = float(np.sum(weight / curves.factor[points.edge[some]]))
    constant = float(weight @ distance**2)

    def loss(logs: np.ndarray | tuple[float, float]) -> float:
        log_noise, log_bend = logs
        variance = np.exp(2 * log_noise)
        prior = np.where(bends, np.exp(-2 * log_bend), held)
        # (The last term is below rounding, unless an edge has fewer points than parameters.)
        factor = factorised(square + diags_array(variance * prior + 1e-14 * square.diagonal()))
        value = (total - len(used)) * 2 * log_noise - np.sum(np.log(prior))
        value += np.sum(np.log(np.abs(factor.U.diagonal())))
        return float(value + (constant - push @ factor.solve(push)) / variance)

    noise = np.log(max(curves.noise, 1e-9 * grain) if given is None else given)
    range_of_noise, limits = (noise - 4.0, noise + 2.0), np.log(_BENDINGS)
    straight, bent = (noise, limits[0]), (noise, np.log(max(curves.bending, 0.02)))
    if given is None:
        options = {"xatol": 0.03}
        one = lambda log: loss((log, limits[0]))
        optimum: Any = minimize_scalar(
            one, bounds=range_of_noise, method="bounded", options=options
        )
        straight = float(optimum.x), limits[0]
        corners = [bent, (bent[0] - 0.7, bent[1]), (bent[0], bent[1] + 0.7)]
        options = {"xatol": 0.03, "fatol": 0.03, "initial_simplex": corners}
        bounds = [range_of_noise, tuple(limits)]
        optimum: Any = minimize(loss, bent, method="Nelder-Mead", bounds=bounds, options=options)
        bent = tuple(optimum.x)
    else:
        one = lambda log: loss((noise, log))
        optimum: Any = minimize_scalar(one, bounds=tuple(limits), method="bounded")
        bent = noise, float(optimum.x)
    best = min(straight, bent, key=loss)
    return float(np.exp(best[0])), float(np.exp(best[1]))


def _prior(
    tissue: ObservedGeometry, grain: float, bending: float
) -> Float[np.ndarray, " geometry"]:
    """Precision of parameters that the points do not determine, which stay at their initial values."""
    n, n_edges = 2 * tissue.n_vertices, len(tissue.angle)
    return np.repeat([_VERTEX * grain, _ANGLE, bending], [n, n_edges, 2 * n_edges]) ** -2.0


def correlation_length(points: Points, rest: Float[np.ndarray, " points"]) -> float:
    """Distance along an edge at which the distances of two points from the curves are independent.

    The integral of the correlation along edges, up to the first lag where it is below 0.05.

    **Arguments:**

    - `points`: the points.
    - `rest`: their distances.

    **Returns:** the length.
    """
    edge, away = points
    same = edge[1:] == edge[:-1]
    spacing = float(np.mean(np.linalg.norm(np.diff(away, axis=0), axis=1)[same]))
    total, lag = 1.0, 1
    while lag < 50:
        pair = edge[lag:] == edge[:-lag]
        if np.sum(pair) < 20:
            break
        one, other = rest[lag:][pair], rest[:-lag][pair]
        correlation = np.sum(one * other) / np.sqrt(np.sum(one**2) * np.sum(other**2) + 1e-300)
        if correlation <= 0.05:
            break
        total, lag = total + 2 * correlation, lag + 1
    return total * spacing
