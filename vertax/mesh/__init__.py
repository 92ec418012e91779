"""The mesh: connectivity, positions, boundary and geometry of a tissue."""

from vertax.mesh._boundary import (
    AbstractBoundary as AbstractBoundary,
    Free as Free,
    Periodic as Periodic,
)
from vertax.mesh._outlines import cell_polygons as cell_polygons
from vertax.mesh._overlaps import Overlaps as Overlaps
from vertax.mesh._padding import pad as pad
from vertax.mesh._tissue import Tissue as Tissue
from vertax.mesh._topology import Topology as Topology
from vertax.mesh._trajectory import Trajectory as Trajectory
