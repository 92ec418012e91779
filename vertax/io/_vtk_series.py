"""VTK time series of trajectories, for ParaView."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vertax._base.atomic import atomic_write
from vertax.io._data_tables import Column
from vertax.io._vtk import write_vtk
from vertax.mesh import Trajectory


def write_vtk_series(
    path: str | os.PathLike[str],
    trajectory: Trajectory,
    *,
    cells: Mapping[str, Column] | None = None,
    points_per_arc: int = 24,
) -> None:
    """Write the frames of a trajectory for ParaView: a `.pvd` file, and a `.vtu` file for each frame.

    The times are the values `time` of the trajectory, if it has them (as from
    [`evolve`][vertax.evolve]), or else the numbers of the frames. The `.pvd` file is written last.

    ```python
    movie = vx.evolve(tissue, energy, friction, times)
    vx.io.write_vtk_series("movie.pvd", movie.trajectory)  # and movie_0000.vtu, …
    ```

    **Arguments:**

    - `path`: the file, which ends in `.pvd`.
    - `trajectory`: with at least one frame.
    - `cells`: more numbers of the cells by name, shape `(frames, cells)`.
    - `points_per_arc`: number of straight pieces of an arc.

    **Raises:**

    - `ValueError` for another ending, no frame, values with another number of rows, and as
        [`write_vtk`][vertax.io.write_vtk].
    - `ImportError` if meshio is not installed: `pip install -e ".[files]"`.
    """
    path = Path(path)
    if path.suffix != ".pvd":
        raise ValueError(f"Argument `path` must end in .pvd, but is {os.fspath(path)!r}.")
    if len(trajectory) == 0:
        raise ValueError("Argument `trajectory` must have at least one frame, but is empty.")
    columns = {name: np.asarray(values) for name, values in (cells or {}).items()}
    for name, values in columns.items():
        if values.ndim != 2 or len(values) != len(trajectory):
            raise ValueError(
                f"Column `{name}` must have a row for each of {len(trajectory)} frames, but its shape is "
                f"{values.shape}."
            )
    times = trajectory.values.get("time", np.arange(len(trajectory)))
    root = ET.Element("VTKFile", type="Collection", version="0.1")
    collection = ET.SubElement(root, "Collection")
    for number, (frame, time) in enumerate(zip(trajectory, times, strict=True)):
        place = path.with_name(f"{path.stem}_{number:04d}.vtu")
        now = {name: values[number] for name, values in columns.items()}
        write_vtk(place, frame, cells=now, points_per_arc=points_per_arc)
        ET.SubElement(collection, "DataSet", timestep=repr(float(time)), part="0", file=place.name)
    ET.indent(root)
    with atomic_write(path) as file:
        file.write(ET.tostring(root, encoding="unicode", xml_declaration=True))
