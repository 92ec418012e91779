"""The command `vertax`."""

from __future__ import annotations

import enum
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, NoReturn

import typer

# JAX, jobs and experiments are imported by the commands that use them, so that help is printed quickly.

app = typer.Typer(
    help="A differentiable vertex model of epithelial tissue.",
    epilog="Exit codes: 0 success, 1 the run failed or is unfinished, 2 wrong use, 130 interrupted.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # Rich shows a type, <bool>, for flags, which take no value
    pretty_exceptions_enable=False,
)

USAGE, FAILURE, INTERRUPTED = 2, 1, 130

_CONFIG = "Configuration file, or the name of one that comes with vertax, e.g. demo."
_SET = "Set one key, e.g. fit.epochs=50; may be repeated."
_GRID = "Values of one key, e.g. tissue.n_cells=50,100 or seed=0:20; several grids give all combinations."
_OUTPUT = (
    "Folder of the results; by default runs/NAME of the configuration, or NAME-2, … if that exists."
)
_RESUME = (
    "Resume the interrupted run in this folder: fits continue after their last epoch, other steps "
    "begin again."
)
_NO_CACHE = (
    "Do not use the folder of compiled functions in the user's cache (the environment variable "
    "VERTAX_CACHE names another folder, or is off)."
)

_WORKERS = "Number of local processes for many masks, replicates or the runs of a sweep."
_SCHEDULER = "Use the workers of a Dask cluster instead: the address of its scheduler, or its scheduler file."
_CLUSTER = "Start the Dask cluster that this TOML file describes, and close it at the end."

Format = enum.StrEnum("Format", {name: name for name in ("png", "pdf", "svg")})
Workers = Annotated[int | None, typer.Option(min=1, help=_WORKERS)]
Scheduler = Annotated[str | None, typer.Option(metavar="ADDRESS", help=_SCHEDULER)]
Cluster = Annotated[Path | None, typer.Option("--cluster", metavar="FILE", help=_CLUSTER)]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=_SET)]
Figures = Annotated[
    list[Format] | None,
    typer.Option(help="Format of the figures, by default png; may be repeated."),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress bar and no summary.")]


def _show_version(wanted: bool) -> bool:
    if wanted:
        from vertax import __version__

        typer.echo(f"vertax {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass


@app.command("list")
def list_experiments() -> None:
    """List the jobs, the experiments of the repository, and the configurations of both."""
    from vertax.runs._registry import (
        all_experiments,
        experiment_of,
        shipped_configurations,
        summary_of,
    )

    experiments = all_experiments()
    files = [f for f in shipped_configurations().values() if experiment_of(f) in experiments]
    describe_one = "vertax describe NAME prints all keys of one:"
    groups = {
        f"Jobs; {describe_one}": {e.name: e.summary for e in experiments.values() if e.is_job},
        f"Experiments of the repository; {describe_one}": {
            e.name: e.summary for e in experiments.values() if not e.is_job
        },
        "Configurations; vertax run NAME runs one:": {f.stem: summary_of(f) for f in files},
    }
    width = max(len(name) for group in groups.values() for name in group)
    for title, group in groups.items():
        if group:
            typer.echo("\n".join([title, *(f"  {n:{width}}  {s}" for n, s in group.items())]))


@app.command()
def describe(
    experiment: Annotated[
        str, typer.Argument(help="Name of a job or an experiment, see `vertax list`.")
    ],
) -> None:
    """Print a configuration file with every key of a job or an experiment, explained and at its default."""
    from vertax.runs._config import ConfigError, template
    from vertax.runs._registry import find_experiment

    try:
        typer.echo(template(find_experiment(experiment).config, experiment), nl=False)
    except ConfigError as error:
        _stop(error, USAGE)


@app.command()
def run(
    config: Annotated[Path, typer.Argument(help=_CONFIG)],
    overrides: Set = None,
    output: Annotated[Path | None, typer.Option(help=_OUTPUT)] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")
    ] = False,
    resume: Annotated[Path | None, typer.Option(metavar="RUN", help=_RESUME)] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: Cluster = None,
    figures: Figures = None,
    no_cache: Annotated[bool, typer.Option("--no-cache", help=_NO_CACHE)] = False,
    quiet: Quiet = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Run the job or the experiment that a configuration file describes."""
    from vertax import FitError, enable_compilation_cache
    from vertax._base.announce import announce_in_this_process
    from vertax.runs import ConfigError, RunFolder, load_config
    from vertax.runs._cluster import chosen_executor
    from vertax.runs._execution import execute, new_folder, parts, unfinished_folder
    from vertax.runs._folder import RunFolderError
    from vertax.runs._tables import summary

    path: Path | None = None
    try:
        experiment, settings = load_config(config, overrides or ())
        if not no_cache:
            enable_compilation_cache()
        # (Connected first: a cluster that does not answer changes no folder.)
        with chosen_executor(workers, scheduler, cluster) as executor:
            if resume is None:
                path = new_folder(Path("runs") / config.stem, output, overwrite)
            elif output is not None or overwrite:
                raise RunFolderError(
                    "--resume goes with neither --output nor --overwrite: leave them out."
                )
            else:
                path = unfinished_folder(resume, settings)
            options = {"print_steps": not quiet, "executor": executor}
            folder = RunFolder(path, figures=figures or ("png",), **options)
            if not quiet:
                kept = [part.stem for part in parts(path)]
                kept = ", ".join(kept) if len(kept) <= 5 else f"{len(kept)} parts"
                resumed = f" (resumed; kept so far: {kept})" if kept else ""
                typer.echo(f"{experiment.name}: {config} → {path}{resumed}")
                announce_in_this_process(f"functions for {experiment.name}")
            metrics = execute(experiment, settings, folder, progress=not quiet)
    except KeyboardInterrupt:
        typer.echo(_interrupted(config, overrides or (), path), err=True)
        raise typer.Exit(INTERRUPTED) from None
    # Errors of the user are messages without a traceback; others are bugs.
    except (FitError, ValueError, OSError, RuntimeError, MemoryError, OverflowError) as error:
        if debug:
            raise
        if isinstance(error, MemoryError | OverflowError):
            _stop(f"The run is too large for this machine ({error}). Make it smaller.", FAILURE)
        _stop(error, USAGE if isinstance(error, ConfigError | RunFolderError) else FAILURE)
    if not quiet:
        typer.echo(summary(metrics))
        _warn(folder.warnings)
        _print_files(path)


@app.command()
def sweep(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG...", help=_CONFIG)],
    grid: Annotated[list[str] | None, typer.Option(metavar="KEY=VALUES", help=_GRID)] = None,
    overrides: Set = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Folder of all runs; by default runs/NAME-sweep. Finished runs are kept."
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: Cluster = None,
    figures: Figures = None,
    quiet: Quiet = False,
) -> None:
    """Run one configuration, or several, with different keys."""
    from vertax.runs import ConfigError
    from vertax.runs._cluster import chosen_executor
    from vertax.runs._folder import RunFolderError
    from vertax.runs._sweep import parse_grid, sweep as execute_all, sweep_runs

    folder = Path("runs") / f"{configs[0].stem}-sweep" if output is None else output
    try:
        runs = sweep_runs(configs, parse_grid(grid or ()), folder, overrides or ())
        if not quiet:
            finished = sum(run.is_finished for run in runs)
            kept = f", {finished} of them finished before" if finished else ""
            typer.echo(f"{len(runs)} runs{kept} → {folder}")
        with chosen_executor(workers, scheduler, cluster) as executor:
            options = {"executor": executor, "progress": not quiet}
            errors = execute_all(runs, folder, figures=figures or ("png",), **options)
    except KeyboardInterrupt:
        typer.echo("Interrupted. To continue, give the same command again.", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except (ConfigError, RunFolderError) as error:
        _stop(error, USAGE)
    except RuntimeError as error:  # of the executor
        _stop(error, FAILURE)
    for name, error in errors.items():
        typer.secho(f"{folder / name}: {error}", err=True, fg=typer.colors.RED)
    if not quiet:
        typer.echo(f"{sum(run.is_finished for run in runs)} of {len(runs)} runs are finished.")
        typer.echo(f"Results: {folder / 'sweep.csv'}")
    if errors:
        raise typer.Exit(FAILURE)


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, e.g. runs/demo.")],
) -> None:
    """Print the metrics of a finished run, and list its figures and files."""
    from vertax.runs._execution import CONFIG, existing_folder, read_metrics
    from vertax.runs._folder import METRICS, RunFolderError
    from vertax.runs._tables import summary

    try:
        path = existing_folder(folder)
        if not (path / METRICS).is_file():
            _stop(
                f"The run in {path} is unfinished: it has no {METRICS}, which is written last. It is still "
                f"running, was interrupted or failed; to continue: vertax run {path / CONFIG} "
                f"--resume {path}",
                FAILURE,
            )
        metrics = read_metrics(path)
    except RunFolderError as error:
        _stop(error, USAGE)
    if table := summary(metrics):
        typer.echo(table)
    _warn(metrics.get("warnings", ()))
    _print_files(path)


def _print_files(folder: Path) -> None:
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    typer.echo("\n".join([f"Results: {folder}", *(f"  {file}" for file in files)]))


def _warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        typer.secho(f"Warning: {warning}", err=True, fg=typer.colors.YELLOW)


def _interrupted(config: Path, overrides: Iterable[str], folder: Path | None) -> str:
    if folder is None:
        return "Interrupted before the run began."
    words = ["vertax", "run", str(config), *(w for o in overrides for w in ("--set", o))]
    command = shlex.join([*words, "--resume", str(folder)])
    return f"Interrupted. The results so far are in {folder}. To continue: {command}"


def _stop(error: Exception | str, code: int) -> NoReturn:
    typer.echo(f"Error: {error}", err=True)
    raise typer.Exit(code)
