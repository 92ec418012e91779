"""Costs: what we want of an equilibrium."""

from vertax.costs._cost import (
    AbstractCost as AbstractCost,
    AbstractLeastSquaresCost as AbstractLeastSquaresCost,
    WeightedSum as WeightedSum,
)
from vertax.costs._image import MeshImage as MeshImage, mirror as mirror, render as render
from vertax.costs._vertices import VertexDistance as VertexDistance
