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

from vertax._base.checks import check_choice, check_integer, check_number
from vertax.energies import AbstractEnergy
from vertax.external._evolver_datafile import datafile, spacing_commands
from vertax.external._evolver_model import Terms, parameter_derivatives
from vertax.external._evolver_strings import Strings
from vertax.external._evolver_t1 import can_flip, flip_by_program
from vertax.external._program import run_program, tail
from vertax.external._simulator import AbstractSimulator, Edges, Relaxed, SimulatorError
from vertax.mesh import Tissue

# T1 transitions in one relaxation, at most, per edge: as `T1.max_flips`.
_MAX_T1_PER_EDGE = 20


@dataclasses.dataclass(frozen=True)
class SurfaceEvolver(AbstractSimulator):
    r"""Surface Evolver (Brakke 1992, doi:10.1080/10586458.1992.10504253) as a simulator, run as a process.

    The tissue is written as a datafile: its edges in the string model, its energy and the nudge as named
    quantities. The program relaxes it and prints the positions of the vertices. The energy must be a sum of
    `LineTension`, `BoundedTension`, `AreaElasticity`, `PerimeterElasticity` and `ShapeFactorEnergy`. Tissues
    may be periodic or free.

    Arcs are chains of $n$ straight pieces; all points of a chain relax. The angle of an arc is computed from
    the area between chain and chord, so areas are exact. Lengths, and therefore energies, are those of the
    chains, with a relative error of order $1/n^2$. Therefore the derivatives must be those of the program:
    use `External(..., slope="program", stiffness=...)` for tissues with arcs.

    The program is in the Debian package `evolver-nox`. Its start takes some milliseconds.

    **Arguments:**

    - `command`: the program.
    - `areas`: `"elastic"`, as in the energy, or `"fixed"` at the `target_area` of its `AreaElasticity`, the
        limit of infinite stiffness, as in a foam. (In a periodic box the targets are scaled to sum to its
        area.) With `"fixed"` the energy does not describe the program: use
        `External(..., slope="program", stiffness=...)`.
    - `pieces`: number of pieces per arc.
    - `tolerance`: the relative decrease of the energy in a step at which the relaxation ends.
    - `steps`: number of initial steps of conjugate gradients, for tissues far from rest.
    - `newton_steps`: maximum number of Newton steps; 0 for conjugate gradients only.
    - `timeout`: seconds after which a run is killed.
    - `t1`: a length; shorter edges flip by the program's `t1_edgeswap`, one after another, if the relaxed
        energy decreases. Only straight edges away from the outline. None for no transitions.

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
        check_choice("areas", self.areas, ("elastic", "fixed"))
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
        """Relax a tissue, see [`AbstractSimulator`][vertax.external.AbstractSimulator].

        **Raises:**

        - [`SimulatorError`][vertax.external.SimulatorError], with the end of the log, if the program fails,
            and for an unsupported energy.
        """
        if self.t1 is None or forces is not None:
            return self._relax_in_topology(tissue, energy, forces, torques)
        if tissue.arcs is not None:
            raise SimulatorError(
                "T1 transitions by Surface Evolver are for straight edges: `t1=None`."
            )
        relaxed, current, rejected = (
            self._relax_in_topology(tissue, energy, None, None),
            tissue,
            set(),
        )
        number = 0
        while True:
            current = eqx.tree_at(lambda t: t.vertices, current, relaxed.vertices)
            allowed = can_flip(current.topology)
            allowed[list(rejected)] = False
            lengths = np.hypot(*Edges.of(current).vectors(relaxed.vertices).T)
            edge = int(np.argmin(np.where(allowed, lengths, np.inf)))
            if not (allowed[edge] and lengths[edge] < self.t1):
                return relaxed._replace(topology=current.topology, num_t1=number)
            if number >= _MAX_T1_PER_EDGE * tissue.n_edges:
                raise SimulatorError(
                    f"T1 transitions by Surface Evolver did not end after {number}. Lower `t1`, or pass "
                    "`t1=None`."
                )
            flipped = flip_by_program(current, edge, 0.5 * self.t1, self._run)
            trial = None
            if flipped is not None:
                with suppress(SimulatorError):  # the relaxation after the flip did not converge
                    trial = self._relax_in_topology(flipped, energy, None, None)
            # The loop ends: each transition lowers the energy, and between two of them each edge is
            # rejected at most once.
            if trial is not None and trial.energy < relaxed.energy - 1e-9 * abs(relaxed.energy):
                relaxed, current, rejected, number = trial, flipped, set(), number + 1
            else:
                rejected.add(edge)

    def _relax_in_topology(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        forces: Float[np.ndarray, "vertices 2"] | None,
        torques: Float[np.ndarray, " edges"] | None,
    ) -> Relaxed:
        """Relax a tissue without transitions."""
        strings = Strings.of(tissue, self.pieces)
        terms = Terms.of(energy, strings.pieces.n_cells, len(strings.parts))
        elastic_terms, fixed_cells = terms, ()
        if self.areas == "fixed":
            terms, fixed_cells = self._fixed(strings, elastic_terms)
        text = datafile(strings, terms, forces, torques, fixed_cells=fixed_cells)
        commands = self._commands(strings, near=forces is not None) + _report_commands(fixed_cells)
        points, pressures, numbers = _parse_result(strings, *self._run(text, commands))
        measures = (strings.lengths(points), strings.areas(points), strings.perimeters(points))
        return Relaxed(
            points[: strings.n_vertices] + strings.images @ strings.lattice,
            angles=_angles(strings, points, tissue),
            energy=numbers["energy"],
            num_steps=int(numbers["steps"]),
            slope=parameter_derivatives(
                energy,
                *measures,
                _target_derivatives(strings, elastic_terms, pressures) if fixed_cells else None,
            ),
        )

    def energy(self, tissue: Tissue, energy: AbstractEnergy) -> float:
        """The energy of a tissue without relaxation, computed by the program.

        **Arguments:**

        - `tissue`, `energy`: the tissue, and its energy.

        **Returns:** the energy.
        """
        strings = Strings.of(tissue, self.pieces)
        terms = Terms.of(energy, strings.pieces.n_cells, len(strings.parts))
        commands = "steps_done := 0;\nrecalc;\n" + _report_commands()
        result = self._run(datafile(strings, terms), commands)
        return _parse_result(strings, *result)[2]["energy"]

    def _fixed(self, strings: Strings, terms: Terms) -> tuple[Terms, Sequence[int]]:
        """The terms without area elasticity, and the cells with a fixed area."""
        if not terms.area_stiffness.any():
            raise SimulatorError(
                "Fixed areas need targets: add an AreaElasticity to the energy, of any stiffness."
            )
        n = strings.pieces.n_cells
        targets, fixed_cells = terms.area, range(n)
        if strings.periodic:
            # The last area follows from the area of the box.
            targets, fixed_cells = targets * _target_scale(strings, terms), range(n - 1)
        return terms._replace(area_stiffness=np.zeros(n), area=targets), fixed_cells

    def _run(self, text: str, commands: str) -> tuple[str, str]:
        """Run the program with a datafile and commands; return the text of its result, and its log."""
        command = [self.command, "-i", "-frelax.cmd", "tissue.fe"]
        files = {"tissue.fe": text, "relax.cmd": commands}
        results, log = run_program(
            command, files, ["result"], timeout=self.timeout, install=INSTALL
        )
        return results["result"], log

    def _commands(self, strings: Strings, *, near: bool) -> str:
        """The commands of a relaxation: conjugate gradients, then Newton's method with a line search.

        For a tissue `near` rest the conjugate gradients are left out.
        """
        # (With the first toggle on, its default, the index of the Hessian is wrong and Newton steps stall;
        # with fixed areas they stall too if the last toggle is off.)
        lines = ["function_quantity_sparse off;", "hessian_normal off;", "augmented_hessian on;"]
        lines += [spacing_commands(strings, near=near), "steps_done := 0;", "recalc;"]
        first = 0 if near and self.newton_steps else self.steps
        if first:
            # (Steps along the gradient move the areas to their fixed targets.)
            lines += [f"g 5; U; g {first}; U;", f"steps_done := {first + 5};"]
        elif self.areas == "fixed":
            lines.append("g 1;")  # computes the multipliers of fixed areas
        step = "hessian_seek" if self.newton_steps else "g 5"
        max_steps = first + (self.newton_steps or 100000)
        lines += [
            "gain := 1;",
            f"while (gain > {self.tolerance:.3g}*abs(total_energy) and steps_done < {max_steps}) do "
            f"{{ level; before := total_energy; {step}; gain := abs(before - total_energy); "
            "steps_done += 1; };",
        ]
        if self.newton_steps and self.tolerance < 1e-10:
            # Near the minimum the energy changes by less than its rounding error, so a line search is
            # useless: take the last steps in full.
            last = 2 if not strings.chains.any() else 3 if near else 5
            lines.append(f"weaken; {'level; hessian; ' * last}steps_done += {last};")
        return "\n".join([*lines, ""])


def _angles(
    strings: Strings, points: Float[np.ndarray, "points 2"], tissue: Tissue
) -> Float[np.ndarray, " edges"] | None:
    """The angles of arcs; those of straight edges do not change."""
    if tissue.arcs is None:
        return None
    return np.where(strings.chains, strings.angles(points), np.asarray(tissue.arcs.angles))


def _target_scale(strings: Strings, terms: Terms) -> float:
    """The ratio of the area of a periodic box to the sum of the target areas."""
    return float(abs(np.linalg.det(strings.lattice)) / np.sum(terms.area))


def _target_derivatives(
    strings: Strings, terms: Terms, pressures: Float[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """Derivatives of the energy with respect to the targets of fixed areas."""
    if not strings.periodic:
        return pressures
    mean = pressures @ terms.area / np.sum(terms.area)
    return _target_scale(strings, terms) * (pressures - mean)


INSTALL = (
    "Install Surface Evolver, e.g. by apt-get install evolver-nox, or pass "
    "SurfaceEvolver(command=...)."
)


def _report_commands(fixed_cells: Sequence[int] = ()) -> str:
    """Commands that write all points and the multipliers of fixed areas, and end the program."""
    lines = [
        'printf "energy %.17g\\n", total_energy-nudge.value-spacing.value >> "result";',
        'printf "steps %g\\n", steps_done >> "result";',
        'foreach vertex vv do printf "point %d %.17g %.17g\\n", vv.id, vv.x, vv.y >> "result";',
        *(f'printf "pressure {c} %.17g\\n", keep_{c}.pressure >> "result";' for c in fixed_cells),
    ]
    return "\n".join([*lines, 'printf "end\\n" >> "result";', "quit", "quit", ""])


def _parse_result(
    strings: Strings, text: str, log: str
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Points, pressures (of fixed areas) and numbers from the output of the program."""
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
        raise SimulatorError(
            f"The output of evolver cannot be read ({error}). {tail(log)}"
        ) from error
    is_complete = bool(lines) and lines[-1] == "end" and {"energy", "steps"} <= numbers.keys()
    if re.search("ERROR", log) or not is_complete or not np.isfinite(points).all():
        raise SimulatorError(f"The output of evolver is incomplete. {tail(log)}")
    return points, pressures, numbers
