"""The public names at the top of vertax. (Those of packages are the ones in docs/reference.)"""

import importlib.metadata

import vertax as vx

# Public names. Removing one is a breaking change.
NAMES = """
AbstractActivity AbstractBoundary AbstractCost AbstractDissipation AbstractEnergy
AbstractLocalEnergy AbstractResponse AbstractTransitions AutomaticDifferentiation Checkpoint
Equilibrium EquilibriumPropagation Evaluation Evolution External Fit FitError Free
GradientOutcome History ImplicitDifferentiation InverseProblem MINRES Periodic RESULTS Record
Relaxation T1 T2 Tissue Topology Uncertainty activities adjoints animate bayes costs dissipations
dynamics enable_compilation_cache energies equilibrate evolve external
fit fitting growth inference initialise io load map_tasks mechanics mesh plot_history plot_recovery
plot_tissue plotting relax runs save signals solvers surfaces tensions transitions uncertainty
"""


def test_top_level_names():
    assert sorted(dir(vx)) == NAMES.split()
    assert all(hasattr(vx, name) for name in NAMES.split())


def test_version_agrees_with_the_package_metadata():
    assert vx.__version__ == importlib.metadata.version("vertax")


def test_import_does_not_change_settings_of_jax():
    import subprocess
    import sys

    code = (
        "import jax; before = dict(jax.config.values); import vertax; import vertax.jobs; "
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
