"""Saving and loading energies and inverse problems."""

import dataclasses
import json
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optax
import pytest
from free_helpers import cluster
from helpers import FIXED_TOPOLOGY, random_tissue, rewritten
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from jaxtyping import Array, Float

import vertax as vx
from vertax.io import load, save
from vertax.io._module_file import _class_of, _name_of
from vertax.solvers._stop_at_rest import AtRest


class Contractility(vx.AbstractEnergy):
    strength: Float[Array, " cells"]
    exponent: float = 2.0
    name: str = eqx.field(static=True, default="own")

    def __call__(self, tissue):
        return jnp.sum(self.strength * tissue.perimeters**self.exponent)


class Anything(vx.AbstractEnergy):
    value: Any

    def __call__(self, tissue):
        return jnp.zeros(())


class Nearest(vx.AbstractCost):
    target: vx.Tissue

    def __call__(self, tissue, energy):
        return jnp.sum((tissue.vertices - self.target.vertices) ** 2)


class Steepest(vx.solvers.GradientDescent):
    rate: float = 0.0


def same(a, b):
    """Whether two objects have equal types and bits in all parts."""
    if type(a) is not type(b) and not (isinstance(a, jax.Array) and isinstance(b, jax.Array)):
        return False
    if isinstance(a, eqx.Module):
        return vars(a).keys() == vars(b).keys() and all(
            same(x, vars(b)[name]) for name, x in vars(a).items()
        )
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(map(same, a.values(), b.values()))
    if isinstance(a, jax.Array) and a.weak_type != b.weak_type:
        return False
    if isinstance(a, jax.Array | np.ndarray | np.generic | float):
        bits = lambda x: (np.asarray(x).dtype, np.shape(x), np.asarray(x).tobytes())
        return bits(a) == bits(b)
    return a == b


def single(tree):
    """The tree in float32."""
    return jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree)


def tree_of(path):
    with np.load(path) as archive:
        return json.loads(str(archive["tree"]))


N = 8
E = vx.energies
ENERGIES = {
    "constants": E.AreaElasticity(1.0, 0.1),
    "arrays": E.ShapeFactorEnergy(jnp.linspace(3.6, 3.9, N)),
    "weak": E.LineTension(jnp.full(3 * N, 0.1)),
    "bounded": E.BoundedTension(jnp.linspace(0.1, 0.9, 3 * N), 0.0, 1.0),
    "local sum": E.AreaElasticity(1.0, jnp.ones(N)) + E.PerimeterElasticity(0.1, jnp.array(3.0)),
    "sum": E.LineTension(jnp.ones(3 * N)) + Contractility(jnp.arange(1.0, N + 1)),
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "module.npz"


@pytest.fixture(scope="module")
def tissues():
    free = cluster(N)
    return {"periodic": random_tissue(N), "free": eqx.tree_at(lambda t: t.softening, free, 0.01)}


def problem_of(tissue, **options):
    """A problem with something in every field."""
    settings: dict = {
        "tissue": tissue,
        "energy": E.AreaElasticity(1.0, 1.0) + E.LineTension(jnp.full(tissue.n_edges, 0.1)),
        "cost": 0.9 * vx.costs.VertexDistance(tissue) + 0.1 * vx.costs.CellAreas(tissue.areas),
        "adjoint": vx.ImplicitDifferentiation("sensitivity", linear_solver=vx.MINRES(rtol=1e-9)),
        "response": vx.Relaxation(vx.solvers.FIRE(time_step=0.01), vx.T1(0.01), 1e-8, 2, 300),
        "guidance": jnp.array(0.5),
    }
    return vx.InverseProblem(**(settings | options))


class TestRoundTrip:
    @pytest.mark.parametrize("name", ENERGIES)
    @pytest.mark.parametrize("precision", ["float32", "float64"])
    def test_energies(self, path, name, precision):
        energy = single(ENERGIES[name]) if precision == "float32" else ENERGIES[name]
        save(path, energy)
        loaded = load(path, vx.AbstractEnergy, classes=[Contractility])
        assert same(loaded, energy)
        assert jax.tree.structure(loaded) == jax.tree.structure(energy)

    def test_a_loaded_energy_is_as_good_as_the_first(self, path):
        tissue, energy = random_tissue(N), ENERGIES["sum"]
        save(path, energy)
        loaded = load(path, vx.AbstractEnergy, classes=[Contractility])
        assert loaded(tissue) == energy(tissue)

    arrays = hnp.arrays(
        st.sampled_from(["f4", "f8", "i2", "i4", "i8", "u1", "u8", "?", "c8", "c16", ">f8"]),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0),
    )
    leaves = (
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=False)
        | st.just(float("nan"))
        | st.text(max_size=5)
        | arrays
        | arrays.filter(lambda a: a.dtype.isnative).map(jnp.asarray)
        | st.floats().map(lambda x: jnp.full(2, x))
        | st.sampled_from([np.float32(0.1), np.int64(3), np.bool_(True)])
    )
    trees = st.recursive(
        leaves,
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.lists(inner, max_size=3).map(tuple)
            | st.dictionaries(st.text(max_size=5), inner, max_size=3)
            | inner.map(Anything)
        ),
        max_leaves=6,
    )

    @given(trees)
    @settings(max_examples=150, deadline=None)
    def test_whatever_a_field_holds(self, tmp_path_factory, value):
        path = tmp_path_factory.getbasetemp() / "anything.npz"
        save(path, Anything(value))
        assert same(load(path, vx.AbstractEnergy, classes=[Anything]), Anything(value))

    def test_networks_are_saved_with_their_functions(self, path):
        network = eqx.nn.MLP(1, 1, 4, 2, jax.nn.softplus, key=jax.random.key(0))
        save(path, Anything(network))
        loaded = load(path, Anything, classes=[Anything, eqx.nn.MLP, eqx.nn.Linear])
        assert loaded.value.activation is jax.nn.softplus
        assert same(loaded, Anything(network))

    @pytest.mark.parametrize("boundary", ["periodic", "free"])
    @pytest.mark.parametrize("precision", ["float32", "float64"])
    def test_problems(self, path, tissues, boundary, precision):
        problem = problem_of(tissues[boundary])
        problem = single(problem) if precision == "float32" else problem
        save(path, problem)
        assert same(load(path, vx.InverseProblem), problem)
        with jax.enable_x64(precision == "float64"):
            assert same(load(path, vx.InverseProblem), problem)

    @pytest.mark.parametrize(
        "options",
        [
            {"response": vx.Relaxation(transitions=None), "guidance": None},
            {"fit_position": True, "adjoint": vx.EquilibriumPropagation(1e-4, nudge="cost")},
            {"adjoint": vx.AutomaticDifferentiation(throw=False, outcome=vx.GradientOutcome())},
            {"response": vx.Relaxation(vx.solvers.GradientDescent(jnp.array(1e-3)))},
            {"trainable": eqx.is_array},
        ],
    )
    def test_settings(self, path, tissues, options):
        problem = problem_of(tissues["periodic"], **options)
        save(path, problem)
        assert same(load(path, vx.InverseProblem), problem)

    @pytest.mark.parametrize("boundary", ["periodic", "free"])
    def test_costs(self, path, tissues, boundary):
        tissue, c = tissues[boundary], vx.costs
        size = {} if boundary == "periodic" else {"pixel_size": 0.2}
        costs = [
            c.MeshImage(np.random.default_rng(0).random((16, 20)), 0.2, **size),
            c.CentroidDistance(tissue) + 2 * c.MeanShapeFactor(3.8),
            c.IndexAwareStructural(tissue, epsilon=0.2),
            c.VertexDistance(tissue, match="cells"),
            c.HomotypicLength(np.arange(N) % 2, relative=True),
            c.AspectRatio(1.5, "farthest"),
        ]
        for cost in costs:
            problem = problem_of(tissue, cost=cost)
            save(path, problem)
            assert same(load(path, vx.InverseProblem), problem)

    def test_trainable_leaves(self, path, tissues):
        problem = problem_of(tissues["periodic"])
        mask = eqx.tree_at(
            lambda e: e.terms[0].stiffness, jax.tree.map(eqx.is_array, problem.energy), True
        )
        problem = dataclasses.replace(problem, trainable=mask)
        save(path, problem)
        assert same(load(path, vx.InverseProblem), problem)

    def test_a_batch(self, path, tissues):
        problem = problem_of(tissues["periodic"])
        batch = jax.tree.map(lambda x: jnp.stack([x, x]) if eqx.is_array(x) else x, problem)
        save(path, batch)
        assert same(load(path, vx.InverseProblem), batch)

    def test_classes_of_ones_own(self, path, tissues):
        tissue = tissues["periodic"]
        problem = problem_of(
            tissue,
            energy=Contractility(jnp.ones(N)),
            cost=Nearest(tissue) + vx.costs.MeanShapeFactor(3.8),
            adjoint=vx.ImplicitDifferentiation(linear_solver=lx.LU()),
            response=vx.Relaxation(vx.solvers.Wrapped(Steepest(jnp.array(0.1), rate=2.0))),
        )
        save(path, problem)
        loaded = load(path, vx.InverseProblem, classes=[Contractility, Nearest, lx.LU, Steepest])
        assert same(loaded, problem)

    @pytest.mark.thorough
    def test_a_loaded_problem_has_the_same_gradient(self, path, tissues):
        problem = problem_of(tissues["periodic"], response=FIXED_TOPOLOGY, guidance=None)
        save(path, problem)
        gradient = eqx.filter_jit(lambda p: p.value_and_gradient().gradient)
        assert same(gradient(load(path, vx.InverseProblem)), gradient(problem))

    def test_a_new_field_gets_its_default(self, path):
        save(path, Contractility(jnp.ones(3), 4.0, "named"))
        tree = tree_of(path)
        del tree["fields"]["exponent"]
        rewritten(path, tree=json.dumps(tree))
        loaded = load(path, vx.AbstractEnergy, classes=[Contractility])
        assert same(loaded, Contractility(jnp.ones(3), 2.0, "named"))


@pytest.mark.parametrize("generator", ["threefry2x32", "rbg"])
def test_random_keys_are_restored(tmp_path, generator):
    energy = Anything({"one": jax.random.key(3, impl=generator), "text": "a", "none": None})
    energy = Anything((energy, jax.random.split(energy.value["one"], 4)))
    save(tmp_path / "energy.npz", energy)
    loaded = load(tmp_path / "energy.npz", vx.AbstractEnergy, classes=[Anything])
    assert isinstance(loaded, Anything)
    assert jax.tree.structure(loaded) == jax.tree.structure(energy)
    for new, old in zip(jax.tree.leaves(loaded), jax.tree.leaves(energy), strict=True):
        if isinstance(old, jax.Array):
            assert new.dtype == old.dtype
            assert jax.random.normal(new.ravel()[0]) == jax.random.normal(old.ravel()[0])
    rewritten(tmp_path / "energy.npz", **{"data.value.1": np.zeros((4, 7), np.uint32)})
    with pytest.raises(ValueError, match="is not a key of the generator"):
        load(tmp_path / "energy.npz", vx.AbstractEnergy, classes=[Anything])


class TestRefusedToSave:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (
                {"response": vx.Relaxation(vx.solvers.Optax(optax.adam(1e-2)))},
                r"`response\.solver\.optimiser` is of type GradientTransf.*response=vx\.Relaxation\(\)",
            ),
            ({"response": vx.Relaxation(vx.solvers.LBFGS())}, r"`response\.solver\.optimiser`"),
            ({"trainable": lambda x: True}, r"`trainable` is a function.*jax\.tree\.map"),
            ({"energy": Anything({1, 2})}, r"`energy\.value` is of type set"),
            ({"energy": Anything((0, {3: 4}))}, r"`energy\.value\.1` is of type dict"),
            ({"energy": Anything(jnp.ones(2, jnp.bfloat16))}, r"`energy\.value` is bfloat16"),
            ({"energy": Anything(optax.EmptyState())}, r"`energy\.value` is of type EmptyState"),
        ],
    )
    def test_fields_that_cannot_be_stored_raise(self, path, tissues, options, message):
        problem = problem_of(tissues["periodic"], **options)
        with pytest.raises(ValueError, match=rf"Argument `content`.*{message}"):
            save(path, problem)
        assert os.listdir(path.parent) == []

    def test_parts_of_vertax_that_belong_elsewhere(self, path):
        with pytest.raises(ValueError, match=r"`value` is of class AtRest, .*not a public one"):
            save(path, Anything(AtRest()))

    def test_the_remedies_work(self, path, tissues):
        response = vx.Relaxation(vx.solvers.Optax(optax.adam(1e-2)))
        problem = problem_of(tissues["periodic"], response=response, trainable=eqx.is_inexact_array)
        without = dataclasses.replace(problem, response=vx.Relaxation())
        save(path, without)
        assert same(dataclasses.replace(load(path, vx.InverseProblem), response=response), problem)
        mask = jax.tree.map(lambda x: eqx.is_array(x) and x.size > 1, problem.energy)
        save(path, dataclasses.replace(without, trainable=mask))
        assert same(load(path, vx.InverseProblem).trainable, mask)


class TestRefusedToLoad:
    @pytest.fixture
    def saved(self, path):
        save(path, ENERGIES["sum"])
        return path

    def load(self, path):
        return load(path, vx.AbstractEnergy, classes=[Contractility])

    def test_foreign_files(self, saved, tmp_path, tissues):
        (tmp_path / "notes.txt").write_text("cells")
        with pytest.raises(ValueError, match=r"notes\.txt is not a vertax data file"):
            load(tmp_path / "notes.txt", vx.AbstractEnergy)
        vx.save(tmp_path / "tissue.npz", tissues["free"])
        with pytest.raises(
            ValueError, match=r"`kind` must be .*tissue\.npz, Tissue, or .* AbstractE"
        ):
            load(tmp_path / "tissue.npz", vx.AbstractEnergy)
        with pytest.raises(ValueError, match=r"`kind` must be .*module\.npz, Sum.*InverseProblem"):
            load(saved, vx.InverseProblem, classes=[Contractility])

    def test_64_bits_without_x64(self, saved):
        with jax.enable_x64(False), pytest.raises(ValueError, match=r"module.*jax_enable_x64"):
            self.load(saved)

    def test_a_class_that_was_not_given(self, saved):
        with pytest.raises(ValueError, match=r"class Contractility \(at `content\.terms\.1`\)"):
            load(saved, vx.AbstractEnergy)

    def test_a_class_is_never_imported(self, saved):
        tree = tree_of(saved)
        for kind, name in (("own", "os.system"), ("vertax", "io.write_csv")):
            tree["fields"]["terms"]["items"][1] |= {"kind": kind, "class": name}
            rewritten(saved, tree=json.dumps(tree))
            with pytest.raises(ValueError, match=name):
                self.load(saved)

    def test_classes_that_cannot_be_told_apart(self, saved):
        other = type("Contractility", (Contractility,), {})
        with pytest.raises(ValueError, match="two classes of the name Contractility"):
            load(saved, vx.AbstractEnergy, classes=[Contractility, other])

    def test_another_version_of_a_class(self, saved):
        class Contractility(vx.AbstractEnergy):
            rigidity: Float[Array, " cells"]

            def __call__(self, tissue):
                return jnp.zeros(())

        with pytest.raises(
            ValueError, match=r"module\.npz has a field `strength`.*another version"
        ):
            load(saved, vx.AbstractEnergy, classes=[Contractility])
        tree = tree_of(saved)
        tree["fields"]["terms"]["items"][1]["fields"] = {}
        rewritten(saved, tree=json.dumps(tree))
        with pytest.raises(ValueError, match=r"module\.npz has no field `rigidity`"):
            load(saved, vx.AbstractEnergy, classes=[Contractility])

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"tree": None}, "`tree` cannot be read"),
            ({"tree": "{"}, "`tree` cannot be read"),
            ({"tree": "[" * 100_000}, "`tree` cannot be read"),
            ({"tree": "3"}, ", int, or a base class, but is AbstractEnergy"),
            ({"tree": '{"kind": "set", "items": []}'}, "not one of the things"),
            (
                {"tree": '{"kind": "vertax", "class": "mesh.Free", "fields": {}}'},
                ", Free, or a base class",
            ),
            ({"data.terms.0.tension": None}, r"no array `data\.terms\.0\.tension`"),
            ({"version": 0}, "broken header"),
        ],
    )
    def test_contradictions(self, saved, changes, message):
        rewritten(saved, **changes)
        with pytest.raises(ValueError, match=rf"module\.npz.*{message}"):
            self.load(saved)

    def test_a_broken_mesh(self, path, tissues):
        save(path, problem_of(tissues["periodic"]))
        twin = np.zeros(6 * N, np.int32)
        rewritten(path, **{"data.tissue.topology.twin": twin})
        with pytest.raises(ValueError, match=r"module\.npz is broken: `content\.tissue\.topology`"):
            load(path, vx.InverseProblem)
        save(path, problem_of(tissues["periodic"]))
        rewritten(path, **{"data.tissue.vertices": np.zeros((3, 2))})
        with pytest.raises(
            ValueError, match=r"`content\.tissue`: .*`vertices` must have shape \(16, 2\)"
        ):
            load(path, vx.InverseProblem)


@pytest.mark.parametrize(
    "response",
    [
        vx.Relaxation(transitions=vx.T1() + vx.T2()),
        vx.Evolution(vx.dissipations.SubstrateFriction(2.0), [0.0, 0.5]),
        vx.mechanics.BoxRelaxation(stress=0.1),
    ],
    ids=["transitions that add", "movement", "box"],
)
def test_every_response_can_be_stored(path, tissues, response):
    target, energy = tissues["periodic"], vx.energies.ShapeFactorEnergy(3.7)
    cost = vx.costs.VertexDistance(target)
    problem = vx.InverseProblem(target, energy, cost, response=response)
    save(path, problem)
    assert same(load(path, vx.InverseProblem), problem)


def test_every_public_part_of_a_problem_can_be_stored():
    parts = (vx.AbstractBoundary, vx.AbstractTransitions, vx.AbstractCost, vx.AbstractEnergy)
    parts += (vx.adjoints.AbstractAdjoint, vx.solvers.AbstractSolver)
    for family in (vx, vx.adjoints, vx.costs, vx.energies, vx.solvers):
        for name, cls in vars(family).items():
            if isinstance(cls, type) and issubclass(cls, parts) and "Abstract" not in name:
                assert _class_of(_name_of(cls)) is cls, name
