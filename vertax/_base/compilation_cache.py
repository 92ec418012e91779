"""JAX's persistent compilation cache, in the user's cache folder."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

import jax

VARIABLE = "VERTAX_CACHE"
_OFF = ("off", "0", "no", "false")
_MAX_SIZE = 2 * 1024**3  # bytes; the least recently used functions are removed first


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled functions on disk, so that the next process does not compile them again.

    ```python
    import vertax as vx

    vx.enable_compilation_cache()
    ```

    The command `vertax`, the notebooks and the napari widget call it; the library does not, because the
    cache is a setting of JAX for the whole process. Call it before the first computation. A cached function
    is used if its code, the shapes and dtypes of its arguments, the version of JAX and the device are equal.
    Above 2 GB the least recently used functions are removed.

    **Arguments:**

    - `folder`: folder of the cache. By default the value of the environment variable `VERTAX_CACHE` (`off`
        disables the cache), or `vertax` in the user's cache folder (`XDG_CACHE_HOME`, by default
        `~/.cache`; `~/Library/Caches` on macOS, `%LOCALAPPDATA%` on Windows). Other
        users must not have write access: the programs in it are executed.

    **Returns:** the folder, or `None` without a cache: it is disabled, or the user's cache folder is not
    writable. A folder that was set in JAX before (`JAX_COMPILATION_CACHE_DIR`) stays.

    **Raises:**

    - `ValueError` if the given folder cannot be used.
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
        if not asked:  # a read-only home directory is not an error
            return None
        raise ValueError(
            f"Cannot keep compiled functions in {path}: {error.strerror}. Name another folder, or set "
            f"{VARIABLE}=off."
        ) from None
    path = path.absolute()
    _remove_incomplete_files(path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    # By default JAX caches only functions that compile for 1 s; hundreds of small functions take as long.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_compilation_cache_max_size", _MAX_SIZE)
    return path


def _user_folder() -> Path:
    """The cache folder of the user."""
    if (chosen := os.environ.get("XDG_CACHE_HOME", "")) and Path(chosen).is_absolute():
        return Path(chosen)
    home = Path(os.path.expanduser("~"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    return home / ".cache"


def _remove_incomplete_files(folder: Path) -> None:
    """Remove functions that were not written completely: JAX would print a warning at each start."""
    # With a maximum size, JAX writes the file `-atime` after the file `-cache`.
    if not (folder / ".lockfile").exists():
        return
    with contextlib.suppress(OSError):
        for file in folder.glob("*-cache"):
            complete = file.with_name(file.name.removesuffix("-cache") + "-atime").exists()
            if not complete and time.time() - file.stat().st_mtime > 60:
                file.unlink(missing_ok=True)
