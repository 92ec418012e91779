"""Curved surfaces on which a tissue lies."""

from vertax.surfaces._height_map import HeightMap as HeightMap
from vertax.surfaces._shapes import (
    Cylinder as Cylinder,
    Graph as Graph,
    SphericalCap as SphericalCap,
)
from vertax.surfaces._surface import AbstractSurface as AbstractSurface
