"""Checks of arguments: numbers, integers, random keys, times."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, Shaped

from vertax._base.tracing import is_concrete

_SEED_BITS = 64


def check_number(
    name: str,
    value: Any,
    *,
    above: float | int | None = None,
    at_least: float | int | None = None,
    many: bool = False,
    remedy: str = "",
) -> None:
    """Raise an error unless a value is a real number in a range. The range of a tracer is not checked.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: a number, or an array of shape `()`.
    - `above`, `at_least`: exclusive and inclusive lower bound.
    - `many`: whether `value` may be an array of any shape; then each entry is checked.
    - `remedy`: a last sentence of the message.

    **Raises:**

    - `TypeError` unless `value` is a real number.
    - `ValueError` for a number out of range, NaN, or infinity.
    """
    condition = "finite"
    if above is not None:
        condition = "positive" if above == 0 else f"above {above:g}"
    elif at_least is not None:
        condition = f"at least {at_least:g}"
    dtype = _dtype(value)
    # Booleans are integers in Python, but not valid numbers here.
    if dtype is None or not (dtype.kind in "iu" or _floating(dtype)):
        what = "hold real numbers" if many else "be one real number"
        raise TypeError(f"Argument `{name}` must {what}, but is {describe(value)}.")
    if np.shape(value) != () and not many:
        raise ValueError(f"Argument `{name}` must be one number, but is {describe(value)}.")
    if not is_concrete(value):
        return
    array = np.asarray(value).astype(float)
    in_range = ~np.isnan(array)
    if above is not None:
        in_range &= array > above
    if at_least is not None:
        in_range &= array >= at_least
    if in_range.all() and np.isinf(array).any() and condition != "finite":
        condition += " and finite"
    if not (in_range & np.isfinite(array)).all():
        fact = f"Argument `{name}` must be {condition}, but is {_value_or_range(value)}."
        raise ValueError(f"{fact} {remedy}".rstrip())


def check_integer(name: str, value: Any, *, at_least: int | None = None) -> None:
    """Raise an error unless a value is an integer in a range.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: an integer of Python or NumPy.
    - `at_least`: inclusive lower bound.

    **Raises:**

    - `TypeError` unless `value` is an integer.
    - `ValueError` for an integer that is too small.
    """
    condition = "a whole number" if at_least is None else f"at least {at_least}"
    if not isinstance(value, numbers.Integral) or isinstance(value, bool | np.bool_):
        raise TypeError(
            f"Argument `{name}` must be {condition} (a Python integer), but is {describe(value)}."
        )
    if at_least is not None and value < at_least:
        raise ValueError(f"Argument `{name}` must be {condition}, but is {value}.")


def check_instance(name: str, value: Any, kind: Any, expected: str, remedy: str = "") -> None:
    """Raise a `TypeError` unless a value is an instance of a class.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: the value.
    - `kind`: the class, or a union of classes.
    - `expected`: the class in words, with an example.
    - `remedy`: a last sentence of the message.
    """
    if not isinstance(value, kind):
        fact = f"Argument `{name}` must be {expected}, but is {describe(value)}."
        raise TypeError(f"{fact} {remedy}".rstrip())


def check_function(name: str, value: Any, expected: str, remedy: str = "") -> None:
    """Raise a `TypeError` unless a value can be called; arguments as for `check_instance`."""
    check_instance(name, value, Callable, expected, remedy)


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise a `ValueError` unless a value is one of the choices."""
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        listed = ", ".join(map(repr, choices))
        raise ValueError(f"Argument `{name}` must be one of {listed}, but is {describe(value)}.")


def check_shape(name: str, value: Any, *shapes: tuple[int, ...], remedy: str = "") -> None:
    """Raise a `ValueError` unless an array has one of the shapes; `remedy` ends the message."""
    shape = np.shape(value)
    if shape not in shapes:
        allowed = ["be one number"] if () in shapes else []
        arrays = " or ".join(str(each) for each in shapes if each)
        allowed += [f"have shape {arrays}"] if arrays else []
        fact = f"Argument `{name}` must {' or '.join(allowed)}, but its shape is {shape}."
        raise ValueError(f"{fact} {remedy}".rstrip())


def check_concrete(function: str, *arguments: Any) -> None:
    """Raise an error if an argument contains a tracer.

    **Arguments:**

    - `function`: name of the function that needs concrete arrays, such as `periodic_voronoi`.
    - `arguments`: pytrees that must not contain tracers.

    **Raises:**

    - `TypeError` if one of them does.
    """
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(arguments)):
        raise TypeError(
            f"{function} needs arrays with concrete values, so it does not work inside jax.jit, "
            "jax.vmap or jax.grad. Call it outside, once for each tissue; tissues of one size make a batch "
            "by jax.tree.map(lambda *x: jax.numpy.stack(x), *tissues)."
        )


def as_key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    """Convert a seed to a random key; check a random key.

    **Arguments:**

    - `key`: a key from `jax.random.key` (or `jax.random.PRNGKey`), or an integer as its seed.

    **Returns:** the key.

    **Raises:**

    - `TypeError` for anything else.
    - `ValueError` for an array of keys, or a seed of more than 64 bits.
    """
    if isinstance(key, numbers.Integral) and not isinstance(key, bool | np.bool_):
        seed = int(key)
        if not -(2 ** (_SEED_BITS - 1)) <= seed < 2 ** (_SEED_BITS - 1):
            raise ValueError(
                f"Argument `key` must be a seed of at most {_SEED_BITS} bits (with sign), but is {seed}."
            )
        return jax.random.key(seed)
    if isinstance(key, jax.Array | np.ndarray):
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        if key.shape == () if typed else (key.dtype == np.uint32 and key.shape == (2,)):
            return key if typed else jnp.asarray(key)
        if typed or key.dtype == np.uint32:
            raise ValueError(
                f"Argument `key` must be one key, but has shape {key.shape}. Take one of them, key[0]."
            )
    raise TypeError(
        f"Argument `key` must be a key from jax.random.key(seed) or a seed, but is {describe(key)}."
    )


def as_real(name: str, value: ArrayLike | Sequence[Any]) -> Array:
    """Convert to a JAX array of finite real numbers; integers become floating-point numbers.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: an array, which may be traced, or a sequence of numbers.

    **Returns:** the array.

    **Raises:**

    - `TypeError` unless `value` contains real numbers.
    - `ValueError` for NaN and infinity.
    """
    _check_real(name, value)
    array = jnp.asarray(value)
    return array if _floating(array.dtype) else array.astype(jnp.result_type(float))


def as_scalar(name: str, value: ArrayLike) -> Float[Array, ""]:
    """Convert one real number to a JAX array; a `ValueError` for any other shape."""
    number = as_real(name, value)
    check_shape(name, number, (), remedy="Take more of them through jax.vmap.")
    return number


def as_list(name: str, value: ArrayLike | Sequence[Any]) -> Float[Array, " numbers"]:
    """Convert a list of at least one real number to a JAX array; a `ValueError` for any other shape."""
    numbers = as_real(name, value)
    if numbers.ndim != 1 or numbers.size == 0:
        fact = f"Argument `{name}` must be a list of numbers, but its shape is {numbers.shape}."
        raise ValueError(fact)
    return numbers


def as_matrix(name: str, value: ArrayLike, *, symmetric: bool = False) -> Float[Array, "2 2"]:
    """A 2-by-2 matrix; a `ValueError` for any other shape, or if `symmetric` and it is not."""
    matrix = as_real(name, value)
    check_shape(name, matrix, (2, 2))
    if symmetric and is_concrete(matrix):
        difference, size = abs(float(matrix[0, 1] - matrix[1, 0])), float(jnp.max(jnp.abs(matrix)))
        if difference > 1e-5 * size:
            raise ValueError(
                f"Argument `{name}` must be symmetric, but its off-diagonal entries are "
                f"{matrix[0, 1]} and {matrix[1, 0]}."
            )
    return matrix


def as_lattice(box: ArrayLike | Sequence[Any]) -> Float[np.ndarray, "2 2"]:
    """Convert the argument `box` to two lattice vectors; a `ValueError` for another shape or area."""
    lattice = as_float64("box", box)
    if lattice.shape == (2,):
        lattice = np.diag(lattice)
    if lattice.shape != (2, 2):
        raise ValueError(
            "Argument `box` must be width and height, or two lattice vectors as rows, shape (2, 2), but has "
            f"shape {lattice.shape}."
        )
    if not np.linalg.det(lattice) > 0:
        raise ValueError(
            "Argument `box` must have a positive area, its second vector counter-clockwise of its first, but "
            f"its area is {np.linalg.det(lattice):.3g}. Give positive sides, or swap the vectors."
        )
    return lattice


def as_float64(name: str, value: ArrayLike | Sequence[Any]) -> Shaped[np.ndarray, "..."]:
    """Convert to a NumPy array of finite float64 numbers, also if JAX is limited to 32 bits.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: an array or a sequence of numbers.

    **Returns:** the array.

    **Raises:** as `as_real`.
    """
    _check_real(name, value)
    return np.asarray(value).astype(np.float64)


def _check_real(name: str, value: Any) -> None:
    dtype = _dtype(value)
    if dtype is None or dtype.kind == "c":
        was = describe(value) if dtype is None else f"an array of type {dtype}"
        raise TypeError(f"Argument `{name}` must hold real numbers, but is {was}.")
    if is_concrete(value) and not np.isfinite(np.asarray(value)).all():
        raise ValueError(f"Argument `{name}` must be finite, but holds NaN or infinity.")


def _dtype(value: Any) -> np.dtype | None:
    """The dtype of a value; None unless it contains numbers."""
    try:
        dtype = value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype
    except (TypeError, ValueError):  # for example rows of different lengths
        return None
    # Random keys have a dtype that is not a number.
    numeric = isinstance(dtype, np.dtype) and (dtype.kind in "biufc" or _floating(dtype))
    return dtype if numeric else None


def _floating(dtype: np.dtype) -> bool:
    """Whether a dtype is floating point, including bfloat16 and other types of ml_dtypes."""
    return bool(jnp.issubdtype(dtype, jnp.floating))


def describe(value: Any) -> str:
    """Describe a value of the wrong type in an error message."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, str | bytes | numbers.Number | np.generic) or value is None:
        return repr(value)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"an array of shape {np.shape(value)} and type {value.dtype}"
    return f"an object of type {type(value).__name__}"


def _value_or_range(value: Any) -> str:
    """A number, or the range of an array, as text."""
    array = np.asarray(value)
    return str(value) if array.shape == () else f"from {array.min()} to {array.max()}"


def as_times(times: ArrayLike | Sequence[Any]) -> Float[Array, " times"]:
    """Convert the argument `times` to an array.

    **Raises:**

    - `ValueError` for fewer than two times, or times that do not increase.
    """
    array = as_real("times", times)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(
            "Argument `times` must hold two times or more, that of the start first, but its shape is "
            f"{array.shape}."
        )
    if is_concrete(array):
        steps = np.diff(np.asarray(array))
        if not (steps > 0).all():
            at = int(np.argmin(steps > 0))
            raise ValueError(
                f"Argument `times` must increase, but entry {at} is {array[at]} and the next "
                f"{array[at + 1]}."
            )
    return array
