"""Transitions: how a mesh changes its topology."""

from vertax.transitions._t1 import T1 as T1
from vertax.transitions._transitions import AbstractTransitions as AbstractTransitions
