"""Costs: what we want of an equilibrium."""

from vertax.costs._cost import AbstractCost as AbstractCost
from vertax.costs._cost import WeightedSum as WeightedSum
from vertax.costs._image import MeshImage as MeshImage
from vertax.costs._image import mirror as mirror
from vertax.costs._image import render as render
from vertax.costs._vertices import VertexDistance as VertexDistance
