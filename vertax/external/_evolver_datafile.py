"""Datafiles of Surface Evolver from tissues, their energies and weak forces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vertax.external._evolver_model import Terms
from vertax.external._evolver_strings import Strings

# Points of a chain can slide along it at nearly constant energy. Springs along the pieces, with the mean
# length of the pieces of their edge as rest length, keep the pieces equal. At equilibrium the springs are
# relaxed. Rest lengths are updated between steps and lag behind a growing edge, so the springs are weakened
# during the relaxation: by the factor _SPRING_DECAY at each update, down to _MIN_SPRING.
_SPRING_DECAY, _MIN_SPRING = 0.6, 1e-3
_POINT_ATTRIBUTES = ("pull_x", "pull_y", "arm_x", "arm_y")
_PIECE_ATTRIBUTES = ("gam", "soft", "spring", "rest", "chain", "along")
# (`chain` is the first piece of the edge, 0 for a straight edge; `along` accumulates the length of the edge.)
_LENGTH = "sqrt(x3^2+x4^2+soft)"


def datafile(
    strings: Strings,
    terms: Terms,
    forces: Float[np.ndarray, "vertices 2"] | None = None,
    torques: Float[np.ndarray, " edges"] | None = None,
    *,
    fixed_cells: Sequence[int] = (),
) -> str:
    """A tissue, its energy and a nudge in the language of Surface Evolver.

    The areas of `fixed_cells` are constrained to their targets.
    """
    head, point_lines, piece_lines = strings.lines()
    lines = [*head, "KEEP_ORIGINALS"]
    lines += [f"define vertex attribute {name} real" for name in _POINT_ATTRIBUTES]
    lines += [f"define edge attribute {name} real" for name in _PIECE_ATTRIBUTES]
    edges = "method edge_general_integral scalar_integrand:"
    lines += [
        f"quantity tensions energy {edges} gam*{_LENGTH}",
        f"quantity spacing energy {edges} 0.5*spring*({_LENGTH}-rest)^2",
        "quantity nudge energy method vertex_scalar_integral scalar_integrand: -(pull_x*x+pull_y*y)",
    ]
    quantities: list[list[str]] = [["tensions"] for _ in strings.edge]
    for piece in np.flatnonzero(strings.chains[strings.edge]):
        quantities[piece].append("spacing")
    _areas(lines, quantities, strings, terms, fixed_cells)
    _perimeters(lines, quantities, strings, terms)
    pulls, arms = strings.point_forces(forces, torques), np.zeros_like(strings.points)
    springs = _springs(lines, strings, terms, arms)
    lines.append("vertices")
    rows = np.concatenate([pulls, arms], axis=1)
    for i, (line, row) in enumerate(zip(point_lines, rows, strict=True)):
        names = " ".join(springs) if i < strings.n_vertices else ""
        lines.append(f"{line} {_attributes(_POINT_ATTRIBUTES, row)} nudge {names}")
    lines.append("edges")
    parts = strings.parts[strings.edge]
    spring = parts * _stiffness(strings, terms)
    rest = (strings.lengths(strings.points) / strings.parts)[strings.edge]
    soft = (strings.softening / parts) ** 2
    first = np.where(parts > 1, (np.cumsum(strings.parts) - strings.parts)[strings.edge] + 1, 0)
    rows = np.stack(
        [terms.tension[strings.edge], soft, spring, rest, first, np.zeros(len(parts))], axis=1
    )
    for line, row, names in zip(piece_lines, rows, quantities, strict=True):
        attributes = _attributes(_PIECE_ATTRIBUTES, row)
        lines.append(f"{line} density 0 {attributes} {' '.join(names)}")
    return "\n".join([*lines, "read", ""])


def spacing_commands(strings: Strings, *, near: bool) -> str:
    """The commands `level`, which updates the rest lengths of springs and weakens them, and `weaken`.

    For a tissue `near` rest the springs are weak from the start.
    """
    if not strings.chains.any():
        return "level := { recalc; };\nweaken := {};\n"
    n_pieces = int(strings.parts.max())
    each = "foreach edge ee where ee.chain > 0 do"
    return (
        f"weaken := {{ spacing.modulus := {_MIN_SPRING}; }};\n{'weaken' if near else ''};\n"
        f"level := {{ {each} {{ edge[ee.chain].along := 0; }};\n"
        f"{each} {{ edge[ee.chain].along := edge[ee.chain].along + ee.length; }};\n"
        f"{each} {{ ee.rest := edge[ee.chain].along/{n_pieces}; }};\n"
        f"spacing.modulus := maximum({_SPRING_DECAY}*spacing.modulus, {_MIN_SPRING}); recalc; }};\n"
    )


def _attributes(names: Sequence[str], values: Float[np.ndarray, " names"]) -> str:
    return " ".join(f"{name} {value:.17g}" for name, value in zip(names, values, strict=True))


def _areas(
    lines: list[str],
    quantities: list[list[str]],
    strings: Strings,
    terms: Terms,
    fixed_cells: Sequence[int],
) -> None:
    """A quantity for each cell with area elasticity or a fixed area."""
    pieces = strings.pieces
    has_elasticity = terms.area_stiffness != 0
    has_elasticity[list(fixed_cells)] = True
    instances: dict[tuple, str] = {}
    parts: dict[int, list[str]] = {}
    for e in range(len(pieces.ends)):
        for side, sign in ((0, 1), (1, -1)):
            cell = int(pieces.cells[e, side])
            if cell == pieces.n_cells or not has_elasticity[cell]:
                continue
            x, y = pieces.shifts[e, side]
            key = (cell, sign, round(float(x), 9), round(float(y), 9))
            if key not in instances:
                # Half the integral of x dy - y dx along the edge, in the frame of the cell.
                name = instances[key] = f"surface_{cell}_{len(parts.get(cell, []))}"
                parts.setdefault(cell, []).append(name)
                lines.append(
                    f"method_instance {name} method edge_vector_integral vector_integrand: "
                    f"q1: {-0.5 * sign:g}*(y+({y:.17g})) q2: {0.5 * sign:g}*(x+({x:.17g}))"
                )
            quantities[e].append(instances[key])
    for cell, names in parts.items():
        area = "+".join(f"{name}.value" for name in names)
        target = terms.area[cell]
        if cell in fixed_cells:
            # (A function of the instances would have a dense Hessian for each cell.)
            methods = " ".join(f"method {name}" for name in names)
            lines.append(f"quantity keep_{cell} fixed = {target:.17g} {methods}")
            continue
        k = terms.area_stiffness[cell]
        lines.append(
            f"quantity swell_{cell} energy function {0.5 * k:.17g}*({area}-({target:.17g}))^2"
        )


def _perimeters(
    lines: list[str], quantities: list[list[str]], strings: Strings, terms: Terms
) -> None:
    """A quantity for each cell with perimeter elasticity."""
    for cell in np.flatnonzero(terms.perimeter_stiffness):
        lines.append(
            f"method_instance around_{cell} method edge_general_integral scalar_integrand: {_LENGTH}"
        )
        k, target = terms.perimeter_stiffness[cell], terms.perimeter[cell]
        lines.append(
            f"quantity tighten_{cell} energy function "
            f"{0.5 * k:.17g}*(around_{cell}.value-({target:.17g}))^2"
        )
    has_elasticity = set(np.flatnonzero(terms.perimeter_stiffness).tolist())
    for names, cells in zip(quantities, strings.pieces.cells.tolist(), strict=True):
        names += [f"around_{c}" for c in cells if c in has_elasticity]


def _springs(
    lines: list[str], strings: Strings, terms: Terms, arms: Float[np.ndarray, "points 2"]
) -> list[str]:
    """Springs against rigid motions; they do not change the shape, and make the Hessian regular."""
    n = strings.n_vertices
    points = strings.points[:n]
    k = _stiffness(strings, terms)
    modes = {}
    if len(strings.fixed) == 0:
        modes |= {"x": "x", "y": "y"}
    centre = points.mean(axis=0) if len(strings.fixed) == 0 else points[strings.fixed[0]]
    if not strings.periodic and len(strings.fixed) <= 1:
        arms[:n] = (points - centre) / np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))
        modes |= {"turn": "arm_x*y-arm_y*x"}
    initial_sums = {
        "x": points[:, 0].sum(),
        "y": points[:, 1].sum(),
        "turn": np.sum(arms[:n, 0] * points[:, 1] - arms[:n, 1] * points[:, 0]),
    }
    for name, integrand in modes.items():
        lines.append(
            f"method_instance sum_{name} method vertex_scalar_integral scalar_integrand: {integrand}"
        )
        lines.append(
            f"quantity hold_{name} energy function "
            f"{0.5 * k / n:.17g}*(sum_{name}.value-({initial_sums[name]:.17g}))^2"
        )
    return [f"sum_{name}" for name in modes]


def _stiffness(strings: Strings, terms: Terms) -> float:
    """A typical second derivative of the energy."""
    size = np.abs(strings.areas(strings.points)).mean()
    return max(
        float(np.mean(np.abs(terms.tension))) / np.sqrt(size),
        float(np.mean(terms.area_stiffness)) * size,
        float(np.mean(terms.perimeter_stiffness)),
    )
