"""Sweeps: runs of one configuration with different keys, in the workers of an executor."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial, reduce
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from vertax._base.atomic import atomic_write
from vertax._base.compilation_cache import enable_compilation_cache
from vertax._base.processes import LocalProcesses, ProcessDied
from vertax._base.tasks import map_tasks
from vertax.io import write_csv
from vertax.runs._config import ConfigError, ExperimentConfig
from vertax.runs._execution import (
    CONFIG,
    FAILED,
    changes,
    execute,
    new_folder,
    read_metrics,
    unfinished_folder,
)
from vertax.runs._folder import METRICS, RunFolder, RunFolderError
from vertax.runs._registry import find_experiment, load_config
from vertax.runs._tables import file_name, plain


class SweepRun(NamedTuple):
    """One run of a sweep: its folder, its values of the keys of the grid, and its configuration."""

    folder: Path
    keys: Mapping[str, Any]
    config: ExperimentConfig

    @property
    def is_finished(self) -> bool:
        """Whether its folder has metrics."""
        return (self.folder / METRICS).is_file()


def parse_grid(texts: Iterable[str]) -> dict[str, list[str]]:
    """The values of each key of a sweep, from texts such as `"tissue.n_cells=50,100"` or `"seed=0:20:5"`."""
    grid: dict[str, list[str]] = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals and values):
            raise ConfigError(
                f"A grid must have the form key=value,value,… as in tissue.n_cells=50,100 or seed=0:20, "
                f"but is {text!r}."
            )
        if key in grid:
            raise ConfigError(f"The key `{key}` has two grids. Write all its values in one.")
        grid[key] = _values(values)
        if not grid[key]:
            raise ConfigError(f"The grid {text!r} has no values.")
    return grid


def _values(text: str) -> list[str]:
    """Integers of a range, or the texts between the commas that are outside quotes and brackets."""
    if re.fullmatch(r"-?\d+:-?\d+(:-?\d+)?", text):
        start, stop, *step = map(int, text.split(":"))
        if step == [0]:
            raise ConfigError(f"The range {text} has a step of 0.")
        return [str(value) for value in range(start, stop, *step)]
    values, pending = [], ""
    for piece in text.split(","):
        pending = f"{pending},{piece}" if pending else piece.strip()
        try:
            tomllib.loads(f"value = {pending}")
        except ValueError:
            if re.match(r"[\[{\"']", pending):  # a list or a text with commas
                continue
        values.append(pending.strip())
        pending = ""
    return [value for value in [*values, pending] if value]


def sweep_runs(
    configs: Sequence[str | os.PathLike[str]],
    grid: Mapping[str, Sequence[str]],
    output: str | os.PathLike[str],
    overrides: Sequence[str] = (),
) -> list[SweepRun]:
    """The runs of a sweep: each configuration with each combination of values, each in a folder of `output`.

    Raises a `ConfigError` for a configuration that cannot be used or two runs of one name, and a
    `RunFolderError` if one of the folders holds a run of another configuration.
    """
    runs: dict[str, SweepRun] = {}
    for path in map(Path, configs):
        for values in itertools.product(*grid.values()):
            pairs = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
            _, config = load_config(path, [*overrides, *pairs])
            name = file_name("-".join([path.stem, *pairs]))
            if name in runs:
                raise ConfigError(f"Two runs of the sweep are called {name}: {', '.join(pairs)}.")
            folder = Path(output) / name
            if (folder / CONFIG).is_file() and (changed := changes(folder, config)):
                raise RunFolderError(
                    f"In {folder} there is a run of another configuration: {'; '.join(changed)}. Choose "
                    "another folder with --output."
                )
            keys = {key: reduce(getattr, key.split("."), config) for key in grid}
            runs[name] = SweepRun(folder, keys, config)
    return list(runs.values())


def sweep(
    runs: Sequence[SweepRun],
    output: Path,
    *,
    executor: Executor | None = None,
    figures: Sequence[str] = ("png",),
    progress: bool = True,
) -> dict[str, str]:
    """Execute the runs that are not finished, and write the table `sweep.csv` of all.

    A run that fails does not stop the others. After an interrupt, call it again: finished runs are skipped,
    and interrupted ones resumed.

    **Arguments:**

    - `runs`, `output`: the runs, and the folder of all.
    - `executor`: by default local processes, which write the files; other executors send them back.
    - `figures`, `progress`: as of `vertax run`.

    **Returns:** the error messages of the runs that failed, by the name of the run.
    """
    errors: dict[str, str] = {}
    waiting = [run for run in runs if not run.is_finished]
    try:
        output.mkdir(parents=True, exist_ok=True)
        lock = FileLock(output / ".lock", timeout=0).acquire()
    except Timeout:
        raise RunFolderError(
            f"Another sweep writes to {output}. Wait until it ends; for more processes raise its --workers, "
            "and for more machines pass --scheduler."
        ) from None
    except OSError as error:
        raise RunFolderError(
            f"Cannot use {output} as a folder: {error.strerror}. Choose another with --output."
        ) from None
    with lock, executor or LocalProcesses() as executor:
        local = isinstance(executor, LocalProcesses)
        call = partial(_execute_run if local else _execute_elsewhere, figures=tuple(figures))
        tasks = [(run.config, run.folder) for run in waiting]
        outcomes = map_tasks(call, tasks, executor=executor, unit="run", progress=progress)
        try:
            with contextlib.closing(outcomes):  # an interrupt cancels the runs that wait
                for number, files, error in outcomes:
                    run = waiting[number]
                    try:
                        if error is not None:
                            raise error
                        if not local:
                            _write_files(run.folder, files)
                    except Exception as error:  # no error of a run ends the sweep
                        errors[run.folder.name] = _in_one_line(error)
        finally:
            write_csv(output / "sweep.csv", sweep_table(runs, errors))
    return errors


def _in_one_line(error: Exception) -> str:
    """The error of a run in one line."""
    return str(error) if isinstance(error, ProcessDied) else f"{type(error).__name__}: {error}"


def _execute_run(task: tuple[ExperimentConfig, Path], figures: tuple[str, ...] = ("png",)) -> None:
    """Execute or resume one run of a sweep in this process."""
    config, folder = task
    if (folder / CONFIG).is_file() and not (folder / FAILED).is_file():
        unfinished_folder(folder, config)
    else:
        new_folder(folder, folder)
    enable_compilation_cache()
    experiment = find_experiment(config.experiment)
    execute(experiment, config, RunFolder(folder, figures=figures), progress=False)


def _execute_elsewhere(
    task: tuple[ExperimentConfig, Path], figures: tuple[str, ...]
) -> dict[str, bytes]:
    """Execute one run on another machine; return its files."""
    with tempfile.TemporaryDirectory() as folder:
        _execute_run((task[0], Path(folder)), figures)
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def _write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of a run, its metrics last: a folder that has them is complete."""
    new_folder(folder, folder, overwrite=(folder / CONFIG).is_file())
    for name in sorted(files, key=lambda name: name == METRICS):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / name, "wb") as file:
            file.write(files[name])


def sweep_table(runs: Sequence[SweepRun], errors: Mapping[str, str]) -> dict[str, list[Any]]:
    """The table of a sweep: columns by name, a row for each run."""
    rows: list[dict[str, Any]] = []
    for run in runs:
        error, failed = errors.get(run.folder.name, ""), run.folder / FAILED
        if not error and failed.is_file():  # in an earlier sweep
            error = failed.read_text(encoding="utf-8").strip()
        state = "finished" if run.is_finished else "failed" if error else "unfinished"
        row = {"run": run.folder.name, "state": state, "error": error}
        row |= {key: plain(value) for key, value in run.keys.items()}
        rows.append(row | dict(_scalars(read_metrics(run.folder)) if run.is_finished else {}))
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def _scalars(metrics: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            yield from _scalars(value, f"{before}{name}.")
        elif value is None or isinstance(value, int | float | str):
            yield f"{before}{name}", value
