"""Costs: objectives of inference and design, evaluated at an equilibrium."""

from vertax.costs._aspect import AspectRatio as AspectRatio, aspect_ratio as aspect_ratio
from vertax.costs._cells import CellAreas as CellAreas, MeanShapeFactor as MeanShapeFactor
from vertax.costs._cost import (
    AbstractCost as AbstractCost,
    AbstractLeastSquaresCost as AbstractLeastSquaresCost,
    WeightedSum as WeightedSum,
)
from vertax.costs._frames import Frames as Frames
from vertax.costs._image import MeshImage as MeshImage, mirror as mirror, render as render
from vertax.costs._interfaces import HomotypicLength as HomotypicLength
from vertax.costs._mechanics import (
    Anisotropy as Anisotropy,
    BulkModulus as BulkModulus,
    CellStress as CellStress,
    ShearModulus as ShearModulus,
    SpectralGap as SpectralGap,
    Stress as Stress,
)
from vertax.costs._positions import (
    CentroidDistance as CentroidDistance,
    EdgeDistance as EdgeDistance,
    VertexDistance as VertexDistance,
    matching_vertices as matching_vertices,
)
from vertax.costs._structure import (
    IndexAwareStructural as IndexAwareStructural,
    adjacency as adjacency,
    mismatched_neighbours as mismatched_neighbours,
)
