from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.sparse.linalg as spla
from hypothesis import given, settings, strategies as st

from vertax.solvers import MINRES

DEFAULT = MINRES()


def matrix(eigenvalues, seed=0):
    """A symmetric matrix with these eigenvalues and random eigenvectors, and the eigenvectors."""
    size = len(eigenvalues)
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))
    a = (q * np.asarray(eigenvalues)) @ q.T
    return (a + a.T) / 2, q


def random_vector(size, seed=1):
    return np.random.default_rng(seed).standard_normal(size)


def operator(a):
    return lx.MatrixLinearOperator(jnp.asarray(a), lx.symmetric_tag)


@eqx.filter_jit
def solve(a, b, solver=DEFAULT, options=None, throw=True):
    a = operator(a) if eqx.is_array_like(a) else a
    b = jax.tree.map(jnp.asarray, b)
    return lx.linear_solve(a, b, solver, options=options, throw=throw)


def assert_close(x, y, rtol):
    error = np.linalg.norm(np.asarray(x) - np.asarray(y))
    assert error <= rtol * np.linalg.norm(np.asarray(y)), error


DEFINITE = np.linspace(1.0, 30.0, 40)
INDEFINITE = np.concatenate([np.linspace(-9.0, -1.0, 15), np.linspace(1.0, 30.0, 25)])
SINGULAR = np.concatenate([np.zeros(3), np.linspace(-9.0, -1.0, 12), np.linspace(1.0, 30.0, 25)])


# Agreement with other solvers


@pytest.mark.parametrize("eigenvalues", [DEFINITE, -DEFINITE, INDEFINITE])
def test_agrees_with_scipy_and_with_a_direct_solve(eigenvalues):
    a, _ = matrix(eigenvalues)
    b = random_vector(40)
    solution = solve(a, b)
    reference, info = spla.minres(a, b, rtol=1e-12)
    assert info == 0
    assert_close(solution.value, reference, 1e-8)
    assert_close(solution.value, np.linalg.solve(a, b), 1e-9)


def test_takes_no_more_steps_than_scipy_to_the_same_residual():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    residuals = []
    spla.minres(a, b, rtol=1e-15, callback=lambda x: residuals.append(np.linalg.norm(b - a @ x)))
    needed = 1 + np.argmax(np.asarray(residuals) <= 1e-8 * np.linalg.norm(b))
    assert solve(a, b, MINRES(rtol=1e-8)).stats["num_steps"] == needed


def test_consistent_singular_system_gives_the_shortest_solution():
    a, _ = matrix(SINGULAR)
    b = a @ random_vector(40)
    solution = solve(a, b)
    reference, _ = spla.minres(a, b, rtol=1e-12)
    assert_close(solution.value, reference, 1e-8)
    assert_close(solution.value, np.linalg.pinv(a, hermitian=True) @ b, 1e-9)
    assert not solution.stats["inconsistent"]


@pytest.mark.parametrize("condition", [1e1, 1e2, 1e3, 1e4, 1e5])
@pytest.mark.parametrize("seed", range(3))
def test_inconsistent_system_gives_the_pseudo_inverse_solution(condition, seed):
    signs = np.random.default_rng(seed).choice([-1, 1], 37)
    nonzero = signs * np.logspace(0, -np.log10(condition), 37)
    a, _ = matrix(np.concatenate([np.zeros(3), nonzero]), seed)
    b = random_vector(40)
    expected = np.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b
    solution = solve(a, b)
    assert_close(solution.value, expected, 1e-8)
    assert solution.stats["inconsistent"]
    np.testing.assert_allclose(
        solution.stats["residual_norm"],
        np.linalg.norm(b - a @ expected) / np.linalg.norm(b),
        rtol=1e-6,
    )


def test_scipy_blows_up_where_we_do_not():
    # The reason for our stopping rules. If SciPy learns to do better, look there.
    a, _ = matrix(np.concatenate([np.zeros(4), np.linspace(0.1, 1.0, 56)]))
    b = random_vector(60)
    expected = np.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b
    theirs, _ = spla.minres(a, b, rtol=1e-10)
    assert np.linalg.norm(theirs) > 1e3 * np.linalg.norm(expected)
    assert_close(solve(a, b).value, expected, 1e-8)


def test_loose_tolerance_stops_an_inconsistent_system_early():
    a, _ = matrix(SINGULAR)
    b = random_vector(40)
    loose, tight = solve(a, b, MINRES(rtol=1e-3)), solve(a, b)
    assert loose.stats["inconsistent"]
    assert loose.stats["num_steps"] < 0.8 * tight.stats["num_steps"]
    assert_close(loose.value, np.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b, 5e-2)


def test_lifting_removes_the_part_along_the_null_space():
    a, q = matrix(SINGULAR)
    x = solve(a, random_vector(40), MINRES(rtol=1e-3)).value
    # Plain MINRES leaves as much of b's null part in x as it likes; the lifted x has none of it.
    assert np.linalg.norm(q[:, :3].T @ x) < 1e-2 * np.linalg.norm(x)
    plain, _ = spla.minres(a, random_vector(40), rtol=1e-3)
    assert np.linalg.norm(q[:, :3].T @ plain) > 1e-2 * np.linalg.norm(plain)


def test_float32():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    solution = solve(a.astype(np.float32), b.astype(np.float32))
    assert solution.value.dtype == jnp.float32
    assert solution.stats["residual_norm"] < 5e-5
    assert_close(solution.value, np.linalg.solve(a, b), 2e-3)


def test_float32_inconsistent():
    a, _ = matrix(SINGULAR)
    b = random_vector(40)
    solution = solve(a.astype(np.float32), b.astype(np.float32))
    assert solution.stats["inconsistent"]
    assert_close(solution.value, np.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b, 2e-3)


def test_float32_vector_with_vanishing_squares():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    solution = solve(a.astype(np.float32), (1e-30 * b).astype(np.float32))
    assert_close(1e30 * np.asarray(solution.value, np.float64), np.linalg.solve(a, b), 2e-3)


@pytest.mark.parametrize("condition", [1e4, 1e6, 1e7])
def test_ill_conditioned(condition):
    signs = np.random.default_rng(3).choice([-1, 1], 40)
    a, _ = matrix(signs * np.logspace(0, -np.log10(condition), 40))
    b = random_vector(40)
    solution = solve(a, b)
    assert_close(solution.value, np.linalg.solve(a, b), 1e-7)
    assert not solution.stats["inconsistent"]
    # This far down the residual test cannot be met, and the statistics say so.
    assert solution.stats["stagnated"] == (condition > 1e5)
    assert (solution.stats["residual_norm"] > 1e-10) == (condition > 1e5)


# Special systems


def test_zero_vector_gives_zero_without_a_step():
    solution = solve(matrix(INDEFINITE)[0], np.zeros(40))
    np.testing.assert_array_equal(solution.value, 0)
    assert solution.stats["num_steps"] == 0
    assert solution.stats["residual_norm"] == 0


@pytest.mark.parametrize("entry", [2.0, -2.0, 1e-12])
def test_one_by_one(entry):
    np.testing.assert_allclose(solve(np.array([[entry]]), np.array([3.0])).value, [3 / entry])


def test_one_by_one_zero():
    solution = solve(np.array([[0.0]]), np.array([3.0]))
    assert solution.value == 0
    assert solution.stats["inconsistent"]


def test_multiple_of_the_identity_takes_one_step():
    b = random_vector(40)
    solution = solve(-3 * np.eye(40), b)
    assert solution.stats["num_steps"] == 1
    np.testing.assert_allclose(solution.value, b / -3, rtol=1e-14)


def test_zero_operator():
    solution = solve(np.zeros((40, 40)), random_vector(40))
    np.testing.assert_array_equal(solution.value, 0)
    assert solution.stats["inconsistent"]
    np.testing.assert_allclose(solution.stats["residual_norm"], 1)


def test_vector_in_the_null_space_gives_zero():
    # The product of the periodic Laplacian with a constant is exactly zero, with a random null
    # vector it is rounding error, from which Lanczos would otherwise make a basis.
    a, q = matrix(np.concatenate([np.zeros(3), np.linspace(1, 5, 37)]))
    b = q[:, :3] @ np.array([1.0, -2.0, 0.5])
    solution = solve(a, b)
    assert np.linalg.norm(solution.value) < 1e-10 * np.linalg.norm(b)
    assert solution.stats["inconsistent"]


def test_number_of_steps_is_the_number_of_distinct_eigenvalues():
    a, _ = matrix(np.repeat([-2.0, 1.0, 5.0, 6.0], 10))
    assert solve(a, random_vector(40)).stats["num_steps"] == 4


def test_zero_tolerances_stop_at_rounding_and_say_so():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    solution = solve(a, b, MINRES(rtol=0.0))
    assert solution.stats["stagnated"]
    assert solution.stats["residual_norm"] < 1e-13
    assert not solve(a, b).stats["stagnated"]


def test_absolute_tolerance():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    residual = lambda atol: np.linalg.norm(b - a @ solve(a, b, MINRES(rtol=0.0, atol=atol)).value)
    assert 1e-7 < residual(1e-2) < 1e-2
    assert residual(1e-7) < 1e-7


# Structure, transformations


def test_pytrees():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    split = lambda x: {"vertices": x[:30].reshape(15, 2), "box": (x[30:], None)}
    join = lambda t: jnp.concatenate([t["vertices"].reshape(-1), t["box"][0]])
    b_tree = split(jnp.asarray(b))
    op = lx.FunctionLinearOperator(
        lambda t: split(a @ join(t)), jax.eval_shape(lambda: b_tree), lx.symmetric_tag
    )
    value = solve(op, b_tree).value
    assert jax.tree.structure(value) == jax.tree.structure(b_tree)
    assert_close(join(value), np.linalg.solve(a, b), 1e-9)


@pytest.mark.thorough
def test_hessian_is_linearised_once():
    energy = lambda x, _: jnp.sum(jnp.cos(x) * jnp.roll(x, 1) ** 2)
    x = jnp.asarray(random_vector(12))
    op = lx.JacobianLinearOperator(lambda x, _: jax.grad(energy)(x, None), x, tags=lx.symmetric_tag)
    b = random_vector(12)
    state = MINRES().init(op, {})
    assert isinstance(state, lx.FunctionLinearOperator)
    hessian = jax.hessian(energy)(x, None)
    assert_close(solve(op, b).value, np.linalg.solve(hessian, b), 1e-8)


def test_two_products_are_compiled():
    # The recurrence has one in each step, and the looks after each solve share another.
    a = jnp.asarray(matrix(INDEFINITE)[0])
    jaxpr = jax.make_jaxpr(lambda b: MINRES().compute(operator(a), b, {})[0])(jnp.ones(40))

    def products(jaxpr):
        for eqn in jaxpr.eqns:
            shapes = [v.aval.shape for v in eqn.invars]
            yield eqn.primitive.name == "dot_general" and (40, 40) in shapes
            for inner in jax.tree.leaves(
                eqn.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
            ):
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from products(getattr(inner, "jaxpr", inner))

    assert sum(products(jaxpr.jaxpr)) == 2


def test_vmap_over_operators_and_vectors():
    # One lane of each kind: the loop must go on for some after it has ended for others.
    kinds = [DEFINITE, INDEFINITE, SINGULAR, np.full(40, 2.0)]
    a = np.stack([matrix(kind, seed)[0] for seed, kind in enumerate(kinds)])
    b = np.stack([random_vector(40, seed) for seed in range(4)])
    solution = jax.vmap(solve)(a, b)
    for i in range(4):
        alone = solve(a[i], b[i])
        assert_close(solution.value[i], alone.value, 1e-8)
        assert solution.stats["inconsistent"][i] == alone.stats["inconsistent"]
    assert solution.stats["num_steps"][3] == 1


def test_vmap_confines_a_nan_to_its_entry():
    a, _ = matrix(INDEFINITE)
    b = np.stack([random_vector(40), np.full(40, np.nan)])
    solution = jax.vmap(partial(solve, throw=False), in_axes=(None, 0))(a, b)
    assert_close(solution.value[0], np.linalg.solve(a, b[0]), 1e-9)
    assert np.all(np.isnan(solution.value[1]))


@pytest.mark.parametrize(
    ("null", "in_range"),
    [
        pytest.param(0, True, marks=pytest.mark.thorough),
        pytest.param(2, True, marks=pytest.mark.thorough),
        (2, False),
    ],
)
def test_derivatives_agree_with_finite_differences(null, in_range):
    # Every part of the system depends on t, its null space included.
    nonzero = np.concatenate([np.linspace(-4.0, -1.0, 5), np.linspace(1.0, 7.0, 6)])
    a, q = matrix(np.concatenate([np.zeros(null), nonzero]))
    size = len(a)
    generator = np.random.default_rng(5).standard_normal((size, size))
    generator = (generator - generator.T) / 2

    def system(t):
        turn = jnp.linalg.solve(np.eye(size) - t * generator, np.eye(size) + t * generator)
        a_t = turn @ (a + t * a @ a) @ turn.T
        null_t = turn @ q[:, :null]
        b_t = jnp.asarray(random_vector(size)) * (1 + t) ** 2
        return (a_t + a_t.T) / 2, b_t - in_range * null_t @ (null_t.T @ b_t)

    x = lambda t: solve(*system(t), MINRES(rtol=1e-13)).value
    weights = random_vector(size, 7)
    t, h = 0.1, 1e-5
    exact = lambda t: np.linalg.pinv(system(t)[0], rcond=1e-10, hermitian=True) @ system(t)[1]
    difference = (exact(t + h) - exact(t - h)) / (2 * h)

    @jax.jit
    def derivatives(t):
        _, forward = jax.linearize(x, t)
        (backward,) = jax.linear_transpose(forward, t)(jnp.asarray(weights))
        return forward(1.0), backward

    tangent, gradient = derivatives(t)
    assert_close(tangent, difference, 1e-7)
    np.testing.assert_allclose(gradient, difference @ weights, rtol=1e-6)


@pytest.mark.thorough
def test_gradient_with_respect_to_the_matrix():
    a, _ = matrix(INDEFINITE[::4])
    b, w = random_vector(10), random_vector(10, 2)
    gradient = jax.jit(jax.grad(lambda a: solve((a + a.T) / 2, b).value @ w))(a)
    x, y = np.linalg.solve(a, b), np.linalg.solve(a, w)
    np.testing.assert_allclose(gradient, -(np.outer(y, x) + np.outer(x, y)) / 2, atol=1e-8)


def test_transpose_conj_and_rank():
    solver, op = MINRES(), operator(matrix(INDEFINITE)[0])
    state = solver.init(op, {})
    transposed, options = solver.transpose(state, {"y0": jnp.ones(40), "preconditioner": op})
    assert transposed is state
    assert options == {"preconditioner": op}
    assert solver.conj(state, {})[0] is state
    assert not solver.assume_full_rank()


# Options


def test_preconditioner_saves_steps_and_keeps_the_solution():
    rng = np.random.default_rng(2)
    diagonal = np.logspace(0, 4, 60) * rng.choice([-1, 1], 60)
    coupling = rng.standard_normal((60, 60))
    a = np.diag(diagonal) + 0.02 * (coupling + coupling.T)
    b = random_vector(60)
    preconditioner = lx.DiagonalLinearOperator(jnp.asarray(1 / abs(diagonal)))
    preconditioner = lx.TaggedLinearOperator(preconditioner, lx.positive_semidefinite_tag)
    plain = solve(a, b)
    better = solve(a, b, options={"preconditioner": preconditioner})
    assert better.stats["num_steps"] < 0.3 * plain.stats["num_steps"]
    assert_close(better.value, np.linalg.solve(a, b), 1e-8)
    assert_close(plain.value, np.linalg.solve(a, b), 1e-8)


def test_preconditioned_inconsistent_system_gives_the_weighted_pseudo_inverse():
    a, _ = matrix(SINGULAR)
    p, _ = matrix(np.linspace(0.5, 2.0, 40), seed=9)
    b = random_vector(40)
    root = np.linalg.cholesky(p)
    weighted = root @ np.linalg.pinv(root.T @ a @ root, rcond=1e-10) @ root.T @ b
    tagged = lx.MatrixLinearOperator(jnp.asarray(p), lx.positive_semidefinite_tag)
    solution = solve(a, b, options={"preconditioner": tagged})
    assert_close(solution.value, weighted, 1e-8)
    assert solution.stats["inconsistent"]


def test_preconditioner_that_is_not_definite_is_a_breakdown():
    a, _ = matrix(INDEFINITE)
    wrong = lx.MatrixLinearOperator(jnp.asarray(a), lx.positive_semidefinite_tag)
    solution = solve(a, random_vector(40), options={"preconditioner": wrong}, throw=False)
    assert solution.result == lx.RESULTS.breakdown


def test_first_guess_saves_steps():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    exact = np.linalg.solve(a, b)
    assert solve(a, b, options={"y0": jnp.asarray(exact)}).stats["num_steps"] == 0
    near = solve(a, b, options={"y0": jnp.asarray(exact + 1e-6 * random_vector(40, 4))})
    assert near.stats["num_steps"] < solve(a, b).stats["num_steps"]
    assert_close(near.value, exact, 1e-9)


def test_singular_system_gives_the_solution_nearest_to_the_first_guess():
    a, q = matrix(SINGULAR)
    b, y0 = random_vector(40), random_vector(40, 4)
    null = q[:, :3]
    expected = np.linalg.pinv(a, rcond=1e-10, hermitian=True) @ b + null @ (null.T @ y0)
    assert_close(solve(a, b, options={"y0": jnp.asarray(y0)}).value, expected, 1e-8)


# Statistics


def test_operator_norm_is_a_close_lower_bound():
    a, _ = matrix(INDEFINITE)
    norm = solve(a, random_vector(40)).stats["operator_norm"]
    assert 0.5 * 30 < norm <= 30 * (1 + 1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("null", [0, 2])
@pytest.mark.parametrize("seed", range(4))
def test_negative_curvature_is_detected(dtype, null, seed):
    rng = np.random.default_rng(seed)
    positive = np.concatenate([np.zeros(null), 10 ** rng.uniform(-2, 0, 40 - null)])
    mixed = positive.copy()
    mixed[-1] *= -1
    b = random_vector(40, seed).astype(dtype)
    for eigenvalues in (positive, mixed, -positive):
        a, _ = matrix(eigenvalues, seed)
        assert solve(a.astype(dtype), b).stats["negative_curvature"] == np.any(eigenvalues < 0)


def test_negative_curvature_outside_the_krylov_space_is_not_detected():
    a = np.diag(np.concatenate([[-1.0], np.linspace(1, 2, 39)]))
    assert not solve(a, np.eye(40)[5] + np.eye(40)[3]).stats["negative_curvature"]


# Refusals and failures


@pytest.mark.parametrize("where", ["vector", "operator", "y0"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nonfinite_input_ends_at_once_with_its_result(where, bad):
    a, _ = matrix(INDEFINITE)
    b, y0 = random_vector(40), np.zeros(40)
    {"vector": b, "operator": a[7], "y0": y0}[where][7] = bad
    solution = solve(a, b, options={"y0": jnp.asarray(y0)}, throw=False)
    assert solution.result == lx.RESULTS.nonfinite_input
    assert np.all(np.isnan(solution.value))
    assert solution.stats["num_steps"] <= 1


def test_too_few_steps():
    a, _ = matrix(INDEFINITE)
    b = random_vector(40)
    solution = solve(a, b, MINRES(max_steps=5), throw=False)
    assert solution.result == lx.RESULTS.max_steps_reached
    assert solution.stats["num_steps"] == solution.stats["max_steps"] == 5
    np.testing.assert_allclose(
        solution.stats["residual_norm"],
        np.linalg.norm(b - a @ solution.value) / np.linalg.norm(b),
    )
    with pytest.raises(eqx.EquinoxRuntimeError, match="maximum number of solver steps"):
        jax.block_until_ready(solve(a, b, MINRES(max_steps=5)).value)


@pytest.mark.parametrize("condition", [1e7, 1e15])
def test_hopeless_condition_is_reported(condition):
    a, _ = matrix(np.logspace(0, -np.log10(condition), 40))
    solution = solve(a.astype(np.float32), random_vector(40).astype(np.float32), throw=False)
    reported = solution.stats["stagnated"] | solution.stats["inconsistent"]
    assert reported | (solution.result != lx.RESULTS.successful)
    assert solution.stats["residual_norm"] > 1e-3


def test_refuses_an_operator_without_the_tag():
    with pytest.raises(ValueError, match=r"must be symmetric, but .*symmetric_tag"):
        MINRES().init(lx.MatrixLinearOperator(jnp.eye(3)), {})


def test_refuses_an_operator_that_is_not_square():
    with pytest.raises(ValueError, match=r"must be square, but .*LSMR"):
        MINRES().init(lx.MatrixLinearOperator(jnp.ones((3, 2))), {})


def test_refuses_a_complex_operator():
    op = lx.MatrixLinearOperator(jnp.eye(3, dtype=complex), lx.symmetric_tag)
    with pytest.raises(ValueError, match=r"must be real, but"):
        MINRES().init(op, {})


def test_refuses_bad_settings():
    with pytest.raises(ValueError, match=r"`rtol` must be at least 0, but is -1.0"):
        MINRES(rtol=-1.0)
    with pytest.raises(ValueError, match=r"`atol` must be at least 0, but is nan"):
        MINRES(atol=float("nan"))
    with pytest.raises(ValueError, match=r"`max_steps` must be at least 1, but is 0"):
        MINRES(max_steps=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preconditioner": jnp.eye(3)}, "AbstractLinearOperator"),
        ({"preconditioner": operator(np.eye(3))}, "must be positive definite, but"),
        (
            {"preconditioner": lx.MatrixLinearOperator(jnp.eye(2), lx.positive_semidefinite_tag)},
            "must map the space of the operator",
        ),
        ({"y0": jnp.ones(2)}, "must have the structure of the vector"),
    ],
)
def test_refuses_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        solve(np.eye(3), np.ones(3), options=options)


# Any symmetric matrix


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    eigenvalues=st.lists(
        st.one_of(st.just(0.0), st.floats(0.01, 1.0), st.floats(-1.0, -0.01)),
        min_size=8,
        max_size=8,
    ),
    in_range=st.booleans(),
)
def test_any_symmetric_matrix(seed, eigenvalues, in_range):
    a, q = matrix(eigenvalues, seed)
    b = random_vector(8, seed)
    nonzero = np.asarray(eigenvalues) != 0
    if in_range:
        b = a @ b
    inverse = np.where(nonzero, 1 / np.where(nonzero, eigenvalues, 1), 0)
    expected = q @ (inverse * (q.T @ b))
    solution = solve(a, b)
    error = np.linalg.norm(solution.value - expected)
    assert error <= 1e-7 * (1 + np.linalg.norm(expected))
    assert solution.stats["inconsistent"] == (not in_range and not nonzero.all())
