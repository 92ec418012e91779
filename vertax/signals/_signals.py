"""Signals: concentrations in cells as an activity with a state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree

from vertax._base.checks import (
    as_real,
    check_instance,
    check_integer,
    check_number,
    check_shape,
    describe,
)
from vertax._base.extras import requires_extra
from vertax._base.tracing import is_concrete
from vertax.activities import AbstractActivity
from vertax.dissipations import AbstractDissipation
from vertax.dynamics import Material
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.signals._exchange import Exchange, redistributed
from vertax.signals._reaction import (
    AbstractReaction,
    check_rates,
    check_reaction,
    reaction_rates,
)

Couple = Callable[[Float[Array, "species cells"], Tissue], AbstractEnergy]


class SignalState(eqx.Module):
    """The state of [`Signals`][vertax.signals.Signals]."""

    amounts: Float[Array, "species cells"]
    """Amounts (concentration times area) of diluted species, concentrations of the others; 0 in spare slots.
    """
    inner: PyTree[Array] = None
    """The state of the activity of a coupled material."""
    material: Material | None = None
    """The coupled material during a step; None between steps."""


class Signals(AbstractActivity):
    r"""Concentrations of species in cells, coupled to mechanics in both directions.

    $$\frac{\mathrm d c_i}{\mathrm d t} = f(c_i, s_i, t)
      + \frac{1}{A_i} \sum_j D \frac{\ell_{ij}}{d_{ij}} (c_j - c_i) - c_i \frac{\dot A_i}{A_i}$$

    with a reaction $f$ that may depend on the geometry $s_i$ of the cell, exchange with neighbours $j$
    through edges of length $\ell_{ij}$ between centroids at the distance $d_{ij}$, and dilution. Edges on the
    outline exchange nothing. Each time step:

    1. Diffrax integrates reaction and exchange in the geometry at the start of the step, with adaptive inner
        steps.
    2. The tissue moves under its energy plus the energy of `couple`.
    3. Amounts $c_i A_i$ of diluted species stay constant in this motion. Living neighbours share the amount
        of a cell that vanishes, in proportion to the lengths of their edges. In a division the daughters
        share it by area.

    The splitting error is of first order in the time step; a
    [`PIController`][vertax.dynamics.PIController] limits it. Exchange, dilution, T1 and T2 transitions and
    division keep the total amount constant up to rounding.

    ```python
    erk = vx.signals.Signals(Erk(1.0), diffusion=[0.1], couple=contract, initial=[0.5])
    movie = vx.evolve(tissue, energy, friction, times, activity=erk)
    movie.signals  # (times, species, cells)
    ```

    **Arguments:**

    - `reaction`: the [`AbstractReaction`][vertax.signals.AbstractReaction]; None for exchange only.
    - `diffusion`, shape `(species,)`: $D$, length squared per time.
    - `couple`: a function of the concentrations `(species, cells)` and the tissue at the start of the step
        (a function, or an `equinox.Module` to differentiate with respect to its fields). It returns an
        energy, which is added to that of the tissue, or a [`Material`][vertax.dynamics.Material]: its
        dissipation replaces that of the tissue, and its activity acts too.
    - `initial`, shape `(species, cells)` or `(species,)`: the initial concentrations.
    - `diluted`: whether a change of area dilutes the species; a boolean, or one per species. False for
        species that are bound to the membrane: their concentration stays constant in the motion of the tissue
        and is copied in a division.
    - `solver`: a solver of Diffrax, `diffrax.Tsit5()` by default. For stiff reactions `diffrax.Kvaerno3()`.
    - `rtol`, `atol`: tolerances of the concentrations in each step of the tissue; `rtol` is raised to 4 times
        the rounding of their data type.
    - `max_steps`: maximum number of inner steps per step of the tissue.
    - `deterministic`: False if `couple` returns an activity that draws random numbers. Then a key is needed.

    **Raises:**

    - `ImportError` without Diffrax: `pip install -e ".[signals]"`.
    - `TypeError` for an argument of the wrong class, and at the first step for a reaction that uses NumPy, or
        a `couple` that returns no energy.
    - `ValueError` for negative or infinite concentrations or diffusion, rates that are not finite, or wrong
        shapes; at the first step for a reaction of another shape.
    """

    reaction: AbstractReaction | None
    diffusion: Float[Array, " species"]
    couple: Couple | None
    initial: Float[Array, "species *cells"]
    diluted: tuple[bool, ...] = eqx.field(static=True)
    solver: Any
    rtol: float | Float[Array, ""]
    atol: float | Float[Array, ""]
    max_steps: int = eqx.field(static=True)
    deterministic: bool = eqx.field(static=True)

    def __init__(
        self,
        reaction: AbstractReaction | None,
        diffusion: ArrayLike | Sequence[Any],
        *,
        initial: ArrayLike | Sequence[Any],
        couple: Couple | None = None,
        diluted: bool | Sequence[bool] = True,
        solver: Any = None,
        rtol: float | Float[Array, ""] = 1e-5,
        atol: float | Float[Array, ""] = 1e-8,
        max_steps: int = 256,
        deterministic: bool = True,
    ):
        with requires_extra("signals", "Signals"):
            import diffrax
        check_rates(reaction)
        self.diffusion = _as_array("diffusion", diffusion)
        self.initial = _as_array("initial", initial)
        check_number("diffusion", self.diffusion, at_least=0, many=True)
        check_number("initial", self.initial, at_least=0, many=True)
        if self.initial.ndim not in (1, 2) or self.diffusion.shape != self.initial.shape[:1]:
            raise ValueError(
                "Arguments `diffusion` and `initial` must have one row per species, shapes (species,) and "
                f"(species, cells), but have the shapes {self.diffusion.shape} and {self.initial.shape}. "
                "For one species pass [D] and [concentrations]."
            )
        n = len(self.diffusion)
        self.diluted = (diluted,) * n if isinstance(diluted, bool) else tuple(map(bool, diluted))
        if len(self.diluted) != n:
            raise ValueError(
                f"Argument `diluted` must be a boolean or one for each of {n} species, but is {diluted!r}."
            )
        if couple is not None and (isinstance(couple, AbstractEnergy) or not callable(couple)):
            raise TypeError(
                "Argument `couple` must be a function of concentrations and a tissue that returns an energy, "
                f"but is {describe(couple)}. Pass lambda concentrations, tissue: ..."
            )
        expected = "a solver of Diffrax, e.g. diffrax.Kvaerno3()"
        check_instance("solver", solver, diffrax.AbstractSolver | None, expected)
        check_number("rtol", rtol, above=0)
        check_number("atol", atol, above=0)
        check_integer("max_steps", max_steps, at_least=1)
        self.reaction, self.couple = reaction, couple
        self.deterministic = deterministic  # pyright: ignore[reportIncompatibleVariableOverride]
        self.solver = diffrax.Tsit5() if solver is None else solver
        self.rtol, self.atol, self.max_steps = rtol, atol, max_steps

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> SignalState:
        """The initial amounts, and the initial state of a coupled activity."""
        n, n_species, dtype = tissue.n_cells, len(self.diffusion), tissue.vertices.dtype
        remedy = "Give one row per species, with one entry per cell (spare slots included)."
        check_shape("initial", self.initial, (n_species,), (n_species, n), remedy=remedy)
        initial = self.initial if self.initial.ndim == 2 else self.initial[:, None]
        initial = jnp.broadcast_to(initial, (n_species, n)).astype(dtype)
        check_reaction(self.reaction, initial, tissue)
        amounts = self._from_amounts(initial * _areas(tissue), tissue)
        activity = _activity(self._material(amounts, tissue))
        return SignalState(amounts, None if activity is None else activity.init(tissue, key))

    def drive(
        self,
        state: SignalState,
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy | None, SignalState]:
        """The energy of `couple` at the concentrations after reaction and exchange, and these."""
        amounts, inner = self._reacted(state, tissue, time, dt), state.inner
        material = self._material(amounts, tissue)
        if material is None:
            return None, SignalState(amounts)
        energy: Any = material.energy
        if material.activity is not None:
            resistance: Any = dissipation if material.dissipation is None else material.dissipation
            active, inner = material.activity.drive(inner, tissue, resistance, time, dt, key)
            energy = energy if active is None else energy + active
        return energy, SignalState(amounts, inner, material)

    def step_dissipation(
        self, state: SignalState, tissue: Tissue, dissipation: AbstractDissipation | None
    ) -> AbstractDissipation | None:
        """The dissipation of a coupled material, if it has one."""
        coupled = None if state.material is None else state.material.dissipation
        return dissipation if coupled is None else coupled

    def finish(self, state: SignalState, before: Tissue, tissue: Tissue) -> SignalState:
        """The state after a step: the amounts of cells that vanished are in their neighbours."""
        amounts = state.amounts
        if tissue.topology.spare:
            shared = redistributed(amounts, before, tissue)
            amounts = jnp.where(self._is_diluted, shared, jnp.where(tissue.alive, amounts, 0))
        activity = _activity(state.material)
        inner = None if activity is None else activity.finish(state.inner, before, tissue)
        return SignalState(amounts, inner)

    def born(self, state: SignalState, tissue: Tissue, pair: Int[Array, "2"]) -> SignalState:
        """The state after a division: daughters share amounts by area, and copy other concentrations."""
        first, second = state.amounts[:, pair[0]], tissue.areas[pair]
        part = first * second[1] / jnp.sum(second)
        shared = jnp.stack([first - part, part], axis=-1)
        shared = jnp.where(self._is_diluted, shared, first[:, None])
        amounts, inner = state.amounts.at[:, pair].set(shared), state.inner
        if inner is not None:
            activity: Any = _activity(self._material(amounts, tissue))
            inner = activity.born(inner, tissue, pair)
        return SignalState(amounts, inner)

    def record(self, state: SignalState, tissue: Tissue) -> Float[Array, "species cells"]:
        """The concentrations, 0 in spare slots."""
        return self._concentrations(state.amounts, tissue)

    def _concentrations(
        self, amounts: Float[Array, "species cells"], tissue: Tissue
    ) -> Float[Array, "species cells"]:
        return jnp.where(self._is_diluted, amounts / _areas(tissue), amounts)

    @property
    def _is_diluted(self) -> Bool[Array, "species 1"]:
        return jnp.asarray(np.array(self.diluted)[:, None])

    def _from_amounts(
        self, amounts: Float[Array, "species cells"], tissue: Tissue
    ) -> Float[Array, "species cells"]:
        """The values that a state stores, 0 in spare slots."""
        values = jnp.where(self._is_diluted, amounts, amounts / _areas(tissue))
        return jnp.where(tissue.alive, values, 0) if tissue.topology.spare else values

    def _material(self, amounts: Float[Array, "species cells"], tissue: Tissue) -> Material | None:
        """The coupled energy, dissipation and activity at the values of a state; one call of `couple`."""
        if self.couple is None:
            return None
        coupled = self.couple(self._concentrations(amounts, tissue), tissue)
        if isinstance(coupled, AbstractEnergy) and not isinstance(coupled, Material):
            coupled = Material(coupled)
        if not isinstance(coupled, Material) or not isinstance(coupled.energy, AbstractEnergy):
            raise TypeError(
                "Argument `couple` must return an energy or a vertax.dynamics.Material of one, but returned "
                f"{describe(coupled)}."
            )
        activity = coupled.activity
        if activity is not None and self.deterministic and not activity.deterministic:
            raise ValueError(
                f"Argument `couple` returns the activity {type(activity).__name__}, which draws random "
                "numbers. Pass deterministic=False to Signals, and a key."
            )
        return coupled

    def _reacted(
        self, state: SignalState, tissue: Tissue, time: Float[Array, ""], dt: Float[Array, ""]
    ) -> Float[Array, "species cells"]:
        """The stored values after reaction and exchange for a time `dt`."""
        import diffrax

        # Amounts in units of the mean area, so that the tolerances are those of concentrations.
        unit = jax.lax.stop_gradient(tissue.mean_area)
        relative_areas = _areas(tissue) / unit
        exchange = Exchange.of(tissue)
        cells = None if self.reaction is None else self.reaction.sense(tissue)

        def rates(local_time: Any, amounts: Any, _: Any) -> Array:
            c = amounts / relative_areas
            reacting = reaction_rates(self.reaction, c, cells, time + local_time, tissue)
            flux = exchange.flux(c, self.diffusion / unit)
            return (relative_areas * reacting + flux).astype(amounts.dtype)

        start = self.record(state, tissue) * relative_areas
        rtol = jnp.maximum(self.rtol, 4 * jnp.finfo(start.dtype).eps)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            self.solver,
            jnp.zeros_like(dt),
            dt,
            None,
            start,
            stepsize_controller=diffrax.PIDController(rtol, self.atol),
            max_steps=self.max_steps,
            throw=False,
        )
        assert solution.ys is not None
        successful = solution.result == diffrax.RESULTS.successful
        amounts = jnp.where(successful, solution.ys[-1], jnp.nan) * unit
        return self._from_amounts(amounts, tissue)


def _as_array(name: str, value: Any) -> Float[Array, "..."]:
    """An array of finite real numbers, also from a sequence that contains tracers."""
    concrete = all(map(is_concrete, jax.tree.leaves(value)))
    return as_real(name, value if concrete else jnp.asarray(value))


def _activity(material: Material | None) -> AbstractActivity | None:
    return None if material is None else material.activity


def _areas(tissue: Tissue) -> Float[Array, " cells"]:
    """The areas of the cells, 1 for spare slots."""
    areas = tissue.areas
    return jnp.where(tissue.alive, areas, 1) if tissue.topology.spare else areas
