"""Coarsening of a foam by gas diffusion through the walls between bubbles."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue
from jaxtyping import Array, Float

import vertax as vx
from vertax.growth import AbstractLifeCycle, grow

TENSION, STIFFNESS, DIFFUSION = 0.1, 20.0, 3.0


def flux(tissue, gas):
    """Inflow of gas into each bubble: diffusion coefficient × length × pressure difference of each wall."""
    pressure = jnp.append(STIFFNESS * (gas - tissue.areas), 0.0)
    left, right = tissue.topology.edge_cells.T
    flow = DIFFUSION * tissue.edge_lengths * (pressure[right] - pressure[left])
    inflow = jnp.zeros(tissue.n_cells)
    return inflow.at[left].add(flow, mode="drop").at[right].add(-flow, mode="drop")


class GasExchange(AbstractLifeCycle):
    """The state of each bubble is its amount of gas, given as the area at pressure 0."""

    gas: Float[Array, " cells"]

    def init(self, tissue, key):
        return self.gas

    def advance(self, cells, tissue, dt, key):
        gas = jnp.where(tissue.alive, cells + dt * flux(tissue, cells), 0)
        return gas, jnp.zeros(gas.shape, bool)

    def born(self, cells, tissue, pair, key):
        return cells


@pytest.mark.slow
def test_foam_obeys_the_law_of_von_neumann_through_t2_transitions():
    """dA/dt = π/3 γ D (n - 6): J. von Neumann (1952), in Metal Interfaces; W. Mullins (1956)."""
    n = 12
    first = random_tissue(n, 5, lloyd_steps=1).with_capacity(n)
    foam = vx.Tissue(
        first.vertices,
        first.topology,
        first.boundary,
        1e-5,
        angles=jnp.zeros(first.n_edges),
        inner_arcs=True,
    )
    walls = vx.energies.LineTension(TENSION)
    response = vx.Relaxation(transitions=vx.T1(1e-2) + vx.T2(2e-2))
    content = 1.0 + TENSION / STIFFNESS * jnp.ones(n)
    rest = vx.equilibrate(foam, vx.energies.AreaElasticity(STIFFNESS, content) + walls)
    energy = lambda gas: vx.energies.AreaElasticity(STIFFNESS, gas) + walls
    times = jnp.linspace(0, 8.0, 81)
    grown = grow(
        rest.tissue,
        energy,
        GasExchange(content),
        times,
        key=0,
        divisions=1,
        relaxation=response,
        throw=False,
    )
    assert grown.converged
    n_alive = np.asarray(grown.n_alive)
    assert n_alive[-1] <= n - 3
    assert (np.diff(n_alive) <= 0).all()
    frames = list(grown.trajectory)
    law = np.pi / 3 * TENSION * DIFFUSION
    rates_by_sides = {}
    for frame, gas in zip(frames, grown.cells_then, strict=True):
        alive, sides = np.asarray(frame.alive), np.asarray(frame.neighbour_counts)
        inflow = np.asarray(flux(frame, gas))[alive]
        np.testing.assert_allclose(inflow, law * (sides[alive] - 6), atol=1e-3 * law)
        assert frame.areas.sum() == pytest.approx(n)
    # The areas obey the law as well, between two frames of the same topology.
    for k in range(len(frames) - 1):
        before, after = frames[k], frames[k + 1]
        if n_alive[k] != n_alive[k + 1] or vx.plotting.flipped_edges(before, after).any():
            continue
        alive = np.asarray(before.alive)
        rate = np.asarray(after.areas - before.areas)[alive] / 0.1
        for sides, speed in zip(np.asarray(before.neighbour_counts)[alive], rate, strict=True):
            rates_by_sides.setdefault(int(sides), []).append(speed / law)
    assert len(rates_by_sides) >= 4
    assert min(rates_by_sides) <= 4
    for sides, speeds in rates_by_sides.items():
        assert np.mean(speeds) == pytest.approx(sides - 6, abs=0.05)
    print(
        {
            sides: (len(x), float(np.mean(x)), float(np.std(x)))
            for sides, x in rates_by_sides.items()
        }
    )
