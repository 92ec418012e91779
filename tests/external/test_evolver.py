"""Surface Evolver as a forward model. Tests that need the program are skipped if it is not installed."""

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
from vertax.external._evolver_model import Terms, parameter_derivatives
from vertax.external._evolver_strings import Strings
from vertax.external._evolver_t1 import can_flip, flip_edge
from vertax.external._simulator import Relaxed
from vertax.transitions._euler_operators import flip_edges

needs_evolver = pytest.mark.skipif(
    shutil.which("evolver") is None,
    reason="Surface Evolver is not installed: apt-get install evolver-nox",
)


def with_settings(tissue, **settings):
    return vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, **settings)


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


PERIODIC = vx.initialise.periodic_voronoi(6, key=jax.random.key(3))
# All vertices in another image of the box.
SHIFTED = PERIODIC.with_vertices(
    PERIODIC.vertices + PERIODIC.boundary.translation(jnp.array([3, -2]))
)
CLUSTER = with_settings(vx.initialise.free_voronoi(6, key=jax.random.key(3)))
TISSUES = {"periodic": PERIODIC, "stray": SHIFTED, "free": CLUSTER}


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
def test_strings_have_the_measures_of_the_tissue(tissue):
    strings = Strings.of(as_numpy(tissue))
    np.testing.assert_allclose(strings.lengths(strings.points), tissue.edge_lengths, rtol=1e-12)
    np.testing.assert_allclose(strings.areas(strings.points), tissue.areas, rtol=1e-10)
    np.testing.assert_allclose(strings.perimeters(strings.points), tissue.perimeters, rtol=1e-12)


def with_arcs(tissue, inner_arcs, size=0.5):
    angles = size * np.sin(1 + np.arange(tissue.n_edges)).round(1)
    settings = {"angles": angles, "inner_arcs": inner_arcs}
    return with_settings(tissue, softening=0.0, **settings)


ARCS = {
    "outline": with_arcs(CLUSTER, False),
    "all": with_arcs(CLUSTER, True),
    "box": with_arcs(SHIFTED, True),
}
FOAM = with_arcs(
    vx.initialise.free_voronoi(7, key=jax.random.key(1), lloyd_steps=20), True, size=0.1
)


@pytest.mark.parametrize("tissue", ARCS.values(), ids=ARCS)
def test_chains_have_the_areas_and_angles_of_arcs(tissue):
    for n, error in ((3, 0.1), (30, 1e-3)):
        strings = Strings.of(as_numpy(tissue), n)
        assert len(strings.edge) == np.where(tissue.is_arc, n, 1).sum()
        # Chains enclose the same areas as arcs, and are slightly shorter.
        np.testing.assert_allclose(strings.areas(strings.points), tissue.areas, rtol=1e-9)
        np.testing.assert_allclose(strings.lengths(strings.points), tissue.edge_lengths, rtol=error)
        angles = np.where(tissue.is_arc, tissue.angles, 0)
        np.testing.assert_allclose(strings.angles(strings.points), angles, atol=1e-7)
        pieces = np.hypot(*strings.pieces.vectors(strings.points).T)
        mean = (strings.lengths(strings.points) / strings.parts)[strings.edge]
        np.testing.assert_allclose(pieces, mean, rtol=1e-6)


@pytest.mark.parametrize("tissue", ARCS.values(), ids=ARCS)
def test_point_forces_do_the_work_of_forces_and_torques(tissue):
    strings = Strings.of(as_numpy(tissue), 5)
    rng = np.random.default_rng(0)
    torques, forces = rng.normal(size=tissue.n_edges), rng.normal(size=tissue.vertices.shape)
    direction = rng.normal(size=strings.points.shape)
    work = np.sum(strings.point_forces(forces, torques) * direction)
    n = len(forces)
    slope = central_difference(
        lambda p: torques @ strings.angles(np.asarray(p)) + np.sum(forces * p[:n]),
        strings.points,
        direction,
    )
    assert work == pytest.approx(float(slope), rel=1e-5)


@pytest.mark.parametrize("name", ["all", "shape factors"])
def test_parameter_derivatives_equal_those_of_the_energy(name):
    energy = energies(PERIODIC)[name]
    # (Numbers are parameters too.)
    energy = jax.tree.map(jnp.asarray, energy)
    strings = Strings.of(as_numpy(PERIODIC))
    at = strings.points
    measures = (strings.lengths(at), strings.areas(at), strings.perimeters(at))
    derivatives = parameter_derivatives(as_numpy(energy), *measures, None)
    expected = slopes(PERIODIC, energy)
    leaves = lambda tree: jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array_like))
    if name == "all":  # the bounds of tensions are constants
        bounds = lambda e: (e.terms[2].low, e.terms[2].high)
        derivatives, expected = (
            eqx.tree_at(bounds, tree, (0.0, 0.0)) for tree in (derivatives, expected)
        )
    for a, b in zip(leaves(derivatives), leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_terms_of_a_sum_are_combined():
    areas = vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.AreaElasticity(6.0, 2.0)
    terms = Terms.of(areas + vx.energies.LineTension(1.0), 3, 9)
    np.testing.assert_array_equal(terms.tension, np.ones(9))
    np.testing.assert_allclose(terms.area_stiffness, 8.0)
    np.testing.assert_allclose(terms.area, 1.75)


def test_unsupported_energies_raise():
    class CubicEnergy(vx.AbstractEnergy):
        def __call__(self, tissue):
            return jnp.sum(tissue.areas**3)

    with pytest.raises(SimulatorError, match="does not support CubicEnergy"):
        SurfaceEvolver().relax(as_numpy(PERIODIC), CubicEnergy(), None)


@pytest.mark.parametrize("settings", [{"timeout": 0.0}, {"steps": -1}, {"pieces": 1}, {"t1": 0.0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        SurfaceEvolver(**settings)


@pytest.fixture
def fake_program(tmp_path, monkeypatch):
    """A program in the place of Surface Evolver. Its folder of temporary files must be empty at the end."""
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
    ("source", "message"),
    [
        ("print('no memory'); sys.exit(3)", "exit code 3.*\n    no memory"),
        ("print('on fire', flush=True); os.abort()", "signal SIGABRT.*\n    on fire"),
        ("print('done')", "wrote no 'result'.*\n    done"),
        ("print('odd'); open('result', 'w').write('point 1 x y')", "cannot be read.*\n    odd"),
        (
            "print('half'); open('result', 'w').write('energy 1')",
            "is incomplete.*\n    half",
        ),
        ("open('result', 'w').write('point 9999 0 0')", "cannot be read.*It printed nothing"),
    ],
)
def test_failures_raise_with_the_end_of_the_log(fake_program, source, message):
    evolver = SurfaceEvolver(command=fake_program(source))
    with pytest.raises(SimulatorError, match=f"(?s){message}"):
        evolver.relax(as_numpy(PERIODIC), energies(PERIODIC)["foam"], None)


def test_endless_transitions_raise(monkeypatch):
    from vertax.external import _evolver

    energy = iter(np.linspace(1.0, 0.0, 10_000))
    tissue = as_numpy(PERIODIC)
    rest = lambda self, tissue, *_: Relaxed(tissue.vertices, energy=next(energy))
    monkeypatch.setattr(SurfaceEvolver, "_relax_in_topology", rest)
    monkeypatch.setattr(_evolver, "flip_by_program", lambda tissue, *_: tissue)
    with pytest.raises(SimulatorError, match="did not end after"):
        SurfaceEvolver(t1=10.0).relax(tissue, energies(PERIODIC)["foam"], None)


@pytest.mark.thorough
def test_program_is_killed_after_the_timeout(fake_program):
    # It starts a child process, which must be killed too.
    child = "import subprocess; subprocess.Popen(['sleep', '60']); print('working', flush=True)"
    evolver = SurfaceEvolver(command=fake_program(f"{child}; time.sleep(60)"), timeout=4.0)
    began = time.perf_counter()
    with pytest.raises(SimulatorError, match=r"(?s)not done after 4 s.*working"):
        evolver.relax(as_numpy(PERIODIC), energies(PERIODIC)["foam"], None)
    assert time.perf_counter() - began < 40


def test_missing_program_raises_with_install_instructions():
    evolver = SurfaceEvolver(command="no-such-evolver")
    with pytest.raises(
        SimulatorError, match=r"no program 'no-such-evolver'.*apt-get install evolver"
    ):
        evolver.relax(as_numpy(PERIODIC), energies(PERIODIC)["foam"], None)


def test_programs_read_files_and_write_results():
    code = (
        "import pathlib; pathlib.Path('b').write_text(pathlib.Path('a').read_text() * 2); print(1)"
    )
    texts, log = run_program([sys.executable, "-c", code], {"a": "x"}, ["b"], timeout=30.0)
    assert (texts, log) == ({"b": "xx"}, "1\n")


@needs_evolver
@pytest.mark.parametrize("name", ["foam", "all", "shape factors"])
@pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)
def test_energy_of_the_program_equals_the_energy(tissue, name):
    energy = energies(tissue)[name]
    energy_of_program = SurfaceEvolver().energy(as_numpy(tissue), as_numpy(energy))
    assert energy_of_program == pytest.approx(float(energy(tissue)), rel=1e-12)


@needs_evolver
@pytest.mark.parametrize("tissue", [PERIODIC, CLUSTER], ids=["periodic", "free"])
def test_forces_vanish_after_relaxation_with_and_without_a_nudge(tissue):
    energy = energies(tissue)["foam"]
    first = SurfaceEvolver().relax(as_numpy(tissue), as_numpy(energy), None)
    at_rest = tissue.with_vertices(jnp.asarray(first.vertices))
    assert jnp.abs(forces(at_rest, energy)).max() < 1e-11
    nudge = 1e-4 * np.sin(np.arange(tissue.vertices.size)).reshape(-1, 2)
    nudge -= nudge.mean(axis=0)
    if tissue is CLUSTER:  # remove the torque, which would rotate the tissue
        arms = first.vertices - first.vertices.mean(axis=0)
        rotation = np.stack([-arms[:, 1], arms[:, 0]], axis=-1)
        nudge -= rotation * np.sum(rotation * nudge) / np.sum(rotation**2)
    nudged = SurfaceEvolver().relax(as_numpy(at_rest), as_numpy(energy), nudge)
    residual = forces(tissue.with_vertices(jnp.asarray(nudged.vertices)), energy) - nudge
    assert jnp.abs(residual).max() < 1e-7
    assert np.abs(nudged.vertices - first.vertices).max() > 1e-5


def test_fixed_areas_need_targets():
    program = SurfaceEvolver(areas="fixed")
    with pytest.raises(SimulatorError, match="add an AreaElasticity"):
        program.relax(as_numpy(CLUSTER), vx.energies.LineTension(1.0), None)


@needs_evolver
@pytest.mark.parametrize("tissue", [CLUSTER, PERIODIC, FOAM], ids=["free", "box", "arcs"])
def test_fixed_areas_and_their_multipliers(tissue):
    energy = energies(tissue)["foam"]
    soft = SurfaceEvolver(pieces=3).relax(as_numpy(tissue), as_numpy(energy), None)
    tissue = tissue.with_vertices(jnp.asarray(soft.vertices))
    if soft.angles is not None:
        tissue = tissue.with_angles(jnp.asarray(soft.angles))
    areas = np.asarray(tissue.areas)
    program = SurfaceEvolver(areas="fixed", pieces=3)
    at_rest = lambda tension, areas: program.relax(
        as_numpy(tissue),
        as_numpy(
            vx.energies.AreaElasticity(1.0, jnp.array(areas)) + vx.energies.LineTension(tension)
        ),
        None,
    )
    tension = 1.05 * energy.terms[1].tension
    equilibrium = at_rest(tension, areas)
    fixed = tissue.with_vertices(jnp.asarray(equilibrium.vertices))
    if equilibrium.angles is not None:
        fixed = fixed.with_angles(jnp.asarray(equilibrium.angles))
    np.testing.assert_allclose(fixed.areas, areas, atol=1e-9)
    # Derivatives by tensions are lengths at the equilibrium, and those by target areas are the multipliers.
    tensions = 1e-4 * np.cos(np.arange(tension.size))
    swell = 1e-4 * np.eye(areas.size)[1]
    for by, (first, second) in {"tension": (tensions, 0), "target_area": (0, swell)}.items():
        up = at_rest(tension + first, areas + second).energy
        down = at_rest(tension - first, areas - second).energy
        term = equilibrium.slope.terms[by == "tension"]
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
def test_gradient_through_arcs_matches_finite_differences(areas):
    program = SurfaceEvolver(areas=areas, pieces=3)
    response = vx.External(program, slope="program", stiffness=1.0)
    tension = energies(FOAM)["foam"].terms[1].tension
    energy_of = lambda tension: (
        vx.energies.AreaElasticity(10.0, FOAM.areas) + vx.energies.LineTension(tension)
    )
    # (Start from the relaxed tissue, because a foam rotates slightly during its relaxation.)
    tissue = response(FOAM, energy_of(tension)).tissue
    displacement = 0.03 * np.cos(np.arange(tissue.vertices.size)).reshape(-1, 2)
    assert tissue.angles is not None
    target = tissue.with_vertices(tissue.vertices + displacement).with_angles(0.9 * tissue.angles)
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
def test_flips_equal_those_of_vertax(tissue):
    topology = as_numpy(tissue).topology
    flip = jax.jit(flip_edges)
    edges = np.flatnonzero(can_flip(topology))
    assert len(edges) > 0
    for edge in edges:
        flipped = flip_edge(topology, int(edge))
        expected = flip(tissue.topology, np.arange(tissue.n_edges) == edge)
        for a, b in zip(jax.tree.leaves(flipped), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.thorough
@needs_evolver
def test_t1_transitions_of_the_program_lower_the_energy():
    tissue = vx.initialise.periodic_voronoi(9, key=jax.random.key(2))
    tension = vx.energies.LineTension(0.3 + 0.15 * jnp.sin(7.0 * jnp.arange(tissue.n_edges)))
    energy = vx.energies.AreaElasticity(10.0, 1.0) + tension
    without_t1, with_t1 = (
        vx.External(SurfaceEvolver(t1=t1), tolerance=1e-6)(tissue, energy, throw=False)
        for t1 in (None, 0.15)
    )
    assert without_t1.num_t1 == 0
    assert with_t1.num_t1 > 0
    assert with_t1.energy < without_t1.energy - 1e-3
    assert with_t1.converged  # and valid, by the energy of vertax
    with_t1.tissue.topology.validate()
    assert with_t1.energy == pytest.approx(float(energy(with_t1.tissue)), rel=1e-12)
    second_run = vx.External(SurfaceEvolver(t1=0.15), tolerance=1e-6)(with_t1.tissue, energy)
    assert second_run.num_t1 == 0


@needs_evolver
def test_t1_transitions_of_the_program_require_straight_edges():
    with pytest.raises(SimulatorError, match="are for straight edges"):
        SurfaceEvolver(t1=0.1).relax(as_numpy(FOAM), as_numpy(energies(FOAM)["foam"]), None)


@pytest.mark.thorough
@needs_evolver
def test_gradient_by_the_program_equals_implicit_differentiation():
    energy = energies(PERIODIC)["foam"]
    response = vx.External(SurfaceEvolver())
    tissue = response(PERIODIC, energy).tissue
    displacement = 0.03 * np.cos(np.arange(tissue.vertices.size)).reshape(-1, 2)
    cost = vx.costs.VertexDistance(tissue.with_vertices(tissue.vertices + displacement))

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

    gradient_by_runs = np.asarray(gradient(energy))
    pull, hessian, mixed = map(np.asarray, derivatives(energy.terms[1].tension))
    implicit = -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ pull
    cosine = (
        gradient_by_runs @ implicit / np.linalg.norm(gradient_by_runs) / np.linalg.norm(implicit)
    )
    assert cosine > 0.9999
    assert np.linalg.norm(gradient_by_runs - implicit) < 1e-6 * np.linalg.norm(implicit)
