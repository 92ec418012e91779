"""The objective of a relaxation, and its preconditioner: the only place where the energy is traced."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from vertax._base.model_checks import real_scalar
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.precondition._edge_blocks import EdgeBlocks
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._sum import Preconditioner
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


def preconditioner_of(
    tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
) -> Preconditioner:
    """The preconditioner of steps and of derivatives; its local part is diagonal in small tissues."""
    coarse = ElasticMedium.of(tissue)
    if tissue.n_cells < MIN_CELLS_OF_EDGE_BLOCKS or tissue.arcs is not None:
        return Preconditioner(None, coarse)
    more = None if contacts is None else contacts.resistance(tissue)
    return Preconditioner(EdgeBlocks.of(tissue, energy, more), coarse)
