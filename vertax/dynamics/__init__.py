"""Dynamics: overdamped motion in time."""

from vertax.dynamics._evolution import Evolution as Evolution, evolve as evolve
from vertax.dynamics._evolved import Evolved as Evolved
from vertax.dynamics._material import Material as Material
from vertax.dynamics._pi_controller import PIController as PIController
