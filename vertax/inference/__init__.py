"""Parameters from images and movies, synthetic data, and measures of accuracy."""

from vertax.inference._micrograph import (
    Micrograph as Micrograph,
    PinnedEnergy as PinnedEnergy,
    micrograph_problem as micrograph_problem,
)
from vertax.inference._microscope import Microscope as Microscope, label_image as label_image
from vertax.inference._movie import Event as Event, Movie as Movie, Repair as Repair
from vertax.inference._movie_fit import MovieFit as MovieFit, fit_movie as fit_movie
from vertax.inference._movie_table import movie_from_table as movie_from_table
from vertax.inference._recovery import (
    pearson as pearson,
    relative_error as relative_error,
    same_neighbours as same_neighbours,
)
from vertax.inference._scene import (
    Scene as Scene,
    shape_factor_scene as shape_factor_scene,
)
from vertax.inference._sphere import labels_on_sphere as labels_on_sphere
