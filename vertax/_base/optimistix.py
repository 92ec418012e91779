"""The undocumented part of the interface of adjoints in Optimistix; tested with version 0.1.

`optimistix.AbstractAdjoint.apply` receives a minimisation as a function and a tuple of its inputs. The order
of these inputs is used only in this module.
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
    """The arguments of `optimistix.AbstractAdjoint.apply` by name."""

    run_with: Callable[[tuple], tuple[PyTree[Array], PyTree]]
    fn: Any
    """The objective, `fn(y, args) -> (value, aux)`."""
    solver: Any
    y0: PyTree[Array]
    args: PyTree
    options: dict[str, Any]
    others: tuple[Any, ...]
    """Maximum number of steps, shapes of the outputs, tags."""

    @classmethod
    def of(cls, primal_fn: Callable, inputs: tuple) -> Minimisation:
        """From the arguments of `optimistix.AbstractAdjoint.apply`."""
        fn, solver, y0, args, options, *others = inputs
        return cls(primal_fn, fn, solver, y0, args, options, tuple(others))

    @property
    def inputs(self) -> tuple:
        """The tuple of inputs, in the order of Optimistix."""
        return (self.fn, self.solver, self.y0, self.args, self.options, *self.others)

    def run(
        self, kind: Literal["lax", "checkpointed"] = "lax", *, checkpoints: int | None = None
    ) -> tuple[PyTree[Array], PyTree]:
        """Run the minimisation; return the minimum and the residuals of Optimistix."""
        loop = partial(eqxi.while_loop, kind=kind, checkpoints=checkpoints)
        return self.run_with((*self.inputs, loop))

    def run_as_constant(self) -> tuple[PyTree[Array], PyTree]:
        """Like `run`, but not differentiable; on a CPU `jax.vmap` runs the members sequentially."""
        return sequential_vmap_on_cpu(Minimisation.run)(self)

    def replaced(self, **changes: Any) -> Minimisation:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


def num_steps_of(residual: PyTree) -> Int[Array, ""]:
    """Number of steps, from the residuals of `Minimisation.run`."""
    num_steps, *_ = residual
    return num_steps
