"""Ways to make a first tissue."""

from vertax.initialise._voronoi import hexagonal as hexagonal, periodic_voronoi as periodic_voronoi
