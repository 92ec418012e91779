"""Files of tissues, energies, problems and trajectories: a tree of class names and fields, and the arrays."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import json
import math
import os
import re
from collections.abc import Iterable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vertax._base.archive import as_jax, read_archive, write_archive
from vertax._base.checks import check_instance
from vertax.fitting import InverseProblem
from vertax.io._trajectory import members_of, parts_of
from vertax.mesh import Periodic, Tissue, Topology, Trajectory

_VERSION = 1

# A field may hold functions of these modules, which are stored by their import path.
_MODULES = ("jax.nn", "jax.numpy", "jax.lax", "equinox", "optimistix", "optax")
_ODD_FLOATS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


_Content = TypeVar("_Content")


def save(path: str | os.PathLike[str], content: eqx.Module | Trajectory) -> None:
    """Save a tissue, an energy, an inverse problem, a trajectory, or another object of vertax, exactly.

    ```python
    vx.save("tissue.npz", tissue)
    vx.save("energy.npz", energy)
    ```

    Arrays keep their bits and their precision, and Python numbers stay Python numbers: a fit adjusts the
    same parameters by default after loading.

    The file is a NumPy `.npz` archive without pickles: `format` and `version` (the header), `tree` (the
    classes and their fields, as JSON), and each array by its place in the tree: `data.vertices`,
    `data.topology.twin` and others of a tissue, `data.terms.0.stiffness` of a sum of energies. Successive
    frames of a trajectory with one topology are one batch of tissues, `data.parts.0` and so on, and its
    values are `data.values.0` and so on. The file is written atomically: an interrupted save leaves the old
    file, if any, as it was.

    Functions are stored by their import path, such as `jax.nn.tanh`, if they are public in `jax.nn`,
    `jax.numpy`, `jax.lax`, `equinox`, `optimistix` or `optax`. Other functions cannot be stored: remove a
    solver such as [`Optax`][vertax.solvers.Optax] before saving, and set it again after loading:

    ```python
    vx.save("problem.npz", dataclasses.replace(problem, response=vx.Relaxation()))
    loaded = vx.load("problem.npz", vx.InverseProblem)
    problem = dataclasses.replace(loaded, response=problem.response)
    ```

    and write another `trainable` as booleans, `jax.tree.map(trainable, energy)`.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `content`: an object of a public class of vertax or of one of your subclasses of `equinox.Module`, also
        a batch; or a [`Trajectory`][vertax.mesh.Trajectory] with at least one frame. Fields may hold arrays,
        keys of random numbers, numbers, text, None, tuples, lists, dictionaries and modules.

    **Raises:**

    - `TypeError` for another object.
    - `ValueError`, naming the field, for objects that cannot be stored (functions, for example: a
        [`Graph`][vertax.surfaces.Graph] is one), for number types that NumPy does not have, and for a
        trajectory without frames.
    - `OSError` if the file cannot be written.
    """
    expected = "a tissue, an energy, a problem, a trajectory or another equinox.Module"
    check_instance("content", content, eqx.Module | Trajectory, expected)
    writer = _Writer(content)
    tree = json.dumps(writer.node(content, ""), allow_nan=False)
    write_archive(path, "data", _VERSION, {"tree": np.asarray(tree)} | writer.arrays)


def load(
    path: str | os.PathLike[str],
    kind: type[_Content],
    *,
    classes: Iterable[type[eqx.Module]] = (),
) -> _Content:
    """Load what [`save`][vertax.io.save] wrote.

    A file holds the names of classes but no code: the classes are those of vertax and those in `classes`.

    ```python
    tissue = vx.load("tissue.npz", vx.Tissue)
    energy = vx.load("energy.npz", vx.AbstractEnergy, classes=[Contractility])
    ```

    **Arguments:**

    - `path`: the file.
    - `kind`: the class of the content, or an abstract class of it.
    - `classes`: your classes in the file, identified by their names: energies, costs, solvers, boundaries,
        surfaces, …. Objects are made without calling `__init__`. A field that was added to a class later gets
        its default.

    **Returns:** the object, bit for bit as it was saved.

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError`, with the file's name, if it is not a file of `save`, is truncated or damaged, was written
        by a newer version, contains an object of another class than `kind`, a class that is not in `classes`
        or a tissue that contradicts itself, or holds 64-bit numbers while JAX is limited to 32 bits (nothing
        is rounded silently: enable `jax_enable_x64`).
    """
    name = os.fspath(path)
    check_instance("kind", kind, type, "a class, such as vx.Tissue")
    user_classes: dict[str, type[eqx.Module]] = {}
    check_instance("classes", classes, Iterable, "a list of classes")
    for cls in classes:
        check_instance("classes", cls, type(eqx.Module), "a list of subclasses of equinox.Module")
        if user_classes.setdefault(cls.__name__, cls) is not cls:
            raise ValueError(
                f"Argument `classes` holds two classes of the name {cls.__name__}, which a file cannot "
                "distinguish. Rename one."
            )
    arrays = read_archive(path, "data", _VERSION)
    try:
        tree = json.loads(str(arrays.get("tree", "")))
        content = _Reader(name, arrays, user_classes).node(tree, "content")
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{name} is broken: its `tree` cannot be read ({error}).") from error
    if not isinstance(content, kind):
        raise ValueError(
            f"Argument `kind` must be the class of the content of {name}, {type(content).__name__}, or a "
            f"base class, but is {kind.__name__}."
        )
    return content


def _import_path(function: Any) -> str | None:
    """The import path of a function of `_MODULES`; None for other objects."""
    name = getattr(function, "__name__", "")
    paths = [f"{module}.{name}" for module in _MODULES]
    return next((path for path in paths if function is _function_at(path)), None)


def _function_at(path: str) -> Any:
    """The object at an import path of `_MODULES`, or None."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name, None) if module in _MODULES else None


def _default_of(cls: type, name: str) -> Any:
    """The default of a parameter of a class; `inspect.Parameter.empty` without one."""
    parameter = inspect.signature(cls).parameters.get(name)
    return inspect.Parameter.empty if parameter is None else parameter.default


def _name_of(cls: type) -> str | None:
    """The name of a public class of vertax in files, such as `energies.LineTension`."""
    package, *path = cls.__module__.split(".")
    # (`solvers.Scales` is defined below the solvers.)
    family = "solvers" if path[:1] == ["_base"] else "".join(path[:1])
    name = f"{family}.{cls.__name__}"
    return name if package == "vertax" and _class_of(name) is cls else None


@functools.cache
def _class_of(name: str) -> type[eqx.Module] | None:
    """The public class of vertax with a name in files."""
    family, _, name = name.partition(".")
    if not re.fullmatch("[a-z]+", family):
        return None
    try:
        cls = getattr(importlib.import_module(f"vertax.{family}"), name, None)
    except ImportError:
        return None
    is_module = isinstance(cls, type) and issubclass(cls, eqx.Module)
    return cls if is_module and not inspect.isabstract(cls) else None


class _Writer:
    """Convert modules to JSON, and collect their arrays."""

    def __init__(self, content: eqx.Module | Trajectory):
        self.is_problem = isinstance(content, InverseProblem)
        self.arrays: dict[str, np.ndarray] = {}

    def node(self, value: Any, path: str) -> Any:
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"kind": "float", "value": str(value)}
        if type(value) in (tuple, list):
            items = [self.node(item, f"{path}.{i}") for i, item in enumerate(value)]
            return {"kind": type(value).__name__, "items": items}
        if type(value) is dict and all(type(key) is str for key in value):
            nodes = [self.node(item, f"{path}.{i}") for i, item in enumerate(value.values())]
            return {"kind": "dict", "keys": list(value), "items": nodes}
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            data = self.array("key", jax.random.key_data(value), path)
            return data | {"generator": str(jax.random.key_impl(value))}
        if isinstance(value, jax.Array):
            return self.array("array", value, path) | {"weak": bool(value.weak_type)}
        if isinstance(value, np.ndarray) and type(value) is np.ndarray:
            return self.array("numpy", value, path)
        if isinstance(value, np.generic):
            return self.array("scalar", value, path)
        if isinstance(value, eqx.Module):
            return self.module(value, path)
        if isinstance(value, Trajectory):
            parts = self.node(parts_of(value), f"{path}.parts")
            values = self.node(value.values, f"{path}.values")
            return {"kind": "trajectory", "parts": parts, "values": values}
        if (name := _import_path(value)) is not None:
            return {"kind": "function", "name": name}
        what = "a function" if inspect.isroutine(value) else f"of type {type(value).__name__}"
        raise ValueError(
            f"Argument `content` cannot be saved: its `{path[1:]}` is {what}, which has no place "
            f"in a file. {self.remedy(path)}"
        )

    def remedy(self, path: str) -> str:
        if self.is_problem and path.startswith(".trainable"):
            return "Give booleans: dataclasses.replace(problem, trainable=jax.tree.map(trainable, energy))."
        if self.is_problem and path.startswith(".response"):
            return (
                "Save dataclasses.replace(problem, response=vx.Relaxation()), and give the response again "
                "after loading."
            )
        return "Take it out before saving (equinox.tree_at), and put it back after loading."

    def array(self, kind: str, value: Any, path: str) -> dict[str, Any]:
        dtype = value.dtype
        # NumPy would read bfloat16 and similar types as raw bytes.
        if not isinstance(dtype, np.dtype) or dtype.kind not in "biufc":
            raise ValueError(
                "Argument `content` must hold numbers of a NumPy type, but its "
                f"`{path[1:]}` is {dtype}. Convert it before saving, such as to float32."
            )
        name = f"data{path}"
        self.arrays[name] = np.asarray(value)
        return {"kind": kind, "name": name}

    def module(self, module: eqx.Module, path: str) -> dict[str, Any]:
        cls = type(module)
        name = _name_of(cls)
        if name is None and cls.__module__.split(".")[0] == "vertax":
            part = f"its `{path[1:]}`" if path else "it"
            raise ValueError(
                f"Argument `content` cannot be saved: {part} is of class {cls.__name__}, which is not a "
                f"public one of vertax. {self.remedy(path)}"
            )
        held = vars(module)
        names = [field.name for field in dataclasses.fields(cls) if field.name in held]
        # A function that is a default (`final_activation` of equinox.nn.MLP) is left out.
        names = [x for x in names if not callable(held[x]) or held[x] is not _default_of(cls, x)]
        fields = {field: self.node(held[field], f"{path}.{field}") for field in names}
        kind, name = ("own", cls.__name__) if name is None else ("vertax", name)
        return {"kind": kind, "class": name, "fields": fields}


class _Reader:
    """Rebuild the modules that `_Writer` wrote; everything in the file is checked."""

    def __init__(
        self, file: str, arrays: dict[str, np.ndarray], user_classes: dict[str, type[eqx.Module]]
    ):
        self.file = file
        self.arrays = arrays
        self.user_classes = user_classes

    def node(self, node: Any, path: str) -> Any:
        if node is None or isinstance(node, bool | int | float | str):
            return node
        match node:
            case {"kind": "float", "value": "nan" | "inf" | "-inf" as value}:
                return _ODD_FLOATS[value]
            case {"kind": "tuple" | "list" as kind, "items": list(nodes)}:
                items = [self.node(item, f"{path}.{i}") for i, item in enumerate(nodes)]
                return items if kind == "list" else tuple(items)
            case {"kind": "dict", "keys": list(keys), "items": list(nodes)} if len(keys) == len(
                nodes
            ):
                items = [self.node(item, f"{path}.{i}") for i, item in enumerate(nodes)]
                return dict(zip(map(str, keys), items, strict=True))
            case {"kind": "array", "name": str(name), "weak": bool(weak)}:
                array = as_jax(self.array(name), self.file)
                return _weakly_typed(array) if weak else array
            case {"kind": "key", "name": str(name), "generator": str(generator)}:
                return self.key(name, generator, path)
            case {"kind": "numpy", "name": str(name)}:
                return self.array(name)
            case {"kind": "scalar", "name": str(name)}:
                return self.array(name)[()]
            case {"kind": "function", "name": str(name)} if callable(_function_at(name)):
                return _function_at(name)
            case {"kind": "trajectory", "parts": parts, "values": values}:
                values = self.node(values, f"{path}.values")
                return self.trajectory(self.node(parts, f"{path}.parts"), values)
            case {"kind": "vertax" | "own" as kind, "class": str(name), "fields": dict(fields)}:
                return self.module(self.find(kind, name, path), fields, path)
        raise ValueError(
            f"{self.file} is broken: `{path}` is not one of the things that a file may hold."
        )

    def array(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise ValueError(f"{self.file} is incomplete: it has no array `{name}`.")
        return self.arrays[name]

    def key(self, name: str, generator: str, path: str) -> jax.Array:
        """Keys of random numbers, from their data."""
        data = as_jax(self.array(name), self.file)
        try:
            return jax.random.wrap_key_data(data, impl=generator)
        except Exception as error:
            raise ValueError(
                f"{self.file} is broken: `{path}` is not a key of the generator {generator!r} ({error})."
            ) from error

    def find(self, kind: str, name: str, path: str) -> type[eqx.Module]:
        if kind == "vertax":
            cls = _class_of(name)
            if cls is None:
                raise ValueError(
                    f"{self.file} contains {name} of vertax (at `{path}`), which this version does not have. "
                    "Update vertax."
                )
            return cls
        if name not in self.user_classes:
            raise ValueError(
                f"{self.file} holds an object of the class {name} (at `{path}`), which is not one of "
                f"vertax. Pass the class: classes=[{name}]."
            )
        return self.user_classes[name]

    def module(self, cls: type[eqx.Module], nodes: dict[str, Any], path: str) -> eqx.Module:
        declared = {field.name: field for field in dataclasses.fields(cls)}
        for name in nodes:
            if name not in declared:
                raise ValueError(
                    f"{self.file} has a field `{name}` (at `{path}`) that the class {cls.__name__} does "
                    "not have: it was written with another version of that class."
                )
        # As Equinox rebuilds a tree, without `__init__`: the fields hold its results.
        module = object.__new__(cls)
        for name, field in declared.items():
            if name in nodes:
                value = self.node(nodes[name], f"{path}.{name}")
            else:
                value = self.default(cls, field, path)
            object.__setattr__(module, name, value)
        self.check(module, path)
        return module

    def default(self, cls: type[eqx.Module], field: dataclasses.Field[Any], path: str) -> Any:
        convert = field.metadata.get("converter", lambda x: x)
        if field.default is not dataclasses.MISSING:
            return convert(field.default)
        if field.default_factory is not dataclasses.MISSING:
            return convert(field.default_factory())
        if (default := _default_of(cls, field.name)) is not inspect.Parameter.empty:
            return default
        raise ValueError(
            f"{self.file} has no field `{field.name}` (at `{path}`) of the class {cls.__name__}, which has "
            "no default: it was written with another version of that class."
        )

    def trajectory(self, parts: Any, values: Any) -> Trajectory:
        trajectory = Trajectory()
        try:
            parts = jax.tree.map(lambda x: as_jax(x, self.file), parts)
            frames = [frame for part in parts for frame in members_of(part)]
            for frame in frames:
                check_tissue(frame)
            for k, frame in enumerate(frames):
                trajectory.append(frame, **{key: column[k] for key, column in values.items()})
            if any(len(column) != len(frames) for column in values.values()):
                raise ValueError(f"its values are not those of {len(frames)} frames")
        except Exception as error:  # of NumPy and JAX, for arrays that do not fit
            raise ValueError(f"{self.file} is broken: {error}") from error
        return trajectory

    def check(self, module: eqx.Module, path: str) -> None:
        """Check tissues and topologies: JAX raises no error for an index that is out of range."""
        # In a batch, and in a tree of booleans (`trainable`), there is no single tissue.
        try:
            if isinstance(module, Topology) and np.ndim(module.twin) == 1:
                if any(x.dtype != np.int32 for x in jax.tree.leaves(module)):
                    raise ValueError("the arrays of its topology are not of type int32")
                module.validate()
            if isinstance(module, Tissue) and np.ndim(module.vertices) == 2:
                check_tissue(module)
        except Exception as error:
            raise ValueError(f"{self.file} is broken: `{path}`: {error}") from error


def check_tissue(tissue: Tissue) -> None:
    """Raise a `ValueError` for a tissue that its constructor, or that of its box, would refuse or change."""
    if isinstance(tissue.boundary, Periodic):
        Periodic(tissue.boundary.lattice)
    again = Tissue(
        tissue.vertices,
        tissue.topology,
        tissue.boundary,
        tissue.softening,
        angles=tissue.angles,
        inner_arcs=tissue.inner_arcs,
        pinned=tissue.pinned,
        angle_length=tissue.angle_length,
        surface=tissue.surface,
    )
    for given, right in zip(*map(jax.tree.leaves, (tissue, again)), strict=True):
        if eqx.is_array(given) and (given.shape, given.dtype) != (right.shape, right.dtype):
            raise ValueError("the shapes or types of its arrays are not those of a tissue")


def _weakly_typed(array: jax.Array) -> jax.Array:
    """The same numbers with a weak type, as JAX gives Python numbers."""
    zero = {"i": 0, "f": 0.0, "c": 0j}.get(array.dtype.kind)
    filled = None if zero is None else jnp.full(array.shape, zero)
    if filled is None or filled.dtype != array.dtype:
        return array
    return filled.at[...].set(array)
