"""Each public function of a tissue works on a surface, or raises an error that names the surface.

A tilted plane is isometric to the plane: with the coordinate along its slope stretched, all lengths, areas,
energies and forces are those of a flat tissue.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_spare_slots
from test_spare_slots import CASES, CELLS, ENERGY, FIXED_TOPOLOGY, random_tissue

import vertax as vx

SLOPE, STRETCH = 0.75, 1.25  # √(1 + 0.75²)

# These raise an error.
REJECTED = {
    "costs.aspect_ratio",
    "io.to_tables",
    "io.write_geojson",
    "mechanics.BoxRelaxation",
    "mechanics.bulk_modulus",
    "mechanics.complex_modulus",
    "mechanics.deformed",
    "mechanics.elastic_tensor",
    "mechanics.modes",
    "mechanics.modes (sparse)",
    "mechanics.ramp",
    "mechanics.shear_modulus",
    "mechanics.spectrum",
    "mechanics.stress",
    "mechanics.youngs_modulus",
    "mechanics.zero_modes",
    "activities.SelfPropulsion",
}
# These show coordinates of the chart (pictures, files, images), so their results are others than those of the
# flat tissue; or random numbers with one more component. They must run.
IN_CHART = {
    "activities.ThermalNoise",
    "costs.render",
    "inference.label_image",
    "io.write_vtk",
    "plotting.plot_tissue",
    "plotting.plot_mode",
    "plotting.plot_stress",
    "mechanics.compatibility",
    # The axis of the division is the long axis in the chart; a T1 turns an edge by a right angle there.
    "growth.grow",
    "transitions.divide",
    "transitions.remove",
    "mesh.cell_polygons",
    "mesh.geometry_of",
    # Its argument is a force along the coordinates.
    "activities.Push",
}
# The results of these are forces along the coordinates; of the others displacements.
COVECTORS = ("energies.", "activities.", "signals.")
PLACES = {"x", "y", "start_x", "start_y", "end_x", "end_y"}


@pytest.fixture(scope="module")
def tissues():
    """A flat tissue at rest, and the same one on a tilted plane."""
    flat = FIXED_TOPOLOGY(random_tissue(CELLS, 3, lloyd_steps=2), ENERGY).tissue
    return flat, tilted(flat)


def tilted(flat):
    shrink = jnp.array([1 / STRETCH, 1.0])
    box = vx.Periodic(flat.boundary.lattice * shrink)
    surface = vx.surfaces.Graph(_height)
    return vx.Tissue(flat.vertices * shrink, flat.topology, box, flat.softening, surface=surface)


def _height(x):
    return SLOPE * x[0]


def free_on_surface():
    cluster = vx.initialise.free_voronoi(CELLS, key=2, lloyd_steps=2)
    surface = vx.surfaces.Graph(_height)
    return vx.Tissue(cluster.vertices, cluster.topology, cluster.boundary, surface=surface)


FREE_CALLS = {
    "costs.aspect_ratio": vx.costs.aspect_ratio,
    "inference.label_image": lambda t: vx.inference.label_image(t, 40),
    "tensions.infer_tensions": lambda t: vx.tensions.infer_tensions(t).tensions,
}


def invariants(result, name, tissue):
    """The numbers in a result that do not depend on the chart."""
    factors = np.array([1.0 if tissue.surface is None else STRETCH, 1.0])
    factors = 1 / factors if name.startswith(COVECTORS) else factors
    if isinstance(result, dict):
        result = {column: values for column, values in result.items() if column not in PLACES}
    is_tissue = lambda x: isinstance(x, vx.Tissue)
    for leaf in jax.tree.leaves(result, is_leaf=is_tissue):
        if is_tissue(leaf):
            yield from (leaf.areas, leaf.perimeters, leaf.edge_lengths, leaf.topology.cell)
        elif np.shape(leaf)[-2:] == (tissue.n_vertices, 2):
            yield np.asarray(leaf) * factors
        else:
            yield np.asarray(leaf)


@pytest.fixture
def same_displacements(monkeypatch):
    """The displacements of the calls are equal in space."""
    in_space = test_spare_slots.of_vertices

    def of_vertices(tissue):
        return in_space(tissue) / ([1, 1] if tissue.surface is None else [STRETCH, 1])

    def shaken(tissue):
        return tissue.with_vertices(tissue.vertices + 0.03 * of_vertices(tissue))

    monkeypatch.setattr(test_spare_slots, "of_vertices", of_vertices)
    monkeypatch.setattr(test_spare_slots, "shaken", shaken)


# (They compile for 3 to 13 seconds; `equilibrate` and `evolve` stay.)
LONG = {
    "costs.matching_vertices",
    "costs.render",
    "growth.grow",
    "mechanics.recoil",
    "mechanics.velocities",
    "relax.record_relaxation",
    "transitions.T1",
    "transitions.T2",
    "transitions.ablate",
    "signals.Signals",
}


@pytest.mark.parametrize("name", sorted(REJECTED))
def test_functions_without_a_meaning_on_a_surface_name_it(tissues, name):
    tissue, call = (
        (free_on_surface(), FREE_CALLS[name]) if name in FREE_CALLS else (tissues[1], CASES[name])
    )
    with pytest.raises(ValueError, match="surface"):
        call(tissue)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.thorough) if name in LONG else name
        for name in sorted(set(CASES) - REJECTED)
    ],
)
def test_results_on_a_tilted_plane_are_those_of_the_plane(tissues, same_displacements, name):
    if name in FREE_CALLS:
        assert np.nanmax(FREE_CALLS[name](free_on_surface())) > 0
        return
    if name in IN_CHART:
        assert jax.tree.leaves(CASES[name](tissues[1]))
        return
    flat, curved = (list(invariants(CASES[name](t), name, t)) for t in tissues)
    assert len(flat) == len(curved) > 0
    for one, other in zip(flat, curved, strict=True):
        if np.asarray(one).dtype.kind in "fc":
            np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-7)
        else:
            np.testing.assert_array_equal(other, one)
