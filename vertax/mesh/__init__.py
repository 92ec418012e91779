"""The mesh: connectivity, positions, boundary and geometry of a tissue."""

from vertax._base.arcs import angle_of_area as angle_of_area
from vertax.mesh._arcs import Arcs as Arcs
from vertax.mesh._boundary import (
    AbstractBoundary as AbstractBoundary,
    Free as Free,
    Periodic as Periodic,
)
from vertax.mesh._geometry import Geometry as Geometry, geometry_of as geometry_of
from vertax.mesh._outlines import Drawing as Drawing, cell_polygons as cell_polygons
from vertax.mesh._overlaps import Overlaps as Overlaps, crossed_sides as crossed_sides
from vertax.mesh._padding import pad as pad
from vertax.mesh._tissue import Tissue as Tissue
from vertax.mesh._topology import Topology as Topology
from vertax.mesh._trajectory import Trajectory as Trajectory
