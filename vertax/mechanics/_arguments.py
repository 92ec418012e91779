"""Checks of the arguments of this package: each error names the argument and the remedy."""

from __future__ import annotations

from typing import Any

import lineax as lx

from vertax._base.checks import check_instance
from vertax._base.model_checks import check_energy, check_planar, check_single, warn_of_columns
from vertax.dissipations import AbstractDissipation
from vertax.mesh import Periodic, Tissue


def check_system(tissue: Any, energy: Any, *, box: str | None = None) -> None:
    """Raise an error unless the arguments are one tissue and an energy.

    **Arguments:**

    - `tissue`, `energy`: the objects to check.
    - `box`: name of the calculation, for the message, if it needs a periodic box.

    **Raises:**

    - `TypeError` for objects of other classes.
    - `ValueError` for a batch of tissues, or for a free tissue or one on a surface if `box` is given.
    """
    check_tissue(tissue, box=box)
    check_energy(energy)
    warn_of_columns(energy, tissue)


def check_tissue(tissue: Any, *, box: str | None = None) -> None:
    """Raise an error unless the argument is one tissue; see `check_system`."""
    check_instance("tissue", tissue, Tissue, "a vertax.Tissue")
    check_single(tissue)
    if box is not None and not isinstance(tissue.boundary, Periodic):
        raise ValueError(
            f"Argument `tissue` must be periodic: {box} strains the box, and a free tissue has none."
        )
    if box is not None:
        check_planar(box, tissue)


def check_dissipation(dissipation: Any) -> None:
    """Raise a `TypeError` unless the argument is a dissipation."""
    expected = "a dissipation, e.g. vertax.dissipations.SubstrateFriction(1.0)"
    check_instance("dissipation", dissipation, AbstractDissipation, expected)


def check_linear_solver(solver: Any) -> None:
    """Raise a `TypeError` unless the argument is a linear solver."""
    check_instance(
        "linear_solver", solver, lx.AbstractLinearSolver, "a linear solver, e.g. vertax.MINRES()"
    )
