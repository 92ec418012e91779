"""Signals: reactions in cells and exchange between them, coupled to mechanics."""

from vertax.signals._reaction import (
    AbstractReaction as AbstractReaction,
    CellGeometry as CellGeometry,
)
from vertax.signals._signals import Signals as Signals
