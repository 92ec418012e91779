import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, dense_hessian, random_like, relaxed, shape_factors

import vertax as vx
from vertax.costs import VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy


def v2v_problem(n_cells, seed=0):
    """A relaxed tissue, a displaced target, and the cost of p0 at the re-equilibrated tissue."""
    start, _ = relaxed(n_cells, seed)
    target, _ = relaxed(n_cells, seed)
    p0 = shape_factors(n_cells, 3.7, 0.1, seed + 77)
    tissue = vx.equilibrate(start, ShapeFactorEnergy(p0)).tissue
    cost = VertexDistance(target)

    def loss(p, adjoint=None):
        energy = ShapeFactorEnergy(p)
        found = vx.equilibrate(tissue, energy, tolerance=1e-12, transitions=None, adjoint=adjoint)
        return cost(found.tissue, energy)

    return tissue, p0, cost, loss


@pytest.mark.parametrize("n_cells", [20, 64])
def test_hypergradient_against_a_dense_pseudo_inverse_and_finite_differences(n_cells):
    tissue, p0, cost, loss = v2v_problem(n_cells)
    gradient = jax.jit(jax.grad(loss))(p0)

    energy = ShapeFactorEnergy(p0)
    at = vx.equilibrate(tissue, energy, tolerance=1e-12, transitions=None).tissue
    pull = jax.grad(lambda x: cost(at.with_configuration(x), energy))(at.vertices).ravel()
    mixed = jax.jacobian(
        lambda p: jax.grad(lambda x: ShapeFactorEnergy(p)(at.with_configuration(x)))(
            at.vertices
        ).ravel()
    )(p0)
    dense = -mixed.T @ np.linalg.pinv(dense_hessian(at, energy), rcond=1e-10) @ pull
    assert np.linalg.norm(gradient - dense) < 1e-7 * np.linalg.norm(dense)

    direction = random_like(p0)
    difference = central_difference(jax.jit(loss), p0, direction, step=1e-5)
    assert jnp.sum(gradient * direction) == pytest.approx(float(difference), rel=1e-6)


def test_forward_mode_agrees_with_reverse_mode():
    _, p0, _, loss = v2v_problem(12)
    direction = random_like(p0)
    forward = jax.jvp(loss, (p0,), (direction,))[1]
    assert forward == pytest.approx(float(jnp.sum(jax.grad(loss)(p0) * direction)), rel=1e-8)


def test_gradient_with_respect_to_line_tensions():
    n = 14
    tissue, _ = relaxed(n, 2)
    tension = 0.5 + 0.1 * jax.random.uniform(jax.random.key(0), (3 * n,))
    start = vx.equilibrate(tissue, AreaElasticity(20.0, 1.0) + LineTension(tension)).tissue

    def loss(t):
        energy = AreaElasticity(20.0, 1.0) + LineTension(t)
        found = vx.equilibrate(start, energy, tolerance=1e-11, transitions=None)
        return jnp.sum(found.tissue.areas**3)

    direction = random_like(tension)
    slope = jnp.sum(jax.grad(loss)(tension) * direction)
    assert slope == pytest.approx(
        float(central_difference(jax.jit(loss), tension, direction)), rel=1e-5
    )


def test_gradient_with_respect_to_the_shape_of_the_box():
    tissue, energy = relaxed(12, 4)
    strained = lambda lattice: eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)

    def loss(lattice):
        found = vx.equilibrate(strained(lattice), energy, tolerance=1e-12, transitions=None)
        return found.energy

    lattice = tissue.boundary.lattice
    direction = 0.1 * random_like(lattice)
    slope = jnp.sum(jax.grad(loss)(lattice) * direction)
    assert slope == pytest.approx(
        float(central_difference(jax.jit(loss), lattice, direction)), rel=1e-6
    )


def test_gradient_through_a_relaxation_with_t1_transitions():
    # The topology changes on the way; the gradient is that of the equilibrium in the final one.
    tissue = vx.initialise.periodic_voronoi(16, key=jax.random.key(5))
    p0 = shape_factors(16, 3.75, 0.1)

    def loss(p):
        found = vx.equilibrate(tissue, ShapeFactorEnergy(p), tolerance=1e-12)
        return jnp.sum(found.tissue.perimeters**3), found.num_t1

    gradient, num_t1 = jax.jit(jax.grad(loss, has_aux=True))(p0)
    assert num_t1 > 0
    direction = random_like(p0)
    difference = central_difference(lambda p: jax.jit(loss)(p)[0], p0, direction, step=1e-6)
    assert jnp.sum(gradient * direction) == pytest.approx(float(difference), rel=1e-5)


def test_gradients_vmap_over_parameters():
    _, p0, _, loss = v2v_problem(12)
    batch = jnp.stack([p0, p0 + 0.01, p0 - 0.01])
    together = jax.jit(jax.vmap(jax.grad(loss)))(batch)
    for p, gradient in zip(batch, together, strict=True):
        np.testing.assert_allclose(gradient, jax.grad(loss)(p), rtol=1e-6, atol=1e-10)


def test_gradient_in_float32():
    tissue, p0, cost, loss = v2v_problem(12)
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    small, small_cost = jax.tree.map(to32, (tissue, cost))

    def loss32(p):
        energy = ShapeFactorEnergy(p)
        found = vx.equilibrate(small, energy, transitions=None, tolerance=3e-5)
        return small_cost(found.tissue, energy)

    gradient = jax.grad(loss32)(p0.astype(jnp.float32))
    assert gradient.dtype == jnp.float32
    reference = jax.grad(loss)(p0)
    assert jnp.linalg.norm(gradient - reference) < 0.02 * jnp.linalg.norm(reference)


def test_adjoint_ignores_translations():
    # A cost that pulls on the centroid alone has no gradient: no parameter moves the centroid.
    tissue, energy = relaxed(12, 1)

    def loss(p):
        found = vx.equilibrate(tissue, ShapeFactorEnergy(p), transitions=None, tolerance=1e-12)
        return jnp.sum(found.tissue.vertices)

    gradient = jax.grad(loss)(energy.target_shape_factor)
    assert jnp.abs(gradient).max() < 1e-8


def test_gradient_with_respect_to_a_neural_network_inside_an_energy():
    class Learned(vx.AbstractEnergy):
        network: eqx.nn.MLP

        def __call__(self, tissue):
            shape = jnp.stack([tissue.areas, tissue.perimeters / 4], axis=-1)
            return ShapeFactorEnergy(3.6)(tissue) + 0.1 * jnp.sum(jax.vmap(self.network)(shape))

    tissue, _ = relaxed(10, 3)
    energy = Learned(eqx.nn.MLP(2, "scalar", 8, 1, jnp.tanh, key=jax.random.key(0)))

    def loss(e):
        found = vx.equilibrate(tissue, e, transitions=None, tolerance=1e-11)
        return jnp.sum(found.tissue.areas**3)

    gradient = eqx.filter_grad(loss)(energy)
    parameters, constants = eqx.partition(energy, eqx.is_inexact_array)
    direction = random_like(parameters)
    slope = sum(
        jnp.sum(a * b)
        for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    run = eqx.filter_jit(lambda p: loss(eqx.combine(p, constants)))
    assert slope == pytest.approx(float(central_difference(run, parameters, direction)), rel=1e-5)
