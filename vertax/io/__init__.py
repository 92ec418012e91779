"""Files: tissues, energies, problems, trajectories; tables and formats of other programs."""

from vertax._base.pixels import pixel_sides as pixel_sides
from vertax.io._bounded_tables import BoundedTables as BoundedTables
from vertax.io._chaste import write_chaste as write_chaste
from vertax.io._data_tables import (
    append_parquet as append_parquet,
    cell_table as cell_table,
    edge_table as edge_table,
    write_csv as write_csv,
    write_rows as write_rows,
)
from vertax.io._edge_table import from_edge_table as from_edge_table
from vertax.io._force_inference import read_force_inference as read_force_inference
from vertax.io._geojson import write_geojson as write_geojson
from vertax.io._image import read_image as read_image, read_stack as read_stack
from vertax.io._module_file import load as load, save as save
from vertax.io._pixel_size import pixel_aspect as pixel_aspect, pixel_size as pixel_size
from vertax.io._read_geojson import read_geojson as read_geojson
from vertax.io._read_table import read_table as read_table
from vertax.io._surface_evolver import Foam as Foam, read_surface_evolver as read_surface_evolver
from vertax.io._tables import Tables as Tables, from_tables as from_tables, to_tables as to_tables
from vertax.io._tyssue import from_tyssue as from_tyssue
from vertax.io._vtk import write_vtk as write_vtk
from vertax.io._vtk_series import write_vtk_series as write_vtk_series
