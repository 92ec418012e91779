"""Error and coverage of inferred tensions and pressures, on tissues of known forces.

    python benchmarks/tension_coverage.py [--foams 20] [--kinds]

For each class of tissues (near rest, moving, masks, rough outlines, straight edges, movies) the share of
tensions and pressures within intervals of 50, 68, 90 and 95 %, the mean standard deviation over the root mean
square error, the mean logarithmic score less that of a normal distribution with the root mean square error of
the class (0 is good, and positive is too narrow or too wide), and that error.

With `--kinds`, a row for each kind of tissue: foams of Surface Evolver at rest, strongly bent ones, foams
that were stopped on the way to rest, restless ones with weak edges and few points for each edge, and Voronoi
tissues with straight edges; exact and as label images. Last columns: correlation and error of the bare
balance (see `inference.py`) with the same tangents. With `--forsys PYTHON`, an interpreter that has ForSys,
its static inference of the same dumps.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from _arguments import count
from _foams import (
    furrow,
    grouped,
    on_the_way,
    restless,
    run_evolver,
    start,
    to_rest,
    voronoi,
    write_evolver,
)
from inference import FORSYS, Truth, bare, compare, drawn, foam, forsys

from vertax.inference import label_image, pearson
from vertax.io import Foam
from vertax.tensions import EdgeMotion, InferredTensions, infer_tensions

jax.config.update("jax_enable_x64", True)

CLASSES = (
    "near rest",
    "moving",
    "mask, 80 pixels",
    "mask, 40 pixels",
    "mask, 20 pixels",
    "rough outlines",
    "straight edges",
    "movie (EdgeMotion)",
)
QUANTILES = (0.674, 1.0, 1.645, 1.96)
"""Half-widths of intervals of 50, 68, 90 and 95 %, in standard deviations."""


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


def relaxed(folder: Path, seed: int, frames: int = 0) -> list[Path]:
    """The file of a foam of 20 cells at rest, or of frames on the way to rest.

    Foams in which an edge shrinks to a point, where Surface Evolver keeps four edges that are not in
    balance, are not at rest: another one of less contrast takes their place.
    """
    # Contrasts from 0.15 to 0.4, at random or in patches.
    spread, patches = 0.15 + 0.25 * (seed % 5) / 4, seed % 2 == 1
    file = folder / f"class-{seed}-{frames}.fe"
    dumps = [file.with_name(f"{file.stem}-{k}.dmp") for k in range(max(frames, 1))]
    for attempt in range(20):
        if dumps[-1].exists():
            break
        number = 1000 * (attempt + 1) + seed
        tissue = start(20, number)
        less = 0.9**attempt * spread
        write_evolver(file, tissue, grouped(tissue, less, number, patches))
        if frames:
            steps = "".join(f'g 50\ndump "{dump}"\n' for dump in dumps)
            run_evolver(file, f"m 0.002\ng 50\n{steps}")
        else:
            to_rest(file, 80).rename(dumps[0])
            relaxed = foam(dumps[0]).tissue
            inner = ~np.asarray(relaxed.topology.on_outline)
            if np.min(np.asarray(relaxed.edge_lengths)[inner]) < 0.1:
                dumps[0].unlink()
    return dumps


def blurred(foam: Foam, noise: float, random: np.random.Generator) -> list[np.ndarray]:
    """Chains with independent noise of each point, relative to the size of a cell."""
    scale = noise * np.sqrt(np.mean(np.asarray(foam.tissue.areas)))
    places = {tuple(point) for chain in foam.chains for point in np.asarray(chain)}
    moved = {p: np.array(p) + scale * random.normal(size=2) for p in sorted(places)}
    return [np.array([moved[tuple(point)] for point in np.asarray(c)]) for c in foam.chains]


def inferred_motion(folder: Path, seed: int) -> tuple[Truth, InferredTensions]:
    """Tensions of three frames with noise of 0.001 or 0.002 cell sizes."""
    truths = [foam(file) for file in relaxed(folder, seed, 3)]
    random = np.random.default_rng(seed)
    foams = [truth.foam for truth in truths if truth.foam is not None]
    chains = [blurred(each, (0.001, 0.002)[seed % 2], random) for each in foams]
    motion = EdgeMotion([f.tissue for f in foams], chains, [f.time for f in foams])
    # Pressures are those of the second frame, in the order of the first.
    return truths[0]._replace(pressure=truths[1].pressure), motion.tensions()


def members(folder: Path, seeds: range, name: str) -> Iterator[tuple[Truth, InferredTensions]]:
    """Truth and inference of each tissue of a class."""
    for seed in seeds:
        try:
            if name == "movie (EdgeMotion)":
                yield inferred_motion(folder, seed)
                continue
            if name == "straight edges":
                tissue, tension = voronoi(60, seed, (0.002, 0.005, 0.01)[seed % 3])
                truth, source = Truth(tissue, tension, np.zeros(tissue.n_cells)), tissue
            elif name == "moving":
                truth = foam(relaxed(folder, seed, 3)[seed % 3])
                source = truth.foam
            else:
                truth = foam(relaxed(folder, seed)[0])
                source, random = truth.foam, np.random.default_rng(seed)
                if name.startswith("mask"):
                    source = drawn(truth, int(name.split()[1]), 0.0, random)
                elif name == "rough outlines":
                    source = drawn(truth, 60, 0.5, random)
            yield truth, infer_tensions(source)  # pyright: ignore[reportArgumentType]
        except (ValueError, RuntimeError) as error:
            print(f"{name}, {seed}: {error}", flush=True)


def class_row(name: str, folder: Path, seeds: range) -> None:
    """Print coverage, width and score of the intervals of a class."""
    began, parts, share = time.process_time(), [], []
    for truth, result in members(folder, seeds, name):
        parts.append(compare(truth, result))
        share.append(result.determined.sum() / max(np.isfinite(result.tensions).sum(), 1))
    text = []
    for scores, deviations in ((2, 6), (5, 7)):
        z, sd = (np.concatenate([part[k] for part in parts]) for k in (scores, deviations))
        cover = " ".join(f"{np.mean(np.abs(z) < q):4.0%}" for q in QUANTILES)
        rms = float(np.sqrt(np.mean(np.square(z * sd))))
        score = np.mean(0.5 * z**2 + np.log(sd / rms)) - 0.5
        text.append(f"{cover} | {np.mean(sd) / rms:5.2f} | {score:+6.2f} | {rms:6.3f}")
    cpu = (time.process_time() - began) / len(seeds)
    print(f"{name:>20} | {np.mean(share):4.0%} | {' | '.join(text)} | {cpu:4.1f}", flush=True)


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
    parser.add_argument("--foams", type=count, default=20, help="tissues of each class")
    parser.add_argument("--kinds", action="store_true", help="a row for each kind of tissue")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp())
    if not arguments.kinds:
        print(
            f"{'class':>20} | det. | tensions within 50, 68, 90, 95 % | s.d./rms | score | rms | "
            "pressures | s.d./rms | score | rms | s"
        )
        seeds = range(arguments.foams * arguments.seed, arguments.foams * (arguments.seed + 1))
        for name in CLASSES:
            class_row(name, folder, seeds)
        return
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
