"""Quasi-static deformation: a relaxation after each small strain of the box."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.announce import announce_compilations
from vertax._base.batch import member
from vertax._base.checkpoints import Checkpoint
from vertax._base.checks import as_list, as_matrix, as_scalar, check_function, check_instance
from vertax._base.frame_loop import AbstractSimulation, Frame, simulate
from vertax._base.results import RESULTS, AbstractOutcome, first_failure, first_of, result_of
from vertax._base.tracing import traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_system
from vertax.mechanics._landscape import deformed
from vertax.mechanics._stress import stress
from vertax.mesh import Tissue, Trajectory
from vertax.relax import Relaxation

Deformation = Callable[[Float[Array, ""]], Float[Array, "2 2"]]


def simple_shear(strain: ArrayLike) -> Float[Array, "2 2"]:
    r"""Simple shear along x by $\gamma$: the deformation gradient `[[1, γ], [0, 1]]`."""
    strain = as_scalar("strain", strain)
    zero, one = jnp.zeros_like(strain), jnp.ones_like(strain)
    return jnp.stack([jnp.stack([one, strain]), jnp.stack([zero, one])])


def pure_shear(strain: ArrayLike) -> Float[Array, "2 2"]:
    r"""Pure shear at fixed area: the deformation gradient `diag(exp(ε), exp(-ε))`."""
    strain = as_scalar("strain", strain)
    return jnp.diag(jnp.stack([jnp.exp(strain), jnp.exp(-strain)]))


class Ramp(AbstractOutcome):
    """The relaxed tissue at each strain of a quasi-static deformation."""

    strains: Float[Array, " strains"]
    """The strains."""
    frames: Tissue
    """The relaxed tissues: one tissue with a leading axis."""
    energies: Float[Array, " strains"]
    """Their energies."""
    stresses: Float[Array, "strains 2 2"]
    """Their stresses, energy per area."""
    num_t1: Int[Array, " strains"]
    """T1 transitions since the previous strain."""
    results: RESULTS
    """How the relaxation at each strain ended."""

    @property
    def tissue(self) -> Tissue:
        """The relaxed tissue at the last strain."""
        return member(self.frames, -1)

    @property
    def result(self) -> RESULTS:
        """How the ramp ended: the first failure."""
        return first_of(self.results)

    def _details(self) -> str:
        number = int(np.argmax(self.results != RESULTS.successful))
        return f"strain {self.strains[number]:g}, number {number}"

    @property
    def trajectory(self) -> Trajectory:
        """The relaxed tissues as a trajectory, for [`animate`][vertax.animate] and for files."""
        values = {"strain": self.strains, "energy": self.energies, "num_t1": self.num_t1}
        return Trajectory.from_frames(self.frames, **values)

    @property
    def plastic(self) -> Bool[Array, " strains"]:
        """Whether cells changed neighbours at each strain."""
        return self.num_t1 > 0


def ramp(
    tissue: Tissue,
    energy: AbstractEnergy,
    strains: ArrayLike,
    *,
    deformation: Deformation = simple_shear,
    relaxation: Relaxation = Relaxation(),
    adjoint: AbstractAdjoint = ImplicitDifferentiation(),
    throw: bool = True,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
) -> Ramp:
    r"""Deform a tissue quasi-statically at zero temperature (AQS), through its T1 transitions.

    For each strain:

    1. Deform the initial box by the strain.
    2. Map the relaxed tissue of the previous strain affinely into that box.
    3. Relax the tissue.

    Between transitions the work of the stress equals the change of the energy; at a transition energy is
    dissipated (Maloney & Lemaître 2006, doi:10.1103/PhysRevE.74.016118).

    **Arguments:**

    - `tissue`: a periodic tissue.
    - `energy`: its energy.
    - `strains`: the strains in order, in steps small enough for the tissue to follow the same branch of
        minima.
    - `deformation`: a function from a strain to the deformation gradient of the box, shape `(2, 2)`:
        [`simple_shear`][vertax.mechanics.simple_shear], [`pure_shear`][vertax.mechanics.pure_shear], or any
        other function.
    - `relaxation`: the relaxation, by default [`Relaxation()`][vertax.Relaxation].
    - `adjoint`: the differentiation method, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation] by
        default.
    - `throw`: raise an error if a relaxation does not converge.
    - `progress`: show a progress bar (only on a terminal).
    - `checkpoint`: a file, or a [`Checkpoint`][vertax.Checkpoint], as in [`evolve`][vertax.evolve].

    **Returns:** a [`Ramp`][vertax.mechanics.Ramp], differentiable with respect to the energy, as long as the
        same transitions happen in the same steps.

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    - `ValueError` for a free tissue, strains that are not a list of numbers, a deformation of another shape,
        or a checkpoint that is broken or of another run.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and a relaxation did not converge.
    """
    check_system(tissue, energy, box="a ramp")
    values = as_list("strains", strains).astype(tissue.vertices.dtype)
    expected = (
        "a function from a strain to a deformation gradient, e.g. vertax.mechanics.pure_shear"
    )
    check_function("deformation", deformation, expected)
    as_matrix("deformation", jnp.zeros(jax.eval_shape(deformation, values[0]).shape))
    check_instance("relaxation", relaxation, Relaxation, "a vertax.Relaxation")
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    relaxation.check(tissue, energy, adjoint)
    simulation = _Deformation(tissue, energy, deformation, relaxation.traced(), adjoint)
    # The first frame is the undeformed tissue.
    points = jnp.concatenate([jnp.zeros_like(values[:1]), values])
    with announce_compilations(f"the deformation of {tissue.n_cells} cells"):
        return simulate(
            simulation, None, points, progress=progress, checkpoint=checkpoint, throw=throw
        )


class _State(eqx.Module):
    tissue: Tissue
    num_t1: Int[Array, ""]
    result: RESULTS


class _Deformation(AbstractSimulation):
    name: ClassVar[str] = "ramp"
    points: ClassVar[str] = "strains"

    initial: Tissue
    energy: AbstractEnergy
    deformation: Deformation
    relaxation: Relaxation
    adjoint: AbstractAdjoint

    def begin(self, start: None, points: Array) -> tuple[_State, Frame]:
        zero, count = jnp.zeros((2, 2), points.dtype), jnp.array(0)
        state = _State(self.initial, count, result_of(count))
        return state, _frame(self.initial, zero[0, 0], zero, count, state.result)

    def advance(self, state: _State, interval: Array, key: Any) -> tuple[_State, Frame]:
        box = deformed(self.initial, self.deformation(interval[1])).boundary
        rest = self.relaxation.solve(
            state.tissue.carried(box), self.energy, self.adjoint, recompute=True
        )
        stresses = stress(rest.tissue, self.energy)
        frame = _frame(rest.tissue, rest.energy, stresses, rest.num_t1, rest.result)
        result = first_failure(state.result, rest.result)
        return _State(rest.tissue, state.num_t1 + rest.num_t1, result), frame

    def outcome(self, points: Array, end: _State, frames: Frame) -> Ramp:
        after_first = lambda x: x[1:] if eqx.is_array(x) else x
        return Ramp(strains=points[1:], **jax.tree.map(after_first, frames))

    def counts(self, state: _State) -> dict[str, Array]:
        return {"t1": state.num_t1}


def _frame(tissue: Tissue, energy: Array, stresses: Array, num_t1: Array, result: RESULTS) -> Frame:
    values = {"energies": energy, "stresses": stresses, "num_t1": num_t1}
    return {"frames": tissue, "results": result} | values
