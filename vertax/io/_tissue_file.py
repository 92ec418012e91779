"""Files of one tissue."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vertax._base.archive import as_jax, read_archive, write_archive
from vertax._base.checks import describe
from vertax.mesh import AbstractBoundary, Free, Periodic, Tissue, Topology
from vertax.surfaces import AbstractSurface, Cylinder, HeightMap, SphericalCap

_VERSION = 1
_INT32 = np.iinfo(np.int32)


class _BoundaryRecord(NamedTuple):
    """How one class of boundary is stored: its arrays by field name, which are arguments of `build`."""

    build: Callable[..., AbstractBoundary]
    fields: dict[str, tuple[int | None, ...]]
    """Shape of each array; None is any length."""


class _SurfaceRecord(NamedTuple):
    """How one class of surface is stored: its arrays by field name, and its static flags."""

    build: type[AbstractSurface]
    fields: dict[str, tuple[int | None, ...]]
    flags: tuple[str, ...] = ()


# A new boundary class is one more entry. Names and fields are part of the file format: do not change them.
_BOUNDARIES: dict[str, _BoundaryRecord] = {
    "periodic": _BoundaryRecord(Periodic, {"lattice": (2, 2)}),
    "free": _BoundaryRecord(Free, {}),
}

_SURFACES: dict[str, _SurfaceRecord] = {
    "cylinder": _SurfaceRecord(Cylinder, {"radius": ()}),
    "spherical_cap": _SurfaceRecord(SphericalCap, {"radius": ()}),
    "height_map": _SurfaceRecord(
        HeightMap, {"coefficients": (None, None), "sides": (2,), "origin": (2,)}, ("periodic",)
    ),
}


def save_tissue(path: str | os.PathLike[str], tissue: Tissue) -> None:
    """Save a tissue to a file, exactly: every number keeps its bits and its precision.

    The file is a NumPy `.npz` archive without pickles, so other programs can read it. It holds
    `format`, `version` and `boundary` (the header), `vertices`, `softening`, the arrays of the
    [`Topology`][vertax.Topology] by name, and those of the boundary as `boundary_…`; where a tissue
    has them, `angles`, `angle_length`, `inner_arcs`, `pinned` (0 or 1), `spare` (1), and `surface` with
    the arrays `surface_…` of a cylinder, a spherical cap or a height map. It is written
    atomically: an interrupted save leaves the old file, if any, as it was.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `tissue`: the [`Tissue`][vertax.Tissue].

    **Raises:**

    - `ValueError` for a batch of tissues, for number types that NumPy does not have, or for a class of
        boundary or surface that the format does not have (a `Graph` is a function, which a file cannot hold).
    - `TypeError` if `tissue` is not a tissue.
    - `OSError` if the file cannot be written.
    """
    write_archive(path, "tissue", _VERSION, tissue_arrays(tissue))


def load_tissue(path: str | os.PathLike[str]) -> Tissue:
    """Load a tissue that [`save_tissue`][vertax.io.save_tissue] wrote.

    **Arguments:**

    - `path`: the file.

    **Returns:** the [`Tissue`][vertax.Tissue], bit for bit as it was saved.

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError`, with the file's name, if it is not a tissue file, is truncated or damaged, was
        written by a newer version, contradicts itself, or holds float64 numbers while JAX is
        limited to float32 (nothing is rounded silently: enable `jax_enable_x64`).
    """
    return tissue_from(read_archive(path, "tissue", _VERSION), os.fspath(path))


def tissue_arrays(tissue: Tissue) -> dict[str, np.ndarray]:
    """All arrays of a tissue by name, see `save_tissue`; `tissue_from` is the inverse."""
    if not isinstance(tissue, Tissue):
        raise TypeError(f"Argument `tissue` must be a vertax.Tissue, but is {describe(tissue)}.")
    topology = tissue.topology
    kind, record = _record_of(tissue.boundary)
    arrays: dict[str, Any] = {
        "boundary": kind,
        "vertices": tissue.vertices,
        "softening": tissue.softening,
        "twin": topology.twin,
        "cell": topology.cell,
        "frame": topology.frame,
        "edge": topology.edge,
        "half_edge": topology.half_edge,
    }
    arrays |= {f"boundary_{name}": getattr(tissue.boundary, name) for name in record.fields}
    if tissue.angles is not None:
        arrays |= {"angles": tissue.angles, "angle_length": tissue.angle_length}
        arrays |= {"inner_arcs": int(tissue.inner_arcs)}
    if tissue.pinned is not None:
        arrays |= {"pinned": np.asarray(tissue.pinned).astype(np.int8)}
    if topology.spare:
        arrays |= {"spare": 1}
    if tissue.surface is not None:
        arrays |= _surface_arrays(tissue.surface)
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    if arrays["vertices"].ndim != 2:
        raise ValueError(
            "Argument `tissue` must be a single tissue, but its vertices have shape "
            f"{arrays['vertices'].shape}. Save the members of a batch one by one."
        )
    for name, array in arrays.items():
        # NumPy would read bfloat16 and similar types as raw bytes.
        if name not in ("boundary", "surface") and array.dtype.kind not in "fi":
            raise ValueError(
                "Argument `tissue` must hold numbers of a NumPy type, but "
                f"`{name}` is {array.dtype}."
            )
    return arrays


def tissue_from(
    arrays: Mapping[str, np.ndarray], name: str, topology: Topology | None = None
) -> Tissue:
    """Build a tissue from arrays, and check it.

    **Arguments:**

    - `arrays`: as of `tissue_arrays`.
    - `name`: of the file they come from.
    - `topology`: that of `arrays`, if it was built before.

    **Returns:** the tissue.

    **Raises:** see `load_tissue`.
    """
    kind = str(arrays.get("boundary"))
    if kind not in _BOUNDARIES:
        raise ValueError(
            f"{name} has a boundary of an unknown kind, {kind!r}; the kinds are: "
            f"{', '.join(_BOUNDARIES)}."
        )
    record = _BOUNDARIES[kind]

    def get(key: str, kinds: str, *shape: int | None) -> np.ndarray:
        """The array `key`, of a dtype among `kinds` and of the given shape (None: any length)."""
        if key not in arrays:
            raise ValueError(f"{name} is incomplete: it has no array `{key}`.")
        array = arrays[key]
        fits = len(shape) == array.ndim and all(
            size in (None, have) for size, have in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in kinds or not fits:
            expected = f"({', '.join('any' if n is None else str(n) for n in shape)})"
            what = "integers" if kinds == "i" else "real numbers"
            raise ValueError(
                f"{name} is broken: `{key}` has shape {array.shape} and type {array.dtype}, but "
                f"must have shape {expected} and hold {what}."
            )
        if array.dtype.kind == "f":
            as_jax(array, name)
        elif array.size and not (_INT32.min <= array.min() and array.max() <= _INT32.max):
            raise ValueError(
                f"{name} is broken: `{key}` holds numbers from {array.min()} to {array.max()}, which "
                "are out of range in a tissue."
            )
        return array

    twin = get("twin", "i", None)
    n_half = len(twin)
    cell, frame = get("cell", "i", n_half), get("frame", "i", n_half, 2)
    edge, half_edge = get("edge", "i", n_half), get("half_edge", "i", n_half // 2)
    vertices, softening = get("vertices", "f", n_half // 3, 2), get("softening", "f")
    fields = {
        field: get(f"boundary_{field}", "f", *shape) for field, shape in record.fields.items()
    }
    options: dict[str, Any] = {}
    if "angles" in arrays:
        options["angles"] = jnp.asarray(get("angles", "f", n_half // 2))
        options["angle_length"] = jnp.asarray(get("angle_length", "f"))
        options["inner_arcs"] = bool(get("inner_arcs", "i"))
    if "pinned" in arrays:
        options["pinned"] = get("pinned", "i", n_half // 3) != 0
    if "surface" in arrays:
        options["surface"] = _surface_from(str(arrays["surface"]), get, name)
    try:
        if topology is None:
            faces = {"exterior": record.build is Free, "spare": "spare" in arrays}
            topology = _topology_from(twin, cell, frame, edge, half_edge, **faces)
        boundary = record.build(**{field: jnp.asarray(array) for field, array in fields.items()})
        return Tissue(jnp.asarray(vertices), topology, boundary, jnp.asarray(softening), **options)
    except ValueError as error:
        raise ValueError(f"{name} is broken: {error}") from error


def _surface_arrays(surface: AbstractSurface) -> dict[str, Any]:
    for kind, record in _SURFACES.items():
        if type(surface) is record.build:
            flags = {f"surface_{name}": int(getattr(surface, name)) for name in record.flags}
            fields = {f"surface_{name}": getattr(surface, name) for name in record.fields}
            return {"surface": kind} | fields | flags
    raise ValueError(
        f"The tissue format has no surface of class {type(surface).__name__}; it has: "
        f"{', '.join(_SURFACES)}. Save tissue.with_surface(None), and put the surface back after loading."
    )


def _surface_from(kind: str, get: Callable[..., np.ndarray], name: str) -> AbstractSurface:
    if kind not in _SURFACES:
        raise ValueError(
            f"{name} has a surface of an unknown kind, {kind!r}; the kinds are: {', '.join(_SURFACES)}."
        )
    record = _SURFACES[kind]
    surface = object.__new__(record.build)  # its fields are those of the file, bit for bit
    for field, shape in record.fields.items():
        value = jnp.asarray(get(f"surface_{field}", "f", *shape))
        object.__setattr__(surface, field, value)
    for flag in record.flags:
        object.__setattr__(surface, flag, bool(get(f"surface_{flag}", "i")))
    return surface


def _topology_from(
    twin: np.ndarray,
    cell: np.ndarray,
    frame: np.ndarray,
    edge: np.ndarray,
    half_edge: np.ndarray,
    *,
    exterior: bool,
    spare: bool,
) -> Topology:
    topology = Topology(twin, cell, frame, edge, exterior=exterior, spare=spare)
    # The direction of an edge is not in the other arrays: after a T1 it need not be the first half-edge
    # of the pair.
    direction = jnp.asarray(half_edge, topology.half_edge.dtype)
    topology = eqx.tree_at(lambda m: m.half_edge, topology, direction)
    topology.validate()
    return topology


def _record_of(boundary: AbstractBoundary) -> tuple[str, _BoundaryRecord]:
    for kind, record in _BOUNDARIES.items():
        if type(boundary) is record.build:
            return kind, record
    raise ValueError(
        f"The tissue format has no boundary of class {type(boundary).__name__}; it "
        f"has: {', '.join(_BOUNDARIES)}."
    )
