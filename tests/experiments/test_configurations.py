"""Each configuration of the repository runs: here with everything as small as can be."""

import shutil
import warnings
from pathlib import Path

import pytest
from run_helpers import run

from vertax.inference import Microscope
from vertax.initialise import periodic_voronoi

pytestmark = pytest.mark.experiments

CONFIGS = Path(__file__).parents[2] / "configs"
WINGS = Path(__file__).parents[3] / "shared" / "data" / "wings"

# Changes of each configuration, separated by spaces.
SHORT = {
    "adhesions_from_movie": "model.across=4 duration=12 forecast=1 every=2 seeds=2",
    "adjoint_scaling": "methods=['Adj-ID','EP'] sizes=[8] epochs=1",
    "benchmark_adjoints": (
        "replicates=2 tissue.n_cells=8 methods=['Adj-ID','EP'] least_squares_steps=2 "
        "paper.fit.epochs=2 equilibrium.fit.epochs=2"
    ),
    "cell_diffusion": "shape_factors=[3.4,3.9] speeds=[0.5] tissue.n_cells=9 duration=5",
    "cell_sorting": (
        "tests=['sorting'] duration=2 interval=1 replicates=2 sizes=[4] timed_steps=4 "
        "model.across=4 vtk=true"
    ),
    "compare_conditions": (
        "images=1 tissue.n_cells=49 microscope.pixels=240 microscope.snr=[20] "
        "preparation.pixels=96 fit.epochs=2"
    ),
    "convergent_extension": "n_cells=[6] targets=[1.75] replicates=1 start.epochs=2 fit.epochs=2",
    "demo": "tissue.n_cells=6 image.pixels=48 fit.epochs=2",
    "design_mechanics": "tissue.n_cells=6 fit.epochs=2",
    "design_moduli": "tissue.n_cells=6 fit.epochs=2",
    "double_optimisation": (
        "shape_factors=[3.5,3.6,3.7] replicates=2 tissue.n_cells=6 fit.epochs=2"
    ),
    "extend_box": "n_cells=[6] targets=[1.2] replicates=1 start.epochs=2 fit.epochs=2",
    "external_tensions": "tissue.n_cells=6 fit.epochs=2",
    "hypergradient_accuracy": (
        "replicates=2 tissue.n_cells=8 paper.fit.epochs=2 tolerances=[1e-6] betas=[1e-5] "
        "cost_betas=[1e-2] fitted_betas=[1.0]"
    ),
    "infer_from_microscopy": "image.pixels=96 fit.epochs=2",
    "infer_shape_factors": "tissue.n_cells=6 fit.epochs=2",
    "infer_tensions": "cluster.n_cells=6 cluster.pixels=200",
    "inference_across_topologies": (
        "replicates=1 least_mismatch=2 tissue.n_cells=12 fit.epochs=2 "
        'methods=[{name="guided",distance="centroids",guided=true}]'
    ),
    "movement_checks": (
        "tissue.n_cells=9 quenched.n_cells=9 halvings=2 noise_steps=100 tolerances=[1e-2,1e-3]"
    ),
    "oscillatory_shear": "frequencies=[1,10] steps=8 cycles=1 n_cells=0",
    "cyclic_rheology": "n_cells=4 steps=8 refinement=1 epochs=2",
    "paper_benchmark": "tissue.n_cells=6 fit.epochs=2",
    "rigidity_transition": (
        "shape_factors=[3.4,4.1] replicates=2 tissue.n_cells=12 driving.cycles=1 resamples=10"
    ),
    "shear_stiffening": "replicates=1 excess=[0.01] tissue.n_cells=9",
    "salt_and_pepper": (
        "boundaries=['free'] n_types=[2] replicates=1 tissue.n_cells=7 fit.epochs=2"
    ),
    "posterior_calibration": (
        "replicates=2 image_replicates=2 n_cells=6 pixels=24 draws=7 warmup=20 cost_sizes=[6] "
        "cost_draws=20"
    ),
    "proliferation": "duration=4 frames=4 room=12 divisions=2 animation=false",
    "curved_analysis": "foams=1 n_cells=8 pixels=160 slopes=[0.5] tubes=1 circumference=4",
    "erk_waves": "columns=6 duration=0.6 frames=12 substeps=1",
    "turing_growth": "founders=4 room=8 duration=1 frames=3 animation=false",
    "chemotaxis": (
        "n_cells=3 duration=0.4 frames=3 substeps=1 factors=[0.0,1.0] replicates=1 animation=false"
    ),
    "wound_signal": "n_cells=16 duration=0.2 frames=3 substeps=1 diffusion=[1.0]",
    "tensions_from_movie": "substeps=10 cluster.n_cells=7 cluster.frames=3",
    "timed_elongation": (  # with contacts compiling takes minutes
        "n_cells=5 frames=3 substeps=1 knots=2 fit.epochs=2 relaxation.contacts=false"
    ),
    "tissue_moduli": "shape_factors=[3.5,3.7] replicates=2 tissue.n_cells=9",
    "trained_stresses": "trained=[1,4] replicates=1 tissue.n_cells=4 fit.epochs=2",
    "wing_posteriors": "wings=1 draws=20 warmup=60 synthetic_noise=[0.01]",
    "random_walk": "frames=40 replicates=3",
    "monolayer": "duration=4 frames=4 room=12 divisions=2",
    "wound_healing": "columns=8 rows=8 frames=12 duration=1",
}


def test_every_configuration_is_here():
    assert sorted(SHORT) == sorted(path.stem for path in CONFIGS.glob("*.toml"))


@pytest.fixture(scope="module")
def micrograph(tmp_path_factory):
    """An image in a file."""
    import jax
    import numpy as np
    from PIL import Image

    tissue = periodic_voronoi(25, key=jax.random.key(0), lloyd_steps=2)
    image = Microscope(pixels=160, psf_width=2.5, background=0.1)(tissue, key=jax.random.key(1))
    path = tmp_path_factory.mktemp("micrograph") / "membranes.png"
    Image.fromarray((200 * image / image.max()).astype(np.uint8)).save(path)
    return path


@pytest.mark.slow  # other tests run every experiment; these run its file
@pytest.mark.parametrize("name", SHORT)
def test_a_configuration_runs(name, tmp_path, micrograph):
    if name == "external_tensions" and shutil.which("evolver") is None:
        pytest.skip("Surface Evolver is not installed: apt-get install evolver-nox")
    if name == "wing_posteriors" and not WINGS.exists():
        pytest.skip("the folder shared/data/wings is not there")
    data = {"infer_from_microscopy": f"image.path={micrograph}", "wing_posteriors": f"data={WINGS}"}
    changes = [data[name]] if name in data else []
    with warnings.catch_warnings():
        if name == "wing_posteriors":
            # A wing has short edges, and proposals of a short chain include energies without a minimum.
            warnings.filterwarnings("ignore", r"\d+ of 40 (trajectories|draws)", UserWarning)
        _, metrics = run(CONFIGS / f"{name}.toml", tmp_path / "run", *SHORT[name].split(), *changes)
    assert metrics
