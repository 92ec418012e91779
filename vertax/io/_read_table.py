"""Tables from CSV and GeoJSON files."""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from vertax._base.checks import describe

_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf(?:inity)?", re.IGNORECASE)
_MISSING = frozenset({"", "NA", "NaN", "nan"})


def read_table(path: str | os.PathLike[str]) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Read the columns of a CSV file, or the properties of the features of a GeoJSON file.

    It reads what [`write_csv`][vertax.io.write_csv] and [`write_geojson`][vertax.io.write_geojson] write:
    numbers are the same to the last bit.

    ```python
    table = vx.io.read_table("cells.csv")
    table["area"]
    ```

    A column is boolean (`True`, `False`), integer, floating-point or text: the first of these that all its
    entries are. An empty field, `NA`, `NaN`, or null is NaN in a column of numbers.

    **Arguments:**

    - `path`: the file. Files that end in `.geojson` or `.json` are GeoJSON, all others CSV with a comma
        between fields and the names of the columns in the first line.

    **Returns:** NumPy arrays by the name of the column.

    **Raises:**

    - `OSError` if the file cannot be read.
    - `ValueError`, naming the file and the line or feature, if it is no such table.
    """
    path = Path(path)
    if path.suffix.lower() in (".geojson", ".json"):
        return properties(read_features(path), path)
    return _read_csv(path)


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
            lines = [row for row in csv.reader(file, strict=True) if row]
    except UnicodeDecodeError as error:
        raise broken("it is not text in UTF-8") from error
    except csv.Error as error:
        raise broken(str(error)) from error
    if not lines:
        raise broken("it is empty")
    names, rows = lines[0], lines[1:]
    if len(set(names)) < len(names):
        raise broken("two columns have the same name")
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise broken(f"row {number} has {len(row)} fields, and there are {len(names)} columns")
    fields = zip(*rows, strict=True) if rows else [() for _ in names]
    return {name: _from_text(field) for name, field in zip(names, fields, strict=True)}


def _from_text(fields: Sequence[str]) -> np.ndarray:
    if fields and all(field in ("True", "False") for field in fields):
        return np.array([field == "True" for field in fields])
    if fields and all(_INTEGER.fullmatch(field) for field in fields):
        integers = [int(field) for field in fields]
        limits = np.iinfo(np.int64)
        inside = limits.min <= min(integers) and max(integers) <= limits.max
        return np.array(integers, np.int64) if inside else np.array(fields)
    if all(field in _MISSING or _NUMBER.fullmatch(field) for field in fields):
        return np.array([np.nan if field in _MISSING else float(field) for field in fields])
    return np.array(fields)


def read_features(path: Path) -> list[dict[str, Any]]:
    """The features of a GeoJSON file."""
    broken = lambda fact: ValueError(f"{path} is no GeoJSON file of features: {fact}.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise broken(str(error)) from error
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or not features:
        raise broken("it has no list `features`, or an empty one")
    for number, feature in enumerate(features):
        if not isinstance(feature, dict) or not isinstance(feature.get("geometry"), dict):
            raise broken(f"feature {number} has no geometry")
    return features


def properties(features: list[dict[str, Any]], path: Path) -> dict[str, np.ndarray]:
    """The properties of features as columns."""
    rows = [feature.get("properties") or {} for feature in features]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: _from_json([row.get(name) for row in rows], name, path) for name in names}


def _from_json(values: list[Any], name: str, path: Path) -> np.ndarray:
    is_number: Callable[[Any], bool] = lambda x: (
        isinstance(x, int | float) and not isinstance(x, bool)
    )
    if all(isinstance(value, bool) for value in values):
        return np.array(values)
    if all(is_number(value) and isinstance(value, int) for value in values):
        return np.array(values)
    if all(value is None or is_number(value) for value in values):
        return np.array([np.nan if value is None else float(value) for value in values])
    if all(value is None or isinstance(value, str | bool | int | float) for value in values):
        return np.array(["" if value is None else str(value) for value in values])
    raise ValueError(
        f"{path}: property `{name}` must hold numbers, booleans or text, but holds lists or objects. "
        "Remove it "
        "from the file."
    )
