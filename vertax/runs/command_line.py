"""The command `vertax`."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from vertax.runs import RunFolder

# JAX, jobs and experiments are imported by the commands that use them, so that help is printed quickly.

app = typer.Typer(
    help="A differentiable vertex model of epithelial tissue.",
    epilog="Exit codes: 0 all went well, 1 the run failed or is unfinished, 2 wrong use, 130 interrupted.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # Rich shows a type, <bool>, for flags, which take no value
    pretty_exceptions_enable=False,
)

USAGE, FAILURE, INTERRUPTED = 2, 1, 130


def _show_version(wanted: bool) -> bool:
    if wanted:
        from vertax.runs import installed_version

        typer.echo(f"vertax {installed_version('vertax')}")
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
    from vertax.runs import EXPERIMENTS
    from vertax.runs._shipped import (
        configuration_of,
        configuration_summary,
        shipped_configurations,
    )

    shipped = {
        name: file
        for name, file in shipped_configurations().items()
        if configuration_of(file) in EXPERIMENTS
    }
    width = max(map(len, [*EXPERIMENTS, *shipped]))
    jobs = [each for each in EXPERIMENTS.values() if each.is_job]
    experiments = [each for each in EXPERIMENTS.values() if not each.is_job]
    for title, group in (("Jobs", jobs), ("Experiments of the repository", experiments)):
        if group:
            typer.echo(f"{title}; vertax describe NAME prints all keys of one:")
        for each in group:
            typer.echo(f"  {each.name:{width}}  {each.summary}")
    typer.echo("Configurations; vertax run NAME runs one:")
    for name, file in shipped.items():
        typer.echo(f"  {name:{width}}  {configuration_summary(file)}")


@app.command()
def describe(
    experiment: Annotated[
        str, typer.Argument(help="Name of a job or an experiment, see `vertax list`.")
    ],
) -> None:
    """Print a configuration file with every key of a job or an experiment, explained and at its default."""
    from vertax.runs import ConfigError, find_experiment, template

    try:
        named = find_experiment(experiment)
    except ConfigError as error:
        _stop(error, USAGE)
    typer.echo(template(named.config, experiment), nl=False)


@app.command()
def run(
    config: Annotated[
        Path,
        typer.Argument(
            help="Configuration file, or the name of one that comes with vertax, e.g. demo."
        ),
    ],
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Set one key, e.g. fit.epochs=50; may be repeated."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; by default runs/NAME of the configuration, or NAME-2, … "
            "if there is one already.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Resume the interrupted run in this folder: fits continue after their last epoch, "
            "other steps begin again.",
        ),
    ] = None,
    figures: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FORMAT",
            help="png, pdf or svg; may be repeated. By default png.",
            show_default=False,
        ),
    ] = None,
    no_cache: Annotated[
        bool,
        typer.Option(
            "--no-cache",
            help="Do not use the folder of compiled functions in the user's cache (the environment variable "
            "VERTAX_CACHE names another folder, or is off).",
        ),
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Show no progress bar and no summary.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Run the job or the experiment that a configuration file describes."""
    import jax

    from vertax import FitError, enable_compilation_cache
    from vertax._base.announce import announce_in_this_process
    from vertax._base.extras import requires_extra
    from vertax.runs import (
        ConfigError,
        RunFolder,
        RunFolderError,
        load_config,
        summary,
    )

    folder: RunFolder | None = None
    formats = tuple(figures or ("png",))
    with requires_extra("run", "A run"):
        import matplotlib
    # Figures go to files only, also where there is a screen.
    matplotlib.use("Agg")
    try:
        experiment, settings = load_config(config, overrides or ())
        # The configuration sets the precision; the library does not.
        jax.config.update("jax_enable_x64", settings.precision == "float64")
        if not no_cache:
            enable_compilation_cache()
        if resume is None:
            folder = RunFolder.claim(config.stem, output, overwrite=overwrite, figures=formats)
            folder.save_config(settings)
        elif output is not None or overwrite:
            raise RunFolderError(
                "--resume goes with neither --output nor --overwrite: leave them out."
            )
        else:
            folder = RunFolder.unfinished(resume, settings, figures=formats)
        if not quiet:
            typer.echo(f"{experiment.name}: {config} → {folder.path}{_kept_parts(folder)}")
            announce_in_this_process(f"functions for {experiment.name}")
        folder.talkative = not quiet
        try:
            metrics = experiment.run(settings, folder, progress=not quiet)
        except Exception as error:
            if resume is None:
                folder.discard_if_empty()
                folder.mark_failed(error)
            raise
        folder.finish(metrics)
    except KeyboardInterrupt:
        typer.echo(_interrupted(config, overrides or (), folder), err=True)
        raise typer.Exit(INTERRUPTED) from None
    # Errors of the user are messages without a traceback; others are bugs.
    except (ConfigError, RunFolderError) as error:
        if debug:
            raise
        _stop(error, USAGE)
    except (FitError, ValueError, OSError, RuntimeError) as error:
        if debug:
            raise
        _stop(error, FAILURE)
    except (MemoryError, OverflowError) as error:
        if debug:
            raise
        _stop(f"The run is too large for this machine ({error}). Make it smaller.", FAILURE)
    if not quiet:
        typer.echo(summary(metrics))
        _warn(folder.warnings)
        typer.echo(f"Results: {folder.path}")
        for figure in folder.figures():
            typer.echo(f"  {figure}")


@app.command()
def sweep(
    configs: Annotated[
        list[Path],
        typer.Argument(
            metavar="CONFIG...",
            help="Configuration files, or names of those that come with vertax.",
        ),
    ],
    grid: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="Values of one key, e.g. tissue.n_cells=50,100 or seed=0:20; several grids give all "
            "combinations.",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set one key in all runs."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Folder of all runs; by default runs/NAME-sweep. Finished runs in it are kept.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A running Dask scheduler, e.g. tcp://node:8786; by default processes on this machine.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of these processes; by default one per core.")
    ] = None,
    figures: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FORMAT", help="png, pdf or svg; may be repeated.", show_default=False
        ),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Show no progress bar and no summary.")
    ] = False,
) -> None:
    """Run one configuration, or several, with different keys."""
    from vertax.runs import ConfigError, RunFolderError, parse_grid, sweep as run_all, sweep_runs

    folder = Path("runs") / f"{configs[0].stem}-sweep" if output is None else output
    try:
        runs = sweep_runs(configs, parse_grid(grid or ()), folder, overrides or ())
        finished = sum(run.state == "finished" for run in runs)
        if not quiet:
            kept = f", {finished} of them finished before" if finished else ""
            typer.echo(f"{len(runs)} runs{kept} → {folder}")
        runs = run_all(
            runs,
            folder,
            scheduler=scheduler,
            workers=workers,
            figures=tuple(figures or ("png",)),
            progress=not quiet,
        )
    except KeyboardInterrupt:
        typer.echo("Interrupted. To go on, give the same command again.", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except (ConfigError, RunFolderError) as error:
        _stop(error, USAGE)
    except ImportError as error:
        _stop(error, FAILURE)
    failed = [run for run in runs if run.state == "failed"]
    for run in failed:
        typer.secho(f"{run.folder}: {run.error}", err=True, fg=typer.colors.RED)
    if not quiet:
        typer.echo(f"{len(runs) - len(failed)} of {len(runs)} runs are finished.")
        typer.echo(f"Results: {folder / 'sweep.csv'}")
    if failed:
        raise typer.Exit(FAILURE)


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, e.g. runs/demo.")],
) -> None:
    """Print the metrics of a finished run, and list its figures and files."""
    from vertax.runs import RunFolder, RunFolderError, UnfinishedRunError, summary

    try:
        run = RunFolder.existing(folder)
        metrics = run.metrics()
    except UnfinishedRunError as error:
        _stop(error, FAILURE)
    except RunFolderError as error:
        _stop(error, USAGE)
    figures = run.figures()
    others = [file for file in run.files() if file not in figures]
    if table := summary(metrics):
        typer.echo(table)
    _warn(metrics.get("warnings", ()))
    for title, files in (("Figures", figures), ("Files", others)):
        if files:
            typer.echo(f"{title}:")
        for file in files:
            typer.echo(f"  {file}")


def _warn(warnings: Iterable[str]) -> None:
    """Print warnings."""
    for warning in warnings:
        typer.secho(f"Warning: {warning}", err=True, fg=typer.colors.YELLOW)


def _kept_parts(folder: RunFolder) -> str:
    """The parts that a resumed run keeps."""
    parts = folder.parts()
    return f" (resumed; kept so far: {', '.join(part.stem for part in parts)})" if parts else ""


def _interrupted(config: Path, overrides: Iterable[str], folder: RunFolder | None) -> str:
    if folder is None:
        return "Interrupted before the run began."
    changes = "".join(f" --set {shlex.quote(override)}" for override in overrides)
    command = (
        f"vertax run {shlex.quote(str(config))}{changes} --resume {shlex.quote(str(folder.path))}"
    )
    return f"Interrupted. What there is lies in {folder.path}. To go on: {command}"


def _stop(error: Exception | str, code: int) -> NoReturn:
    typer.echo(f"Error: {error}", err=True)
    raise typer.Exit(code)
