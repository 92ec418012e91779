"""What arguments must be: numbers, whole numbers and keys, refused with the name of the argument."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
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
) -> None:
    """Refuse what is no real number, or not in range. The value of a traced number is not looked at.

    **Arguments:**

    - `name`: of the argument, or what the message is to say of it.
    - `value`: a number, or an array of no dimension.
    - `above`, `at_least`: what it must exceed, or at least be.
    - `many`: whether it may be an array, all entries of which are checked.

    **Raises:**

    - `TypeError` for what is no real number.
    - `ValueError` for a number out of range, NaN, or infinity.
    """
    wanted = "finite"
    if above is not None:
        wanted = "positive" if above == 0 else f"above {above:g}"
    elif at_least is not None:
        wanted = f"at least {at_least:g}"
    dtype = _dtype(value)
    # Booleans are numbers to Python, but no length or strength.
    if dtype is None or not (dtype.kind in "iu" or _floating(dtype)):
        what = "hold real numbers" if many else "be one real number"
        raise TypeError(f"Argument `{name}` must {what}, but is {describe(value)}.")
    if np.shape(value) != () and not many:
        raise ValueError(f"Argument `{name}` must be one number, but is {describe(value)}.")
    if not is_concrete(value):
        return
    numbers_given = np.asarray(value).astype(float)
    inside = ~np.isnan(numbers_given)
    if above is not None:
        inside &= numbers_given > above
    if at_least is not None:
        inside &= numbers_given >= at_least
    if not inside.all():
        raise ValueError(f"Argument `{name}` must be {wanted}, but is {_shown(value)}.")
    if np.isinf(numbers_given).any():
        finite = "" if wanted == "finite" else " and finite"
        raise ValueError(f"Argument `{name}` must be {wanted}{finite}, but is {_shown(value)}.")


def check_integer(name: str, value: Any, *, at_least: int | None = None) -> None:
    """Refuse what is no whole number, or too small.

    **Arguments:**

    - `name`: of the argument.
    - `value`: an integer of Python or NumPy.
    - `at_least`: what it must at least be.

    **Raises:**

    - `TypeError` for what is no whole number.
    - `ValueError` for one that is too small.
    """
    wanted = "a whole number" if at_least is None else f"at least {at_least}"
    if not isinstance(value, numbers.Integral) or isinstance(value, bool | np.bool_):
        raise TypeError(
            f"Argument `{name}` must be {wanted} (a Python integer), but is {describe(value)}."
        )
    if at_least is not None and value < at_least:
        raise ValueError(f"Argument `{name}` must be {wanted}, but is {value}.")


def check_concrete(what: str, *arguments: Any) -> None:
    """Refuse traced arrays, with the remedy.

    **Arguments:**

    - `what`: who refuses them, such as `periodic_voronoi`.
    - `arguments`: what must not be traced.

    **Raises:**

    - `TypeError` if one of them is.
    """
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(arguments)):
        raise TypeError(
            f"{what} needs arrays whose numbers it can look at, so it does not work inside jax.jit, "
            "jax.vmap or jax.grad. Call it outside, once for each tissue; tissues of one size make a batch "
            "by "
            "jax.tree.map(lambda *x: jax.numpy.stack(x), *tissues)."
        )


def as_key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    """A key of random numbers, or that of a seed.

    **Arguments:**

    - `key`: a key from `jax.random.key` (or `jax.random.PRNGKey`), or a whole number as its seed.

    **Returns:** the key.

    **Raises:**

    - `TypeError` for anything else.
    - `ValueError` for several keys, or a seed of more than 64 bits.
    """
    if isinstance(key, numbers.Integral) and not isinstance(key, bool | np.bool_):
        seed = int(key)
        if not -(2 ** (_SEED_BITS - 1)) <= seed < 2 ** (_SEED_BITS - 1):
            raise ValueError(
                f"Argument `key` must be a seed of at most {_SEED_BITS} bits (with sign), but is {seed}."
            )
        return jax.random.key(seed)
    if not isinstance(key, jax.Array | np.ndarray):
        raise TypeError(
            "Argument `key` must be a key from jax.random.key(seed) or a seed, but is "
            f"{describe(key)}."
        )
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if typed and key.shape == ():
        return key
    if not typed and key.dtype == np.uint32 and key.shape == (2,):
        return jnp.asarray(key)
    if not typed and key.dtype != np.uint32:
        raise TypeError(
            "Argument `key` must be a key from jax.random.key(seed) or a seed, but is an array of type "
            f"{key.dtype}."
        )
    raise ValueError(
        f"Argument `key` must be one key, but has shape {key.shape}. Take one of them, key[0]."
    )


def as_real(name: str, value: ArrayLike | Sequence[Any]) -> Array:
    """An array of finite real numbers on the device; whole numbers become floating-point numbers.

    **Arguments:**

    - `name`: of the argument.
    - `value`: the array, which may be traced, or what becomes one.

    **Returns:** the array.

    **Raises:**

    - `TypeError` for what is no array of real numbers.
    - `ValueError` for numbers that are not finite.
    """
    _check_real(name, value)
    array = jnp.asarray(value)
    return array if _floating(array.dtype) else array.astype(jnp.result_type(float))


def as_float64(name: str, value: ArrayLike | Sequence[Any]) -> Shaped[np.ndarray, "..."]:
    """Finite real numbers as float64 of NumPy, whatever the precision of the device is.

    **Arguments:**

    - `name`: of the argument.
    - `value`: the array, or what becomes one.

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
    """The type of the numbers, if there are any."""
    try:
        dtype = value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype
    except (TypeError, ValueError):  # rows of different lengths, say
        return None
    # Keys of random numbers have a type of their own.
    numeric = isinstance(dtype, np.dtype) and (dtype.kind in "biufc" or _floating(dtype))
    return dtype if numeric else None


def _floating(dtype: np.dtype) -> bool:
    """Whether a type is one of floating-point numbers, bfloat16 and the like included."""
    return bool(jnp.issubdtype(dtype, jnp.floating))


def describe(value: Any) -> str:
    """What a message says of a value that is of the wrong type: itself if it is short."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if hasattr(value, "shape") and np.shape(value) != ():
        return f"an array of shape {np.shape(value)} and type {value.dtype}"
    if isinstance(value, str | bytes | numbers.Number | np.generic) or value is None:
        return repr(value)
    return f"an object of type {type(value).__name__}"


def _shown(value: Any) -> str:
    """A number, or the range of some."""
    array = np.asarray(value)
    return str(value) if array.shape == () else f"from {array.min()} to {array.max()}"


def as_times(times: ArrayLike | Sequence[Any]) -> Float[Array, " times"]:
    """The argument `times` as an array.

    **Raises:**

    - `ValueError` if there are fewer than two, or they do not increase.
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
