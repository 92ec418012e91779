"""Surface Evolver as a forward model."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from vertax._base.checks import check_number, check_whole
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.responses._evolver_model import Strings, Terms, slope_of
from vertax.responses._program import run_program, tail
from vertax.responses._simulator import AbstractSimulator, Relaxed, SimulatorError


@dataclasses.dataclass(frozen=True)
class SurfaceEvolver(AbstractSimulator):
    r"""Surface Evolver (Brakke 1992, doi:10.1080/10586458.1992.10504253) as a simulator, run as a process.

    A tissue is written as a datafile: its edges in the string model, its energy as named quantities, and the
    nudge as one more of them. The program relaxes it by its own commands, and prints where the vertices are.
    Energies may consist of `LineTension`, `BoundedTension`, `AreaElasticity`, `PerimeterElasticity` and
    `ShapeFactorEnergy`; tissues may be periodic or free.

    The Debian package `evolver-nox` has the program. It takes some milliseconds to begin.

    **Arguments:**

    - `command`: the program.
    - `areas`: `"elastic"`, as the energy says, or `"fixed"` at the `target_area` of its `AreaElasticity`,
        whose stiffness is infinite then, as in a foam; of free tissues only. Then the energy does not
        describe the program: use `External(..., slope="program", stiffness=...)`.
    - `tolerance`: the program has relaxed when a step lowers the energy by less than this share.
    - `steps`: of conjugate gradients to begin with, where a tissue is far from rest.
    - `newton_steps`: at most; 0 for conjugate gradients only, until the tolerance ends them.
    - `timeout`: seconds after which a run is ended.

    **Raises:**

    - `ValueError` for numbers that are not positive, and other settings of `areas`.
    """

    command: str = "evolver"
    areas: Literal["elastic", "fixed"] = "elastic"
    tolerance: float = 1e-14
    steps: int = 20
    newton_steps: int = 40
    timeout: float = 60.0

    def __post_init__(self) -> None:
        if self.areas not in ("elastic", "fixed"):
            raise ValueError(
                f"Argument `areas` must be 'elastic' or 'fixed', but is {self.areas!r}."
            )
        for name in ("tolerance", "timeout"):
            check_number(name, getattr(self, name), above=0)
        check_whole("steps", self.steps, least=0)
        check_whole("newton_steps", self.newton_steps, least=0)

    def relax(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        forces: Float[np.ndarray, "vertices 2"] | None,
    ) -> Relaxed:
        """Bring a tissue to rest, see [`AbstractSimulator`][vertax.responses.AbstractSimulator].

        **Raises:**

        - [`SimulatorError`][vertax.responses.SimulatorError], with the tail of the log, if the program fails,
            and for an energy that it cannot be told of.
        """
        strings = Strings.of(tissue)
        terms = Terms.of(energy, strings.edges.n_cells, len(strings.edges.cells))
        fixed = self.areas == "fixed"
        held = range(strings.edges.n_cells) if fixed else ()
        if fixed and strings.periodic:
            raise SimulatorError(
                "Fixed areas are for free tissues: those of a periodic one add up to its box."
            )
        if fixed and not terms.area_stiffness.any():
            raise SimulatorError(
                "Areas that are fixed need targets: add an AreaElasticity to the energy, of any stiffness."
            )
        if fixed:
            terms = terms._replace(area_stiffness=np.zeros(strings.edges.n_cells))
        text = datafile(strings, terms, forces, fixed=fixed)
        points, pressures, numbers = self._run(text, self._commands() + _report(held), strings)
        vertices = points + strings.images @ strings.lattice
        measures = (
            strings.lengths(points),
            strings.edges.areas(points),
            strings.perimeters(points),
        )
        return Relaxed(
            vertices,
            energy=numbers["energy"],
            num_steps=int(numbers["steps"]),
            slope=slope_of(energy, *measures, pressures if fixed else None),
        )

    def energy(self, tissue: Tissue, energy: AbstractEnergy) -> float:
        """The energy of a tissue as it is, by the program.

        **Arguments:**

        - `tissue`, `energy`: the tissue, and its energy.

        **Returns:** its energy.
        """
        strings = Strings.of(tissue)
        terms = Terms.of(energy, strings.edges.n_cells, len(strings.edges.cells))
        text = datafile(strings, terms, None, fixed=False)
        return self._run(text, "steps_done := 0;\nrecalc;\n" + _report(), strings)[2]["energy"]

    def _run(
        self, text: str, commands: str, strings: Strings
    ) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
        command = [self.command, "-i", "-frelax.cmd", "tissue.fe"]
        files = {"tissue.fe": text, "relax.cmd": commands}
        found, log = run_program(command, files, ["result"], timeout=self.timeout, install=INSTALL)
        return _read(found["result"], strings, log)

    def _commands(self) -> str:
        """How it relaxes: conjugate gradients, and then Newton's method with a search along each step."""
        # (With this toggle on, as it is, the index of the Hessian is wrong and its steps stall.)
        lines = ["function_quantity_sparse off;", "hessian_normal off;"]
        lines += ["steps_done := 0;", "recalc;"]
        if self.steps:
            lines += [f"U; g {self.steps}; U;", f"steps_done := {self.steps};"]
        step = "hessian_seek" if self.newton_steps else "g 5"
        most = self.steps + (self.newton_steps or 100000)
        lines += [
            "gain := 1;",
            f"while (gain > {self.tolerance:.3g}*abs(total_energy) and steps_done < {most}) do "
            f"{{ before := total_energy; {step}; gain := abs(before - total_energy); "
            "steps_done += 1; };",
        ]
        if self.newton_steps and self.tolerance < 1e-10:
            # The energy cannot tell steps below the root of its rounding: two last ones in full.
            lines.append("hessian; hessian; steps_done += 2;")
        return "\n".join([*lines, ""])


INSTALL = (
    "Install Surface Evolver, e.g. by apt-get install evolver-nox, or pass "
    "SurfaceEvolver(command=...)."
)


def _report(held: Sequence[int] = ()) -> str:
    """Commands that write where all points are, and the multipliers of areas held; and end the program."""
    lines = [
        'printf "energy %.17g\\n", total_energy-nudge.value >> "result";',
        'printf "steps %g\\n", steps_done >> "result";',
        'foreach vertex vv do printf "point %d %.17g %.17g\\n", vv.id, vv.x, vv.y >> "result";',
        *(f'printf "pressure {c} %.17g\\n", keep_{c}.pressure >> "result";' for c in held),
    ]
    return "\n".join([*lines, 'printf "end\\n" >> "result";', "quit", "quit", ""])


_OF_VERTICES = ("pull_x", "pull_y", "arm_x", "arm_y")


def datafile(
    strings: Strings, terms: Terms, forces: Float[np.ndarray, "vertices 2"] | None, *, fixed: bool
) -> str:
    """A tissue, its energy and a nudge in the language of Surface Evolver."""
    lines = ["STRING", "SPACE_DIMENSION 2", "KEEP_ORIGINALS"]
    if strings.periodic:
        lines += ["TORUS", "PERIODS", *(f"{a:.17g} {b:.17g}" for a, b in strings.lattice)]
    lines += [f"define vertex attribute {name} real" for name in _OF_VERTICES]
    lines.append("define edge attribute gam real")
    length = f"sqrt(x3^2+x4^2+{strings.softening**2:.17g})"
    lines.append(
        f"quantity tensions energy method edge_general_integral scalar_integrand: gam*{length}"
    )
    of_edge: list[list[str]] = [["tensions"] for _ in strings.edges.ends]
    _areas(lines, of_edge, strings, terms, fixed)
    _perimeters(lines, of_edge, strings, terms, length)
    points, arms = strings.points, np.zeros_like(strings.points)
    pulls = np.zeros_like(points)
    if forces is not None:
        pulls[:] = forces
    lines.append(
        "quantity nudge energy method vertex_scalar_integral scalar_integrand: -(pull_x*x+pull_y*y)"
    )
    held = _springs(lines, strings, terms, arms)
    lines.append("vertices")
    names = " ".join(["nudge", *held])
    pinned = set(strings.fixed.tolist())
    for i, ((x, y), (px, py), (ax, ay)) in enumerate(zip(points, pulls, arms, strict=True)):
        fix = " fixed" if i in pinned else ""
        lines.append(
            f"{i + 1} {x:.17g} {y:.17g}{fix} pull_x {px:.17g} pull_y {py:.17g} arm_x {ax:.17g} "
            f"arm_y {ay:.17g} {names}"
        )
    lines.append("edges")
    sign = {0: "*", 1: "+", -1: "-"}
    for i, ((a, b), wrap) in enumerate(zip(strings.edges.ends, strings.wraps, strict=True)):
        around = " " + " ".join(sign[int(w)] for w in wrap) if strings.periodic else ""
        gamma = terms.tension[i]
        lines.append(
            f"{i + 1} {a + 1} {b + 1}{around} density 0 gam {gamma:.17g} {' '.join(of_edge[i])}"
        )
    return "\n".join([*lines, "read", ""])


def _areas(
    lines: list[str], of_edge: list[list[str]], strings: Strings, terms: Terms, fixed: bool
) -> None:
    """A quantity for the area of each cell that wants one."""
    wanted = np.full(strings.edges.n_cells, True) if fixed else terms.area_stiffness != 0
    instances: dict[tuple, str] = {}
    parts: dict[int, list[str]] = {}
    for e in range(len(strings.edges.ends)):
        for side, sign in ((0, 1), (1, -1)):
            cell = int(strings.edges.cells[e, side])
            if cell == strings.edges.n_cells or not wanted[cell]:
                continue
            x, y = strings.edges.shifts[e, side]
            key = (cell, sign, round(float(x), 9), round(float(y), 9))
            if key not in instances:
                # Half the integral of x dy - y dx, as the cell sees the edge.
                name = instances[key] = f"surface_{cell}_{len(parts.get(cell, []))}"
                parts.setdefault(cell, []).append(name)
                lines.append(
                    f"method_instance {name} method edge_vector_integral vector_integrand: "
                    f"q1: {-0.5 * sign:g}*(y+({y:.17g})) q2: {0.5 * sign:g}*(x+({x:.17g}))"
                )
            of_edge[e].append(instances[key])
    for cell, some in parts.items():
        area = "+".join(f"{name}.value" for name in some)
        target = terms.area[cell]
        if fixed:
            # (Not as a function of the instances: its Hessian would be dense, for each cell.)
            parts_of = " ".join(f"method {name}" for name in some)
            lines.append(f"quantity keep_{cell} fixed = {target:.17g} {parts_of}")
            continue
        k = terms.area_stiffness[cell]
        lines.append(
            f"quantity swell_{cell} energy function {0.5 * k:.17g}*({area}-({target:.17g}))^2"
        )


def _perimeters(
    lines: list[str], of_edge: list[list[str]], strings: Strings, terms: Terms, length: str
) -> None:
    """A quantity for the perimeter of each cell that wants one."""
    for cell in np.flatnonzero(terms.perimeter_stiffness):
        lines.append(
            f"method_instance around_{cell} method edge_general_integral scalar_integrand: {length}"
        )
        k, target = terms.perimeter_stiffness[cell], terms.perimeter[cell]
        lines.append(
            f"quantity tighten_{cell} energy function "
            f"{0.5 * k:.17g}*(around_{cell}.value-({target:.17g}))^2"
        )
    wanted = set(np.flatnonzero(terms.perimeter_stiffness).tolist())
    for e in range(len(strings.edges.ends)):
        of_edge[e] += [f"around_{c}" for c in strings.edges.cells[e].tolist() if c in wanted]


def _springs(
    lines: list[str], strings: Strings, terms: Terms, arms: Float[np.ndarray, "points 2"]
) -> list[str]:
    """Springs that hold the whole where it is; they change no shape, and make the Hessian regular."""
    points, n = strings.points, len(strings.points)
    k = _stiffness(strings, terms)
    modes = {}
    if len(strings.fixed) == 0:
        modes |= {"x": "x", "y": "y"}
    centre = points.mean(axis=0) if len(strings.fixed) == 0 else points[strings.fixed[0]]
    if not strings.periodic and len(strings.fixed) <= 1:
        arms[:] = (points - centre) / np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))
        modes |= {"turn": "arm_x*y-arm_y*x"}
    at = {
        "x": points[:, 0].sum(),
        "y": points[:, 1].sum(),
        "turn": np.sum(arms[:, 0] * points[:, 1] - arms[:, 1] * points[:, 0]),
    }
    for name, integrand in modes.items():
        lines.append(
            f"method_instance sum_{name} method vertex_scalar_integral scalar_integrand: {integrand}"
        )
        lines.append(
            f"quantity hold_{name} energy function "
            f"{0.5 * k / n:.17g}*(sum_{name}.value-({at[name]:.17g}))^2"
        )
    return [f"sum_{name}" for name in modes]


def _stiffness(strings: Strings, terms: Terms) -> float:
    """A typical second derivative of the energy."""
    size = np.abs(strings.edges.areas(strings.points)).mean()
    return max(
        float(np.mean(np.abs(terms.tension))) / np.sqrt(size),
        float(np.mean(terms.area_stiffness)) * size,
        float(np.mean(terms.perimeter_stiffness)),
    )


def _read(text: str, strings: Strings, log: str) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Points, pressures (of areas that are held) and numbers that the program wrote."""
    points = np.full_like(strings.points, np.nan)
    pressures = np.zeros(strings.edges.n_cells)
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
