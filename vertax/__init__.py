"""A differentiable vertex model of epithelial tissue, on JAX and Equinox."""

from vertax import initialise as initialise
from vertax._boundary import AbstractBoundary as AbstractBoundary, Periodic as Periodic
from vertax._tissue import Tissue as Tissue
from vertax._topology import Topology as Topology
