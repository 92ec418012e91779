"""Initial tissues: Voronoi, hexagonal, and from label images and micrographs."""

from vertax.initialise._free import free_voronoi as free_voronoi
from vertax.initialise._labels import (
    Courses as Courses,
    Segmentation as Segmentation,
    from_labels as from_labels,
)
from vertax.initialise._microscopy import from_microscopy as from_microscopy
from vertax.initialise._polygons import (
    PolygonTissue as PolygonTissue,
    from_polygons as from_polygons,
)
from vertax.initialise._report import MaskChange as MaskChange, MaskReport as MaskReport
from vertax.initialise._segmenters import (
    Cellpose as Cellpose,
    Segmenter as Segmenter,
    Watershed as Watershed,
)
from vertax.initialise._skeleton import labels_from_skeleton as labels_from_skeleton
from vertax.initialise._voronoi import hexagonal as hexagonal, periodic_voronoi as periodic_voronoi
