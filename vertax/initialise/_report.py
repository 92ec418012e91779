"""Report on a mask: what became of each label, and which contacts the mask shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.initialise._gaps import least_hole_radius, reach_of
from vertax.initialise._pieces import connected_pieces

# A contact is closed if less than this share of its length is shown by the mask.
_LEAST_SHOWN = 0.5
# A contact across a gap is uncertain if it is shorter than this times the width of the gap.
LEAST_LENGTH = 1.5
# Number of changes in a summary.
_LISTED = 50


KINDS = ("new cell", "piece", "absorbed", "left out", "hole", "closed hole")


class MaskChange(eqx.Module):
    """A connected region of a mask that is not what its label says, or a hole."""

    kind: str
    """`"new cell"`: a second piece of a label became a cell with a label not in the mask.
    `"piece"`: a piece of a label joined another cell.
    `"absorbed"`: the pixels of a label without a cell joined another cell.
    `"left out"`: labelled pixels became exterior or a hole.
    `"hole"`: pixels without a label within the tissue are a face without a cell.
    `"closed hole"`: pixels without a label, too wide for a gap, were given to the cells next to them."""
    label: int
    """Label in the mask; 0 for pixels without a label."""
    into: int
    """Label of the cell that the pixels belong to in the tissue; 0 for none."""
    pixels: int
    """Number of pixels."""
    row: float
    """Row of the centroid of the region, in pixels."""
    column: float
    """Column of the centroid of the region, in pixels."""

    def __str__(self) -> str:
        """The change in words, with its place."""
        place = f"{self.pixels} pixels at row {self.row:.0f}, column {self.column:.0f}"
        return {
            "new cell": f"label {self.label} is in several pieces: that of {place} is the cell {self.into}",
            "piece": f"a piece of label {self.label} ({place}) joined the cell {self.into}",
            "absorbed": f"label {self.label} ({place}) joined the cell {self.into}",
            "left out": f"label {self.label} ({place}) was left out",
            "hole": f"a hole of {place} is no cell",
            "closed hole": f"a hole of {place} was closed",
        }[self.kind]


class MaskReport(eqx.Module):
    """What became of the labels of a mask, and which contacts between cells the mask shows."""

    labels: Int[np.ndarray, " labels"]
    """The labels in the mask, ascending, without the background."""
    pixels: Int[np.ndarray, " labels"]
    """Number of pixels of each."""
    became: Int[np.ndarray, " labels"]
    """Label of the cell that has most of these pixels: the label itself if it is a cell, 0 for none."""
    changes: tuple[MaskChange, ...] = eqx.field(static=True)
    """Regions with another label than in the mask, and holes; the largest first."""
    gap_width: float
    """Largest width of the gaps that were closed, in the shorter side of a pixel."""
    line_width: float
    """Width of the gaps between neighbouring labels as measured, in the shorter side of a pixel."""
    shown: Float[np.ndarray, " edges"]
    """Share of the length of each edge along which the mask shows the contact: the two labels touch, or a gap
    of at most `gap_width` is between them."""
    uncertain: Bool[np.ndarray, " edges"]
    """Edges across a gap and shorter than 1.5 times its width: other cells may touch there."""
    cell_pixels: Int[np.ndarray, " cells"]
    """Number of pixels of each cell in the image from which the mesh was made."""

    @property
    def closed(self) -> Bool[np.ndarray, " edges"]:
        """Edges along which the mask does not show the contact over half of their length."""
        return self.shown < _LEAST_SHOWN

    def of_kind(self, *kinds: str) -> list[MaskChange]:
        """The changes of some kinds.

        **Arguments:**

        - `kinds`: names, see [`MaskChange`][vertax.initialise.MaskChange].

        **Returns:** the changes, the largest first.
        """
        return [change for change in self.changes if change.kind in kinds]

    def summary(self) -> dict[str, Any]:
        """The report as numbers and text, for JSON.

        **Returns:** numbers of labels, contacts and changes by kind; and the 50 largest changes.
        """
        kinds = [change.kind for change in self.changes]
        counts = {f"n_{kind.replace(' ', '_')}": kinds.count(kind) for kind in KINDS}
        return {
            "n_labels": len(self.labels),
            "n_labels_without_cell": int(np.sum(self.became != self.labels)),
            "gap_width": self.gap_width,
            "line_width": self.line_width,
            "n_contacts_closed": int(self.closed.sum()),
            "n_contacts_uncertain": int(np.sum(self.uncertain & ~self.closed)),
            **counts,
            "largest_changes": [dataclasses.asdict(change) for change in self.changes[:_LISTED]],
        }

    def change_table(self) -> dict[str, np.ndarray]:
        """The changes as a table.

        **Returns:** columns by name: the fields of [`MaskChange`][vertax.initialise.MaskChange].
        """
        names = [field.name for field in dataclasses.fields(MaskChange)]
        return {name: np.array([getattr(c, name) for c in self.changes]) for name in names}


class Repaired(NamedTuple):
    """A mask, and the image of faces that was made of it."""

    values: Int[np.ndarray, " labels"]
    """The labels in the mask, ascending."""
    given: Int[np.ndarray, "rows columns"]
    """Index among the labels of each pixel; -1 for none."""
    final: Int[np.ndarray, "rows columns"]
    """Index among `names` of each pixel."""
    names: Int[np.ndarray, " faces"]
    """Label of each face of the final image; 0 for holes and the exterior."""
    exterior: int | None
    """Index of the exterior among `names`."""
    cells: Int[np.ndarray, " faces"]
    """Faces of the final image that are cells of the mesh."""


def changes_of(repaired: Repaired, gap_width: float, depth: np.ndarray) -> tuple[MaskChange, ...]:
    """The regions of a mask with another label than given, and holes.

    **Arguments:**

    - `repaired`: the mask and the image made of it.
    - `gap_width`: largest width of the gaps that were closed.
    - `depth`: distance of each changed pixel from the nearest pixel that was not changed.
    """
    values, given, final, names = repaired[:4]
    label = np.append(values, 0)[given]
    now = names[final]
    # Pairs (label, face): 0 where nothing is to be reported.
    pair = np.where((label > 0) & (label != now), given * (len(names) + 1) + final + 1, 0)
    unlabelled = (label == 0) & (final != repaired.exterior)
    pair = np.where(unlabelled & (now == 0), -1 - final, pair)
    closed = unlabelled & (now > 0)
    pair = np.where(closed, -len(names) - 1, pair)
    pieces = connected_pieces(pair, periodic=False)
    interesting = np.flatnonzero(pieces.value != 0)
    deepest = np.zeros(len(pieces.value))
    np.maximum.at(deepest, pieces.piece.ravel(), depth.ravel())
    gaps = pieces.value == -len(names) - 1
    interesting = interesting[
        ~gaps[interesting] | (deepest[interesting] > least_hole_radius(gap_width))
    ]
    if not len(interesting):
        return ()
    n = len(pieces.value)
    rows, columns = np.indices(final.shape)
    row, column = (
        np.bincount(pieces.piece.ravel(), x.ravel(), n) / pieces.size for x in (rows, columns)
    )
    first = np.full(n, -1)
    flat = pieces.piece.ravel()
    first[flat[::-1]] = np.arange(final.size)[::-1]
    present = set(names[repaired.cells].tolist())
    new = set(np.setdiff1d(names, np.append(values, 0)).tolist())
    changes = []
    for k in interesting.tolist():
        old, into = int(label.flat[first[k]]), int(now.flat[first[k]])
        if gaps[k]:
            kind, into = "closed hole", 0
        elif old == 0:
            kind = "hole"
        elif into == 0:
            kind = "left out"
        elif into in new:
            kind = "new cell"
        else:
            kind = "piece" if old in present else "absorbed"
        size = int(pieces.size[k])
        changes.append(MaskChange(kind, old, into, size, float(row[k]), float(column[k])))
    return tuple(sorted(changes, key=lambda change: -change.pixels))


def report_on(
    repaired: Repaired,
    contacts: tuple[Float[np.ndarray, " edges"], Bool[np.ndarray, " edges"]],
    depth: Float[np.ndarray, "rows columns"],
    widths: tuple[float, float],
    cell_pixels: Int[np.ndarray, " cells"],
) -> MaskReport:
    """The report on a mask.

    **Arguments:**

    - `repaired`: the mask and the image made of it.
    - `contacts`: share shown and whether uncertain of each edge, see `contacts_of`.
    - `depth`: distance of each changed pixel from the nearest pixel that was not changed.
    - `widths`: largest width of the gaps that were closed, and the width measured.
    - `cell_pixels`: number of pixels of each cell of the mesh.
    """
    values, given, final, names = repaired[:4]
    labelled = given >= 0
    n, n_faces = len(values), len(names)
    share = np.bincount(
        given[labelled].astype(np.int64) * n_faces + final[labelled], minlength=n * n_faces
    ).reshape(n, n_faces)
    became = names[np.argmax(share, axis=1)]
    # A label is a cell if a face has its name, even if most of its pixels joined others.
    became = np.where(np.isin(values, names[repaired.cells]), values, became)
    return MaskReport(
        labels=values,
        pixels=share.sum(axis=1),
        became=became,
        changes=changes_of(repaired, widths[0], depth),
        gap_width=widths[0],
        line_width=widths[1],
        shown=contacts[0],
        uncertain=contacts[1],
        cell_pixels=cell_pixels,
    )


def contacts_of(
    edge: Int[np.ndarray, " points"],
    points: Float[np.ndarray, "points 2"],
    length: Float[np.ndarray, " edges"],
    depth_at: Callable[[np.ndarray, np.ndarray], np.ndarray],
    gap_width: float,
) -> tuple[Float[np.ndarray, " edges"], Bool[np.ndarray, " edges"], Bool[np.ndarray, " points"]]:
    """Share of each edge that the mask shows, whether the edge is uncertain, and which points it shows.

    **Arguments:**

    - `edge`, `points`: middles of the sides between pixels of different cells, in pixels.
    - `length`: distance of the ends of each edge, in the shorter side of a pixel.
    - `depth_at`: distance of pixels (rows, columns) from the nearest pixel that was not changed.
    - `gap_width`: largest width of gaps that were closed.
    """
    x, y = points.T
    upright = x == np.rint(x)  # the side between two pixels of a row
    low = np.floor(np.stack([y - ~upright, x - upright])).astype(int)
    high = np.floor(np.stack([y, x])).astype(int)
    one, other = depth_at(*low), depth_at(*high)
    width = one + other
    shows = np.maximum(one, other) <= reach_of(gap_width)
    n = len(length)
    count = np.bincount(edge, minlength=n)
    shown = np.where(count > 0, np.bincount(edge, shows, n) / np.maximum(count, 1), 1.0)
    widest = np.zeros(n)
    np.maximum.at(widest, edge, np.where(shows, width, 0.0))
    return shown, length < LEAST_LENGTH * widest, shows
