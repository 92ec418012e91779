"""Files of one tissue."""

from __future__ import annotations

import os
from collections.abc import Iterable

import equinox as eqx

from vertax.io._module_file import load_module, save_module
from vertax.mesh import Tissue


def save_tissue(path: str | os.PathLike[str], tissue: Tissue) -> None:
    """Save a tissue to a file, exactly: every number keeps its bits and its precision.

    The format is that of [`save_energy`][vertax.io.save_energy]; other programs find the vertices as
    `data.vertices`, and the [`Topology`][vertax.Topology] as `data.topology.twin`, `data.topology.cell` and
    so on.

    **Arguments:**

    - `path`: the file, by custom with the ending `.npz`; taken as it is.
    - `tissue`: the [`Tissue`][vertax.Tissue].

    **Raises:**

    - `ValueError` for a batch of tissues, and as [`save_energy`][vertax.io.save_energy]: a
        [`Graph`][vertax.surfaces.Graph] is a function, which has no place in a file.
    - `TypeError` if `tissue` is not a tissue.
    - `OSError` if the file cannot be written.
    """
    if isinstance(tissue, Tissue) and tissue.vertices.ndim != 2:
        raise ValueError(
            "Argument `tissue` must be a single tissue, but its vertices have shape "
            f"{tissue.vertices.shape}. Save the members of a batch one by one."
        )
    save_module(path, "tissue", tissue, Tissue)


def load_tissue(
    path: str | os.PathLike[str], *, classes: Iterable[type[eqx.Module]] = ()
) -> Tissue:
    """Load a tissue that [`save_tissue`][vertax.io.save_tissue] wrote.

    **Arguments:**

    - `path`: the file.
    - `classes`: your classes of boundaries and surfaces, see [`load_energy`][vertax.io.load_energy].

    **Returns:** the [`Tissue`][vertax.Tissue], bit for bit as it was saved.

    **Raises:** as [`load_energy`][vertax.io.load_energy], and `ValueError` for a tissue that contradicts
    itself.
    """
    return load_module(path, "tissue", Tissue, classes)
