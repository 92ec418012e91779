"""Surface Evolver as a forward model."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import ClassVar, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vertax._base.checks import check_integer, check_number
from vertax.energies import AbstractEnergy
from vertax.external._evolver_datafile import datafile, leveller
from vertax.external._evolver_model import Terms, slope_of
from vertax.external._evolver_strings import Strings
from vertax.external._evolver_t1 import can_flip, shortest, swapped
from vertax.external._program import run_program, tail
from vertax.external._simulator import AbstractSimulator, Edges, Relaxed, SimulatorError
from vertax.mesh import Tissue

# T1 transitions in one relaxation, at most, per edge: as `T1.max_flips`.
_MOST_T1 = 20


@dataclasses.dataclass(frozen=True)
class SurfaceEvolver(AbstractSimulator):
    r"""Surface Evolver (Brakke 1992, doi:10.1080/10586458.1992.10504253) as a simulator, run as a process.

    A tissue is written as a datafile: its edges in the string model, its energy as named quantities, and the
    nudge as one more of them. The program relaxes it by its own commands, and prints where the vertices are.
    Energies may consist of `LineTension`, `BoundedTension`, `AreaElasticity`, `PerimeterElasticity` and
    `ShapeFactorEnergy`. Tissues may be periodic or free.

    Arcs are chains of straight pieces, all of whose points relax. Their angles are those of arcs that enclose
    as much, so areas are exact; lengths, and with them energies, are those of chains, shorter by parts in
    $n^2$ with $n$ pieces. So the program, and not the energy, says what the derivatives are: use
    `External(..., slope="program", stiffness=...)` for tissues with arcs.

    The Debian package `evolver-nox` has the program. It takes some milliseconds to begin.

    **Arguments:**

    - `command`: the program.
    - `areas`: `"elastic"`, as the energy says, or `"fixed"` at the `target_area` of its `AreaElasticity`,
        whose stiffness is infinite then, as in a foam. (In a periodic box the targets are scaled such that
        they fill it.) Then the energy does not describe the program: use
        `External(..., slope="program", stiffness=...)`.
    - `pieces`: of each arc.
    - `tolerance`: the program has relaxed when a step lowers the energy by less than this share.
    - `steps`: of conjugate gradients to begin with, where a tissue is far from rest.
    - `newton_steps`: at most; 0 for conjugate gradients only, until the tolerance ends them.
    - `timeout`: seconds after which a run is ended.
    - `t1`: a length; shorter edges flip by the program's `t1_edgeswap`, one after another, if the tissue then
        comes to rest with a lower energy. Of straight edges, and not at the outline. None for no transitions.

    **Raises:**

    - `ValueError` for numbers that are not positive, and other settings of `areas`.
    """

    bends: ClassVar[bool] = True

    command: str = "evolver"
    areas: Literal["elastic", "fixed"] = "elastic"
    tolerance: float = 1e-14
    pieces: int = 8
    steps: int = 20
    newton_steps: int = 40
    timeout: float = 60.0
    t1: float | None = None

    def __post_init__(self) -> None:
        if self.areas not in ("elastic", "fixed"):
            raise ValueError(
                f"Argument `areas` must be 'elastic' or 'fixed', but is {self.areas!r}."
            )
        for name in ("tolerance", "timeout"):
            check_number(name, getattr(self, name), above=0)
        if self.t1 is not None:
            check_number("t1", self.t1, above=0)
        check_integer("pieces", self.pieces, at_least=2)
        check_integer("steps", self.steps, at_least=0)
        check_integer("newton_steps", self.newton_steps, at_least=0)

    def relax(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        forces: Float[np.ndarray, "vertices 2"] | None,
        torques: Float[np.ndarray, " edges"] | None = None,
    ) -> Relaxed:
        """Bring a tissue to rest, see [`AbstractSimulator`][vertax.external.AbstractSimulator].

        **Raises:**

        - [`SimulatorError`][vertax.external.SimulatorError], with the tail of the log, if the program fails,
            and for an energy that it cannot be told of.
        """
        if self.t1 is None or forces is not None:
            return self._at_rest(tissue, energy, forces, torques)
        if tissue.arcs is not None:
            raise SimulatorError(
                "T1 transitions by Surface Evolver are for straight edges: `t1=None`."
            )
        found, there, refused = self._at_rest(tissue, energy, None, None), tissue, set()
        number = 0
        while True:
            there = eqx.tree_at(lambda t: t.vertices, there, found.vertices)
            allowed = can_flip(there.topology)
            allowed[list(refused)] = False
            lengths = np.hypot(*Edges.of(there).vectors(found.vertices).T)
            edge = shortest(lengths, self.t1, allowed)
            if edge is None:
                return found._replace(tissue=there, num_t1=number)
            if number >= _MOST_T1 * tissue.n_edges:
                raise SimulatorError(
                    f"T1 transitions by Surface Evolver came to no end after {number}. Lower `t1`, or pass "
                    "`t1=None`."
                )
            other = swapped(there, edge, 0.5 * self.t1, self._ask)
            trial = None
            if other is not None:
                with suppress(SimulatorError):  # it comes to no rest that way
                    trial = self._at_rest(other, energy, None, None)
            # The energy falls with each transition, and between two of them each edge is refused once.
            if trial is not None and trial.energy < found.energy - 1e-9 * abs(found.energy):
                found, there, refused, number = trial, other, set(), number + 1
            else:
                refused.add(edge)

    def _at_rest(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        forces: Float[np.ndarray, "vertices 2"] | None,
        torques: Float[np.ndarray, " edges"] | None,
    ) -> Relaxed:
        """Where a tissue rests in its topology."""
        strings = Strings.of(tissue, self.pieces)
        terms = Terms.of(energy, strings.pieces.n_cells, len(strings.parts))
        given, held = terms, ()
        if self.areas == "fixed":
            terms, held = self._fixed(strings, given)
        text = datafile(strings, terms, forces, torques, held=held)
        points, pressures, numbers = self._run(
            text, self._commands(strings, near=forces is not None) + _report(held), strings
        )
        measures = (strings.lengths(points), strings.areas(points), strings.perimeters(points))
        return Relaxed(
            points[: strings.n_vertices] + strings.images @ strings.lattice,
            angles=_angles(strings, points, tissue),
            energy=numbers["energy"],
            num_steps=int(numbers["steps"]),
            slope=slope_of(
                energy, *measures, _by_targets(strings, given, pressures) if held else None
            ),
        )

    def energy(self, tissue: Tissue, energy: AbstractEnergy) -> float:
        """The energy of a tissue as it is, by the program.

        **Arguments:**

        - `tissue`, `energy`: the tissue, and its energy.

        **Returns:** its energy.
        """
        strings = Strings.of(tissue, self.pieces)
        terms = Terms.of(energy, strings.pieces.n_cells, len(strings.parts))
        text = datafile(strings, terms)
        return self._run(text, "steps_done := 0;\nrecalc;\n" + _report(), strings)[2]["energy"]

    def _fixed(self, strings: Strings, terms: Terms) -> tuple[Terms, Sequence[int]]:
        """The terms of an energy whose areas are fixed, and the cells to hold."""
        if not terms.area_stiffness.any():
            raise SimulatorError(
                "Areas that are fixed need targets: add an AreaElasticity to the energy, of any stiffness."
            )
        n = strings.pieces.n_cells
        targets, held = terms.area, range(n)
        if strings.periodic:
            # The box holds the area of the last cell, once it holds the others.
            targets, held = targets * _share(strings, terms), range(n - 1)
        return terms._replace(area_stiffness=np.zeros(n), area=targets), held

    def _ask(self, text: str, commands: str) -> str:
        """What the program writes, given a datafile and commands."""
        command = [self.command, "-i", "-frelax.cmd", "tissue.fe"]
        files = {"tissue.fe": text, "relax.cmd": commands}
        found, _ = run_program(command, files, ["result"], timeout=self.timeout, install=INSTALL)
        return found["result"]

    def _run(
        self, text: str, commands: str, strings: Strings
    ) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
        command = [self.command, "-i", "-frelax.cmd", "tissue.fe"]
        files = {"tissue.fe": text, "relax.cmd": commands}
        found, log = run_program(command, files, ["result"], timeout=self.timeout, install=INSTALL)
        return _read(found["result"], strings, log)

    def _commands(self, strings: Strings, *, near: bool) -> str:
        """How it relaxes: conjugate gradients, and then Newton's method with a search along each step.

        A tissue that is `near` to rest needs no first steps.
        """
        # (With the first toggle on, as it is, the index of the Hessian is wrong and its steps stall; so do
        # they with areas that are held if the last one is off.)
        lines = ["function_quantity_sparse off;", "hessian_normal off;", "augmented_hessian on;"]
        lines += [leveller(strings, near=near), "steps_done := 0;", "recalc;"]
        first = 0 if near and self.newton_steps else self.steps
        if first:
            # (Areas that are held are reached by steps along the gradient.)
            lines += [f"g 5; U; g {first}; U;", f"steps_done := {first + 5};"]
        elif self.areas == "fixed":
            lines.append("g 1;")  # which the multipliers of areas that are held take to be known
        step = "hessian_seek" if self.newton_steps else "g 5"
        most = first + (self.newton_steps or 100000)
        lines += [
            "gain := 1;",
            f"while (gain > {self.tolerance:.3g}*abs(total_energy) and steps_done < {most}) do "
            f"{{ level; before := total_energy; {step}; gain := abs(before - total_energy); "
            "steps_done += 1; };",
        ]
        if self.newton_steps and self.tolerance < 1e-10:
            # The energy cannot tell steps below the root of its rounding: last ones in full.
            last = 2 if not strings.chains.any() else 3 if near else 5
            lines.append(f"weaken; {'level; hessian; ' * last}steps_done += {last};")
        return "\n".join([*lines, ""])


def _angles(
    strings: Strings, points: Float[np.ndarray, "points 2"], tissue: Tissue
) -> Float[np.ndarray, " edges"] | None:
    """The angles of arcs; those of straight edges stay as they were."""
    if tissue.arcs is None:
        return None
    return np.where(strings.chains, strings.angles(points), np.asarray(tissue.arcs.angles))


def _share(strings: Strings, terms: Terms) -> float:
    """By how much target areas are too small for a periodic box."""
    return float(abs(np.linalg.det(strings.lattice)) / np.sum(terms.area))


def _by_targets(
    strings: Strings, terms: Terms, pressures: Float[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """Derivatives of the energy with respect to the targets of areas that are held."""
    if not strings.periodic:
        return pressures
    mean = pressures @ terms.area / np.sum(terms.area)
    return _share(strings, terms) * (pressures - mean)


INSTALL = (
    "Install Surface Evolver, e.g. by apt-get install evolver-nox, or pass "
    "SurfaceEvolver(command=...)."
)


def _report(held: Sequence[int] = ()) -> str:
    """Commands that write where all points are, and the multipliers of areas held; and end the program."""
    lines = [
        'printf "energy %.17g\\n", total_energy-nudge.value-spacing.value >> "result";',
        'printf "steps %g\\n", steps_done >> "result";',
        'foreach vertex vv do printf "point %d %.17g %.17g\\n", vv.id, vv.x, vv.y >> "result";',
        *(f'printf "pressure {c} %.17g\\n", keep_{c}.pressure >> "result";' for c in held),
    ]
    return "\n".join([*lines, 'printf "end\\n" >> "result";', "quit", "quit", ""])


def _read(text: str, strings: Strings, log: str) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Points, pressures (of areas that are held) and numbers that the program wrote."""
    points = np.full_like(strings.points, np.nan)
    pressures = np.zeros(strings.pieces.n_cells)
    numbers: dict[str, float] = {}
    lines = text.splitlines()
    try:
        for line in lines:
            kind, *values = line.split()
            if kind == "point":
                points[int(values[0]) - 1] = [float(v) for v in values[1:]]
            elif kind == "pressure":
                pressures[int(values[0])] = float(values[1])
            elif kind != "end":
                numbers[kind] = float(values[0])
    except (ValueError, IndexError) as error:
        raise SimulatorError(f"What evolver wrote cannot be read ({error}). {tail(log)}") from error
    complete = bool(lines) and lines[-1] == "end" and {"energy", "steps"} <= numbers.keys()
    if re.search("ERROR", log) or not complete or not np.isfinite(points).all():
        raise SimulatorError(f"evolver did not come to an end. {tail(log)}")
    return points, pressures, numbers
