"""From images, masks and synthetic data to parameters: what experiments and notebooks call."""

from vertax.inference._find_masks import MaskFrame as MaskFrame, find_masks as find_masks
from vertax.inference._foam import (
    foam_energy as foam_energy,
    foam_terms as foam_terms,
)
from vertax.inference._infer_tensions import infer_tensions as infer_tensions
from vertax.inference._inferred import InferredTensions as InferredTensions
from vertax.inference._many import (
    TensionsOfMasks as TensionsOfMasks,
    infer_tensions_of_masks as infer_tensions_of_masks,
)
from vertax.inference._mask import read_mask as read_mask
from vertax.inference._micrograph import (
    Micrograph as Micrograph,
    PinnedEnergy as PinnedEnergy,
    micrograph_problem as micrograph_problem,
)
from vertax.inference._microscope import Microscope as Microscope, label_image as label_image
from vertax.inference._motion import (
    EdgeMotion as EdgeMotion,
    MovingTensions as MovingTensions,
)
from vertax.inference._movie import Event as Event, Movie as Movie
from vertax.inference._movie_fit import MovieFit as MovieFit, fit_movie as fit_movie
from vertax.inference._movie_table import movie_from_table as movie_from_table
from vertax.inference._recovery import (
    RecoveryWatch as RecoveryWatch,
    pearson as pearson,
    relative_error as relative_error,
    same_neighbours as same_neighbours,
)
from vertax.inference._scene import (
    Scene as Scene,
    shape_factor_scene as shape_factor_scene,
)
from vertax.inference._transition import (
    Transition as Transition,
    fit_onset as fit_onset,
    fit_transition as fit_transition,
)
