"""The public names of vertax."""

import importlib.metadata

import vertax as vx

# Public names. Removing one is a breaking change.
NAMES = """
AbstractActivity AbstractBoundary AbstractCost AbstractDissipation AbstractEnergy
AbstractLocalEnergy AbstractResponse AbstractTransitions AutomaticDifferentiation Checkpoint
Equilibrium EquilibriumPropagation Evaluation Evolution External Fit FitError Free
GradientOutcome History ImplicitDifferentiation InverseProblem MINRES Periodic RESULTS Record
Relaxation T1 T2 Tissue Topology Uncertainty activities adjoints animate bayes costs dissipations
dynamics enable_compilation_cache enable_fast_compilation energies equilibrate evolve external
fit fitting growth inference initialise io load_tissue map_tasks mechanics mesh plot_history plot_recovery
plot_tissue plotting relax runs save_tissue signals solvers surfaces tensions transitions uncertainty
"""

PACKAGES = {
    "activities": "AbstractActivity FluctuatingTensions Push SelfPropulsion Sum ThermalNoise",
    "adjoints": "AbstractAdjoint AutomaticDifferentiation EquilibriumPropagation GradientOutcome "
    "ImplicitDifferentiation",
    "bayes": "Laplace LogPosterior Posterior evidence sample",
    "costs": "AbstractCost AbstractLeastSquaresCost Anisotropy AspectRatio BulkModulus CellAreas "
    "CellStress CentroidDistance EdgeDistance Frames HomotypicLength IndexAwareStructural "
    "MeanShapeFactor MeshImage ShearModulus SpectralGap Stress VertexDistance WeightedSum "
    "adjacency aspect_ratio matching_vertices mirror mismatched_neighbours render",
    "dissipations": "AbstractDissipation AbstractViscosity AreaViscosity EdgeViscosity "
    "PerimeterViscosity SubstrateFriction Sum ViscositySum",
    "energies": "Ablated AbstractEnergy AbstractLocalEnergy AreaElasticity BoundedTension "
    "LineTension LocalSum PerimeterElasticity ShapeFactorEnergy Sum TypeTension by_type foam_energy",
    "fitting": "Checkpoint Evaluation Fit FitError History InverseProblem Record Uncertainty fit "
    "fit_warnings limits member stack stack_fits uncertainty",
    "growth": "AbstractLifeCycle Cells GrowAndDivide Grown Lineage grow score_function",
    "inference": "Event Micrograph Microscope Movie MovieFit PinnedEnergy Repair Scene fit_movie "
    "label_image labels_on_sphere micrograph_problem movie_from_table pearson relative_error same_neighbours "
    "shape_factor_scene",
    "initialise": "AbstractSegmenter Cellpose Courses MaskChange MaskReport PolygonTissue "
    "Segmentation Watershed "
    "free_voronoi from_labels from_microscopy from_polygons hexagonal labels_from_skeleton "
    "periodic_voronoi",
    "io": "BoundedTables Foam Tables append_parquet cell_table edge_table from_edge_table from_tables "
    "from_tyssue load_energy load_problem load_tissue load_trajectory pixel_aspect pixel_sides pixel_size "
    "read_force_inference "
    "read_geojson read_image read_stack read_surface_evolver read_table save_energy save_problem save_tissue "
    "save_trajectory to_tables write_chaste write_csv write_geojson write_rows write_vtk "
    "write_vtk_series",
    "mechanics": "BoxRelaxation Modes Ramp SelfStress bulk_modulus cell_stress compatibility "
    "complex_modulus deformed density_of_states elastic_tensor modes pressures "
    "principal pure_shear ramp recoil self_stresses shear_modulus simple_shear "
    "spectrum stress tensions velocities youngs_modulus zero_modes",
    "mesh": "AbstractBoundary Arcs Drawing Free Geometry Overlaps Periodic Tissue Topology Trajectory "
    "angle_of_area cell_polygons crossed_sides geometry_of pad",
    "plotting": "INK SERIES animate animate_figures cell_polygons flipped_edges house_style label_colours "
    "new_figure plot_density_of_states plot_history plot_image "
    "plot_mode plot_moduli plot_recovery plot_stress plot_stress_strain plot_surface plot_tensions "
    "plot_tissue plot_tissues scale_bar tension_layer",
    "dynamics": "Evolution Evolved Material PIController evolve",
    "external": "AbstractSimulator Edges External Ledger Relaxed SimulatorError SurfaceEvolver "
    "run_program",
    "signals": "AbstractReaction CellGeometry Signals",
    "relax": "AbstractResponse Equilibrium Relaxation equilibrate record_relaxation",
    "solvers": "AbstractIteration AbstractSolver Direct FIRE GradientDescent LBFGS MINRES NewtonCG Optax "
    "Progress Scales TruncatedCG VertexTrustRegion Wrapped",
    "surfaces": "AbstractSurface Cylinder Graph HeightMap SphericalCap",
    "tensions": "CurvedGeometry EdgeMotion InferredTensions MaskFrame MotionFit TensionsOfMasks find_masks "
    "infer_tensions infer_tensions_of_masks read_mask",
    "transitions": "AbstractTransitions Change InTurn T1 T2 ablate divide remove",
}


def public(module):
    # The import hook of jaxtyping, which checks types in tests, adds this name.
    return sorted(n for n in vars(module) if not n.startswith("_") and n != "jaxtyping")


def test_top_level_names():
    assert sorted(dir(vx)) == NAMES.split()
    assert all(hasattr(vx, name) for name in NAMES.split())


def test_version_agrees_with_the_package_metadata():
    assert vx.__version__ == importlib.metadata.version("vertax")


def test_names_of_packages():
    for package, names in PACKAGES.items():
        assert public(getattr(vx, package)) == names.split(), package


def test_import_does_not_change_settings_of_jax():
    import subprocess
    import sys

    code = (
        "import jax; before = dict(jax.config.values); import vertax; import vertax.jobs; "
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
