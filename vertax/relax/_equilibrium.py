"""A relaxation in two parts: the search for the equilibrium, and a solve that can be differentiated there."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.results import RESULTS
from vertax._base.scales import Scales
from vertax._base.tracing import frozen, is_concrete
from vertax.adjoints import AbstractAdjoint
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.relax._contacts import Contacts
from vertax.relax._loop import Search, SearchState
from vertax.relax._objective import objective, preconditioner_of
from vertax.relax._response import Equilibrium, with_overlaps
from vertax.solvers._stop_at_rest import AtRest, StopAtRest


class SearchEnd(eqx.Module):
    """Where a search ended, not differentiable."""

    tissue: Tissue
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    contacts: Contacts | None
    scales: Scales
    max_force: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    overlaps: Bool[Array, ""] | None
    """Whether the tissue overlaps; None without contacts."""
    result: RESULTS

    @classmethod
    def of(cls, search: Search, state: SearchState) -> SearchEnd:
        """The end of a search."""
        return cls(
            tissue=state.tissue,
            origin=state.origin,
            contacts=state.contacts,
            scales=search.scales,
            max_force=state.force,
            num_steps=state.num_steps,
            num_t1=state.num_t1,
            overlaps=None if state.contacts is None else state.overlaps,
            result=search.result(state),
        )


def conclude(
    end: SearchEnd,
    tissue: Tissue,
    energy: AbstractEnergy,
    adjoint: AbstractAdjoint,
    minimiser: StopAtRest,
    max_steps: int | Int[Array, ""],
) -> Equilibrium:
    """The equilibrium that a search from `tissue` ended at, differentiable.

    `minimiser` and `max_steps` are for adjoints that relax the tissue again.
    """
    relaxed, scales = end.tissue, end.scales
    # Without an equilibrium the derivatives are 0. In a batch NaN would reach the parameters that all members
    # share, also through a cost that masks this member.
    exists = end.result != RESULTS.nonfinite
    tissue, energy = (_constant_unless(exists, part) for part in (tissue, energy))
    free = free_motions(relaxed, frozen(energy), scales)
    # Rigid motions of the relaxation depend on its path: undo them, unless the energy depends on them.
    settled = _choose(
        jnp.all(free), relaxed.settled(frozen(tissue)), _recentred(relaxed, tissue, free)
    )
    moved = settled.held_as(_choose(jnp.all(free), tissue, relaxed))
    springs = jnp.ones_like(moved.drift(settled.configuration)).at[: len(free)].set(free)
    options = {
        "scales": scales,
        "exists": exists,
        "relaxation": minimiser,
        "start": end.origin,
        "max_steps": jnp.asarray(max_steps),
        "preconditioner": preconditioner_of(settled, energy, end.contacts),
    }
    # This solve takes no step: it is differentiated.
    solution = optx.minimise(
        _pinned_energy,
        AtRest(),
        settled.configuration,
        (moved, energy, frozen(end.contacts), scales.stiffness * springs),
        frozen(options),
        max_steps=None,
        adjoint=adjoint,
        throw=False,
    )
    final = follow_start(moved.with_configuration(solution.value), tissue, free)
    overlaps = final.overlaps.any if end.overlaps is None else end.overlaps
    return Equilibrium(
        tissue=final,
        energy=energy(final),
        max_force=end.max_force,
        num_steps=end.num_steps,
        num_t1=end.num_t1,
        result=with_overlaps(end.result, overlaps),
    )


def follow_start(relaxed: Tissue, start: Tissue, free: Bool[Array, " modes"]) -> Tissue:
    """The same tissue, with the derivative of its position by that of `start`.

    A relaxation keeps the centroid of the start, and the orientation of a free tissue, unless the energy
    determines them. The adjoint differentiates the shape at a fixed position. This function differentiates
    the position, so that every adjoint has the derivative with respect to the start. If only some rigid
    motions are zero modes, only translations are followed.
    """
    settled = relaxed.settled(start).vertices
    # (Only the derivative changes, no bit of the value.)
    settled = settled + jax.lax.stop_gradient(relaxed.vertices - settled)
    gathered = start.gathered(start.vertices)
    moved = jnp.mean(gathered - jax.lax.stop_gradient(gathered), axis=0) * free[:2]
    if start.pinned is not None:
        moved = jnp.where(jnp.any(start.pinned), 0, moved)
    return relaxed.with_vertices(jnp.where(jnp.all(free), settled, relaxed.vertices + moved))


def _recentred(relaxed: Tissue, start: Tissue, free: Bool[Array, " modes"]) -> Tissue:
    """The same tissue, moved to the centroid of `start` along the translations that are free."""
    drift = jnp.mean(start.gathered(start.vertices) - relaxed.gathered(relaxed.vertices), axis=0)
    drift = jax.lax.stop_gradient(drift) * free[:2]
    if start.pinned is not None:
        drift = jnp.where(jnp.any(start.pinned), 0, drift)
    return relaxed.with_vertices(relaxed.vertices + drift)


def _constant_unless(condition: Bool[Array, ""], tree: PyTree) -> PyTree:
    """The same values; derivatives through them are 0 unless the condition holds."""
    numbers, rest = eqx.partition(tree, lambda x: eqx.is_inexact_array(x) and not is_concrete(x))
    mask = lambda x: jnp.where(condition, x, jax.lax.stop_gradient(x))
    return eqx.combine(jax.tree.map(mask, numbers), rest)


def _choose(condition: Bool[Array, ""], one: Tissue, other: Tissue) -> Tissue:
    """The vertices of one tissue or another; pinned ones are where the first has them."""
    if one.pinned is not None:
        condition = condition | one.pinned[:, None]
    return one.with_vertices(jnp.where(condition, one.vertices, other.vertices))


def free_motions(tissue: Tissue, energy: AbstractEnergy, scales: Scales) -> Bool[Array, " modes"]:
    """Which rigid motions are zero modes: all, unless the energy depends on absolute positions."""
    displaced = tissue.boundary.motions(tissue.vertices, 0.3 * scales.length)
    positions = jnp.concatenate([tissue.vertices[None], displaced])
    energies = jax.vmap(lambda vertices: energy(tissue.with_vertices(vertices)))(positions)
    value = energies[0]
    rounding = jnp.finfo(value.dtype).eps ** 0.6
    size = jnp.abs(value) + scales.force * scales.length
    return jnp.abs(energies[1:] - value) <= rounding * size


def _pinned_energy(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Contacts | None, Array]
) -> Array:
    """The energy, and springs that fix rigid motions that are zero modes.

    Zero modes make the Hessian singular, and a nudged relaxation would drift along them. Springs to the
    positions in `tissue` remove them and change no shape.
    """
    tissue, energy, contacts, gauge = args
    drift = tissue.drift(configuration)
    return objective(configuration, (tissue, energy, contacts))[0] + 0.5 * jnp.sum(gauge * drift**2)
