"""Recording a relaxation while it runs."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.experimental import io_callback
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax.energies import AbstractEnergy
from vertax.io._data_tables import check_single
from vertax.io._trajectory import Trajectory
from vertax.mesh import Tissue
from vertax.responses._relaxation import Equilibrium, equilibrate, free_motions, mean_stiffness
from vertax.transitions import T1, AbstractTransitions


def record_relaxation(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    every: int = 1,
    solver: optx.AbstractMinimiser[Any, Any, Any] | None = None,
    transitions: AbstractTransitions | None = T1(),
    tolerance: float | Float[Array, ""] | None = None,
    patience: int = 1,
    max_steps: int = 2000,
    throw: bool = True,
) -> tuple[Equilibrium, Trajectory]:
    """Relax a tissue as [`equilibrate`][vertax.equilibrate] does, and record its way.

    **Arguments:**

    - `tissue`, `energy`: what to relax.
    - `every`: number of steps from one frame to the next.
    - `solver`, `transitions`, `tolerance`, `patience`, `max_steps`: see
        [`equilibrate`][vertax.equilibrate].
    - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

    **Returns:** the equilibrium; and the trajectory, from `tissue` to the tissue of the equilibrium, with
    the values `num_steps` and `num_t1` (both so far), `energy` and `max_force`.

    **Raises:**

    - `ValueError` if `every` is less than 1, for a batch of tissues, and as
        [`equilibrate`][vertax.equilibrate].
    - `RuntimeError` if `throw` and the relaxation did not converge.
    """
    if every < 1:
        raise ValueError(f"Argument `every` must be at least 1, but is {every}.")
    check_single(tissue)
    trajectory = Trajectory()
    tissue = jax.tree.map(jnp.asarray, tissue)

    def add(frame: Tissue, num_steps: ArrayLike, num_t1: ArrayLike) -> None:
        value, force = _energy_and_force(frame, energy)
        trajectory.append(frame, num_steps=num_steps, num_t1=num_t1, energy=value, max_force=force)

    add(tissue, 0, 0)
    seen: list[tuple[int, np.ndarray, tuple[np.ndarray, ...]]] = []
    n_sweeps = itertools.count()

    def see(num_t1: np.ndarray, *leaves: np.ndarray) -> None:
        num_steps = next(n_sweeps)
        if num_steps > 0 and num_steps % every == 0:
            seen.append((num_steps, num_t1, leaves))

    ticket = next(_TICKETS)
    _OBSERVERS[ticket] = see
    try:
        found = equilibrate(
            tissue,
            energy,
            solver=solver,
            transitions=_Observed(transitions, jnp.asarray(ticket)),
            tolerance=tolerance,
            patience=patience,
            max_steps=max_steps,
            throw=False,
        )
        jax.effects_barrier()
    finally:
        del _OBSERVERS[ticket]
    structure = jax.tree.structure(tissue)
    adrift = _adrift(found.tissue, energy)
    for num_steps, num_t1, leaves in seen:
        if num_steps < found.num_steps:
            frame: Tissue = jax.tree.unflatten(structure, map(jnp.asarray, leaves))
            add(_settled(frame, tissue) if adrift else frame, num_steps, num_t1)
    if found.num_steps > 0:
        add(found.tissue, found.num_steps, found.num_t1)
    if throw and not found.converged:
        raise RuntimeError(
            f"The relaxation reached no equilibrium in {int(found.num_steps)} steps (largest force "
            f"{float(found.max_force):.1e}). Raise `max_steps`, or pass throw=False to see its frames."
        )
    return found, trajectory


# The tissue is looked at where a relaxation sweeps it for transitions, once before each step. A function
# in the compiled program would be another one for each recording, and compile it anew; so there is one
# for all, and a number, which is data, tells it whom to call.
_OBSERVERS: dict[int, Callable[..., None]] = {}
_TICKETS = itertools.count()


def _notify(ticket: ArrayLike, *arrays: ArrayLike) -> None:
    _OBSERVERS[int(np.asarray(ticket))](*map(np.array, arrays))


class _Observed(AbstractTransitions):
    """A rule for transitions that shows the tissue to an observer."""

    transitions: AbstractTransitions | None
    ticket: Int[Array, ""]

    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        if self.transitions is None:
            return jnp.zeros(tissue.n_edges, jnp.int32)
        return self.transitions.init(tissue)

    def sweep(
        self, tissue: Tissue, energy: AbstractEnergy, counts: Int[Array, " edges"]
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        if self.transitions is not None:
            tissue, counts = self.transitions.sweep(tissue, energy, counts)
        leaves = jax.tree.leaves(tissue)
        io_callback(_notify, None, self.ticket, jnp.sum(counts), *leaves, ordered=True)
        return tissue, counts


@eqx.filter_jit
def _energy_and_force(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    at = lambda y: energy(tissue.with_configuration(y))
    value, slope = jax.value_and_grad(at)(tissue.configuration)
    return value, optx.max_norm(slope)


@eqx.filter_jit
def _adrift(tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, ""]:
    """Whether the energy does not mind where the tissue is, so that `equilibrate` moves it back."""
    scale = jnp.sqrt(jnp.mean(jnp.abs(tissue.areas)))
    return jnp.all(free_motions(tissue, energy, scale, mean_stiffness(tissue, energy)))


@eqx.filter_jit
def _settled(tissue: Tissue, start: Tissue) -> Tissue:
    return tissue.settled(start)
