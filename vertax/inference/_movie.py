"""Movies of tracked cells: frames with the same cell numbers, and the events between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vertax._base.batch import member, stack
from vertax._base.checks import as_times, check_number
from vertax.mesh import Periodic, Tissue, Topology

Cells = frozenset[int]


class Event(NamedTuple):
    """A change between two frames."""

    kind: str
    """`"T1"`; `"contact lost"` and `"contact gained"`, where several T1 transitions happened between two
    frames; `"division"`, `"death"`; `"entry"` and `"exit"` of a cell at the border; `"gap"`, a cell that is
    missing for some frames."""
    frame: int
    """The first frame after it."""
    cells: tuple[int, ...]
    """Numbers of the cells: of a T1 transition the two that lose their contact, then the two that gain one;
    of a division the mother, then the daughters. -1 is the exterior."""


class Repair(NamedTuple):
    """What a reader mended in a frame."""

    kind: str
    """`"clockwise"`: corners that were turned round; `"repeated corner"`: a corner that was left out;
    `"inserted corner"`: that of a neighbour in the middle of a side; `"listed twice"`: a copy that was left
    out; `"renumbered"`: cells that have the place of a cell with another number."""
    frame: int
    """The frame, from 0."""
    cells: tuple[int, ...]
    """Numbers of the cells in the movie."""


class Movie(eqx.Module):
    """Frames of a tissue in which cells keep their numbers while their neighbours change.

    Cells are matched by number, and vertices by the three cells that they join. All frames have the same
    array sizes: cell k of each tissue is the cell with the number `cells[k]`, and a spare slot in frames
    without it.

    **Arguments:**

    - `tissues`: the frames, two at least.
    - `times`: their times, increasing.
    - `cells`: for each frame the number of each cell; by default cells have the numbers 0, 1, ... in all.
    - `types`: type of each cell by number; by default there are none.
    - `filled`: for each frame the numbers of cells that were not observed but fill a hole; each is an event
        `"gap"`.
    - `repairs`: what a reader mended.
    - `outline_nodes`: for each frame the number of nodes inside each edge: 0 except on the outline.
    - `largest_jump`: largest distance that a centroid moves from one frame to the next, in units of the
        root of the mean cell area.

    **Raises:**

    - `ValueError`, naming cells and frames, for times out of order, numbers that are negative or that two
        cells of a frame share, cells that jump or have a number that was used elsewhere, and cells without
        a type.
    """

    tissue: Tissue
    """The frames: one tissue with a leading axis."""
    times: Float[Array, " frames"]
    cells: Int[np.ndarray, " cells"]
    """Number of each cell, ascending."""
    types: Int[np.ndarray, " cells"] | None
    """Type of each cell, for [`by_type`][vertax.energies.by_type]."""
    events: tuple[Event, ...]
    """What changed between frames, in the order of frames."""
    repairs: tuple[Repair, ...]
    """What [`movie_from_table`][vertax.inference.movie_from_table] mended, in the order of frames."""
    outline_nodes: Int[np.ndarray, "frames edges"] | None
    """The number of points of a table inside each edge, for a free tissue; see `node_friction` of
    [`fit_movie`][vertax.inference.fit_movie]."""

    def __init__(
        self,
        tissues: Sequence[Tissue],
        times: Sequence[Any] | Array | np.ndarray,
        *,
        cells: Sequence[Any] | None = None,
        types: dict[int, int] | None = None,
        filled: Sequence[Sequence[int]] | None = None,
        repairs: Sequence[Repair] = (),
        outline_nodes: Sequence[Int[np.ndarray, " edges"]] | None = None,
        largest_jump: float = 1.0,
    ):
        check_number("largest_jump", largest_jump, above=0)
        self.times = as_times(times)
        if not len(self.times) == len(tissues):
            raise ValueError(
                f"Argument `times` must have one entry per frame, but has {len(self.times)} for "
                f"{len(tissues)} frames."
            )
        tissues = [t.without_spare() if t.topology.spare else t for t in tissues]
        given = [np.arange(t.n_cells) for t in tissues] if cells is None else cells
        numbers = [
            _checked_numbers(k, n, t) for k, (n, t) in enumerate(zip(given, tissues, strict=True))
        ]
        self.cells = np.unique(np.concatenate(numbers))
        frames = [_Frame(n, t) for n, t in zip(numbers, tissues, strict=True)]
        _check_jumps(frames, largest_jump)
        gaps = [Event("gap", k, (c,)) for k, holes in enumerate(filled or ()) for c in holes]
        events = sorted([*_events(frames), *gaps], key=lambda event: event.frame)
        self.events = tuple(events)
        self.repairs = tuple(repairs)
        self.types = None
        if types is not None:
            missing = [int(cell) for cell in self.cells if int(cell) not in types]
            if missing:
                raise ValueError(
                    f"Argument `types` must have the type of each cell, but has none for {missing[:10]}."
                )
            self.types = np.array([types[int(cell)] for cell in self.cells])
        placed = [
            _with_slots_of(t, np.searchsorted(self.cells, n), len(self.cells))
            for n, t in zip(numbers, tissues, strict=True)
        ]
        self.outline_nodes = None
        if outline_nodes is not None:
            self.outline_nodes = np.zeros((len(placed), placed[0].n_edges), int)
            for row, inside in zip(self.outline_nodes, outline_nodes, strict=True):
                row[: len(inside)] = inside
        softening = placed[0].softening
        self.tissue = stack([eqx.tree_at(lambda t: t.softening, t, softening) for t in placed])

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.times)

    def frame(self, number: int) -> Tissue:
        """The tissue of a frame; cells that it lacks are spare slots.

        **Raises:**

        - `IndexError` if there is no such frame.
        """
        return member(self.tissue, number)


class _Frame:
    """Places, areas and contacts of the cells of a frame, by number."""

    def __init__(self, numbers: Int[np.ndarray, " cells"], tissue: Tissue):
        boundary = tissue.boundary
        self.lattice = boundary.lattice if isinstance(boundary, Periodic) else None
        values = zip(
            numbers.tolist(), np.asarray(tissue.centroids), np.asarray(tissue.areas), strict=True
        )
        self.places: dict[int, np.ndarray] = {}
        self.areas: dict[int, float] = {}
        for number, place, area in values:
            self.places[number], self.areas[number] = place, float(area)
        self.size = float(np.sqrt(np.mean(list(self.areas.values()))))
        named = np.append(numbers, -1)  # the exterior
        pairs = named[np.asarray(tissue.topology.edge_cells)]
        self.contacts: set[Cells] = {frozenset(pair) for pair in pairs.tolist()}
        self.neighbours: dict[int, set[int]] = {}
        for a, b in pairs.tolist():
            self.neighbours.setdefault(a, set()).add(b)
            self.neighbours.setdefault(b, set()).add(a)


def shortest(
    away: Float[np.ndarray, "*n 2"], lattice: Float[np.ndarray | Array, "2 2"] | None
) -> Float[np.ndarray, "*n 2"]:
    """Vectors between points, the shortest across the boundary of a periodic tissue."""
    if lattice is None:
        return away
    return np.asarray(Periodic(jnp.asarray(lattice)).shortest(jnp.asarray(away)))


def _checked_numbers(frame: int, numbers: Any, tissue: Tissue) -> Int[np.ndarray, " cells"]:
    array = np.asarray(numbers)
    if array.shape != (tissue.n_cells,) or array.dtype.kind not in "iu" or (array < 0).any():
        raise ValueError(
            f"Argument `cells` must hold a number from 0 for each of the {tissue.n_cells} cells of frame "
            f"{frame}, but does not."
        )
    values, counts = np.unique(array, return_counts=True)
    if (counts > 1).any():
        raise ValueError(
            f"Argument `cells` must name each cell of a frame once, but frame {frame} has two cells "
            f"{int(values[counts > 1][0])}. Give one of them another number."
        )
    return array.astype(int)


def _check_jumps(frames: list[_Frame], largest: float) -> None:
    """Raise an error for cells that move too far from one of their frames to the next."""
    last: dict[int, int] = {}
    for now, frame in enumerate(frames):
        cells = [cell for cell in frame.places if cell in last]
        if cells:
            places = np.array([frame.places[cell] for cell in cells])
            origins = np.array([frames[last[cell]].places[cell] for cell in cells])
            away = shortest(places - origins, frame.lattice)
            away = np.linalg.norm(away, axis=1) / frame.size
            elapsed = now - np.array([last[cell] for cell in cells])
            if (jumps := np.flatnonzero(away > largest * elapsed)).size:
                k = int(jumps[0])
                _raise_jump(cells[k], now, last[cells[k]], float(away[k]))
        last |= dict.fromkeys(frame.places, now)


def _raise_jump(cell: int, now: int, before: int, away: float) -> NoReturn:
    """Raise the error for a cell that moved by `away` cell sizes."""
    fact = f"cell {cell} is {away:.3g} cell sizes away from its place in frame {before}"
    if now - before > 1:
        raise ValueError(
            f"Argument `cells` must not use the number of a lost cell again, but in frame {now} {fact}. Give "
            "the new cell another number."
        )
    raise ValueError(
        f"Cells must not jump, but in frame {now} {fact}. Correct the tracking, or pass a larger "
        "`largest_jump`."
    )


def _events(frames: list[_Frame]) -> list[Event]:
    """The events between all pairs of consecutive frames."""
    present = [set(frame.places) for frame in frames]
    last = {cell: k for k, cells in enumerate(present) for cell in cells}
    known_cells: set[int] = set(present[0])
    events: list[Event] = []
    for now in range(1, len(frames)):
        before, after = frames[now - 1], frames[now]
        gone, new = present[now - 1] - present[now], present[now] - present[now - 1]
        events += [Event("gap", now, (cell,)) for cell in sorted(gone) if last[cell] > now]
        gone = {cell for cell in gone if last[cell] < now}
        new, known_cells = new - known_cells, known_cells | new
        for mother, daughters in _divisions(before, after, gone, new):
            events.append(Event("division", now, (mother, *daughters)))
            gone, new = gone - {mother}, new - set(daughters)
        on_border = lambda frame, cell: frozenset((cell, -1)) in frame.contacts
        for cell in sorted(gone):
            events.append(Event("exit" if on_border(before, cell) else "death", now, (cell,)))
        events += [Event("entry", now, (cell,)) for cell in sorted(new)]
        events += _changes_of_contact(before, after, now)
    return events


def _divisions(
    before: _Frame, after: _Frame, gone: set[int], new: set[int]
) -> list[tuple[int, tuple[int, ...]]]:
    """Mothers and daughters: two neighbours at the place of one cell; one may keep its number."""
    divisions, free = [], set(new)
    for first in sorted(new):
        if first not in free:
            continue
        best: tuple[float, int, tuple[int, ...]] | None = None
        for second in sorted(after.neighbours.get(first, set()) - {-1}):
            if second in free:
                mothers, daughters = gone, (first, second)
            elif second in before.places:
                mothers, daughters = {second}, (second, first)
            else:
                continue
            areas = np.array([after.areas[d] for d in daughters])
            places = np.stack([after.places[d] for d in daughters])
            places = places[0] + shortest(places - places[0], after.lattice)
            middle = areas @ places / areas.sum()
            for mother in mothers:
                # The daughters cover the mother: the same centroid within a third of its size.
                change = abs(np.log(areas.sum() / before.areas[mother]))
                away = shortest(middle - before.places[mother], after.lattice)
                away = float(np.linalg.norm(away)) / np.sqrt(before.areas[mother])
                if change < 0.5 and away < 1 / 3 and (best is None or away < best[0]):
                    best = (away, mother, daughters)
        if best is not None:
            divisions.append(best[1:])
            free -= set(best[2])
            gone = gone - {best[1]}
    return divisions


def _changes_of_contact(before: _Frame, after: _Frame, now: int) -> list[Event]:
    """T1 transitions among cells of both frames; other changes of contacts one by one."""
    both = set(before.places) & set(after.places) | {-1}
    among = lambda pairs: sorted((tuple(sorted(p)) for p in pairs if p <= both), key=str)
    lost, gained = among(before.contacts - after.contacts), among(after.contacts - before.contacts)
    events = []
    for pair in list(lost):
        a, b = pair[0], pair[-1]
        ends = before.neighbours[a] & before.neighbours[b]
        partner = next((p for p in gained if set(p) <= ends), None)
        if partner is not None:
            events.append(Event("T1", now, (*pair, *partner)))
            lost.remove(pair)
            gained.remove(partner)
    events += [Event("contact lost", now, pair) for pair in lost]
    return events + [Event("contact gained", now, pair) for pair in gained]


def _with_slots_of(tissue: Tissue, slots: Int[np.ndarray, " cells"], n_slots: int) -> Tissue:
    """A tissue with a capacity, in which cell k has the number `slots[k]`."""
    if n_slots > tissue.n_cells:
        tissue = tissue.with_capacity(n_slots)
    m = tissue.topology
    # Labels of the exterior and of spare slots stay.
    label = np.concatenate([slots, np.zeros(n_slots - len(slots), int), [n_slots, n_slots + 1]])
    topology = Topology(
        m.twin, label[np.asarray(m.cell)], m.frame, m.edge, exterior=m.exterior, spare=True
    )
    return tissue.with_topology(eqx.tree_at(lambda t: t.half_edge, topology, m.half_edge))
