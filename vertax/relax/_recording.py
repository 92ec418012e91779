"""Recording a relaxation while it runs."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_integer
from vertax._base.model_checks import check_single
from vertax._base.tracing import traced
from vertax.adjoints import ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.energies._scales import scales_of
from vertax.mesh import Tissue, Trajectory
from vertax.relax._equilibrium import SearchEnd, free_motions
from vertax.relax._loop import Search, SearchState
from vertax.relax._relaxation import Relaxation, attached
from vertax.relax._response import Equilibrium


def record_relaxation(
    tissue: Tissue,
    energy: AbstractEnergy,
    response: Relaxation | None = None,
    *,
    every: int = 1,
    throw: bool = True,
) -> tuple[Equilibrium, Trajectory]:
    """Relax a tissue as [`equilibrate`][vertax.equilibrate] does, and record its way.

    **Arguments:**

    - `tissue`, `energy`: what to relax.
    - `response`: how, a [`Relaxation`][vertax.Relaxation].
    - `every`: number of steps from one frame to the next.
    - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

    **Returns:** the equilibrium; and the trajectory, from `tissue` to the tissue of the equilibrium, with
    the values `num_steps` and `num_t1` (both so far), `energy` and `max_force`.

    **Raises:**

    - `ValueError` if `every` is less than 1, for a batch of tissues, and as
        [`equilibrate`][vertax.equilibrate].
    - `RuntimeError` if `throw` and the relaxation did not converge.
    """
    check_integer("every", every, at_least=1)
    check_single(tissue, "Record the members of a batch one by one.")
    response = (Relaxation() if response is None else response).traced()
    response.check(tissue, energy, ImplicitDifferentiation())
    tissue, energy = jax.tree.map(jnp.asarray, tissue), energy
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    trajectory = Trajectory()

    def add(frame: Tissue, num_steps: Array, num_t1: Array) -> None:
        value, force = _energy_and_force(frame, energy)
        trajectory.append(frame, num_steps=num_steps, num_t1=num_t1, energy=value, max_force=force)

    search, state, adrift = _begin(response, tissue, energy)
    add(tissue, state.num_steps, state.num_t1)
    while not state.finished and state.num_steps < response.max_steps:
        limit = jnp.minimum(state.num_steps + every, response.max_steps)
        state = _advance(search, state, energy, limit)
        if not state.finished and state.num_steps < response.max_steps:
            frame = _settled(state.tissue, tissue) if adrift else state.tissue
            add(frame, state.num_steps, state.num_t1)
    equilibrium = _conclude(search, state, tissue, energy, response)
    if equilibrium.num_steps > 0:
        add(equilibrium.tissue, equilibrium.num_steps, equilibrium.num_t1)
    return equilibrium.checked() if throw else equilibrium, trajectory


@eqx.filter_jit
def _begin(
    response: Relaxation, tissue: Tissue, energy: AbstractEnergy
) -> tuple[Search, SearchState, Bool[Array, ""]]:
    search = response.search(tissue, energy)
    # Where the energy does not mind where the tissue is, `equilibrate` moves it back.
    adrift = jnp.all(free_motions(tissue, energy, scales_of(tissue, energy)))
    return search, search.begin(tissue, energy), adrift


@eqx.filter_jit
def _advance(
    search: Search, state: SearchState, energy: AbstractEnergy, num_steps: int | Int[Array, ""]
) -> SearchState:
    return search.advance(state, energy, num_steps)


@eqx.filter_jit
def _conclude(
    search: Search,
    state: SearchState,
    tissue: Tissue,
    energy: AbstractEnergy,
    response: Relaxation,
) -> Equilibrium:
    end = SearchEnd.of(search, state)
    return attached(end, tissue, energy, response, ImplicitDifferentiation())


@eqx.filter_jit
def _energy_and_force(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    at = lambda y: energy(tissue.with_configuration(y))
    value, slope = jax.value_and_grad(at)(tissue.configuration)
    return value, optx.max_norm(slope)


@eqx.filter_jit
def _settled(tissue: Tissue, start: Tissue) -> Tissue:
    return tissue.settled(start)
