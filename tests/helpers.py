"""Shared by the tests: tissues, the table of solvers, finite differences."""

import contextlib
import functools
import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from hypothesis import strategies as st
from jax import Array

import vertax as vx

# Add a row for a new solver: (name, solver, largest force after at most 3000 steps).
SOLVERS = [
    ("newton_cg", vx.solvers.NewtonCG(), 1e-10),
    ("lbfgs", vx.solvers.LBFGS(), 1e-6),
    ("fire", vx.solvers.FIRE(), 1e-8),
    ("gradient_descent", vx.solvers.GradientDescent(learning_rate=5e-3), 1e-5),
    ("optax_adam", vx.solvers.Optax(optax.adam(optax.exponential_decay(1e-2, 100, 0.7))), 1e-4),
    ("optimistix_bfgs", optx.BFGS(rtol=0.0, atol=0.0), 1e-6),
    ("optimistix_nonlinear_cg", optx.NonlinearCG(rtol=0.0, atol=0.0), 1e-5),
]

# JAX compares optimisers by identity: fits with this one share compiled functions.
ADAM = optax.adam(1e-2)
# Contacts and T1 transitions have their own tests; without them compilation takes half the time.
FIXED_TOPOLOGY = vx.Relaxation(transitions=None, contact_range=None)
NO_CONTACT = vx.Relaxation(contact_range=None)
LEAST_SQUARES = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)


def each_solver(*quick: str) -> pytest.MarkDecorator:
    """Parametrise a test by all solvers; those not in `quick` are marked as slow."""
    rows = [
        pytest.param(solver, force, marks=() if name in quick else (pytest.mark.slow,), id=name)
        for name, solver, force in SOLVERS
    ]
    return pytest.mark.parametrize(("solver", "force"), rows)


@contextlib.contextmanager
def counted_compilations(names: list[str]):
    """Append the name of each function that XLA compiles in this context to `names`."""
    logger = logging.getLogger("jax._src.interpreters.pxla")
    handler = logging.Handler()
    handler.emit = lambda record: names.append(record.getMessage().split()[1])
    level, propagates = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagates


def random_tissue(n_cells: int, seed: int = 0, **options) -> vx.Tissue:
    return vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(seed), **options)


def shape_factors(n_cells: int, mean: float, deviation: float, seed: int = 0) -> jax.Array:
    return mean + deviation * jax.random.normal(jax.random.key(seed + 1000), (n_cells,))


def relaxed(n_cells: int, seed: int = 0, mean: float = 3.7) -> tuple[vx.Tissue, vx.AbstractEnergy]:
    energy = vx.energies.ShapeFactorEnergy(shape_factors(n_cells, mean, 0.1, seed))
    return NO_CONTACT(random_tissue(n_cells, seed), energy).tissue, energy


def central_difference(f, x, direction, step=1e-5):
    """Derivative of `f` at the pytree `x` along `direction`."""
    # NumPy, to avoid compilation.
    moved = lambda a, b, s: jnp.asarray(np.asarray(a) + s * np.asarray(b))
    at = lambda s: np.asarray(f(jax.tree.map(lambda a, b: moved(a, b, s), x, direction)))
    return (at(step) - at(-step)) / (2 * step)


def fine_difference(f, x, direction, step=1e-4):
    """Fourth-order central difference (Richardson extrapolation): larger steps, less rounding error."""
    over = lambda h: central_difference(f, x, direction, h)
    return (4 * over(step) - over(2 * step)) / 3


@eqx.filter_jit
def _random_like(x, seed):
    leaves, structure = jax.tree.flatten(x)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    return jax.tree.unflatten(
        structure,
        [jax.random.normal(k, a.shape, a.dtype) for k, a in zip(keys, leaves, strict=True)],
    )


def random_like(x, seed: int = 0):
    """A pytree of normal random numbers."""
    return _random_like(x, np.asarray(seed))


@st.composite
def lattices(draw, n_cells: int):
    """Boxes of mean cell area 1, stretched and sheared."""
    stretch = draw(st.floats(0.7, 1.4))
    shear = draw(st.floats(-0.6, 0.6))
    side = np.sqrt(n_cells)
    return side * np.array([[stretch, 0.0], [shear * stretch, 1 / stretch]])


@st.composite
def tissues(draw, min_cells: int = 1, max_cells: int = 30):
    """Functions that create random Voronoi tissues in boxes of different shapes."""
    n = draw(st.sampled_from([n for n in (1, 3, 12) if min_cells <= n <= max_cells]))
    seed, lattice = draw(st.integers(0, 2**16)), draw(lattices(n))
    return functools.partial(random_tissue, n, seed, lattice=lattice)


def box(tissue: vx.Tissue) -> vx.Periodic:
    """The boundary of a periodic tissue."""
    assert isinstance(tissue.boundary, vx.Periodic)
    return tissue.boundary


def p0_of(energy: vx.AbstractEnergy) -> jax.Array:
    """The target shape factors of an energy E1."""
    assert isinstance(energy, vx.energies.ShapeFactorEnergy)
    return jnp.asarray(energy.target_shape_factor)


# Compiled once for each tissue size and class of energy and cost.
@eqx.filter_jit
def _hessian(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> Array:
    f = lambda y: energy(tissue.with_configuration(y.reshape(tissue.vertices.shape)))
    return jax.hessian(f)(tissue.vertices.ravel())


@eqx.filter_jit
def _pull_and_slope(
    tissue: vx.Tissue, energy: vx.AbstractEnergy, cost: vx.AbstractCost
) -> tuple[Array, Array]:
    pull = jax.grad(lambda x: cost(tissue.with_configuration(x), energy))(tissue.vertices)

    def force(p: Array) -> Array:
        e = vx.energies.ShapeFactorEnergy(p)
        return jax.grad(lambda x: e(tissue.with_configuration(x)))(tissue.vertices).ravel()

    return pull.ravel(), jax.jacobian(force)(p0_of(energy))


def dense_hessian(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> np.ndarray:
    return np.asarray(_hessian(tissue, energy))


def dense_hypergradient(
    tissue: vx.Tissue, energy: vx.AbstractEnergy, cost: vx.AbstractCost
) -> np.ndarray:
    """Gradient with respect to the target shape factors of E1 at an equilibrium, by a pseudo-inverse."""
    pull, slope = map(np.asarray, _pull_and_slope(tissue, energy, cost))
    inverse = np.linalg.pinv(dense_hessian(tissue, energy), rcond=1e-10)
    return -slope.T @ inverse @ pull


@eqx.filter_jit
def value_of(cost: vx.AbstractCost, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> Array:
    """The value of a cost, compiled once for each class."""
    return cost(tissue, energy)


def edge_cell_sets(tissue: vx.Tissue) -> list[tuple[int, int]]:
    """Unordered pair of cells on the two sides of each edge."""
    return [tuple(sorted(pair)) for pair in np.asarray(tissue.topology.edge_cells).tolist()]


def hexagon_index() -> float:
    return float(jnp.sqrt(8 * jnp.sqrt(3.0)))


def rewritten(path, **changes):
    """Replace arrays of an archive, or remove those that are None."""
    with np.load(path) as archive:
        arrays = dict(archive) | changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path
