"""Activities: forces and noise that are not the gradient of an energy."""

from vertax.activities._activity import AbstractActivity as AbstractActivity, Sum as Sum
from vertax.activities._noise import ThermalNoise as ThermalNoise
from vertax.activities._propulsion import SelfPropulsion as SelfPropulsion
from vertax.activities._push import Push as Push
from vertax.activities._tensions import FluctuatingTensions as FluctuatingTensions
