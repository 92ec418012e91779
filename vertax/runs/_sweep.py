"""Sweeps: runs of one configuration with different keys, in processes or on a cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vertax._base.compilation_cache import enable_compilation_cache
from vertax._base.extras import requires_extra
from vertax.fitting import FitError
from vertax.io import write_csv
from vertax.runs._claim import CONFIG, METRICS, changes
from vertax.runs._config import ExperimentConfig, validate
from vertax.runs._errors import ConfigError, RunFolderError
from vertax.runs._figures import checked_formats
from vertax.runs._folder import RunFolder
from vertax.runs._load import load_config
from vertax.runs._pool import THREADS, n_threads
from vertax.runs._registry import find_experiment
from vertax.runs._summary import plain, safe

with requires_extra("run", "A sweep"):
    import tomli_w

TABLE = "sweep"
# Errors of the user; no error of a run ends the sweep.
_EXPECTED = (FitError, ValueError, OSError, RuntimeError, MemoryError, OverflowError)


@dataclasses.dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    **Arguments:**

    - `folder`: the folder of its results.
    - `keys`: the keys of the grid and their values, by dotted names.
    - `config`: its configuration.
    - `state`: `"new"`, `"finished"` or `"failed"`.
    - `error`: the message of its failure, or empty.
    """

    folder: Path
    keys: Mapping[str, Any]
    config: ExperimentConfig
    state: str = "new"
    error: str = ""

    def ended(self, error: str | None) -> SweepRun:
        """A copy with state and error."""
        state = "finished" if error is None else "failed"
        return dataclasses.replace(self, state=state, error=error or "")


def parse_grid(texts: Iterable[str]) -> dict[str, list[str]]:
    """The keys of a sweep, and the values that each of them takes.

    **Arguments:**

    - `texts`: `key=values` with a dotted key. Values are written as in TOML, with commas between them;
        `0:20` are the integers from 0 to 19, and `0:20:5` every fifth of them.

    **Returns:** the values, as texts that `apply_overrides` understands.

    **Raises:**

    - `ConfigError` for a text of another form, no value, or a key that is there twice.
    """
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
    if re.fullmatch(r"-?\d+:-?\d+(:-?\d+)?", text):
        ends = slice(*map(int, text.split(":")))
        if ends.step == 0:
            raise ConfigError(f"The range {text} has a step of 0.")
        return [str(value) for value in range(ends.start, ends.stop, ends.step or 1)]
    try:
        entries = tomllib.loads(f"values = [{text}]")
    except ValueError:  # plain words
        return [entry.strip() for entry in text.split(",") if entry.strip()]
    if entries.keys() != {"values"}:
        raise ConfigError(f"The values {text!r} must stand in one line.")
    return [_in_toml(entry) for entry in entries["values"]]


def _in_toml(value: Any) -> str:
    return tomli_w.dumps({"x": value}).partition("=")[2].strip().replace("\n", " ")


def sweep_runs(
    configs: Sequence[str | os.PathLike[str]],
    grid: Mapping[str, Sequence[str]],
    output: str | os.PathLike[str],
    overrides: Sequence[str] = (),
) -> list[SweepRun]:
    """The runs of a sweep: each configuration with each combination of values.

    **Arguments:**

    - `configs`: configuration files.
    - `grid`: values by dotted key, see `parse_grid`.
    - `output`: the folder of all; each run has a subfolder named after its keys.
    - `overrides`: keys set in all runs, as of `apply_overrides`.

    **Returns:** the runs; one that was finished by an earlier sweep says so.

    **Raises:**

    - `ConfigError` for a configuration that cannot be used, or two runs of one name.
    - `RunFolderError` if a run of another configuration lies where one of these belongs.
    """
    runs: dict[str, SweepRun] = {}
    for path in map(Path, configs):
        for values in itertools.product(*grid.values()):
            changes = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
            _, config = load_config(path, [*overrides, *changes])
            name = safe("-".join([path.stem, *changes]))
            if name in runs:
                raise ConfigError(f"Two runs of the sweep are called {name}: {', '.join(changes)}.")
            keys = {key: _value(config, key) for key in grid}
            runs[name] = _with_state(SweepRun(Path(output) / name, keys, config))
    return list(runs.values())


def _value(config: ExperimentConfig, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part)
    return value


def _with_state(run: SweepRun) -> SweepRun:
    """A copy with the state of its folder."""
    if not (run.folder / CONFIG).is_file():
        return run
    if changed := changes(run.folder, run.config):
        raise RunFolderError(
            f"In {run.folder} there is a run of another configuration: {'; '.join(changed)}. Choose "
            "another folder with --output."
        )
    return run.ended(None) if (run.folder / METRICS).is_file() else run


def sweep(
    runs: Sequence[SweepRun],
    output: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    figures: Sequence[str] = ("png",),
    progress: bool = True,
) -> list[SweepRun]:
    """Execute the runs of a sweep that are not finished, and write one table of all.

    A run that fails does not stop the others. After an interrupt, call it again: finished runs are skipped
    and interrupted ones resumed. The table `sweep.csv` has a row for each run: its folder, state and
    keys, and its metrics that are numbers or texts.

    **Arguments:**

    - `runs`: see `sweep_runs`.
    - `output`: the folder of all.
    - `scheduler`: address of a Dask scheduler, such as `"tcp://node:8786"`, with workers on the same
        file system; None for processes on this machine.
    - `workers`: number of those processes; by default one a core.
    - `figures`: formats of the pictures.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the runs with their states.

    **Raises:**

    - `ImportError` if the extra `[distributed]` is missing.
    - `ConfigError` if there is no scheduler at the address.
    - `RunFolderError` if the folder cannot be used, or for another format of pictures.
    - `KeyboardInterrupt` after an interrupt; the table is written.
    """
    figures = checked_formats(figures)  # before anything runs
    try:
        Path(output).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"Cannot use {output} as a folder: {error.strerror}. Choose another with --output."
        ) from None
    ended = {run.folder: run for run in runs}
    waiting = [run for run in runs if run.state == "new"]
    bar = tqdm(total=len(runs), unit="run", disable=None if progress else True)
    try:
        with bar:
            bar.update(len(runs) - len(waiting))
            for run in _done(waiting, scheduler, workers or n_threads(), figures):
                ended[run.folder] = run
                bar.update()
    finally:
        write_csv(Path(output) / f"{TABLE}.csv", sweep_table(list(ended.values())))
    return list(ended.values())


def _done(
    runs: Sequence[SweepRun], scheduler: str | None, workers: int, figures: tuple[str, ...]
) -> Iterator[SweepRun]:
    """The runs as they end."""
    if not runs:
        return
    with _client(scheduler, min(workers, len(runs))) as client:
        futures = {client.submit(perform, *_task(run), figures, pure=False): run for run in runs}
        from distributed import as_completed

        for future in as_completed(futures):
            yield futures[future].ended(_outcome(future))


@contextlib.contextmanager
def _client(scheduler: str | None, workers: int) -> Iterator[Any]:
    with requires_extra("distributed", "A sweep"):
        import distributed

    if scheduler is None:
        # One thread per process: the other cores belong to the other runs.
        cluster = distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,
            env={THREADS: "1"},
        )
        with cluster, distributed.Client(cluster) as client:
            yield client
        return
    try:
        client = distributed.Client(scheduler, timeout=10)
    except (OSError, ValueError) as error:
        raise ConfigError(f"There is no Dask scheduler at {scheduler} ({error}).") from None
    with client:
        yield client


def _outcome(future: Any) -> str | None:
    """The error message of a failed run, or None."""
    error = future.exception()
    if error is None:
        return future.result()
    if type(error).__name__ == "KilledWorker":
        return "its process died, perhaps for lack of memory"
    return f"{type(error).__name__}: {error}"


def _task(run: SweepRun) -> tuple[dict[str, Any], str]:
    # Plain data: workers on other machines import the classes by the name of the experiment.
    return run.config.model_dump(mode="json", exclude_none=True), str(run.folder.absolute())


def perform(content: dict[str, Any], folder: str, figures: tuple[str, ...]) -> str | None:
    """Execute or resume one run in this process.

    **Arguments:**

    - `content`: the configuration.
    - `folder`: the folder of the run.
    - `figures`: formats of the figures.

    **Returns:** the error message of a failed run, or None.
    """
    import jax
    import matplotlib

    matplotlib.use("Agg")
    try:
        experiment = find_experiment(content.get("experiment"))
        config = validate(experiment.config, content)
        jax.config.update("jax_enable_x64", config.precision == "float64")
        enable_compilation_cache()
        if (Path(folder) / CONFIG).is_file():
            run = RunFolder.unfinished(folder, config, figures=figures)
        else:
            run = RunFolder.claim("", folder, figures=figures)
            run.save_config(config)
        run.finish(experiment.run(config, run, progress=False))
    except _EXPECTED as error:
        return f"{type(error).__name__}: {error}"
    return None


def sweep_table(runs: Sequence[SweepRun]) -> dict[str, list[Any]]:
    """The table of a sweep.

    **Arguments:**

    - `runs`: the runs with their states.

    **Returns:** columns by name, a row for each run.
    """
    rows: list[dict[str, Any]] = []
    for run in runs:
        finished = run.state == "finished"
        facts = {"run": run.folder.name, "state": run.state, "error": run.error}
        metrics = dict(_scalars(RunFolder(run.folder).metrics())) if finished else {}
        rows.append(facts | {key: plain(value) for key, value in run.keys.items()} | metrics)
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def _scalars(metrics: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            yield from _scalars(value, f"{before}{name}.")
        elif value is None or isinstance(value, int | float | str):
            yield f"{before}{name}", value
