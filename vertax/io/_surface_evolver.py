"""Dumps of Surface Evolver: foams with their tensions and pressures."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vertax.initialise._faces import Names, Sides, build_faces
from vertax.mesh import Free, Tissue, angle_of_area
from vertax.surfaces import HeightMap


class Foam(eqx.Module):
    """A foam of Surface Evolver."""

    tissue: Tissue
    """Its cells as a free tissue with inner arcs. Each arc encloses the same area over its chord as its chain
    of pieces: areas are those of the file. Of a curved foam, its projection along z."""
    tensions: Float[Array, " edges"]
    """Line tension of each edge, energy per length: the `density` of its pieces. Where they differ, as they
    may on the outline, their mean by length. Of an edge of length 0 (where more than three edges meet), the
    mean of the edges that meet there."""
    tension_spreads: Float[Array, " edges"]
    """The largest difference between pieces of an edge; 0 where they agree."""
    pressures: Float[Array, " cells"]
    """Lagrange multipliers of the areas, energy per area; 0 for cells without. Positive in compressed cells,
    also for bodies that the file lists clockwise, with a negative area and the opposite sign."""
    target_areas: Float[Array, " cells"]
    """Fixed areas (`volume`) of the cells, positive; the area (in space) where a cell has none."""
    time: float
    """`TOTAL_TIME`."""
    chains: tuple[Float[np.ndarray, "_ 2"], ...]
    """The points of each edge from one end to the other."""
    bodies: Int[np.ndarray, " cells"]
    """Number of the body of each cell in the file, at least 1."""
    surface: HeightMap | None = None
    """The smooth surface through all points of a curved foam; None in the plane."""


def read_surface_evolver(path: str | os.PathLike[str]) -> Foam:
    """Read a foam from a dump or a data file of Surface Evolver (Brakke 1992,
    doi:10.1080/10586458.1992.10504253).

    Vertices, edges (with `density`), faces and bodies (with `volume` and `lagrange_multiplier`) are read, in
    the string model; commands at the end are not. Points at which three edges meet become the vertices of the
    tissue; a chain of pieces between two of them becomes one edge. A point at which k > 3 edges meet becomes
    k - 2 vertices, joined by edges of length 0. The order of edges at a vertex is that of the faces there,
    also where chains cross.

    A foam with three coordinates, where z is not constant, is read as its projection along z and the smooth
    surface through its points, see [`HeightMap.through`][vertax.surfaces.HeightMap.through].
    [`infer_tensions`][vertax.tensions.infer_tensions] uses both.

    **Arguments:**

    - `path`: the file.

    **Returns:** a [`Foam`][vertax.io.Foam].

    **Raises:**

    - `OSError` if the file cannot be read.
    - `ValueError`, naming the file and the place, for a file of another kind or a truncated one, bodies
        that overlap, touch in a point only, enclose a hole or lie apart; for
        overhangs of a curved foam.
    """
    path = Path(path)
    pieces = _parsed(path)
    return _foam(pieces, path)


def is_surface_evolver(path: Path) -> bool:
    """Whether a file has an ending of Surface Evolver, or is a text with a section `vertices`."""
    if path.suffix.lower() in (".fe", ".dmp"):
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if b"\0" in file.read(4096):  # an image, or an array
            return False
        file.seek(0)
        return re.search(rb"^\s*vertices\b", file.read(), re.MULTILINE | re.IGNORECASE) is not None


class _Pieces(NamedTuple):
    """The elements of the file, numbered from 0."""

    points: Float[np.ndarray, "points 3"]
    edges: Int[np.ndarray, "edges 2"]
    density: Float[np.ndarray, " edges"]
    # Of each body: numbers of its edges from 1, counter-clockwise; negative: against the edge.
    loops: list[Int[np.ndarray, " _"]]
    pressures: Float[np.ndarray, " bodies"]
    volumes: Float[np.ndarray, " bodies"]
    areas: Float[np.ndarray, " bodies"]
    """Areas within the loops, in space."""
    bodies: Int[np.ndarray, " bodies"]
    """Their numbers in the file."""
    time: float


_SECTIONS = ("vertices", "edges", "faces", "bodies")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def _parsed(path: Path) -> _Pieces:
    broken = lambda what: ValueError(f"{path} is not a foam of Surface Evolver: {what}.")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise broken("it is not text") from error
    text = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)
    text = re.sub(r"//[^\n]*", " ", text)
    text = re.sub(r"\\[ \t]*\n", " ", text)
    dimension = re.search(r"^SPACE_DIMENSION\s+(\d+)", text, re.MULTILINE | re.IGNORECASE)
    if dimension is not None and dimension[1] not in ("2", "3"):
        raise broken(f"its space has {dimension[1]} dimensions")
    time = re.search(rf"^TOTAL_TIME\s+({_NUMBER})", text, re.MULTILINE | re.IGNORECASE)
    rows: dict[str, list[list[str]]] = {name: [] for name in _SECTIONS}
    section = None
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        first = words[0].lower()
        if first in _SECTIONS or first in ("facets", "read"):
            section = {"facets": "faces", "read": None}.get(first, first)
            if first == "read":
                break
        elif section is not None and re.fullmatch(r"\d+", words[0]):
            rows[section].append(words)
    for name in _SECTIONS:
        if not rows[name]:
            raise broken(f"it has no section `{name}`, or is truncated")
    try:
        # Without a dimension the space has three; a file for the plane may leave out z.
        has_z = dimension[1] == "3" if dimension else _is_number(rows["vertices"][0][3:4])
        points = {
            int(w[0]): (float(w[1]), float(w[2]), float(w[3]) if has_z else 0.0)
            for w in rows["vertices"]
        }
        edges = {
            int(w[0]): (int(w[1]), int(w[2]), _after(w, "density", 1.0)) for w in rows["edges"]
        }
        faces = {int(w[0]): _integers(w[1:]) for w in rows["faces"]}
        bodies = [
            (_integers(w[1:]), _after(w, "volume", np.nan), _after(w, "lagrange_multiplier", 0.0))
            for w in rows["bodies"]
        ]
    except (ValueError, IndexError) as error:
        raise broken(f"a line cannot be read ({error})") from error
    bodies_in_file = np.array([int(w[0]) for w in rows["bodies"]])
    if bodies_in_file.min() < 1:
        raise broken("a body has the number 0, and numbers begin at 1")
    try:
        number = {name: index for index, name in enumerate(points)}
        place = {name: index for index, name in enumerate(edges)}
        ends = np.array([(number[a], number[b]) for a, b, _ in edges.values()])
        loops = [
            np.array([(place[abs(e)] + 1) * (1 if e > 0 else -1) for e in _turned(faces, body)])
            for body, *_ in bodies
        ]
    except KeyError as error:
        raise broken(f"element {error} is used but missing; the file may be truncated") from error
    where = np.array(list(points.values()))
    vectors = np.array([_area_of(loop, ends, where, broken) for loop in loops])
    areas = vectors[:, 2]
    pressures, volumes = np.array([body[1:] for body in bodies]).T[::-1]
    # A body with a clockwise face has a negative area and volume, and its Lagrange multiplier the opposite
    # sign. A data file that was written by hand may have a positive volume all the same.
    negative = np.where(np.isnan(volumes), areas, volumes) < 0
    return _Pieces(
        points=where,
        edges=ends,
        density=np.array([density for *_, density in edges.values()]),
        loops=[loop if area > 0 else -loop[::-1] for loop, area in zip(loops, areas, strict=True)],
        pressures=np.where(negative, -pressures, pressures),
        volumes=np.abs(volumes),
        areas=np.linalg.norm(vectors, axis=1),
        bodies=bodies_in_file,
        time=float(time[1]) if time else 0.0,
    )


def _after(words: list[str], name: str, default: float) -> float:
    """The number after a word."""
    lower = [word.lower() for word in words]
    return float(words[lower.index(name) + 1]) if name in lower else default


def _is_number(words: list[str]) -> bool:
    return bool(words) and re.fullmatch(_NUMBER, words[0]) is not None


def _integers(words: list[str]) -> list[int]:
    """The leading integers of a row."""
    integers = []
    for word in words:
        if not re.fullmatch(r"[-+]?\d+", word):
            break
        integers.append(int(word))
    return integers


def _turned(faces: dict[int, list[int]], body: list[int]) -> list[int]:
    """The edges around the one face of a body, in its direction."""
    if len(body) != 1:
        raise KeyError(f"of a body of {len(body)} faces")
    loop = faces[abs(body[0])]
    return loop if body[0] > 0 else [-edge for edge in reversed(loop)]


def _area_of(
    loop: Int[np.ndarray, " pieces"],
    ends: Int[np.ndarray, "edges 2"],
    points: Float[np.ndarray, "points 3"],
    broken: Callable[[str], ValueError],
) -> Float[np.ndarray, "3"]:
    """The vector area within the edges around a face; its z is negative if they are clockwise."""
    start = np.where(loop > 0, ends[np.abs(loop) - 1, 0], ends[np.abs(loop) - 1, 1])
    stop = np.where(loop > 0, ends[np.abs(loop) - 1, 1], ends[np.abs(loop) - 1, 0])
    if not np.array_equal(stop, np.roll(start, -1)):
        raise broken("the edges of a face are not a closed loop")
    corner = points[start] - points[start].mean(axis=0)
    return 0.5 * np.cross(corner, np.roll(corner, -1, axis=0)).sum(axis=0)


def _foam(pieces: _Pieces, path: Path) -> Foam:
    # A directed piece is 2 e along edge e and 2 e + 1 against it.
    directed = np.concatenate([2 * (np.abs(loop) - 1) + (loop < 0) for loop in pieces.loops])
    cell = np.repeat(np.arange(len(pieces.loops)), [len(loop) for loop in pieces.loops])
    corner = pieces.edges.ravel()[directed]
    places, heights = pieces.points[:, :2], pieces.points[:, 2]
    curved = np.ptp(heights) > 1e-9 * np.ptp(places)
    names = Names(
        f"{path} is not a foam {'without overhangs' if curved else 'in the plane'}: its bodies",
        lambda point: f"the point {pieces.points[point, : 3 if curved else 2].tolist()}",
        lambda body: f"body {pieces.bodies[body]}",
    )
    sides = Sides(corner, np.zeros((len(corner), 2), int), cell)
    mesh = build_faces(places, sides, names, exterior=True)
    topology, vertices = mesh.topology, places[mesh.points]

    length = np.linalg.norm(np.diff(pieces.points[pieces.edges], axis=1)[:, 0], axis=1)
    ends = np.asarray(topology.edge_vertices)
    n_edges = topology.n_edges
    tensions, spreads, angles = np.full(n_edges, np.nan), np.zeros(n_edges), np.zeros(n_edges)
    courses, chains = [], mesh.chains()
    for edge, half_edge in enumerate(np.asarray(topology.half_edge)):
        chain = chains[half_edge]
        course = np.append(places[corner[chain]], vertices[ends[edge, 1:]], axis=0)
        if not len(chain):  # an edge of length 0
            courses.append(vertices[ends[edge]])
            continue
        which = directed[chain] // 2
        density = pieces.density[which]
        tensions[edge] = np.average(density, weights=np.maximum(length[which], 1e-300))
        spreads[edge] = np.ptp(density)
        courses.append(course)
        chord = course[-1] - course[0]
        rest = course - course[0]
        bulge = 0.5 * np.sum(rest[:-1, 0] * rest[1:, 1] - rest[:-1, 1] * rest[1:, 0])
        angles[edge] = angle_of_area(np.array([bulge]), np.array([np.linalg.norm(chord)]))[0]
    points = mesh.points[ends]
    for edge in np.flatnonzero(np.isnan(tensions)):
        tensions[edge] = np.nanmean(tensions[np.any(points == points[edge, 0], axis=1)])
    tissue = Tissue(vertices, topology, Free(), angles=angles, inner_arcs=True)
    if curved and tissue.overlaps.any:
        bad = np.flatnonzero(np.asarray(tissue.overlaps.cells))
        names.refuse(
            "have projections along z that do not overlap",
            f"there are overlaps at {names.cells(bad) if bad.size else 'the outline'}",
            "Turn the foam, or cut it.",
        )
    volumes = np.where(np.isnan(pieces.volumes), pieces.areas, pieces.volumes)
    as_numbers = lambda values: jnp.asarray(values, tissue.vertices.dtype)
    return Foam(
        tissue=tissue,
        tensions=as_numbers(tensions),
        tension_spreads=as_numbers(spreads),
        pressures=as_numbers(pieces.pressures),
        target_areas=as_numbers(volumes),
        time=pieces.time,
        chains=tuple(courses),
        bodies=pieces.bodies,
        surface=HeightMap.through(pieces.points) if curved else None,
    )
