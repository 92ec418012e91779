"""NumPy archives (`.npz`) with a header: the kind of file and the version of its format."""

from __future__ import annotations

import os
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from vertax._base.atomic import atomic_write


def write_archive(
    path: str | os.PathLike[str], what: str, version: int, arrays: Mapping[str, np.ndarray]
) -> None:
    """Write arrays and a header to an `.npz` archive, atomically.

    **Arguments:**

    - `path`: the file.
    - `what`: the kind of file; its format is called `vertax-{what}`.
    - `version`: version of that format.
    - `arrays`: the arrays by name.
    """
    header = {"format": np.asarray(f"vertax-{what}"), "version": np.asarray(version)}
    with atomic_write(path, "wb") as file:
        np.savez_compressed(file, **(header | dict(arrays)))  # pyright: ignore[reportArgumentType]


def read_archive(path: str | os.PathLike[str], what: str, version: int) -> dict[str, np.ndarray]:
    """Read all arrays of an archive at once, so that a damaged file is an error here.

    **Arguments:**

    - `path`: the file.
    - `what`: the kind of file, see `write_archive`.
    - `version`: the newest version that can be read.

    **Returns:** the arrays by name, header included.

    **Raises:**

    - `FileNotFoundError` if the file does not exist.
    - `ValueError`, with the file's name, for another kind of file, a truncated or damaged file, or a
        newer version.
    """
    name = os.fspath(path)
    arrays = _read(name, what)
    if "format" not in arrays or str(arrays["format"]) != f"vertax-{what}":
        raise ValueError(f"{name} is not a vertax {what} file: it has no header saying so.")
    stored = arrays.get("version", np.asarray(""))
    if stored.shape != () or stored.dtype.kind != "i" or stored < 1:
        raise ValueError(f"{name} has a broken header: its version is {stored}.")
    if stored > version:
        raise ValueError(
            f"{name} has version {stored} of the {what} format, but this vertax reads up to "
            f"version {version}. Update vertax."
        )
    return arrays


def as_jax(array: Shaped[np.ndarray, "..."], name: str) -> Shaped[Array, "..."]:
    """Convert an array of the file `name` to JAX without rounding.

    **Raises:**

    - `ValueError` for 64-bit numbers if JAX is limited to 32 bits.
    """
    converted = jnp.asarray(array)
    if converted.dtype != array.dtype:
        raise ValueError(
            f"{name} holds {array.dtype} numbers, but JAX is limited to {converted.dtype}, which would "
            'round them. Call jax.config.update("jax_enable_x64", True) first.'
        )
    return converted


def _read(name: str, what: str) -> dict[str, np.ndarray]:
    with open(name, "rb") as file:
        if file.read(2) not in (b"PK", b""):
            raise ValueError(f"{name} is not a vertax {what} file (nor any .npz archive).")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as archive:
                return {key: np.asarray(archive[key]) for key in archive.files}
        # NumPy raises errors of many types for a damaged archive.
        except Exception as error:
            raise ValueError(f"{name} is truncated or damaged: {error}") from error
