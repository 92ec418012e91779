"""What adjoints know of Optimistix beyond its documented interface; known to work with 0.1.

An adjoint of Optimistix is handed a minimisation as a function and a tuple whose entries have no names.
This is the only place that knows their order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import equinox.internal as eqxi
from jaxtyping import Array, Int, PyTree

from vertax._base.sequential_vmap import sequential_vmap_on_cpu


class Minimisation(eqx.Module):
    """A minimisation as an adjoint of Optimistix sees it."""

    run_with: Callable[[tuple], tuple[PyTree[Array], PyTree]]
    fn: Any
    """The objective, `fn(y, args) -> (value, aux)`."""
    solver: Any
    y0: PyTree[Array]
    args: PyTree
    options: dict[str, Any]
    others: tuple[Any, ...]
    """What an adjoint need not know: most steps, the shapes of outputs, tags."""

    @classmethod
    def of(cls, primal_fn: Callable, inputs: tuple) -> Minimisation:
        """The minimisation that `optimistix.AbstractAdjoint.apply` is called with."""
        fn, solver, y0, args, options, *others = inputs
        return cls(primal_fn, fn, solver, y0, args, options, tuple(others))

    @property
    def inputs(self) -> tuple:
        """The tuple that it was made from."""
        return (self.fn, self.solver, self.y0, self.args, self.options, *self.others)

    def run(
        self, kind: Literal["lax", "checkpointed"] = "lax", *, checkpoints: int | None = None
    ) -> tuple[PyTree[Array], PyTree]:
        """The minimum, and what Optimistix has to say of the way there."""
        loop = partial(eqxi.while_loop, kind=kind, checkpoints=checkpoints)
        return self.run_with((*self.inputs, loop))

    def run_as_constant(self) -> tuple[PyTree[Array], PyTree]:
        """The same, not differentiable; on a CPU members of a `jax.vmap` run one after another."""
        return sequential_vmap_on_cpu(Minimisation.run)(self)

    def replaced(self, **changes: Any) -> Minimisation:
        """The same with some of its parts replaced."""
        return dataclasses.replace(self, **changes)


def num_steps_of(residual: PyTree) -> Int[Array, ""]:
    """How many steps a minimisation took."""
    num_steps, *_ = residual
    return num_steps
