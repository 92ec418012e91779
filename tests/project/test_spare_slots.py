"""Spare slots change no result: each public function that takes a tissue, with and without them."""

import inspect
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue
from matplotlib.backends.backend_agg import FigureCanvasAgg

import vertax as vx
from vertax import activities, dissipations, energies, mechanics

CELLS, CAPACITY = 9, 12
ENERGY = energies.LocalSum(
    (energies.AreaElasticity(1.0, 1.0), energies.PerimeterElasticity(1.0, 3.4))
)
FRICTION = dissipations.SubstrateFriction(1.0)
VISCOSITY = FRICTION + dissipations.EdgeViscosity(0.5)
GRADIENT = jnp.array([[1.02, 0.05], [0.01, 0.97]])


@pytest.fixture(scope="module")
def tissues():
    """A tissue at rest, and the same one with spare slots."""
    plain = FIXED_TOPOLOGY(random_tissue(CELLS, 3, lloyd_steps=2), ENERGY).tissue
    return plain, plain.with_capacity(CAPACITY)


def rows(tissue, per_cell):
    """An array with entries for each cell (2 per vertex, 3 per edge) of a tissue."""
    n = tissue.n_cells * per_cell
    return 1 + 0.3 * np.cos(np.arange(CAPACITY * per_cell))[:n]


def of_cells(tissue):
    return rows(tissue, 1)


def of_edges(tissue):
    return rows(tissue, 3)


def of_vertices(tissue):
    return np.stack([rows(tissue, 2), -rows(tissue, 2)], axis=-1)


def shaken(tissue):
    return tissue.with_vertices(tissue.vertices + 0.03 * np.sin(3 * of_vertices(tissue)))


# (`of_vertices` and `shaken` are called outside of jit: another test replaces them.)
def dissipated(make):
    power = jax.jit(lambda tissue, later: make(tissue)(later, tissue, 0.1))

    def run(tissue):
        moves = tissue.topology.alive_vertices[:, None]
        return power(
            tissue, tissue.with_vertices(tissue.vertices + 0.01 * moves * of_vertices(tissue))
        )

    return run


def energy_and_force(make):
    def run(tissue):
        energy = make(tissue)
        value = lambda vertices: energy(tissue.with_vertices(vertices))
        return jax.value_and_grad(value)(tissue.vertices)

    compiled = eqx.filter_jit(run)
    return lambda tissue: compiled(shaken(tissue))


def driven(make):
    """Force and next state of an activity."""

    @jax.jit
    def run(tissue):
        activity, key, dt = make(tissue), jax.random.key(3), jnp.array(0.1)
        state = activity.init(tissue, key)
        energy, state = activity.drive(state, tissue, FRICTION, jnp.array(0.0), dt, key)
        state = activity.finish(state, tissue, tissue)
        return jax.grad(lambda y: energy(tissue.with_vertices(y)))(tissue.vertices), state

    return run


class Root(vx.signals.AbstractReaction):
    """A reaction that is not finite at the concentration 0 of spare slots."""

    def __call__(self, concentrations, cells, time):
        return cells.areas / jnp.sqrt(concentrations)


def reacting(tissue):
    couple = lambda c, tissue: energies.AreaElasticity(1.0, c[0])
    return vx.signals.Signals(Root(), [0.2], initial=of_cells(tissue)[None], couple=couple)


def evolved(tissue):
    run = vx.evolve(tissue, ENERGY, FRICTION, [0.0, 0.1, 0.2], relaxation=FIXED_TOPOLOGY)
    return run.tissue, run.energy, run.frames.vertices


def grown(tissue):
    cycle = vx.growth.GrowAndDivide(0.1, 2.0)
    energy = lambda cells: energies.AreaElasticity(1.0, cells.target_area)
    run = vx.growth.grow(tissue, energy, cycle, [0.0, 0.5], key=0, relaxation=FIXED_TOPOLOGY)
    return run.tissue, run.frames.vertices


def boxed(tissue):
    relaxation = mechanics.BoxRelaxation(relaxation=FIXED_TOPOLOGY)
    return relaxation(shaken(tissue), ENERGY).tissue


def pixels(plot):
    """The pixels of a figure."""

    def draw(tissue):
        canvas = FigureCanvasAgg(plot(tissue).figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())

    return draw


def text(write):
    """The content of a file."""

    def run(tissue):
        with tempfile.TemporaryDirectory() as folder:
            write(f"{folder}/file.vtu", tissue)
            return np.frombuffer(Path(f"{folder}/file.vtu").read_bytes(), np.uint8)

    return run


def free(function):
    """A function of a free tissue with as many cells as a given one."""

    def run(tissue):
        cluster = vx.initialise.free_voronoi(CELLS, key=2, lloyd_steps=2)
        return function(cluster.with_capacity(CAPACITY) if tissue.topology.spare else cluster)

    return run


def with_room(operation):
    """An operation that needs spare slots."""
    return lambda tissue: operation(tissue.with_capacity(max(tissue.n_cells, CELLS + 1)))


def flattened(modes):
    """Values, and participation ratios of the modes that are not translations."""
    return modes.values, modes.participation_ratios[2:]


def extruded(tissue):
    areas = np.where(np.arange(tissue.n_cells) == 2, 0.0, 1.0)
    energy = energies.AreaElasticity(1.0, areas) + energies.PerimeterElasticity(1.0, areas)
    rules = vx.T1() + vx.T2(0.2)
    return vx.Relaxation(transitions=rules, contact_range=None)(tissue, energy).tissue


def ablated(tissue):
    edges, cells = np.arange(tissue.n_edges) == 1, np.arange(tissue.n_cells) == 2
    return vx.transitions.ablate(tissue, ENERGY, edges=edges, cells=cells)[0]


def self_stress(tissue):
    """The space of tensions of edges in equilibrium, and its dimension."""
    stress = mechanics.self_stresses(tissue, ["edge_lengths"])
    return stress.states.T @ stress.states, stress.zero_modes, stress.number


def of_energy(function):
    return eqx.filter_jit(lambda tissue: function(tissue, ENERGY))


# A call of each public function. The results have the entries of spare slots last.
CASES = {
    "equilibrate": lambda t: vx.equilibrate(shaken(t), ENERGY).tissue,
    "evolve": evolved,
    "inference.label_image": free(lambda t: vx.inference.label_image(t, 40)),
    "growth.grow": with_room(grown),
    "costs.adjacency": vx.costs.adjacency,
    "costs.aspect_ratio": free(vx.costs.aspect_ratio),
    "costs.matching_vertices": lambda t: vx.costs.matching_vertices(t, shaken(t)),
    "costs.mismatched_neighbours": lambda t: vx.costs.mismatched_neighbours(t, shaken(t)),
    "costs.render": lambda t: vx.costs.render(t, (8, 8), 0.8),
    "inference.same_neighbours": lambda t: vx.inference.same_neighbours(t, t),
    "io.cell_table": lambda t: vx.io.cell_table(t, number=of_cells(t)),
    "io.edge_table": lambda t: vx.io.edge_table(t, number=of_edges(t)),
    "io.to_tables": lambda t: list(vx.io.to_tables(t)[:3]),
    "io.write_geojson": text(
        lambda path, t: vx.io.write_geojson(path, t, cells={"number": of_cells(t)}, edges={})
    ),
    "io.write_vtk": text(
        lambda path, t: vx.io.write_vtk(path, t, cells={"number": of_cells(t)}, edges={})
    ),
    "mechanics.BoxRelaxation": boxed,
    "mechanics.bulk_modulus": of_energy(mechanics.bulk_modulus),
    "mechanics.cell_stress": of_energy(mechanics.cell_stress),
    "mechanics.compatibility": lambda t: mechanics.compatibility(t, ["edge_lengths"]),
    "mechanics.complex_modulus": lambda t: mechanics.complex_modulus(t, ENERGY, FRICTION, 0.1),
    "mechanics.deformed": lambda t: mechanics.deformed(t, GRADIENT),
    "mechanics.elastic_tensor": of_energy(mechanics.elastic_tensor),
    "mechanics.modes": lambda t: flattened(mechanics.modes(t, ENERGY, 8)),
    "mechanics.modes (sparse)": lambda t: flattened(mechanics.modes(t, ENERGY, 8, method="sparse")),
    "mechanics.pressures": of_energy(mechanics.pressures),
    "mechanics.ramp": lambda t: (
        mechanics.ramp(t, ENERGY, np.array([0.0, 0.02]), relaxation=FIXED_TOPOLOGY).stresses
    ),
    "mechanics.recoil": lambda t: mechanics.recoil(t, ENERGY, FRICTION, 4),
    "mechanics.self_stresses": self_stress,
    "mechanics.shear_modulus": of_energy(mechanics.shear_modulus),
    "mechanics.spectrum": lambda t: mechanics.spectrum(t, ENERGY),
    "mechanics.stress": of_energy(mechanics.stress),
    "mechanics.tensions": of_energy(mechanics.tensions),
    "mechanics.velocities": lambda t: mechanics.velocities(shaken(t), ENERGY, VISCOSITY),
    "mechanics.youngs_modulus": of_energy(mechanics.youngs_modulus),
    "mechanics.zero_modes": lambda t: mechanics.zero_modes(t, ENERGY),
    "mesh.cell_polygons": vx.mesh.cell_polygons,
    "mesh.geometry_of": vx.mesh.geometry_of,
    "mesh.pad": vx.mesh.pad,
    "plotting.flipped_edges": lambda t: vx.plotting.flipped_edges(t, shaken(t)),
    "plotting.plot_tissue": pixels(lambda t: vx.plot_tissue(t, of_cells(t), of_edges(t))),
    "plotting.plot_mode": pixels(lambda t: vx.plotting.plot_mode(t, of_vertices(t))),
    "plotting.plot_stress": pixels(
        lambda t: vx.plotting.plot_stress(t, mechanics.cell_stress(t, ENERGY))
    ),
    "tensions.infer_tensions": free(lambda t: vx.tensions.infer_tensions(t).tensions),
    "relax.record_relaxation": lambda t: (
        vx.relax.record_relaxation(shaken(t), ENERGY, FIXED_TOPOLOGY)[0].tissue
    ),
    "transitions.ablate": with_room(ablated),
    "transitions.divide": with_room(lambda t: vx.transitions.divide(t, 4).tissue),
    "transitions.remove": with_room(lambda t: vx.transitions.remove(t, 4).tissue),
    "transitions.T1": lambda t: vx.Relaxation(contact_range=None)(shaken(t), ENERGY).tissue,
    "transitions.T2": with_room(extruded),
    "energies.Ablated": energy_and_force(
        lambda t: energies.Ablated(ENERGY, cells=of_cells(t) > 1.2, edges=of_edges(t) > 1.2)
    ),
    "energies.AreaElasticity": energy_and_force(
        lambda t: energies.AreaElasticity(of_cells(t), 1.1)
    ),
    "energies.BoundedTension": energy_and_force(
        lambda t: energies.BoundedTension(of_edges(t), 0.1, 0.9)
    ),
    "energies.LineTension": energy_and_force(lambda t: energies.LineTension(of_edges(t))),
    "energies.PerimeterElasticity": energy_and_force(
        lambda t: energies.PerimeterElasticity(of_cells(t), 3.5)
    ),
    "energies.ShapeFactorEnergy": energy_and_force(
        lambda t: energies.ShapeFactorEnergy(3 + of_cells(t))
    ),
    "energies.LocalSum": energy_and_force(lambda t: ENERGY + energies.LineTension(of_edges(t))),
    "energies.TypeTension": energy_and_force(
        lambda t: energies.by_type([[1.0, 2.0], [2.0, 3.0]], (of_cells(t) > 1).astype(int))
    ),
    "dissipations.AreaViscosity": dissipated(lambda t: dissipations.AreaViscosity(of_cells(t))),
    "dissipations.EdgeViscosity": dissipated(lambda t: dissipations.EdgeViscosity(of_edges(t))),
    "dissipations.PerimeterViscosity": dissipated(
        lambda t: dissipations.PerimeterViscosity(of_cells(t))
    ),
    "dissipations.ViscositySum": dissipated(lambda t: VISCOSITY),
    "dissipations.SubstrateFriction": dissipated(
        lambda t: dissipations.SubstrateFriction(rows(t, 2))
    ),
    "activities.FluctuatingTensions": driven(lambda t: activities.FluctuatingTensions(0.3, 1.0)),
    "activities.Push": energy_and_force(
        lambda t: activities.Push(t.topology.alive_vertices[:, None] * of_vertices(t))
    ),
    "activities.SelfPropulsion": driven(lambda t: activities.SelfPropulsion(of_cells(t))),
    "signals.Signals": driven(reacting),
    "activities.ThermalNoise": driven(lambda t: activities.ThermalNoise(0.1)),
}


# Names that need no case, and the reason.
ELSEWHERE = {
    "Relaxation Evolution InverseProblem Material": "classes behind equilibrate, evolve, fit and grow",
    "Sum InTurn": "loops over terms that have cases",
    "AbstractLocalEnergy": "the base class",
    "animate plot_tissues": "draw by plot_tissue",
    "save": "keeps spare slots; tests/io/test_files_with_spare_slots.py",
    "plot_surface": "needs a surface; tests/io/test_curved_files.py",
    "External": "needs another program",
    "Microscope PinnedEnergy": "render and ShapeFactorEnergy with other arguments",
}


def without_spare(result):
    """The leaves of a result, tissues without spare slots."""
    is_tissue = lambda x: isinstance(x, vx.Tissue)
    leaves = jax.tree.leaves(result, is_leaf=is_tissue)
    return jax.tree.leaves([x.without_spare() if is_tissue(x) else x for x in leaves])


# These compile for longer, and use the functions of the others.
THOROUGH = (
    "growth.grow",
    "mechanics.BoxRelaxation",
    "relax.record_relaxation",
    "transitions.T1",
    "transitions.T2",
    "mechanics.bulk_modulus",
    "mechanics.shear_modulus",
    "mechanics.youngs_modulus",
    "mechanics.complex_modulus",
    "mechanics.elastic_tensor",
    "mechanics.modes (sparse)",
    "mechanics.ramp",
    "mechanics.recoil",
    "mechanics.velocities",
    "transitions.ablate",
    "transitions.remove",
)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.thorough if name in THOROUGH else ()) for name in CASES],
)
def test_results_do_not_depend_on_spare_slots(tissues, name):
    plain, roomy = (without_spare(CASES[name](tissue)) for tissue in tissues)
    assert len(plain) == len(roomy) > 0
    for one, other in zip(plain, roomy, strict=True):
        one, other = np.asarray(one), np.asarray(other)
        living = other[tuple(slice(0, size) for size in one.shape)]
        if one.dtype.kind in "fc":
            np.testing.assert_allclose(living, one, rtol=1e-7, atol=1e-9)
        else:
            np.testing.assert_array_equal(living, one)


def takes_tissue(function):
    parameters = inspect.signature(function).parameters.values()
    return any("Tissue" in str(parameter.annotation) for parameter in parameters)


def public_callables():
    """Names of public functions that take a tissue, and of concrete classes with such a method."""
    modules = [module for _, module in inspect.getmembers(vx, inspect.ismodule)]
    for module in (vx, *modules):
        for name in dir(module):
            thing = getattr(module, name)
            if inspect.isclass(thing) and not inspect.isabstract(thing):
                methods = [
                    getattr(thing, m, None) for m in ("__call__", "drive", "strains", "sweep")
                ]
                takes = any(takes_tissue(m) for m in methods if inspect.isfunction(m))
            else:
                takes = inspect.isfunction(thing) and takes_tissue(thing)
            # Costs have tests/costs/test_spare_slots.py.
            is_cost = inspect.isclass(thing) and issubclass(thing, vx.AbstractCost)
            if takes and not is_cost and not name.startswith("_"):
                yield f"{module.__name__}.{name}"


def test_each_public_function_of_a_tissue_has_a_case():
    tested = {name.split(" ")[0].rpartition(".")[2] for name in CASES}
    tested |= {name for names in ELSEWHERE for name in names.split(" ")}
    assert not [name for name in public_callables() if name.rpartition(".")[2] not in tested]
