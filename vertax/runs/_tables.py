"""Tables and metrics of fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from vertax.fitting import Fit, History


def history_columns(history: History, **labels: str) -> dict[str, Any]:
    """The columns of a table of the epochs of a fit.

    **Arguments:**

    - `history`: a [`History`][vertax.History].
    - `labels`: columns of one repeated text each, to distinguish fits in one table.

    **Returns:** the labels, the number of the epoch and every curve of the history.
    """
    n = len(history.cost)
    return {name: [text] * n for name, text in labels.items()} | {
        "epoch": np.arange(n),
        **history.columns(),
    }


def histories(outcome: Fit, labels: Sequence[dict[str, str]]) -> dict[str, Any]:
    """The table of all epochs of a batch.

    **Arguments:**

    - `outcome`: the fit of the batch.
    - `labels`: labels of each member.

    **Returns:** columns by name.
    """
    single = lambda k: jax.tree.map(lambda x: x[:, k] if x.ndim > 1 else x, outcome.history)
    parts = [history_columns(single(k), **label) for k, label in enumerate(labels)]
    names = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def joined(tables: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Concatenate tables; the result has their common columns.

    **Arguments:**

    - `tables`: columns by name.

    **Returns:** columns by name.
    """
    names = [name for name in tables[0] if all(name in table for table in tables)]
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


def fit_metrics(outcome: Fit) -> dict[str, Any]:
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
