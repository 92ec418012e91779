"""The objective of a relaxation, and its preconditioners: the only place where the energy is traced."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from vertax.energies import AbstractEnergy
from vertax.energies._energy import real_scalar
from vertax.mesh import Tissue
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.precondition._edge_blocks import EdgeBlocks
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._recycled_hessian import RecycledHessian
from vertax.relax._contacts import Contacts

MIN_CELLS_OF_EDGE_BLOCKS = 300
"""In smaller tissues edge blocks take more time than they save."""


# A relaxation evaluates it in several places: so it is traced once.
@eqx.filter_jit
def objective(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy, Contacts | None]
) -> tuple[Float[Array, ""], None]:
    """The energy of a configuration and of its contacts, as Optimistix wants it."""
    tissue, energy, contacts = args
    trial = tissue.with_configuration(configuration)
    value = real_scalar(energy(MeasuredTissue(trial)))
    return value if contacts is None else value + contacts(trial), None


def coarse_preconditioner(
    tissue: Tissue, recycled_hessian: RecycledHessian | None
) -> RecycledHessian | ElasticMedium | None:
    """A preconditioner for long waves; None for a small tissue without a recycled Hessian."""
    if recycled_hessian is None:
        return ElasticMedium.of(tissue)
    return recycled_hessian.near(tissue.configuration)


def edge_preconditioner(
    tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
) -> EdgeBlocks | None:
    """The stiffness of edges and contacts; None for arcs and in small tissues."""
    if tissue.n_cells < MIN_CELLS_OF_EDGE_BLOCKS:
        return None
    if contacts is None or tissue.arcs is not None:
        return EdgeBlocks.of(tissue, energy)
    return EdgeBlocks.of(tissue, energy, contacts.resistance(tissue))
