"""Error and coverage of inferred tensions and pressures, on tissues of known forces.

A row for each kind of tissue: foams of Surface Evolver at rest, strongly bent ones, foams that were stopped
on the way to rest, restless ones with weak edges and few points for each edge, and Voronoi tissues with
straight edges; exact and as label images. Last columns: correlation and error of the bare balance (see
`inference.py`) with the same tangents. With
`--forsys PYTHON`, an interpreter that has ForSys, its static inference of the same dumps.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from _foams import furrow, grouped, on_the_way, restless, start, to_rest, voronoi, write_evolver
from inference import FORSYS, Truth, bare, compare, foam, forsys

from vertax.inference import label_image, pearson
from vertax.tensions import infer_tensions

jax.config.update("jax_enable_x64", True)


def make_foams(folder: Path, seed: int) -> dict[str, list[Path]]:
    """Files of foams by kind, made if they are not there."""
    kinds: dict[str, list[Path]] = {}
    tissue = start(50, seed)
    for patches in (False, True):
        layout = "patches" if patches else "random"
        for spread in (0.2, 0.5, 0.8):
            file = folder / f"{seed}-{layout}-{spread}.fe"
            dumps = sorted(file.parent.glob(f"{file.stem}-*.dmp"))
            if len(dumps) < 3:
                write_evolver(file, tissue, grouped(tissue, spread, seed, patches))
                dumps = on_the_way(file)
            for share, dump in zip((20, 50, 80), sorted(dumps), strict=True):
                kinds[f"{layout} {spread}, {share} % of the way"] = [dump]
    for pieces in (4, 8):
        file = folder / f"{seed}-restless-{pieces}.fe"
        shares = (0.5, 0.8, 0.93, 0.98)
        dumps = [file.with_name(f"{file.stem}-{share:.0%}.dmp") for share in shares]
        if not all(dump.exists() for dump in dumps):
            write_evolver(file, tissue, restless(tissue, seed), pieces=pieces)
            on_the_way(file, shares)
        for share, dump in zip(shares, dumps, strict=True):
            kinds[f"restless, {pieces} pieces, {share:.0%}"] = [dump]
    for number in range(3):
        small = start(30, 10 * seed + number)
        options = {
            "at rest": (grouped(small, 0.3, number, number > 0), None),
            "bent": furrow(small, 10 * seed + number),
        }
        for kind, (tension, areas) in options.items():
            file = folder / f"{seed}-{kind.replace(' ', '-')}-{number}.fe"
            if not file.with_suffix(".dmp").exists():
                write_evolver(file, small, tension, areas)
                to_rest(file)
            kinds.setdefault(kind, []).append(file.with_suffix(".dmp"))
    return kinds


def cases(folder: Path, seed: int) -> Iterator[tuple[str, list[tuple[Truth, object]]]]:
    """Names of rows, and their tissues: the truth, and what is given to `infer_tensions`."""
    foams = make_foams(folder, seed)
    for kind, files in foams.items():
        truths = [foam(file) for file in files]
        yield kind, [(truth, truth.foam) for truth in truths]
        if len(truths) > 1:
            yield (
                f"{kind}, 1000 pixels",
                [(t, label_image(t.foam or t.tissue, 1000)) for t in truths],
            )
    for noise in (0.0, 0.005, 0.02):
        shapes = [voronoi(80, 10 * seed + k, noise) for k in range(3)]
        truths = [Truth(t, tension, np.zeros(t.n_cells)) for t, tension in shapes]
        yield f"Voronoi, noise {noise}", [(truth, truth.tissue) for truth in truths]
        if not noise:
            yield "Voronoi, 1000 pixels", [(t, label_image(t.tissue, 1000)) for t in truths]


def row(name: str, members: list[tuple[Truth, object]]) -> None:
    """Print correlations, errors and coverage of one kind of tissue."""
    parts: list[tuple[np.ndarray, ...]] = []
    determined, seconds, edges, plain = [], [], [], []
    for truth, source in members:
        began = time.perf_counter()
        try:
            result = infer_tensions(source)  # pyright: ignore[reportArgumentType]
        except ValueError as error:
            print(f"{name:>30} | {error}")
            return
        seconds.append(time.perf_counter() - began)
        determined.append(result.determined.sum() / np.isfinite(result.tensions).sum())
        edges.append(result.edges)
        parts.append(compare(truth, result))
        plain.append(compare(truth, bare(result)))
    r = np.mean([pearson(p[0], p[1]) for p in parts])
    error = np.mean([np.mean(np.abs(p[1] - p[0]) / p[0]) for p in parts])
    flat = [np.ptp(p[3]) < 1e-9 for p in parts]
    by_pressure = np.mean(
        [np.nan if f else float(pearson(p[3], p[4])) for p, f in zip(parts, flat, strict=True)]
    )
    scores = [np.abs(np.concatenate([p[k] for p in parts])) for k in (2, 5)]
    cover = [
        f"{np.mean(s < 1):4.0%} {np.mean(s < 2):4.0%} {np.sqrt(np.mean(s**2)):5.2f}" for s in scores
    ]
    print(
        f"{name:>30} | {np.mean(determined):4.0%} | {r:6.3f} {error:6.1%} {cover[0]} | "
        f"{by_pressure:6.3f} {cover[1]} | {np.median(seconds):4.1f} | {'/'.join(sorted(set(edges)))} | "
        f"{np.mean([pearson(p[0], p[1]) for p in plain]):6.3f} "
        f"{np.mean([np.mean(np.abs(p[1] - p[0]) / p[0]) for p in plain]):6.1%}",
        flush=True,
    )


def main() -> None:
    """Print a row for each kind of tissue."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="folder where foams are kept")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--forsys", help="interpreter that has ForSys")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp())
    print(
        f"{'tissue':>30} | det. | tensions: r, error, within 1, 2 s.d., rms z | pressures | s | edges | bare"
    )
    for name, members in cases(folder, arguments.seed):
        row(name, members)
    if arguments.forsys:
        for kind, files in make_foams(folder, arguments.seed).items():
            forsys(arguments.forsys, kind, FORSYS, [files[0]])


if __name__ == "__main__":
    main()
