"""Growth of a tissue: a life cycle updates the cells, and the tissue relaxes or moves in between."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray

from vertax._base.announce import announce_compilations
from vertax._base.checkpoints import Checkpoint
from vertax._base.checks import as_key, as_times, check_instance, check_integer, describe
from vertax._base.frame_loop import simulate
from vertax._base.model_checks import check_spare
from vertax._base.tracing import is_concrete, traced
from vertax.activities import AbstractActivity
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.growth._grown import Grown
from vertax.growth._growth import Growth
from vertax.growth._life_cycle import AbstractLifeCycle
from vertax.mesh import Tissue
from vertax.relax import Relaxation
from vertax.transitions import T1, T2

Energy = Callable[[Any], AbstractEnergy]


def grow(
    tissue: Tissue,
    energy: Energy,
    cycle: AbstractLifeCycle,
    times: ArrayLike | Sequence[Any],
    *,
    key: PRNGKeyArray | int,
    substeps: int = 1,
    divisions: int | None = None,
    records: int | None = None,
    dissipation: AbstractDissipation | None = None,
    activity: AbstractActivity | None = None,
    relaxation: Relaxation = Relaxation(transitions=T1() + T2()),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    throw: bool = True,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
) -> Grown:
    r"""Let the cells of a tissue grow, divide and die.

    ```python
    def energy(cells):
        return vx.energies.AreaElasticity(1.0, cells.target_area) + vx.energies.LineTension(0.1)

    cycle = vx.growth.GrowAndDivide(growth_rate=0.1, division_area=1.5)
    tissue = vx.initialise.free_voronoi(4, key=0).with_capacity(100)
    grown = vx.growth.grow(tissue, energy, cycle, jnp.linspace(0, 40, 81), key=1)
    vx.animate(grown.trajectory, "growth.gif")
    ```

    Each time step:

    1. The life cycle updates the cell states and selects the cells that divide.
    2. The selected cells divide.
    3. The tissue relaxes to equilibrium; with a dissipation it moves for the length of the step instead, as
       in [`evolve`][vertax.evolve]. T1 and T2 transitions happen here.

    Works under `jax.jit` and `jax.vmap`. Gradients hold the discrete events (divisions, deaths and their
    steps) fixed; [`score_function`][vertax.growth.score_function] adds the dependence of their probabilities
    on the parameters.

    **Arguments:**

    - `tissue`: the initial tissue, with spare slots for all cells alive at the same time, see
        [`with_capacity`][vertax.Tissue.with_capacity]. At least one cell in a periodic box, two in a free
        tissue.
    - `energy`: a function of the cell states that returns the energy of the tissue.
    - `cycle`: the life cycle, e.g. [`GrowAndDivide`][vertax.growth.GrowAndDivide].
    - `times`: increasing times of the frames; the first is the initial time.
    - `key`: key or seed for random numbers.
    - `substeps`: number of time steps between two frames.
    - `divisions`: maximum number of divisions per step, by default 4 + capacity / 20; further divisions wait
        for the next step.
    - `records`: capacity of the lineage, by default eight times the number of cell slots.
    - `dissipation`: friction and viscosity; by default none, and the tissue relaxes in each step.
    - `activity`: active forces, noise or [signals][vertax.signals.Signals]. Daughters inherit its state, see
        `born` of [`AbstractActivity`][vertax.AbstractActivity]. An activity that draws random numbers needs a
        dissipation.
    - `relaxation`: solver and transitions of each step, by default with T1 and T2 transitions.
    - `adjoint`: how to differentiate each step.
    - `throw`: raise an error if a step does not converge or capacity is exhausted. If False, look at
        `result`.
    - `progress`: show a progress bar (only on a terminal).
    - `checkpoint`: a file, or a [`Checkpoint`][vertax.Checkpoint], as in [`evolve`][vertax.evolve].

    **Returns:** a [`Grown`][vertax.growth.Grown].

    **Raises:**

    - `TypeError` for a cycle, an energy, a dissipation, an activity or a relaxation of a wrong type.
    - `ValueError` for times that do not increase, a tissue without spare slots, noise without a
        dissipation, or a checkpoint that is broken or of another run.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a step does not converge or capacity is
        exhausted.
    """
    for name, value, kind, expected in (
        ("cycle", cycle, AbstractLifeCycle, "an AbstractLifeCycle"),
        ("dissipation", dissipation, AbstractDissipation | None, "an AbstractDissipation or None"),
        ("activity", activity, AbstractActivity | None, "an AbstractActivity or None"),
        ("relaxation", relaxation, Relaxation, "a Relaxation"),
    ):
        check_instance(name, value, kind, expected)
    invalid = isinstance(energy, AbstractEnergy) or not callable(energy)
    if invalid or (isinstance(energy, type) and issubclass(energy, AbstractEnergy)):
        name = energy.__name__ if isinstance(energy, type) else "energy"
        raise TypeError(
            "Argument `energy` must be a function of the cell states that returns an energy, "
            f"but is {describe(energy)}. Pass such a function, e.g. lambda cells: {name}"
            f"{'(...)' if isinstance(energy, type) else ''}."
        )
    if activity is not None and dissipation is None and not activity.deterministic:
        raise ValueError(
            "Argument `dissipation` is missing: an activity with random numbers needs one. Pass e.g. "
            "vertax.dissipations.SubstrateFriction(1.0)."
        )
    check_spare(tissue)
    check_integer("substeps", substeps, at_least=1)
    divisions = 4 + tissue.n_cells // 20 if divisions is None else divisions
    check_integer("divisions", divisions, at_least=1)
    records = 8 * tissue.n_cells if records is None else records
    check_integer("records", records, at_least=1)
    if is_concrete(tissue.topology.cell):
        labels = np.unique(np.asarray(tissue.topology.cell))
        check_integer("records", records, at_least=int(np.sum(labels < tissue.n_cells)))
    points = as_times(times).astype(tissue.vertices.dtype)
    parts = (tissue, energy, cycle, dissipation, activity)
    tissue, energy, cycle, dissipation, activity = traced(parts, tissue.vertices.dtype)
    rules = (energy, cycle, dissipation, activity, relaxation.traced(), adjoint)
    growth = Growth(*rules, substeps, divisions, records)
    with announce_compilations(f"the growth of a tissue with {tissue.n_cells} cell slots"):
        return simulate(
            growth,
            (tissue, as_key(key)),
            points,
            progress=progress,
            checkpoint=checkpoint,
            throw=throw,
        )
