"""Growth: cell growth, division and death, with the cell lineage."""

from vertax.growth._grow import grow as grow
from vertax.growth._grown import Grown as Grown
from vertax.growth._life_cycle import (
    AbstractLifeCycle as AbstractLifeCycle,
    Cells as Cells,
    GrowAndDivide as GrowAndDivide,
)
from vertax.growth._lineage import Lineage as Lineage
from vertax.growth._score import score_function as score_function
