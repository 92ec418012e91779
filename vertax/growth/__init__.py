"""Growth: tissues in which cells grow, divide and die, with their lineage."""

from vertax.growth._grow import Grown as Grown, grow as grow
from vertax.growth._life_cycle import (
    AbstractLifeCycle as AbstractLifeCycle,
    Cells as Cells,
    GrowAndDivide as GrowAndDivide,
)
from vertax.growth._lineage import Lineage as Lineage
from vertax.growth._score import score_function as score_function
