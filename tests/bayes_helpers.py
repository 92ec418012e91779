"""Small problems with a posterior."""

import dataclasses

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from helpers import FIXED_TOPOLOGY, random_tissue, shape_factors

import vertax as vx

N_CELLS = 6
MEAN, SPREAD = 3.65, 0.1
PRIOR = {"target_shape_factor": dist.Normal(MEAN, SPREAD)}


def noisy_problem(noise, seed=0, n_cells=N_CELLS, response=FIXED_TOPOLOGY, truth=None, **options):
    """A problem with displacements of vertices as residuals, and the true parameters."""
    energy = vx.energies.ShapeFactorEnergy(jnp.full(n_cells, MEAN, float))
    start = FIXED_TOPOLOGY(random_tissue(n_cells, seed, lloyd_steps=2), energy).tissue
    truth = shape_factors(n_cells, MEAN, SPREAD, seed) if truth is None else truth
    exact = FIXED_TOPOLOGY(start, vx.energies.ShapeFactorEnergy(truth)).tissue
    shifts = noise * jax.random.normal(jax.random.key(seed + 1), exact.vertices.shape)
    target = exact.with_vertices(exact.vertices + shifts)
    cost = start.n_vertices * vx.costs.VertexDistance(target)
    return vx.InverseProblem(start, energy, cost, response=response, **options), truth


def padded(problem, size):
    """The problem with spare slots up to a number of cells, to stack it with others."""
    tissue, target = (t.with_capacity(size) for t in (problem.tissue, problem.cost.costs[0].target))
    cost = problem.tissue.n_vertices * vx.costs.VertexDistance(target)
    energy = vx.energies.ShapeFactorEnergy(jnp.full(size, MEAN, float))
    return dataclasses.replace(problem, tissue=tissue, energy=energy, cost=cost)
