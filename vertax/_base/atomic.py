"""Atomic writing of files: a file is complete or absent."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from vertax._base.checks import check_choice


@contextlib.contextmanager
def atomic_write(
    path: str | os.PathLike[str],
    mode: str = "w",
    *,
    encoding: str | None = None,
    newline: str | None = None,
) -> Iterator[IO[Any]]:
    """Write a file that appears under its name only when it is complete.

    The text or bytes go to a temporary file in the same folder, which replaces `path` when the
    block ends. If the block raises (or the process is interrupted), an old file stays unchanged and
    the temporary file is removed.

    ```python
    with atomic_write("metrics.json") as file:
        json.dump(metrics, file)
    ```

    **Arguments:**

    - `path`: the file to write. Of a symbolic link the target is replaced.
    - `mode`: `"w"` for text, `"wb"` for bytes.
    - `encoding`: of text; by default UTF-8.
    - `newline`: as for `open`; pass `""` for the `csv` module.

    **Returns:** a context manager that gives the open file.

    **Raises:**

    - `ValueError` for another mode.
    - `FileNotFoundError` if the folder of `path` does not exist.
    - `IsADirectoryError` if `path` is a folder.
    """
    check_choice("mode", mode, ("w", "wb"))
    destination = Path(os.path.realpath(path))
    folder = destination.parent
    if not folder.is_dir():
        raise FileNotFoundError(f"Cannot write {os.fspath(path)!r}: there is no folder {folder}.")
    if destination.is_dir():
        raise IsADirectoryError(f"Cannot write {os.fspath(path)!r}: it is a folder.")
    # `open` with mode "x" instead of `tempfile`, which would leave the final file readable only by its
    # owner.
    temporary = folder / f".vertax-{secrets.token_hex(8)}.tmp"
    if mode == "w":
        encoding = encoding or "utf-8"
    try:
        with open(temporary, mode.replace("w", "x"), encoding=encoding, newline=newline) as file:
            yield file
            file.flush()
            # Without fsync, a crash of the machine can leave an empty file under the final name.
            os.fsync(file.fileno())
        if destination.exists():
            shutil.copymode(destination, temporary)
        os.replace(temporary, destination)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(folder)


@contextlib.contextmanager
def atomic_draft(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Like `atomic_write`, for a file that another program writes.

    **Arguments:**

    - `path`: the file to write.

    **Returns:** a context manager that gives the path of a temporary file with the same suffix.

    **Raises:** as `atomic_write`.
    """
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"draft{Path(path).suffix}"
        with atomic_write(path, "wb") as file:  # an invalid `path` raises here, before the work
            yield draft
            with draft.open("rb") as content:
                shutil.copyfileobj(content, file)


def _sync_folder(folder: Path) -> None:
    """Write the folder entry to disk, if the system supports it."""
    # Windows cannot open folders; some file systems cannot sync them.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
