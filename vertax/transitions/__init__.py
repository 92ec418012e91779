"""Changes of topology: T1 and T2 transitions, division, removal and ablation of cells."""

from vertax.transitions._ablation import ablate as ablate
from vertax.transitions._change import Change as Change
from vertax.transitions._division import divide as divide
from vertax.transitions._removal import remove as remove
from vertax.transitions._t1 import T1 as T1
from vertax.transitions._t2 import T2 as T2
from vertax.transitions._transitions import (
    AbstractTransitions as AbstractTransitions,
    InTurn as InTurn,
)
