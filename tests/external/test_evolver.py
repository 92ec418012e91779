"""Surface Evolver as a forward model. What needs the program is skipped where it is not installed."""

import shutil
import stat
import sys
import tempfile
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import vertax as vx
from vertax.external import SimulatorError, SurfaceEvolver, run_program
from vertax.external._evolver_model import Terms, slope_of
from vertax.external._evolver_strings import Strings
from vertax.external._evolver_t1 import can_flip, flipped
from vertax.external._simulator import Relaxed
from vertax.mesh._topology import flip_edges

needs_evolver = pytest.mark.skipif(
    shutil.which("evolver") is None,
    reason="Surface Evolver is not installed: apt-get install evolver-nox",
)


def straight(tissue, **settings):
    return vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, **settings)


def on_host(tree):
    return jax.tree.map(np.asarray, tree)


PERIODIC = vx.initialise.periodic_voronoi(6, key=jax.random.key(3))
# Vertices far outside of the box, each elsewhere.
STRAY = PERIODIC.with_vertices(
    PERIODIC.vertices + PERIODIC.boundary.translation(jnp.array([3, -2]))
)
CLUSTER = straight(vx.initialise.free_voronoi(6, key=jax.random.key(3)))
TISSUES = {"periodic": PERIODIC, "stray": STRAY, "free": CLUSTER}


def energies(tissue):
    tension = vx.energies.LineTension(0.3 + 0.04 * jnp.sin(1.7 * jnp.arange(tissue.n_edges)))
    areas = vx.energies.AreaElasticity(jnp.array(10.0), jnp.linspace(0.9, 1.1, tissue.n_cells))
    perimeters = vx.energies.PerimeterElasticity(0.1, 3.0)
    bounded = vx.energies.BoundedTension(jnp.full(tissue.n_edges, 0.3), 0.0, 1.0)
    return {
        "foam": areas + tension,
        "all": areas + tension + bounded + perimeters,
        "shape factors": vx.energies.ShapeFactorEnergy(jnp.full(tissue.n_cells, 3.6), 1.1),
    }


@eqx.filter_jit
def forces(tissue, energy):
    return jax.grad(lambda x: energy(tissue.with_vertices(x)))(tissue.vertices)


@eqx.filter_jit
def slopes(tissue, energy):
    return eqx.filter_grad(lambda e: e(tissue))(energy)


@pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)
def test_strings_are_the_tissue(tissue):
    strings = Strings.of(on_host(tissue))
    np.testing.assert_allclose(strings.lengths(strings.points), tissue.edge_lengths, rtol=1e-12)
    np.testing.assert_allclose(strings.areas(strings.points), tissue.areas, rtol=1e-10)
    np.testing.assert_allclose(strings.perimeters(strings.points), tissue.perimeters, rtol=1e-12)


def bent(tissue, inner_arcs, by=0.5):
    angles = by * np.sin(1 + np.arange(tissue.n_edges)).round(1)
    settings = {"angles": angles, "inner_arcs": inner_arcs}
    return straight(tissue, softening=0.0, **settings)


ARCS = {"outline": bent(CLUSTER, False), "all": bent(CLUSTER, True), "box": bent(STRAY, True)}
FOAM = bent(vx.initialise.free_voronoi(7, key=jax.random.key(1), lloyd_steps=20), True, by=0.1)


@pytest.mark.parametrize("tissue", ARCS.values(), ids=ARCS)
def test_chains_are_arcs(tissue):
    for n, error in ((3, 0.1), (30, 1e-3)):
        strings = Strings.of(on_host(tissue), n)
        assert len(strings.edge) == np.where(tissue.is_arc, n, 1).sum()
        # What they enclose is the same, and they are a little shorter.
        np.testing.assert_allclose(strings.areas(strings.points), tissue.areas, rtol=1e-9)
        np.testing.assert_allclose(strings.lengths(strings.points), tissue.edge_lengths, rtol=error)
        angles = np.where(tissue.is_arc, tissue.angles, 0)
        np.testing.assert_allclose(strings.angles(strings.points), angles, atol=1e-7)
        pieces = np.hypot(*strings.pieces.vectors(strings.points).T)
        mean = (strings.lengths(strings.points) / strings.parts)[strings.edge]
        np.testing.assert_allclose(pieces, mean, rtol=1e-6)


@pytest.mark.parametrize("tissue", ARCS.values(), ids=ARCS)
def test_pulls_on_points_are_torques_on_angles(tissue):
    strings = Strings.of(on_host(tissue), 5)
    rng = np.random.default_rng(0)
    torques, forces = rng.normal(size=tissue.n_edges), rng.normal(size=tissue.vertices.shape)
    way = rng.normal(size=strings.points.shape)
    work = np.sum(strings.pulls(forces, torques) * way)
    n = len(forces)
    slope = central_difference(
        lambda p: torques @ strings.angles(np.asarray(p)) + np.sum(forces * p[:n]),
        strings.points,
        way,
    )
    assert work == pytest.approx(float(slope), rel=1e-5)


@pytest.mark.parametrize("name", ["all", "shape factors"])
def test_derivatives_are_those_of_the_energy(name):
    energy = energies(PERIODIC)[name]
    # (Numbers are parameters too.)
    energy = jax.tree.map(jnp.asarray, energy)
    strings = Strings.of(on_host(PERIODIC))
    at = strings.points
    measures = (strings.lengths(at), strings.areas(at), strings.perimeters(at))
    found = slope_of(on_host(energy), *measures, None)
    wanted = slopes(PERIODIC, energy)
    leaves = lambda tree: jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array_like))
    if name == "all":  # the bounds of tensions are constants
        bounds = lambda e: (e.terms[2].low, e.terms[2].high)
        found, wanted = (eqx.tree_at(bounds, tree, (0.0, 0.0)) for tree in (found, wanted))
    for a, b in zip(leaves(found), leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_terms_add_up():
    areas = vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.AreaElasticity(6.0, 2.0)
    terms = Terms.of(areas + vx.energies.LineTension(1.0), 3, 9)
    np.testing.assert_array_equal(terms.tension, np.ones(9))
    np.testing.assert_allclose(terms.area_stiffness, 8.0)
    np.testing.assert_allclose(terms.area, 1.75)


def test_energies_that_cannot_be_told_are_refused():
    class Odd(vx.AbstractEnergy):
        def __call__(self, tissue):
            return jnp.sum(tissue.areas**3)

    with pytest.raises(SimulatorError, match="is not told of a Odd"):
        SurfaceEvolver().relax(on_host(PERIODIC), Odd(), None)


@pytest.mark.parametrize("settings", [{"timeout": 0.0}, {"steps": -1}, {"pieces": 1}, {"t1": 0.0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        SurfaceEvolver(**settings)


@pytest.fixture
def impostor(tmp_path, monkeypatch):
    """A program in place of Surface Evolver, and a folder for temporary files that must be empty then."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()

    def make(source):
        path = tmp_path / "evolver"
        path.write_text(f"#!{sys.executable}\nimport os, sys, time\n{source}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    yield make
    assert list((tmp_path / "scratch").iterdir()) == []


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("print('no memory'); sys.exit(3)", "exit code 3.*\n    no memory"),
        ("print('on fire', flush=True); os.abort()", "signal SIGABRT.*\n    on fire"),
        ("print('done')", "wrote no 'result'.*\n    done"),
        ("print('odd'); open('result', 'w').write('point 1 x y')", "cannot be read.*\n    odd"),
        (
            "print('half'); open('result', 'w').write('energy 1')",
            "did not come to an end.*\n    half",
        ),
        ("open('result', 'w').write('point 9999 0 0')", "cannot be read.*It printed nothing"),
    ],
)
def test_failures_are_errors_with_the_tail_of_the_log(impostor, source, says):
    evolver = SurfaceEvolver(command=impostor(source))
    with pytest.raises(SimulatorError, match=f"(?s){says}"):
        evolver.relax(on_host(PERIODIC), energies(PERIODIC)["foam"], None)


def test_transitions_that_come_to_no_end_are_an_error(monkeypatch):
    from vertax.external import _evolver

    energy = iter(np.linspace(1.0, 0.0, 10_000))
    tissue = on_host(PERIODIC)
    rest = lambda self, tissue, *_: Relaxed(tissue.vertices, energy=next(energy))
    monkeypatch.setattr(SurfaceEvolver, "_at_rest", rest)
    monkeypatch.setattr(_evolver, "swapped", lambda tissue, *_: tissue)
    with pytest.raises(SimulatorError, match="came to no end"):
        SurfaceEvolver(t1=10.0).relax(tissue, energies(PERIODIC)["foam"], None)


def test_what_takes_too_long_is_ended(impostor):
    # It starts another one, which must not live on.
    child = "import subprocess; subprocess.Popen(['sleep', '60']); print('working', flush=True)"
    evolver = SurfaceEvolver(command=impostor(f"{child}; time.sleep(60)"), timeout=4.0)
    began = time.perf_counter()
    with pytest.raises(SimulatorError, match=r"(?s)not done after 4 s.*working"):
        evolver.relax(on_host(PERIODIC), energies(PERIODIC)["foam"], None)
    assert time.perf_counter() - began < 40


def test_a_program_that_is_not_there_says_how_to_install_it():
    evolver = SurfaceEvolver(command="no-such-evolver")
    with pytest.raises(
        SimulatorError, match=r"no program 'no-such-evolver'.*apt-get install evolver"
    ):
        evolver.relax(on_host(PERIODIC), energies(PERIODIC)["foam"], None)


def test_programs_get_files_and_leave_results():
    code = (
        "import pathlib; pathlib.Path('b').write_text(pathlib.Path('a').read_text() * 2); print(1)"
    )
    found, log = run_program([sys.executable, "-c", code], {"a": "x"}, ["b"], timeout=30.0)
    assert (found, log) == ({"b": "xx"}, "1\n")


@needs_evolver
@pytest.mark.parametrize("name", ["foam", "all", "shape factors"])
@pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)
def test_the_program_means_the_same_energy(tissue, name):
    energy = energies(tissue)[name]
    there = SurfaceEvolver().energy(on_host(tissue), on_host(energy))
    assert there == pytest.approx(float(energy(tissue)), rel=1e-12)


@needs_evolver
@pytest.mark.parametrize("tissue", [PERIODIC, CLUSTER], ids=["periodic", "free"])
def test_it_comes_to_rest_under_a_pull(tissue):
    energy = energies(tissue)["foam"]
    first = SurfaceEvolver().relax(on_host(tissue), on_host(energy), None)
    at_rest = tissue.with_vertices(jnp.asarray(first.vertices))
    assert jnp.abs(forces(at_rest, energy)).max() < 1e-11
    pull = 1e-4 * np.sin(np.arange(tissue.vertices.size)).reshape(-1, 2)
    pull -= pull.mean(axis=0)
    if tissue is CLUSTER:  # which would turn
        arms = first.vertices - first.vertices.mean(axis=0)
        aside = np.stack([-arms[:, 1], arms[:, 0]], axis=-1)
        pull -= aside * np.sum(aside * pull) / np.sum(aside**2)
    pulled = SurfaceEvolver().relax(on_host(at_rest), on_host(energy), pull)
    left = forces(tissue.with_vertices(jnp.asarray(pulled.vertices)), energy) - pull
    assert jnp.abs(left).max() < 1e-7
    assert np.abs(pulled.vertices - first.vertices).max() > 1e-5


def test_fixed_areas_need_targets():
    program = SurfaceEvolver(areas="fixed")
    with pytest.raises(SimulatorError, match="add an AreaElasticity"):
        program.relax(on_host(CLUSTER), vx.energies.LineTension(1.0), None)


@needs_evolver
@pytest.mark.parametrize("tissue", [CLUSTER, PERIODIC, FOAM], ids=["free", "box", "arcs"])
def test_fixed_areas_are_held_and_have_pressures(tissue):
    energy = energies(tissue)["foam"]
    soft = SurfaceEvolver(pieces=3).relax(on_host(tissue), on_host(energy), None)
    tissue = tissue.with_vertices(jnp.asarray(soft.vertices))
    if soft.angles is not None:
        tissue = tissue.with_angles(jnp.asarray(soft.angles))
    areas = np.asarray(tissue.areas)
    program = SurfaceEvolver(areas="fixed", pieces=3)
    at_rest = lambda tension, areas: program.relax(
        on_host(tissue),
        on_host(
            vx.energies.AreaElasticity(1.0, jnp.array(areas)) + vx.energies.LineTension(tension)
        ),
        None,
    )
    tension = 1.05 * energy.terms[1].tension
    found = at_rest(tension, areas)
    held = tissue.with_vertices(jnp.asarray(found.vertices))
    if found.angles is not None:
        held = held.with_angles(jnp.asarray(found.angles))
    np.testing.assert_allclose(held.areas, areas, atol=1e-9)
    # The energy is differentiated where the vertices are, and the areas by their multipliers.
    tensions = 1e-4 * np.cos(np.arange(tension.size))
    swell = 1e-4 * np.eye(areas.size)[1]
    for by, (first, second) in {"tension": (tensions, 0), "target_area": (0, swell)}.items():
        up = at_rest(tension + first, areas + second).energy
        down = at_rest(tension - first, areas - second).energy
        term = found.slope.terms[by == "tension"]
        slope = getattr(term, by) @ (first + second)
        assert (up - down) / 2 == pytest.approx(slope, rel=1e-4)


class Shape(vx.costs.AbstractLeastSquaresCost):
    """Distance of vertices and of angles."""

    tissue: vx.Tissue

    def residuals(self, tissue, energy):
        vertices = (tissue.vertices - self.tissue.vertices).ravel()
        return jnp.concatenate([vertices, tissue.edge_angles - self.tissue.edge_angles])


@needs_evolver
@pytest.mark.parametrize("areas", [pytest.param("elastic", marks=pytest.mark.thorough), "fixed"])
def test_gradient_through_arcs_is_that_of_differences(areas):
    program = SurfaceEvolver(areas=areas, pieces=3)
    response = vx.External(program, slope="program", stiffness=1.0)
    tension = energies(FOAM)["foam"].terms[1].tension
    energy_of = lambda tension: (
        vx.energies.AreaElasticity(10.0, FOAM.areas) + vx.energies.LineTension(tension)
    )
    # (From where it rests, for the program lets a foam turn a little on its way there.)
    tissue = response(FOAM, energy_of(tension)).tissue
    away = 0.03 * np.cos(np.arange(tissue.vertices.size)).reshape(-1, 2)
    assert tissue.angles is not None
    target = tissue.with_vertices(tissue.vertices + away).with_angles(0.9 * tissue.angles)
    adjoint = vx.EquilibriumPropagation()
    problem = vx.InverseProblem(
        tissue, energy_of(tension), Shape(target), response=response, adjoint=adjoint
    )
    gradient = eqx.filter_jit(lambda p: p.value_and_gradient().gradient)(problem).terms[1].tension
    direction = np.cos(np.arange(tension.size))
    cost = eqx.filter_jit(lambda tension: problem(energy_of(tension))[0])
    slope = central_difference(cost, tension, direction, step=1e-5)
    assert gradient @ direction == pytest.approx(float(slope), rel=1e-5)


@pytest.mark.parametrize("tissue", [PERIODIC, CLUSTER], ids=["periodic", "free"])
def test_flips_are_those_of_vertax(tissue):
    topology = on_host(tissue).topology
    flip = jax.jit(flip_edges)
    edges = np.flatnonzero(can_flip(topology))
    assert len(edges) > 0
    for edge in edges:
        found = flipped(topology, int(edge))
        wanted = flip(tissue.topology, np.arange(tissue.n_edges) == edge)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_array_equal(a, b)


@needs_evolver
def test_t1_transitions_of_it_lower_the_energy():
    tissue = vx.initialise.periodic_voronoi(9, key=jax.random.key(2))
    tension = vx.energies.LineTension(0.3 + 0.15 * jnp.sin(7.0 * jnp.arange(tissue.n_edges)))
    energy = vx.energies.AreaElasticity(10.0, 1.0) + tension
    kept, changed = (
        vx.External(SurfaceEvolver(t1=t1), tolerance=1e-6)(tissue, energy, throw=False)
        for t1 in (None, 0.15)
    )
    assert kept.num_t1 == 0
    assert changed.num_t1 > 0
    assert changed.energy < kept.energy - 1e-3
    assert changed.converged  # and valid, by the energy of vertax
    changed.tissue.topology.validate()
    assert changed.energy == pytest.approx(float(energy(changed.tissue)), rel=1e-12)
    again = vx.External(SurfaceEvolver(t1=0.15), tolerance=1e-6)(changed.tissue, energy)
    assert again.num_t1 == 0


@needs_evolver
def test_t1_transitions_of_it_are_for_straight_edges():
    with pytest.raises(SimulatorError, match="are for straight edges"):
        SurfaceEvolver(t1=0.1).relax(on_host(FOAM), on_host(energies(FOAM)["foam"]), None)


@needs_evolver
def test_gradient_by_two_runs_of_it():
    energy = energies(PERIODIC)["foam"]
    response = vx.External(SurfaceEvolver())
    tissue = response(PERIODIC, energy).tissue
    away = 0.03 * np.cos(np.arange(tissue.vertices.size)).reshape(-1, 2)
    cost = vx.costs.VertexDistance(tissue.with_vertices(tissue.vertices + away))

    @eqx.filter_jit
    def gradient(energy):
        adjoint = vx.EquilibriumPropagation()
        problem = vx.InverseProblem(tissue, energy, cost, response=response, adjoint=adjoint)
        return problem.value_and_gradient().gradient.terms[1].tension

    @eqx.filter_jit
    def derivatives(tensions):
        value = lambda x, t: (energy.terms[0] + vx.energies.LineTension(t))(
            tissue.with_vertices(x.reshape(-1, 2))
        )
        x = tissue.vertices.ravel()
        pull = jax.grad(lambda x: cost(tissue.with_vertices(x.reshape(-1, 2)), energy))(x)
        return pull, jax.hessian(value)(x, tensions), jax.jacobian(jax.grad(value), 1)(x, tensions)

    found = np.asarray(gradient(energy))
    pull, hessian, mixed = map(np.asarray, derivatives(energy.terms[1].tension))
    implicit = -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ pull
    cosine = found @ implicit / np.linalg.norm(found) / np.linalg.norm(implicit)
    assert cosine > 0.9999
    assert np.linalg.norm(found - implicit) < 1e-6 * np.linalg.norm(implicit)
