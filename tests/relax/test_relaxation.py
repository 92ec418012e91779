import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from free_helpers import cluster
from helpers import (
    FIXED_TOPOLOGY,
    NO_CONTACT,
    SOLVERS,
    counted_compilations,
    dense_hessian,
    each_solver,
    random_tissue,
    relaxed,
    shape_factors,
)

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy
from vertax.relax import _relaxation


@pytest.fixture(scope="module")
def disturbed():
    """A tissue near equilibrium, in the equilibrium's topology."""
    tissue, energy = relaxed(12, seed=1)
    nudge = 0.03 * jax.random.normal(jax.random.key(0), tissue.vertices.shape)
    return tissue.with_configuration(tissue.vertices + nudge), energy, tissue


@eqx.filter_jit
def force_of(tissue, energy):
    return jax.grad(lambda x: energy(tissue.with_configuration(x)))(tissue.vertices)


@eqx.filter_jit
def pull_of(tissue, energy):
    """The force on the vertices alone, where angles are free too."""
    return jax.grad(lambda x: energy(tissue.with_vertices(x)))(tissue.vertices)


@each_solver(*(name for name, *_ in SOLVERS))
def test_every_solver_finds_the_same_equilibrium(solver, force, disturbed):
    start, energy, reference = disturbed
    equilibrium = vx.equilibrate(
        start,
        energy,
        solver=solver,
        transitions=None,
        contact_range=None,
        tolerance=force,
        max_steps=3000,
    )
    assert equilibrium.converged
    assert equilibrium.max_force < force
    assert np.abs(force_of(equilibrium.tissue, energy)).max() < force
    assert equilibrium.energy == pytest.approx(float(energy(reference)), abs=10 * force**2 + 1e-9)


@pytest.mark.thorough
@each_solver("newton_cg", "lbfgs")
def test_every_solver_works_in_float32(solver, force, disturbed):
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    start, energy, reference = disturbed
    equilibrium = vx.equilibrate(
        *jax.tree.map(to32, (start, energy)),
        solver=solver,
        transitions=None,
        contact_range=None,
        tolerance=5e-3,
    )
    assert equilibrium.tissue.vertices.dtype == jnp.float32
    assert equilibrium.max_force < 5e-3
    assert equilibrium.energy == pytest.approx(float(energy(reference)), rel=1e-3)


@pytest.mark.thorough
def test_float32_tissue_relaxes_where_float64_is_enabled():
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    tissue = jax.tree.map(to32, random_tissue(20, 0))
    energy = ShapeFactorEnergy(jnp.full(20, 3.7, jnp.float32))
    near = vx.equilibrate(tissue, energy)
    assert near.converged
    assert near.tissue.vertices.dtype == near.energy.dtype == jnp.float32
    # Up to some hundred cells from the origin; farther away rounded coordinates distort the cells.
    far = vx.equilibrate(tissue.with_vertices(tissue.vertices + 20), energy)
    assert far.converged
    assert far.energy == pytest.approx(float(near.energy), rel=1e-3)
    with pytest.raises(ValueError, match="near the origin in float32"):
        vx.equilibrate(tissue.with_vertices(tissue.vertices + 1000), energy)


@eqx.filter_jit
def relaxed_one_by_one(tissues, targets):
    # Compiled once for all values; as one `vmap` all would wait for the slowest.
    relax = lambda x: vx.equilibrate(x[0], ShapeFactorEnergy(x[1]), tolerance=1e-8, throw=False)
    return jax.lax.map(relax, (tissues, targets))


@pytest.mark.parametrize(
    "p0",
    [
        pytest.param(3.5, marks=pytest.mark.thorough),
        pytest.param(3.7, marks=pytest.mark.slow),
        pytest.param(3.8, marks=pytest.mark.slow),
        3.9,
    ],
)
@pytest.mark.thorough
def test_random_tissues_reach_true_equilibria(p0):
    batch = [random_tissue(64, s) for s in range(6)]
    tissues = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    targets = jnp.stack([shape_factors(64, p0, 0.1, s) for s in range(6)])
    equilibrium = relaxed_one_by_one(tissues, targets)
    assert equilibrium.converged.all()
    assert (equilibrium.max_force < 1e-8).all()
    assert equilibrium.num_t1.sum() > 30
    by_themselves = 0
    for k in range(6):
        one = jax.tree.map(lambda x, k=k: x[k], equilibrium.tissue)
        one.topology.validate()
        assert one.areas.sum() == pytest.approx(64)
        energy = ShapeFactorEnergy(targets[k])
        if np.abs(force_of(one, energy)).max() < 1e-8:  # otherwise contacts bear something
            by_themselves += 1
            spectrum = np.linalg.eigvalsh(dense_hessian(one, energy))
            assert spectrum[0] > -1e-6 * spectrum[-1]  # a minimum, not a saddle
    assert by_themselves >= 4


@pytest.mark.thorough
def test_most_tissues_near_rest_keep_their_neighbours():
    """Few steps lead to edges that are short only on the way."""
    relax = eqx.filter_jit(vx.Relaxation(tolerance=1e-8))
    flips = []
    for seed in range(80):
        place, target, change = jax.random.split(jax.random.key(seed), 3)
        targets = 3.7 + 0.1 * jax.random.normal(target, (100,))
        changed = targets + 0.1 * jax.random.normal(change, (100,))
        tissue = vx.initialise.periodic_voronoi(100, key=place)
        rest = relax(tissue, ShapeFactorEnergy(targets)).tissue
        flips.append(relax(rest, ShapeFactorEnergy(changed)).num_t1)
    # (Single tissues say nothing: rounding decides. Of 200 some 160 keep all, and the others flip 1.5 edges.)
    assert np.mean(np.array(flips) == 0) > 0.65
    assert np.mean(flips) < 0.6


@pytest.mark.thorough
def test_vmap_and_single_runs_agree():
    batch = [random_tissue(12, s) for s in range(3)]
    energy = AreaElasticity(20.0, 1.0) + LineTension(jnp.full(36, 0.5))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    together = eqx.filter_vmap(lambda t: NO_CONTACT(t, energy))(stacked)
    for k, tissue in enumerate(batch):
        alone = NO_CONTACT(tissue, energy)
        np.testing.assert_array_equal(alone.num_t1, together.num_t1[k])
        np.testing.assert_allclose(alone.tissue.vertices, together.tissue.vertices[k], atol=1e-9)


@pytest.mark.thorough
def test_relaxation_does_not_drift():
    tissue = random_tissue(12, 3)
    equilibrium = vx.equilibrate(tissue, ShapeFactorEnergy(jnp.full(12, 3.7)))
    np.testing.assert_allclose(
        equilibrium.tissue.vertices.mean(0), tissue.vertices.mean(0), atol=1e-12
    )


@pytest.mark.thorough
def test_equilibrium_does_not_depend_on_where_the_box_is():
    tissue = random_tissue(12, 3)
    moved = tissue.with_configuration(tissue.vertices + jnp.array([3.3, -7.1]))
    energy = ShapeFactorEnergy(shape_factors(12, 3.7, 0.1))
    a, b = vx.equilibrate(tissue, energy), vx.equilibrate(moved, energy)
    np.testing.assert_allclose(a.tissue.areas, b.tissue.areas, atol=1e-7)


class Scaled(vx.AbstractEnergy):
    """An energy in another unit."""

    energy: vx.AbstractEnergy
    unit: float

    def __call__(self, tissue):
        return self.unit * self.energy(tissue)


@pytest.mark.parametrize(
    "solver", [vx.solvers.NewtonCG(), vx.solvers.FIRE()], ids=["newton", "fire"]
)
@pytest.mark.thorough
def test_units_do_not_matter(solver):
    # The same physics in cells, in micrometres and in pixels, with all defaults and any unit of energy.
    tissue, p0 = random_tissue(12, 3), shape_factors(12, 3.7, 0.1)
    relax = vx.Relaxation(solver, contact_range=None)
    a = relax(tissue, Scaled(ShapeFactorEnergy(p0, 1.0), 1.0))
    for scale, unit in ((37.0, 1.0), (0.01, 1e8), (1.0, 1e-9)):
        lattice = scale * tissue.boundary.lattice
        other = vx.initialise.periodic_voronoi(12, key=jax.random.key(3), lattice=lattice)
        b = relax(other, Scaled(ShapeFactorEnergy(p0, scale**2), unit))
        np.testing.assert_allclose(b.tissue.areas, scale**2 * a.tissue.areas, rtol=1e-6)
        assert abs(int(b.num_steps) - int(a.num_steps)) <= 0.1 * a.num_steps + 1


def test_another_number_compiles_nothing():
    tissue = random_tissue(12, 0)

    default = vx.ImplicitDifferentiation()

    def relax(
        p0: float,
        tolerance: float,
        max_steps: int,
        threshold: float,
        adjoint: vx.adjoints.AbstractAdjoint = default,
    ):
        rule = vx.T1(threshold)
        settings = {"tolerance": tolerance, "max_steps": max_steps, "transitions": rule}
        settings["contact_range"] = None
        return vx.equilibrate(tissue, ShapeFactorEnergy(p0), adjoint=adjoint, **settings)

    compiled = []
    assert relax(3.7, 1e-8, 1000, 0.02).converged
    with counted_compilations(compiled):
        assert relax(3.71, 1e-9, 1001, 0.03).converged
        assert relax(3.72, 1e-7, 500, 0.01).converged
        # Where nothing is differentiated, another adjoint neither.
        assert relax(3.7, 1e-8, 500, 0.02, vx.EquilibriumPropagation()).converged
    assert not compiled


@pytest.mark.thorough
def test_a_compiled_gradient_is_cached_on_disk():
    # JAX keeps no program that calls back to the host, as an error raised within it does.
    tissue, adjoint = random_tissue(6, 0), vx.ImplicitDifferentiation(throw=False)
    relax = lambda factor: vx.equilibrate(
        tissue, ShapeFactorEnergy(factor), adjoint=adjoint, throw=False
    )
    cost = lambda factor: jnp.sum(relax(factor).tissue.edge_lengths)
    program = jax.jit(jax.value_and_grad(cost)).lower(jnp.asarray(3.7)).as_text()
    assert "callback" not in program


def test_consecutive_steps_are_counted():
    tissue, energy = relaxed(12, seed=1)
    run = lambda consecutive_steps: vx.equilibrate(
        tissue,
        energy,
        solver=vx.solvers.GradientDescent(1e-3),
        transitions=None,
        contact_range=None,
        tolerance=1e-6,
        consecutive_steps=consecutive_steps,
    )
    assert run(1).num_steps == 0
    assert run(10).num_steps == 9


@pytest.mark.thorough
def test_the_protocol_of_the_paper_reports_no_convergence():
    equilibrium = vx.equilibrate(
        random_tissue(12, 0),
        ShapeFactorEnergy(shape_factors(12, 3.7, 0.1)),
        solver=vx.solvers.GradientDescent(1e-2),
        tolerance=1e-3,
        consecutive_steps=10,
        max_steps=1000,
        transitions=vx.T1(5e-3),
        contact_range=None,
        throw=False,
    )
    assert equilibrium.num_steps <= 1000
    assert equilibrium.converged == (equilibrium.max_force < 1e-3)


def test_no_convergence_is_an_error_by_default_and_a_result_otherwise():
    tissue, energy = random_tissue(12, 0), ShapeFactorEnergy(jnp.full(12, 3.7))
    with pytest.raises(Exception, match=r"no equilibrium.*after 2 steps"):
        vx.equilibrate(tissue, energy, max_steps=2)
    # (Without contacts two steps from the random tissue make cells overlap, which has another message.)
    few, lattice = (
        dataclasses.replace(FIXED_TOPOLOGY, max_steps=2, tolerance=1e-30),
        vx.initialise.hexagonal(3, 4),
    )
    with pytest.raises(Exception, match="reached no equilibrium"):
        jax.jit(lambda t: few(t, energy).energy)(lattice).block_until_ready()
    equilibrium = vx.equilibrate(tissue, energy, max_steps=2, throw=False)
    assert not equilibrium.converged
    assert equilibrium.num_steps == 2
    assert equilibrium.result == vx.RESULTS.nonlinear_max_steps_reached


def test_a_nan_parameter_is_reported():
    # An energy refuses NaN when it is made; an optimiser may make it later.
    p0 = lambda e: e.target_shape_factor
    energy = eqx.tree_at(p0, ShapeFactorEnergy(jnp.full(12, 3.7)), jnp.full(12, jnp.nan))
    equilibrium = vx.equilibrate(random_tissue(12, 0), energy, throw=False)
    assert equilibrium.result == vx.RESULTS.nonfinite
    assert equilibrium.num_steps == 0
    message = "broke down: its forces are not finite. The parameters of the energy must be finite"
    with pytest.raises(RuntimeError, match=message):
        vx.equilibrate(random_tissue(12, 0), energy)
    tissue = random_tissue(12, 0)
    relax = eqx.filter_jit(lambda p: FIXED_TOPOLOGY(tissue, ShapeFactorEnergy(p)).energy)
    with pytest.raises(RuntimeError, match=message):
        relax(jnp.full(12, jnp.nan)).block_until_ready()


def equilibrium(**outcome):
    """An equilibrium of no relaxation, with a given outcome."""
    converged = vx.Equilibrium(
        tissue=random_tissue(5),
        energy=jnp.array(1.0),
        max_force=jnp.array(0.0),
        num_steps=jnp.array(3),
        num_t1=jnp.array(0),
        result=vx.RESULTS.successful,
    )
    return dataclasses.replace(converged, **outcome)


@pytest.mark.parametrize(
    ("outcome", "message"),
    [
        ({"result": vx.RESULTS.nonlinear_max_steps_reached}, "reached no equilibrium"),
        ({"result": vx.RESULTS.overlap}, "Cells of the tissue overlap"),
        ({"result": vx.RESULTS.no_progress}, "made no progress"),
        ({"max_force": jnp.array(jnp.nan), "result": vx.RESULTS.nonfinite}, "must be finite"),
    ],
)
def test_messages_in_compiled_programs_name_the_cause(outcome, message):
    failed = equilibrium(**outcome)
    with pytest.raises(RuntimeError, match=message):
        failed.checked()
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(eqx.filter_jit(lambda e: e.checked().energy)(failed))


class _Blind(vx.AbstractEnergy):
    """Springs to the origin, but for the first vertex."""

    def __call__(self, tissue):
        first = jnp.arange(tissue.n_vertices)[:, None] == 0
        return jnp.sum(jnp.where(first, 0, jnp.nan_to_num(tissue.vertices)) ** 2)


def test_a_relaxation_ends_where_an_energy_ignores_a_coordinate_that_is_nan():
    tissue = random_tissue(3, 1)
    tissue = tissue.with_vertices(tissue.vertices.at[0].set(jnp.nan))
    equilibrium = dataclasses.replace(FIXED_TOPOLOGY, max_steps=20)(tissue, _Blind(), throw=False)
    assert equilibrium.num_steps <= 20
    assert equilibrium.result == vx.RESULTS.nonfinite


@pytest.mark.parametrize(
    "options",
    [{"tolerance": 0.0}, {"tolerance": -1e-3}, {"consecutive_steps": 0}, {"max_steps": 0}],
)
def test_bad_settings_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        vx.equilibrate(random_tissue(5), ShapeFactorEnergy(3.7), **options)


def test_an_adjoint_that_would_unroll_is_refused():
    adjoint = optx.RecursiveCheckpointAdjoint()
    with pytest.raises(Exception, match="adjoint"):
        vx.equilibrate(random_tissue(5), ShapeFactorEnergy(3.7), adjoint=adjoint)  # pyright: ignore


class Substrate(vx.AbstractEnergy):
    """Springs from vertices to fixed positions: an energy that depends on absolute positions."""

    home: jax.Array
    stiffness: float = 0.3

    def __call__(self, tissue):
        tug = jnp.sum((tissue.vertices - self.home) ** 2)
        return vx.energies.ShapeFactorEnergy(3.6)(tissue) + 0.5 * self.stiffness * tug


@pytest.mark.parametrize("boundary", ["periodic", "free"])
@pytest.mark.thorough
def test_an_energy_may_depend_on_absolute_positions(boundary):
    tissue = random_tissue(9, 1) if boundary == "periodic" else cluster(6, 1, lloyd_steps=2)
    home = tissue.vertices + jnp.array([0.4, -0.2])
    # A cluster without tensions on its outline would overlap.
    contacts = 0.01 if boundary == "free" else None
    relax = vx.Relaxation(transitions=None, contact_range=contacts)
    equilibrium = relax(tissue, Substrate(home))
    assert equilibrium.converged
    assert float(np.max(np.abs(pull_of(equilibrium.tissue, Substrate(home))))) < 1e-8
    # Inner forces move no centroid, so that of the springs decides.
    np.testing.assert_allclose(jnp.mean(equilibrium.tissue.vertices - home, axis=0), 0, atol=1e-8)
    # Without springs the whole stays where it was.
    stays = relax(tissue, Substrate(home, 0.0)).tissue
    np.testing.assert_allclose(jnp.mean(stays.vertices - tissue.vertices, axis=0), 0, atol=1e-9)


@pytest.mark.thorough
def test_a_second_call_checks_no_numbers_and_traces_nothing(monkeypatch):
    traces = []

    class Counted(vx.AbstractEnergy):
        p0: jax.Array

        def __call__(self, tissue):
            traces.append(1)
            return ShapeFactorEnergy(self.p0)(tissue)

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("called in the second call")

    relax = lambda tissue, p0: vx.equilibrate(tissue, Counted(jnp.array(p0)), tolerance=1e-7)
    first = relax(random_tissue(6, 0), 3.7)
    # Evaluating the final energy outside of the compiled part would count too.
    number = len(traces)
    monkeypatch.setattr(_relaxation, "check_number", refuse)
    monkeypatch.setattr(dataclasses, "replace", refuse)
    assert relax(first.tissue, 3.7).num_steps == 0
    assert relax(random_tissue(6, 1), 3.61).num_steps > 0
    assert number == len(traces) > 0
