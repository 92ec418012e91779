"""Files: tissues, energies, inverse problems and trajectories; and for other programs."""

from vertax._base.atomic import atomic_write as atomic_write
from vertax.io._bounded_tables import BoundedTables as BoundedTables
from vertax.io._data_tables import (
    cell_table as cell_table,
    edge_table as edge_table,
    write_csv as write_csv,
)
from vertax.io._geojson import write_geojson as write_geojson
from vertax.io._image import pixel_aspect as pixel_aspect, read_image as read_image
from vertax.io._module_file import (
    load_energy as load_energy,
    load_problem as load_problem,
    save_energy as save_energy,
    save_problem as save_problem,
)
from vertax.io._surface_evolver import (
    Foam as Foam,
    read_surface_evolver as read_surface_evolver,
)
from vertax.io._tables import Tables as Tables, from_tables as from_tables, to_tables as to_tables
from vertax.io._tissue_file import load_tissue as load_tissue, save_tissue as save_tissue
from vertax.io._trajectory import (
    load_trajectory as load_trajectory,
    save_trajectory as save_trajectory,
)
from vertax.io._vtk import write_vtk as write_vtk
from vertax.io._vtk_series import write_vtk_series as write_vtk_series
