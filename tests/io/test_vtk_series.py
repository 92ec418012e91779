"""VTK time series for ParaView."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

import vertax as vx
from vertax.io import write_vtk_series


@pytest.fixture
def movie():
    trajectory = vx.mesh.Trajectory()
    tissue = vx.initialise.periodic_voronoi(6, key=0)
    for time in (0.0, 0.25, 1.0):
        trajectory.append(tissue.with_vertices(tissue.vertices + time), time=time)
    return trajectory


def test_each_time_has_a_file_with_its_frame(tmp_path, movie):
    meshio = pytest.importorskip("meshio")
    strain = np.arange(18.0).reshape(3, 6)
    write_vtk_series(tmp_path / "movie.pvd", movie, cells={"strain": strain})
    sets = ET.parse(tmp_path / "movie.pvd").getroot().findall("Collection/DataSet")
    assert [float(each.attrib["timestep"]) for each in sets] == [0.0, 0.25, 1.0]
    meshes = [meshio.read(tmp_path / each.attrib["file"]) for each in sets]
    for mesh, row in zip(meshes, strain, strict=True):
        np.testing.assert_array_equal(np.concatenate(mesh.cell_data["strain"]), row)
    # Cells have their centroids in the box: each moved by the displacement of the tissue, modulo the box.
    assert len({mesh.points.tobytes() for mesh in meshes}) == 3


def test_bad_input(tmp_path, movie, without_type_checks):
    with pytest.raises(ValueError, match=r"must end in \.pvd"):
        write_vtk_series(tmp_path / "movie.vtu", movie)
    with pytest.raises(ValueError, match="at least one frame"):
        write_vtk_series(tmp_path / "movie.pvd", vx.mesh.Trajectory())
    with pytest.raises(ValueError, match="a row for each of 3 frames"):
        write_vtk_series(tmp_path / "movie.pvd", movie, cells={"strain": np.zeros(6)})
