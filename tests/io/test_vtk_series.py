"""VTK time series for ParaView."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

import vertax as vx
from vertax.inference import movie_from_table
from vertax.io import read_table, write_vtk_series


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


@pytest.mark.thorough
def test_a_series_is_read_as_a_movie(tmp_path):
    pytest.importorskip("meshio")
    tissue = vx.initialise.periodic_voronoi(16, key=0)
    trajectory = vx.mesh.Trajectory()
    for time in (0.0, 0.25, 0.5):
        trajectory.append(tissue.with_vertices(tissue.vertices + time), time=time)
    kind = np.tile(np.arange(16), (3, 1))
    write_vtk_series(tmp_path / "movie.pvd", trajectory, cells={"type": kind})
    back = movie_from_table(tmp_path / "movie.pvd", box=tissue.boundary.lattice)
    np.testing.assert_array_equal(back.times, [0, 0.25, 0.5])
    np.testing.assert_array_equal(back.types, np.arange(16))
    assert back.events == ()
    assert back.frame(2).n_vertices == tissue.n_vertices
    np.testing.assert_allclose(back.frame(2).areas, tissue.areas, rtol=1e-12)


def test_free_tissues_are_read_from_one_file(tmp_path):
    """Cells that are not convex are triangles in the file."""
    pytest.importorskip("meshio")
    tissue = vx.initialise.free_voronoi(9, key=2)
    vx.io.write_vtk(tmp_path / "tissue.vtu", tissue, points_per_arc=200)
    table = read_table(tmp_path / "tissue.vtu") | {}
    again = {name: np.concatenate([values, values]) for name, values in table.items()}
    again["frame"] = np.repeat([0, 1], len(table["x"]))
    again["time"] = again["frame"]
    back = movie_from_table(again)
    np.testing.assert_allclose(back.frame(0).areas, tissue.areas, rtol=1e-3)


SQUARES = """<VTKFile type="UnstructuredGrid" version="2.2" byte_order="LittleEndian">
<UnstructuredGrid><Piece NumberOfPoints="6" NumberOfCells="2"><Points>
<DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 2 0 0 0 1 0 1 1 0 2 1 0</DataArray></Points><Cells>
<DataArray type="Int64" Name="connectivity" format="ascii">0 1 4 3 1 2 5 4</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4 8</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">7 7</DataArray></Cells><CellData>
<DataArray type="Float64" Name="Cell IDs" format="ascii">3 8</DataArray>
<DataArray type="Float64" Name="Cell labels" format="ascii">0 5</DataArray></CellData>
</Piece></UnstructuredGrid></VTKFile>"""


def test_polygons_as_text(tmp_path):
    """As other programs write them, with the names of columns of Chaste and a version of VTK 9."""
    pytest.importorskip("meshio")
    (tmp_path / "squares.vtu").write_text(SQUARES)
    table = read_table(tmp_path / "squares.vtu")
    np.testing.assert_array_equal(table["cell"], [3] * 4 + [8] * 4)
    np.testing.assert_array_equal(table["type"], [0] * 4 + [5] * 4)
    np.testing.assert_array_equal(table["x"], [0, 1, 1, 0, 1, 2, 2, 1])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1 0 2 1 0<", "1 0 2 1 1<", "its points have different z"),
        (">7 7<", ">3 3<", "it has no polygons"),
        (">7 7<", ">10 10<", "it has tetra"),
        ("0 1 4 3 1 2 5 4", "0 1 x", "cannot be read"),
        ("</VTKFile>", "", "cannot be read"),
        ("</UnstructuredGrid>", "<Piece/></UnstructuredGrid>", "it has several pieces"),
    ],
)
def test_other_grids_are_refused(tmp_path, old, new, message):
    pytest.importorskip("meshio")
    (tmp_path / "squares.vtu").write_text(SQUARES.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "squares.vtu")


def test_collections_without_files_are_refused(tmp_path):
    (tmp_path / "movie.pvd").write_text("<VTKFile><Collection/></VTKFile>")
    with pytest.raises(ValueError, match="it lists no file"):
        read_table(tmp_path / "movie.pvd")
    (tmp_path / "movie.pvd").write_text("<VTKFile>")
    with pytest.raises(ValueError, match="its text is broken"):
        read_table(tmp_path / "movie.pvd")
