"""Tables and metrics of fits, and metrics and names as text."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from vertax.fitting import Fit, History


def history_table(history: History, *labels: Mapping[str, str]) -> dict[str, Any]:
    """The table of all epochs of a fit or of a batch of fits.

    **Arguments:**

    - `history`: a [`History`][vertax.History].
    - `labels`: columns of one repeated text each, for the fit or for each member of the batch; by default a
        batch has a column `member` with its number.

    **Returns:** columns by name: the labels, the number of the epoch and every curve of the history.
    """
    n = len(history.cost)
    if history.cost.ndim == 1:
        repeated = {name: [text] * n for label in labels for name, text in label.items()}
        return repeated | {"epoch": np.arange(n), **history.columns()}
    labels = labels or tuple({"member": str(k)} for k in range(history.cost.shape[1]))
    single = lambda k: jax.tree.map(lambda x: x[:, k] if x.ndim > 1 else x, history)
    return concatenate([history_table(single(k), label) for k, label in enumerate(labels)])


def concatenate(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Concatenate tables; the result has their common columns.

    **Arguments:**

    - `tables`: columns by name.

    **Returns:** columns by name.
    """
    names = [name for name in tables[0] if all(name in table for table in tables)]
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


def fit_metrics(outcome: Fit[Any]) -> dict[str, Any]:
    """The metrics of a fit.

    **Arguments:**

    - `outcome`: the fit.

    **Returns:** costs, largest force, epochs, seconds and T1 transitions.
    """
    history = outcome.history
    return {
        "cost_initial": history.cost[0],
        "cost_final": outcome.cost,
        "max_force": outcome.max_force,
        "epochs": len(history.cost),
        "best_epoch": outcome.best_epoch,
        # The first epoch is the one that is compiled.
        "seconds_per_epoch": np.median(history.seconds[1:]) if len(history.cost) > 1 else np.nan,
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
    }


def plain(value: Any) -> Any:
    """A value that strict JSON can hold."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and scalars of NumPy and JAX
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def file_name(name: str) -> str:
    """A name as a part of the name of a file."""
    return re.sub("[^0-9A-Za-z.-]+", "_", name)


def sentence(text: str, names: Sequence[str]) -> str:
    """A warning after the first three names that it concerns."""
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"{shown}: {text}." if names else f"{text[:1].upper()}{text[1:]}."


def summary(metrics: Mapping[str, Any]) -> str:
    """Numbers of the metrics as text; groups with names in common are columns of one table.

    If there are groups, other entries are left out.
    """
    everything = plain(metrics)
    groups = {k: _numbers(v) for k, v in everything.items() if isinstance(v, dict)}
    groups = {k: group for k, group in groups.items() if group} or {"": _numbers(everything)}
    tables: list[dict[str, dict[str, Any]]] = []
    for label, group in groups.items():
        common = (t for t in tables if any(group.keys() & other.keys() for other in t.values()))
        table = next(common, None)
        if table is None:
            tables.append(table := {})
        table[label] = group
    return "\n\n".join(filter(None, map(_in_columns, tables)))


def _numbers(group: Mapping[str, Any]) -> dict[str, Any]:
    numeric = lambda value: isinstance(value, int | float) and not isinstance(value, bool)
    return {name: value for name, value in group.items() if numeric(value)}


def _in_columns(groups: Mapping[str, dict[str, Any]]) -> str:
    names = dict.fromkeys(name for group in groups.values() for name in group)
    rows = [["", *groups]] if any(groups) else []
    entry = lambda group, name: f"{group[name]:.4g}" if name in group else ""
    rows += [[name, *(entry(group, name) for group in groups.values())] for name in names]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    line = lambda name, *entries: [name.ljust(widths[0]), *map(str.rjust, entries, widths[1:])]
    return "\n".join("  ".join(line(*row)) for row in rows)
