"""Labels in several pieces, and labels too small for a cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Integer
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vertax.initialise._gaps import EXTERIOR, FIRST_HOLE, GAP, fill_gaps

# Areas relative to the median cell: of the smallest piece that is a cell, and of the largest speck.
_CELL, _SPECK = 0.25, 0.03
# Smallest number of pixels of a piece that becomes a cell.
_CELL_PIXELS = 25


class Pieces(NamedTuple):
    """The connected regions of equal pixels, joined by the sides of pixels."""

    piece: Int[np.ndarray, "rows columns"]
    """The piece of each pixel."""
    value: Int[np.ndarray, " pieces"]
    """The value of the pixels of each piece."""
    size: Int[np.ndarray, " pieces"]
    """Its number of pixels."""


def connected_pieces(image: Integer[np.ndarray, "rows columns"], periodic: bool) -> Pieces:
    """The connected regions of equal pixels."""
    # The nodes are runs of equal pixels along a row, far fewer than pixels. Two runs in adjacent
    # rows overlap where one of them starts.
    start = np.ones(image.shape, bool)
    start[:, 1:] = image[:, 1:] != image[:, :-1]
    run = np.cumsum(start.ravel()).reshape(image.shape) - 1
    overlap = start[1:] | start[:-1]
    above, below = [run[:-1][overlap]], [run[1:][overlap]]
    if periodic:
        above += [run[-1], run[:, -1]]
        below += [run[0], run[:, 0]]
    a, b = np.concatenate(above), np.concatenate(below)
    value = image[start]
    same = value[a] == value[b]
    n_pieces, piece_of_run = components(len(value), a[same], b[same])
    value_of_piece = np.zeros(n_pieces, image.dtype)
    value_of_piece[piece_of_run] = value
    piece = piece_of_run[run]
    return Pieces(piece, value_of_piece, np.bincount(piece.ravel(), minlength=n_pieces))


def components(
    n: int, a: Int[np.ndarray, " links"], b: Int[np.ndarray, " links"]
) -> tuple[int, Int[np.ndarray, " nodes"]]:
    """Number of the connected parts of a graph of n nodes with links from a to b, and the part of each."""
    links = coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n))
    return connected_components(links, directed=False)


def cell_size(pieces: Pieces) -> float:
    """Pixels of the median cell: the median over the labels, or, where labels repeat, over their pieces.

    The median over pieces is weighted by their pixels, so that stray pixels do not count.
    """
    is_label = pieces.value >= 0
    sizes = np.sort(pieces.size[is_label])
    labelled = np.bincount(pieces.value[is_label], pieces.size[is_label])
    of_pieces = sizes[np.searchsorted(np.cumsum(sizes), sizes.sum() / 2)]
    return float(min(np.median(labelled[labelled > 0]), of_pieces))


def without_specks(
    image: Int[np.ndarray, "rows columns"], spacing: tuple[float, float]
) -> tuple[Int[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """The image without labels of less than 0.03 median cells, and the pixels that become exterior.

    The nearest other value replaces a speck. Specks at the border of the image may be cells that it cuts:
    they become exterior, so that no contact is added between their neighbours.
    """
    sizes = np.bincount(image[image >= 0])
    specks = (sizes > 0) & (sizes < _SPECK * cell_size(connected_pieces(image, periodic=False)))
    if not specks.any():
        return image, np.zeros(image.shape, bool)
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    cut = np.zeros(len(sizes), bool)
    cut[border[border >= 0]] = True
    outside = (image >= 0) & (cut & specks)[image]
    # Gaps are values here: a speck in the exterior becomes a part of it.
    filled = np.where(image == GAP, EXTERIOR, image)
    filled = np.where((image >= 0) & (specks & ~cut)[image], GAP, filled)
    filled = fill_gaps(filled, spacing=spacing)
    return np.where(filled == EXTERIOR, GAP, filled), outside


def join_pieces(
    image: Int[np.ndarray, "rows columns"], n_labels: int, periodic: bool, *, keep_holes: bool
) -> tuple[Int[np.ndarray, "rows columns"], Int[np.ndarray, " new_labels"]]:
    """An image of connected labels.

    Of each label the largest piece stays. A piece of at least 0.25 median cells (and 25 pixels) becomes a new
    label.
    Of the others, those of at least 0.03 median cells become holes, if holes are kept, because whatever the
    neighbour that received them its contacts could be wrong; all others go to the neighbour with the longest
    common interface.

    **Returns:** the image, and the label from which each new label (`n_labels`, …) was split.
    """
    pieces = connected_pieces(image, periodic)
    value, size = pieces.value, pieces.size
    order = np.lexsort((np.arange(len(value)), -size, value))
    kept = np.zeros(len(value), bool)
    kept[order[np.unique(value[order], return_index=True)[1]]] = True
    if kept.all():
        return image, np.zeros(0, int)
    value = value.copy()
    is_label = value >= 0
    median = cell_size(pieces)
    new = np.flatnonzero(~kept & is_label & (size >= max(_CELL * median, _CELL_PIXELS)))
    parents = value[new]
    value[new] = n_labels + np.arange(len(new))
    kept[new] = True
    if keep_holes:
        # A large bay that closing the gaps cut off from the exterior is a hole too.
        holes = np.flatnonzero(~kept & (size >= _SPECK * median))
        value[holes] = min(FIRST_HOLE, int(value.min()) - 1) - np.arange(len(holes))
        kept[holes] = True
    value = _joined(pieces.piece, value, kept, periodic)
    return value[pieces.piece].astype(image.dtype), parents


def _joined(
    piece: Int[np.ndarray, "rows columns"],
    value: Int[np.ndarray, " pieces"],
    kept: Bool[np.ndarray, " pieces"],
    periodic: bool,
) -> Int[np.ndarray, " pieces"]:
    """The values of the pieces, where those not kept take that of the neighbour of the longest interface."""
    a, b = piece[:, :-1].ravel(), piece[:, 1:].ravel()
    c, d = piece[:-1].ravel(), piece[1:].ravel()
    pairs = [np.stack([a, b])[:, a != b], np.stack([c, d])[:, c != d]]
    if periodic:
        pairs += [np.stack([piece[:, -1], piece[:, 0]]), np.stack([piece[-1], piece[0]])]
    a, b = np.concatenate(pairs, axis=1)
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    while not kept.all():  # a piece among pieces waits until a neighbour has a value
        use = ~kept[a] & kept[b]
        joining, into = longest_interface(a[use], value[b[use]])
        value[joining] = into
        kept[joining] = True
    return value


def longest_interface(
    a: Int[np.ndarray, " sides"], b: Int[np.ndarray, " sides"]
) -> tuple[Int[np.ndarray, " distinct"], Int[np.ndarray, " distinct"]]:
    """For each number in `a`, the number in `b` paired with it most often (or the smallest)."""
    pairs, counts = np.unique(np.stack([a, b]), axis=1, return_counts=True)
    order = np.lexsort((pairs[1], -counts, pairs[0]))
    first = order[np.unique(pairs[0][order], return_index=True)[1]]
    return pairs[0][first], pairs[1][first]


def numbered(
    image: Int[np.ndarray, "rows columns"], n_labels: int
) -> tuple[Int[np.ndarray, "rows columns"], int]:
    """The image with holes numbered from `n_labels` on and the exterior after them, and the exterior."""
    codes = np.unique(image)
    holes = codes[codes <= FIRST_HOLE]
    exterior = n_labels + len(holes)
    code = np.zeros(n_labels - int(codes[0]), np.int32)  # negative codes index from its end
    code[np.arange(n_labels)] = np.arange(n_labels)
    code[holes] = n_labels + np.arange(len(holes))
    code[EXTERIOR] = exterior
    return code[image], exterior
