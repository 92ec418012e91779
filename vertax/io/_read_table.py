"""Tables from CSV and GeoJSON files."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from vertax._base.checks import describe
from vertax._base.extras import requires_extra
from vertax.io._chaste import read_chaste
from vertax.io._read_vtk import read_vtk

_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf(?:inity)?", re.IGNORECASE)
_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_MISSING = frozenset({"", "NA", "NaN", "nan"})
_SEPARATORS = ",;\t"
# Most header rows that an error message recognises.
_HEADERS = 5


def read_table(path: str | os.PathLike[str]) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Read the columns of a CSV or Parquet file, properties of a GeoJSON file, or polygons of Chaste or VTK.

    It reads what [`write_csv`][vertax.io.write_csv], [`append_parquet`][vertax.io.append_parquet] and
    [`write_geojson`][vertax.io.write_geojson] write: numbers are the same to the last bit.

    ```python
    table = vx.io.read_table("cells.csv")
    table["area"]
    ```

    A column is boolean (`True`, `False`), integer, floating-point or text: the first of these that all its
    entries are. An empty field, `NA`, `NaN`, or null is NaN in a column of numbers. Spaces around names and
    numbers are ignored.

    **Arguments:**

    - `path`: the file. Files that end in `.geojson` or `.json` are GeoJSON; nested properties are columns
        with both names, such as `classification.name`, and lists are left out, with a warning. A folder holds
        Parquet files, the parts of one table in the order of their names, or
        results of Chaste: `results.viznodes`, `results.vizelements` and, if there are, `results.vizlabels` or
        `results.vizcelltypes` and `loggedcell.dat`; a last line without an end is left out, with a warning.
        `.pvd` and `.vtu` files are polygons of VTK in a plane, read through meshio (`pip install -e
        ".[files]"`): `cell` and `type` are their data `cell` or `Cell IDs`, and `type` or `Cell labels`.
        The columns of such movies are those of [`movie_from_table`][vertax.inference.movie_from_table].
        All other files are CSV with a comma, a semicolon or a tab between fields and the names of the columns
        in the first line. Beside semicolons and tabs a comma in a number is the decimal point.

    **Returns:** NumPy arrays by the name of the column.

    **Raises:**

    - `OSError` if the file cannot be read.
    - `ValueError`, naming the file and the line or feature, if it is no such table.
    - `ImportError` for VTK files if meshio is not installed, and for Parquet files if PyArrow is not.
    """
    path = Path(path)
    if path.suffix == ".parquet" or (path.is_dir() and any(path.glob("*.parquet"))):
        return _read_parquet(path)
    if path.is_dir():
        return read_chaste(path)
    if path.suffix in (".pvd", ".vtu"):
        return read_vtk(path)
    if path.suffix.lower() in (".geojson", ".json"):
        return properties(read_features(path), path)
    return _read_csv(path)


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    with requires_extra("cluster", "Reading Parquet files"):
        import pyarrow.parquet  # pyright: ignore[reportMissingImports]
    try:
        table = pyarrow.parquet.read_table(path)
    except ValueError as error:
        raise ValueError(f"{path} is no Parquet table: {error}.") from error
    arrays = {name: table[name].to_numpy() for name in table.column_names}
    return {
        name: _from_json(x.tolist()) if x.dtype.kind == "O" else x for name, x in arrays.items()
    }


def column(table: Any, name: str, argument: str) -> Shaped[np.ndarray, " rows"]:
    """A column of a mapping or a data frame."""
    try:
        values = np.asarray(table[name])
    except (KeyError, IndexError, TypeError) as error:
        if not isinstance(table, Mapping) and not hasattr(table, "columns"):
            raise TypeError(
                f"Argument `{argument}` must hold columns by name, as a dictionary or a data frame does, but "
                f"is {describe(table)}."
            ) from error
        have = ", ".join(str(each) for each in table) or "none"
        raise ValueError(
            f"Argument `{argument}` must have a column `{name}`, but its columns are: {have}."
        ) from error
    if values.ndim != 1:
        raise ValueError(
            f"Argument `{argument}` must hold columns of one dimension, but `{name}` has shape "
            f"{values.shape}."
        )
    return values


def whole_numbers(table: Any, name: str, argument: str) -> Shaped[np.ndarray, " rows"]:
    """A column of integers; they may be stored as floating-point numbers."""
    values = column(table, name, argument)
    if values.dtype.kind == "f" and np.array_equal(values, np.rint(values)):
        values = values.astype(int)
    if values.size and values.dtype.kind not in "iu":
        raise ValueError(
            f"Column `{name}` of argument `{argument}` must hold integers, but its type is {values.dtype}."
        )
    return values.astype(int)


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    broken = lambda fact: ValueError(f"{path} is no CSV table: {fact}.")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            text = file.read()
        lines, separator = _rows(text)
    except UnicodeDecodeError as error:
        raise broken("it is not text in UTF-8") from error
    except csv.Error as error:
        raise broken(str(error)) from error
    if not lines:
        raise broken("it is empty")
    names, rows = [name.strip() for name in lines[0]], lines[1:]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise broken(f"two columns have the same name, `{twice}`")
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise broken(f"row {number} has {len(row)} fields, and there are {len(names)} columns")
    if extra := _header_rows(rows):
        raise broken(
            f"row {extra} below the names of the columns holds no number, and later rows do: delete further "
            "rows of the header"
        )
    if separator != ",":
        rows = [
            [field.replace(",", ".") if _COMMA.fullmatch(field.strip()) else field for field in row]
            for row in rows
        ]
    fields = zip(*rows, strict=True) if rows else [() for _ in names]
    return {name: _from_text(field) for name, field in zip(names, fields, strict=True)}


def _rows(text: str) -> tuple[list[list[str]], str]:
    """The rows of a table, and the separator that gives the most columns."""
    best: tuple[list[list[str]], str] = [], ","
    for separator in _SEPARATORS:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        try:
            rows = [row for row in reader if row]
        except csv.Error:
            if separator == ",":
                raise
            continue
        if separator == "," or (rows and len(rows[0]) > len(best[0][0])):
            best = rows, separator
        if not rows:
            break
    return best


def _header_rows(rows: Sequence[Sequence[str]]) -> int:
    """Number of the first rows without any number, where a column has only numbers below them."""
    is_number = lambda field: _NUMBER.fullmatch(field.strip()) or _COMMA.fullmatch(field.strip())
    n = next((k for k, row in enumerate(rows) if any(map(is_number, row))), 0)
    if not 0 < n <= _HEADERS:
        return 0
    for column in zip(*rows, strict=True):
        below = [field for field in column[n:] if field.strip() not in _MISSING]
        above = [field for field in column[:n] if field.strip() not in _MISSING]
        if above and below and all(map(is_number, below)):
            return n
    return 0


def _from_text(given: Sequence[str]) -> np.ndarray:
    # (A field of spaces alone is text.)
    fields = [field.strip(" ") or field for field in given]
    if fields and all(field in ("True", "False") for field in fields):
        return np.array([field == "True" for field in fields])
    if fields and all(_INTEGER.fullmatch(field) for field in fields):
        integers = [int(field) for field in fields]
        limits = np.iinfo(np.int64)
        inside = limits.min <= min(integers) and max(integers) <= limits.max
        return np.array(integers, np.int64) if inside else np.array(given)
    if all(field in _MISSING or _NUMBER.fullmatch(field) for field in fields):
        return np.array([np.nan if field in _MISSING else float(field) for field in fields])
    return np.array(given)


def read_features(path: Path) -> list[dict[str, Any]]:
    """The features of a GeoJSON file."""
    broken = lambda fact: ValueError(f"{path} is no GeoJSON file of features: {fact}.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise broken(str(error)) from error
    if isinstance(content, dict) and content.get("type") == "GeometryCollection":
        content = [{"geometry": geometry} for geometry in content.get("geometries") or []]
    features = content.get("features") if isinstance(content, dict) else content
    if not isinstance(features, list) or not features:
        raise broken("it has no list `features`, or an empty one")
    for number, feature in enumerate(features):
        if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
            raise broken(f"feature {number} is no object with properties")
        if "geometry" not in feature:
            raise broken(f"feature {number} has no geometry")
    return features


def properties(features: list[dict[str, Any]], path: Path) -> dict[str, np.ndarray]:
    """The properties of features as columns."""
    rows = [_flat(feature.get("properties") or {}) for feature in features]
    names = dict.fromkeys(name for row in rows for name in row)
    lists = [name for name in names if any(isinstance(row.get(name), list) for row in rows)]
    if lists:
        listed = ", ".join(f"`{name}`" for name in lists)
        warnings.warn(f"{path}: properties that hold lists are left out: {listed}.", stacklevel=3)
    return {
        name: _from_json([row.get(name) for row in rows]) for name in names if name not in lists
    }


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested objects as entries with all their names, joined by points."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= (
            _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return flat


def _from_json(values: list[Any]) -> np.ndarray:
    is_number: Callable[[Any], bool] = lambda x: (
        isinstance(x, int | float) and not isinstance(x, bool)
    )
    if all(isinstance(value, bool) for value in values):
        return np.array(values)
    if all(is_number(value) and isinstance(value, int) for value in values):
        return np.array(values)
    if all(value is None or is_number(value) for value in values):
        return np.array([np.nan if value is None else float(value) for value in values])
    return np.array(["" if value is None else str(value) for value in values])
