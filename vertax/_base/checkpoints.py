"""Checkpoints of long runs: write the progress to a file, and continue from it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import wadler_lindig
from jaxtyping import PyTree, Shaped

from vertax._base.archive import as_jax, read_archive, write_archive
from vertax._base.checks import check_number

_VERSION = 1
# Largest fraction of the run time that is spent on writing.
_WRITING_FRACTION = 0.02

COMPUTATION = "what its functions compute, or the version of vertax or JAX"
"""The part of a run that a fingerprint identifies, for messages."""

Row = Mapping[str, Any]


class Checkpoint(eqx.Module):
    """File and interval of the checkpoints of [`fit`][vertax.fit] and [`evolve`][vertax.evolve].

    ```python
    fit = vx.fit(problem, optax.adam(1e-2), epochs=5000, checkpoint="fit.npz")
    ```

    If the file exists, the same call continues from it and returns the same result as an uninterrupted run
    (on the same machine, bit for bit); a finished fit is not repeated. Delete the file to start again. A
    larger number of `epochs` continues a finished fit, and more `times` a finished evolution. A file of
    another run is refused: other numbers, or functions that compute something else, also by another version
    of vertax or JAX. (An external program is compared by its name and settings only.)

    The file is a NumPy `.npz` archive without pickles. For a fit it holds the state of the optimiser, the
    parameters, the tissue, the best point so far and the history; for an evolution all frames and the current
    state. It is written atomically at the end, after a keyboard interrupt, and between epochs or frames: a
    process that is killed while it writes leaves the previous checkpoint.

    **Arguments:**

    - `path`: the file, usually with the suffix `.npz`.
    - `every`: minimum time between two checkpoints in seconds; 0 writes after each epoch or frame, unless
        writing takes more than 2 % of the time.

    **Raises:**

    - `ValueError` if `every` is negative.
    """

    path: Path = eqx.field(converter=Path)
    every: float = eqx.field(default=10.0, converter=float)

    def __check_init__(self) -> None:
        check_number("every", self.every, at_least=0)


class Progress(NamedTuple):
    """State and history of a run; replaced as a whole, so that an interrupt never saves a partial one."""

    state: PyTree
    rows: tuple[Row, ...] = ()
    notes: tuple[Row, ...] = ()


class CheckpointFile:
    """Reads and writes the checkpoints of one fit or evolution.

    **Arguments:**

    - `checkpoint`: a path or a `Checkpoint`; None for no checkpoints.
    - `identity`: returns texts that identify the run, by their name in messages; called only if there is a
        `checkpoint`.
    - `what`: name of the run in messages.
    """

    def __init__(
        self,
        checkpoint: str | os.PathLike[str] | Checkpoint | None,
        identity: Callable[[], dict[str, str]],
        what: str = "fit",
    ):
        if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
            checkpoint = Checkpoint(checkpoint)
        self._what = what
        if checkpoint is not None and not checkpoint.path.absolute().parent.is_dir():
            # Raise now, not after hours of work.
            raise FileNotFoundError(
                f"Argument `checkpoint` is {os.fspath(checkpoint.path)!r}, but there is no folder "
                f"{checkpoint.path.parent}. Make it first."
            )
        self._checkpoint = checkpoint
        self._identity = identity() if checkpoint is not None else {}
        self._next_time = 0.0 if checkpoint is None else time.perf_counter() + checkpoint.every

    def load(self, start: PyTree) -> Progress:
        """Return the progress in the file, or initial progress with the state `start`."""
        if self._checkpoint is None or not self._checkpoint.path.exists():
            return Progress(start)
        return _load(self._checkpoint.path, self._identity, start, self._what)

    def save_if_due(self, progress: Progress) -> None:
        """Write a checkpoint if `every` seconds have passed since the last one."""
        if self._checkpoint is None or time.perf_counter() < self._next_time:
            return
        began = time.perf_counter()
        self.save(progress)
        ended = time.perf_counter()
        self._next_time = ended + max(self._checkpoint.every, (ended - began) / _WRITING_FRACTION)

    def save(self, progress: Progress) -> None:
        """Write a checkpoint."""
        if self._checkpoint is not None:
            _save(self._checkpoint.path, self._identity, progress)


def without_addresses(text: str) -> str:
    """Remove memory addresses from a text, which differ between processes."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def layout(tree: PyTree) -> str:
    """Sizes, classes and settings of a pytree, defaults too: after pickling they are other objects."""
    return without_addresses(wadler_lindig.pformat(tree, width=100, hide_defaults=False))


def digest(tree: PyTree) -> str:
    """SHA-256 hash of the arrays of a pytree."""
    numbers = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        if eqx.is_array_like(leaf):
            numbers.update(np.ascontiguousarray(_plain(leaf)).tobytes())
    return numbers.hexdigest()


def _save(path: Path, identity: Mapping[str, str], progress: Progress) -> None:
    state = [_plain(x) for x in _arrays(progress.state)]
    arrays = {
        "identity": np.asarray(json.dumps(identity)),
        "epochs": np.asarray(len(progress.rows)),
    }
    arrays |= {f"state_{i}": x for i, x in enumerate(state)}
    arrays |= {f"row_{name}": column for name, column in columns_of(progress.rows).items()}
    arrays |= {f"note_{name}": column for name, column in columns_of(progress.notes).items()}
    write_archive(path, "checkpoint", _VERSION, arrays)


def _load(path: Path, identity: Mapping[str, str], start: PyTree, what: str) -> Progress:
    name, remedy = os.fspath(path), f"Delete the file to start this {what} anew."
    try:
        arrays = read_archive(path, "checkpoint", _VERSION)
    except ValueError as error:
        raise ValueError(f"{error} {remedy}") from error
    _check_identity(name, str(arrays.get("identity", "{}")), identity, what, remedy)
    n = arrays.get("epochs", np.asarray(-1))
    rows, notes = (_rows(arrays, prefix) for prefix in ("row_", "note_"))
    fresh = _arrays(start)
    stored = [arrays.get(f"state_{i}", np.zeros(0, bool)) for i in range(len(fresh))]
    if (
        n.shape
        or n != len(rows)
        or len(notes) not in (0, n)
        or not all(map(_same_layout, stored, fresh))
    ):
        raise ValueError(f"{name} is broken: its state does not match the {what}. {remedy}")
    restored = [_restored(x, like, name) for x, like in zip(stored, fresh, strict=True)]
    dynamic, static = eqx.partition(start, eqx.is_array)
    state = eqx.combine(jax.tree.unflatten(jax.tree.structure(dynamic), restored), static)
    return Progress(state, rows, notes)


def _check_identity(
    name: str, text: str, expected: Mapping[str, str], what: str, remedy: str
) -> None:
    try:
        stored = json.loads(text)
    except json.JSONDecodeError:
        stored = {}
    for part, value in expected.items():
        if stored.get(part) != value:
            raise ValueError(
                f"{name} is the checkpoint of a {what} with another {part}"
                f"{_difference(stored, part, value)}. Give the same one again, or choose another file as "
                f"`checkpoint`. {remedy}"
            )


def _difference(stored: Mapping[str, str], part: str, value: str) -> str:
    """The first difference of two descriptions, as text; empty if it is long."""
    then, now = (
        [piece.strip(" ,") for piece in re.split(r", |\n", text)]
        for text in (stored.get(part, ""), value)
    )
    pieces = (
        [piece for piece in then if piece not in now][:1],
        [piece for piece in now if piece not in then][:1],
    )
    # A setting that is missing in a description has its default.
    texts = [next(iter(piece), "the default") for piece in pieces]
    return (
        "" if max(map(len, texts)) > 60 or not any(pieces) else f": {texts[0]} and not {texts[1]}"
    )


def columns_of(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Rows as columns: arrays with the rows along the first axis."""
    return {name: np.asarray([row[name] for row in rows]) for name in rows[0]} if rows else {}


def _rows(arrays: Mapping[str, np.ndarray], prefix: str) -> tuple[Row, ...]:
    columns = {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
    if not columns or min(a.ndim for a in columns.values()) == 0:
        return ()
    length = min(len(column) for column in columns.values())
    return tuple({name: column[i] for name, column in columns.items()} for i in range(length))


def _arrays(tree: PyTree) -> list[Any]:
    return jax.tree.leaves(eqx.filter(tree, eqx.is_array))


def _is_key(x: Any) -> bool:
    return eqx.is_array(x) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(x: Any) -> Shaped[np.ndarray, "..."]:
    """A NumPy array of numbers, also for random keys."""
    return np.asarray(jax.random.key_data(x) if _is_key(x) else x)


def _same_layout(stored: np.ndarray, fresh: Any) -> bool:
    like = _plain(fresh)
    # NumPy stores dtypes of ml_dtypes, such as bfloat16, as raw bytes.
    return (stored.shape, stored.itemsize) == (like.shape, like.itemsize)


def _restored(stored: np.ndarray, fresh: Any, name: str) -> Any:
    array = as_jax(stored.view(_plain(fresh).dtype), name)
    return (
        jax.random.wrap_key_data(array, impl=jax.random.key_impl(fresh))
        if _is_key(fresh)
        else array
    )
