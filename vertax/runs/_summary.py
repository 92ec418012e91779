"""Metrics and names in text."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def summary(metrics: Mapping[str, Any]) -> str:
    """Metrics as text tables, one column for each group of them.

    **Arguments:**

    - `metrics`: numbers by name, or mappings of numbers by the name of the group; if there are
        groups, other entries are left out.

    **Returns:** the tables: groups that have names in common share one.
    """
    everything: dict[str, Any] = plain(metrics)
    groups = {"": everything} | {
        k: group for k, group in everything.items() if isinstance(group, dict)
    }
    groups = {k: group for k, group in groups.items() if any(map(_is_number, group.values()))}
    if len(groups) > 1:
        groups.pop("", None)
    return "\n\n".join(_table(alike) for alike in _alike(groups))


def _alike(groups: Mapping[str, dict[str, Any]]) -> list[dict[str, dict[str, Any]]]:
    """Groups by table; groups with common names share one."""
    tables: list[dict[str, dict[str, Any]]] = []
    for label, group in groups.items():
        group_table = {label: {name: value for name, value in group.items() if _is_number(value)}}
        for table in tables:
            if any(group_table[label].keys() & other.keys() for other in table.values()):
                table |= group_table
                break
        else:
            tables.append(group_table)
    return tables


def _table(groups: Mapping[str, dict[str, Any]]) -> str:
    names = dict.fromkeys(name for group in groups.values() for name in group)
    rows = [["", *groups]] if any(groups) else []
    rows += [[name, *(_short(group.get(name)) for group in groups.values())] for name in names]
    first, *others = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join([name.ljust(first), *map(str.rjust, entries, others)]) for name, *entries in rows
    ]
    return "\n".join(lines)


def plain(value: Any) -> Any:
    """A value that strict JSON can hold."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and scalars of NumPy and JAX
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def safe(name: str) -> str:
    """A name as a part of the name of a file."""
    return re.sub("[^0-9A-Za-z.-]+", "_", name)


def sentence(text: str, names: Sequence[str]) -> str:
    """A warning after the first three names that it concerns."""
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"{shown}: {text}." if names else f"{text[:1].upper()}{text[1:]}."


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    return f"{value:.4g}" if _is_number(value) else ""
