"""The shape of a tissue in an image, lifted to a curved surface."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vertax._base.announce import announced_jit
from vertax.mesh import Tissue, geometry_of
from vertax.surfaces import AbstractSurface
from vertax.tensions._inferred import CurvedGeometry
from vertax.tensions._observed_geometry import Lift, ObservedGeometry

# A point x of the image lies at r(x). With J = ∂r/∂x and the metric g = JᵀJ, the columns of J S⁻¹, S = √g
# (symmetric), are an orthonormal basis of the tangent plane, in which a direction t of the image is S t: at
# small slopes it differs least from t. Balance in the tangent plane: Σ γ S t / |S t| = 0.
#
# Along an arc with the tangent T and the normal N in the image, d²r/ds² = D²r(T, T) + κ J N. Its components
# in the tangent plane and along the normal n give the geodesic curvature and the normal one,
# κ_g = (r' × r'') · n / |r'|³ and κ_n = r'' · n / |r'|². The law of Laplace is γ κ_g = Δp; tensions press on
# what is below with the force γ κ_n per length.
_PIECES = 8
"""Intervals along an edge, with one sample in the middle of each."""
_STEP = 1e-2
"""Change of the angle of an arc, in radians, for the slope of its angle in space."""


def lifted(
    geometry: ObservedGeometry, change: Float[np.ndarray, " geometry"], surface: AbstractSurface
) -> Lift:
    """The map of directions and arcs of an image to a surface, after a change by the fit."""
    vertex = geometry.place + change[: 2 * geometry.n_vertices].reshape(-1, 2)
    moved = geometry.moved(change)
    start = vertex[moved.ends[:, 0]]
    arc = _along(surface, start, moved.chord, moved.angle)
    other = _along(surface, start, moved.chord, moved.angle + _STEP)
    slope = (other.angle - arc.angle) / _STEP
    tangents = np.asarray(_jacobian(surface, jnp.asarray(vertex)))
    root = _square_root(np.swapaxes(tangents, 1, 2) @ tangents)
    way = np.where(moved.forward, 1, -1)[..., None]
    away = way * moved.chord[moved.half_edge]
    chord = way * _chords(surface, start, moved.chord)[moved.half_edge]
    projected = np.einsum("vij,vkj,vlk->vli", np.linalg.inv(root), tangents, chord)
    return Lift(
        root=root,
        offset=projected - np.einsum("vij,vlj->vli", root, away),
        turn=np.stack([arc.angle - slope * moved.angle, slope], axis=1),
        chord=arc.length * np.sinc(arc.angle / np.pi),
    )


def curved_geometry(
    tissue: Tissue, surface: AbstractSurface, tensions: Float[np.ndarray, " edges"]
) -> tuple[CurvedGeometry, Float[np.ndarray, "edges 2 2"]]:
    """The geometry in space of a tissue in an image, and the integrals of t t along its edges, in the bases
    of tangent planes."""
    geometry, m = geometry_of(tissue), tissue.topology
    start = np.asarray(tissue.edge_segments[0], float)
    arc = _along(surface, start, geometry.edge_vectors, geometry.edge_angles)
    middle = start + 0.5 * geometry.edge_vectors
    areas, slopes = _areas(
        surface, geometry.edge_cells, tissue.n_cells, middle, arc.border, geometry.edge_angles
    )
    lengths = arc.length
    if tissue.arcs is None:
        lengths = np.linalg.norm(_chords(surface, start, geometry.edge_vectors), axis=1)
    perimeters = np.zeros(tissue.n_cells + 1)
    for side in geometry.edge_cells.T:
        np.add.at(perimeters, side, lengths)
    load = 0.5 * tensions * arc.bending
    curved = CurvedGeometry(
        tissue=Tissue(tissue.vertices, m, tissue.boundary, tissue.softening, surface=surface),
        areas=areas,
        perimeters=perimeters[:-1],
        slopes=slopes,
        lengths=lengths,
        normal_loads=load[np.asarray(m.edge).reshape(-1, 3)].sum(axis=1),
    )
    return curved, arc.fabric


class _Arc(NamedTuple):
    length: np.ndarray
    angle: np.ndarray
    """Half of the geodesic turning."""
    bending: np.ndarray
    """Integral of the normal curvature."""
    fabric: np.ndarray
    border: np.ndarray
    """Points in the image at the ends of the intervals."""


def _along(
    surface: AbstractSurface, start: np.ndarray, chord: np.ndarray, angle: np.ndarray
) -> _Arc:
    """Integrals along arcs."""
    length = np.linalg.norm(chord, axis=1)
    unit = chord / np.maximum(length, 1e-300)[:, None]
    left = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    arc = length / np.sinc(angle / np.pi)

    def at(fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and directions of tangents. (Chords from the start turn by α τ, with lengths sinc(α τ).)"""
        turned = angle[:, None] * fraction
        reach = (arc[:, None] * fraction * np.sinc(turned / np.pi))[..., None]
        way = turned - angle[:, None]
        along = np.cos(way)[..., None] * unit[:, None] + np.sin(way)[..., None] * left[:, None]
        return start[:, None] + reach * along, way + turned

    x, way = at((np.arange(_PIECES) + 0.5) / _PIECES)
    rotated = lambda turn: (
        np.cos(way + turn)[..., None] * unit[:, None]
        + np.sin(way + turn)[..., None] * left[:, None]
    )
    tangent, normal = rotated(0.0), rotated(np.pi / 2)
    curvature = 2 * angle / np.maximum(arc, 1e-300)
    bent = curvature[:, None, None] * normal
    points = [jnp.asarray(part.reshape(-1, 2)) for part in (x, tangent, bent)]
    first, second, frame = (np.asarray(part) for part in _derivatives(surface, *points))
    up = np.cross(frame[:, :, 0], frame[:, :, 1])
    up /= np.linalg.norm(up, axis=1)[:, None]
    speed = np.linalg.norm(first, axis=1)
    geodesic = np.sum(np.cross(first, second) * up, axis=1) / speed**2  # per length in the image
    pressing = np.sum(second * up, axis=1) / speed
    metric = np.swapaxes(frame, 1, 2) @ frame
    way3 = np.einsum("nij,nj->ni", _square_root(metric), tangent.reshape(-1, 2)) / speed[:, None]
    total = lambda values: (
        values.reshape(len(angle), _PIECES, *values.shape[1:]).mean(axis=1)
        * arc.reshape(-1, *[1] * (values.ndim - 1))
    )
    outer = speed[:, None, None] * way3[:, :, None] * way3[:, None, :]
    border, _ = at(np.arange(_PIECES + 1) / _PIECES)
    return _Arc(total(speed), 0.5 * total(geodesic), total(pressing), total(outer), border)


def _areas(
    surface: AbstractSurface,
    cells: np.ndarray,
    n: int,
    middle: np.ndarray,
    border: np.ndarray,
    angle: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Areas of the cells in space, by fans of triangles in the image, and slopes at the means of their
    outlines, √(det g - 1)."""
    # The area between an interval, an arc of the angle β, and its chord c is c² (2β - sin 2β) / 8 sin² β.
    part = np.where(angle == 0, 1, angle / _PIECES)
    chord = np.linalg.norm(border[:, 1] - border[:, 0], axis=1)
    bulge = chord**2 * (2 * part - np.sin(2 * part)) / (8 * np.sin(part) ** 2)
    bulge = np.where(np.abs(angle) < 1e-4, 0, bulge)
    sums, length = np.zeros((n + 1, 3)), np.linalg.norm(border[:, -1:] - border[:, :1], axis=2)
    for side in cells.T:
        np.add.at(sums, side, length * np.column_stack([middle, np.ones(len(middle))]))
    centre = sums[:, :2] / np.maximum(sums[:, 2:], 1e-300)
    total = np.zeros(n + 1)
    for side, sign in zip(cells.T, (1, -1), strict=True):
        arm = border - centre[side][:, None]
        a, b = arm[:, :-1], arm[:, 1:]
        planar = 0.5 * sign * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        places = centre[side][:, None, None] + 0.5 * np.stack([a + b, a, b], axis=2)
        density = surface.sampled(places)[1]
        share = planar * density.mean(axis=-1) + sign * bulge[:, None] * density[:, :, 0]
        np.add.at(total, side, share.sum(axis=1))
    density = surface.sampled(centre[:-1])[1]
    return total[:-1], np.sqrt(np.maximum(density**2 - 1, 0))


def _square_root(metric: np.ndarray) -> np.ndarray:
    """The square root of positive 2 × 2 matrices, (g + √det g) / √(tr g + 2 √det g)."""
    root = np.sqrt(np.linalg.det(metric))
    trace = np.trace(metric, axis1=1, axis2=2) + 2 * root
    return (metric + root[:, None, None] * np.eye(2)) / np.sqrt(trace)[:, None, None]


def _chords(surface: AbstractSurface, start: np.ndarray, chord: np.ndarray) -> np.ndarray:
    first, second = surface.sampled(np.stack([start, start + chord]))[0]
    return second - first


@announced_jit
def _jacobian(surface: AbstractSurface, x: Float[Array, "n 2"]) -> Float[Array, "n 3 2"]:
    return surface.jacobian(x)


@announced_jit
def _derivatives(
    surface: AbstractSurface,
    x: Float[Array, "n 2"],
    tangent: Float[Array, "n 2"],
    bent: Float[Array, "n 2"],
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n 3 2"]]:
    """J T, D²r(T, T) + J b, and J."""
    along = lambda x: jax.jvp(surface.points, (x,), (tangent,))[1]
    first, second = jax.jvp(along, (x,), (tangent,))
    return first, second + jax.jvp(surface.points, (x,), (bent,))[1], surface.jacobian(x)
