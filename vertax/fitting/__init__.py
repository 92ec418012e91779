"""Inverse problems: find parameters such that the equilibrium minimises a cost."""

from vertax._base.batch import stack as stack
from vertax._base.checkpoints import Checkpoint as Checkpoint
from vertax.fitting._batch import member as member, stack_fits as stack_fits
from vertax.fitting._convergence import fit_warnings as fit_warnings, limits as limits
from vertax.fitting._fit import fit as fit
from vertax.fitting._history import (
    Fit as Fit,
    FitError as FitError,
    History as History,
    Record as Record,
)
from vertax.fitting._inverse import (
    Evaluation as Evaluation,
    InverseProblem as InverseProblem,
)
from vertax.fitting._uncertainty import Uncertainty as Uncertainty, uncertainty as uncertainty
