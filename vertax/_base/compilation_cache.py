"""Compiled functions that outlive the process: JAX's persistent compilation cache, in the user's folder."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

import jax

VARIABLE = "VERTAX_CACHE"
_OFF = ("off", "0", "no", "false")
_LARGEST = 2 * 1024**3  # bytes; what was not used for longest goes first


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled functions on disk, so that the next process does not compile them again.

    ```python
    import vertax as vx

    vx.enable_compilation_cache()
    ```

    The command `vertax`, the notebooks and the widget of napari call it; the library does not, because the
    cache is a setting of JAX for the whole process. Call it before the first computation. A function is found
    again if it, the shapes of its arguments and the versions of JAX and of the device are the same; numbers
    may differ. At 2 GB the functions that were not used for longest are removed.

    **Arguments:**

    - `folder`: where to keep them. If left out, the folder that the environment variable `VERTAX_CACHE`
        names (`off` for none), and else `vertax` in the user's cache folder (`XDG_CACHE_HOME`, by default
        `~/.cache`; `~/Library/Caches` on macOS, `%LOCALAPPDATA%` on Windows). Others must not be able to
        write there: the programs in it are executed.

    **Returns:** the folder, or `None` if nothing is kept: it is switched off, or the user's cache folder
    cannot be written to. A folder that was set for JAX before (`JAX_COMPILATION_CACHE_DIR`) is left as it is.

    **Raises:**

    - `ValueError` if the folder that was asked for cannot be used.
    """
    asked = os.environ.get(VARIABLE, "") if folder is None else os.fspath(folder)
    if folder is None and asked.lower() in _OFF:
        return None
    if folder is None and (earlier := jax.config.values["jax_compilation_cache_dir"]) is not None:
        return Path(earlier)
    path = Path(asked).expanduser() if asked else _user_folder() / "vertax"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(None, "no permission to write")
    except OSError as error:
        if not asked:  # a home that is read-only is no reason to stop
            return None
        raise ValueError(
            f"Cannot keep compiled functions in {path}: {error.strerror}. Name another folder, or set "
            f"{VARIABLE}=off."
        ) from None
    path = path.absolute()
    _forget_halves(path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    # JAX keeps what took a second; hundreds of small functions take as long together.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_compilation_cache_max_size", _LARGEST)
    return path


def _user_folder() -> Path:
    """The folder for what programs can make again."""
    if (chosen := os.environ.get("XDG_CACHE_HOME", "")) and Path(chosen).is_absolute():
        return Path(chosen)
    home = Path(os.path.expanduser("~"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    return home / ".cache"


def _forget_halves(folder: Path) -> None:
    """Remove functions whose writing was cut short: JAX would warn of them at each start."""
    # It writes the time of the last use after the function itself, if it keeps to a size.
    if not (folder / ".lockfile").exists():
        return
    with contextlib.suppress(OSError):
        for file in folder.glob("*-cache"):
            complete = file.with_name(file.name.removesuffix("-cache") + "-atime").exists()
            if not complete and time.time() - file.stat().st_mtime > 60:
                file.unlink(missing_ok=True)
