"""Hash of what a function computes, to compare the functions of two processes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from vertax._base.checkpoints import digest, without_addresses


def fingerprint(function: Callable[..., Any], *args: Any) -> str:
    """SHA-256 hash of what a function computes: its jaxpr and the constants in it.

    The code of a function, the values that it closes over and the methods of classes are part of the hash;
    names and memory addresses are not. It is equal in all processes with the same versions of vertax and JAX.
    Functions that the host calls count by their name only.

    **Arguments:**

    - `function`: the function. Compiled functions that it calls are traced once for this and later calls.
    - `args`: its arguments. Their arrays are variables; the numbers in them are not part of the hash.
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    of_arrays = lambda arrays: eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array)
    return _hash(jax.make_jaxpr(of_arrays)(arrays), {})


def _hash(value: Any, visited: dict[int, str]) -> str:
    """Hash of a value in a jaxpr; `visited` has the hashes of jaxprs, of which many occur several times."""
    if isinstance(value, Jaxpr):
        if id(value) not in visited:
            visited[id(value)] = _sha(_lines(value, visited))
        return visited[id(value)]
    if isinstance(value, ClosedJaxpr):
        return _hash((value.jaxpr, *value.consts), visited)
    if isinstance(value, tuple | list):
        return _sha([_hash(item, visited) for item in value])
    if isinstance(value, set | frozenset):  # their order differs between processes
        return _sha(sorted(_hash(item, visited) for item in value))
    if isinstance(value, dict):
        return _hash(list(value.items()), visited)
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return _sha([str(value.dtype), str(value.shape), digest(value)])
    return _sha([without_addresses(repr(value))])


def _lines(jaxpr: Jaxpr, visited: dict[int, str]) -> list[str]:
    numbers: dict[Any, int] = {}

    def atom(x: Any) -> str:
        if isinstance(x, Literal):
            return _hash(x.val, visited)
        return f"{numbers.setdefault(x, len(numbers))}:{x.aval}"

    lines = [_hash(list(getattr(jaxpr, "consts", [])), visited)]  # (since JAX 0.12)
    lines += [" ".join(map(atom, (*jaxpr.constvars, *jaxpr.invars)))]
    for equation in jaxpr.eqns:
        parameters = {k: v for k, v in equation.params.items() if k != "name"}
        ends = [atom(x) for x in (*equation.invars, *equation.outvars)]
        lines.append(" ".join([equation.primitive.name, _hash(parameters, visited), *ends]))
    return [*lines, " ".join(map(atom, jaxpr.outvars))]


def _sha(parts: list[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
