"""Files that are either there in full or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any


@contextlib.contextmanager
def atomic_write(
    path: str | os.PathLike[str],
    mode: str = "w",
    *,
    encoding: str | None = None,
    newline: str | None = None,
) -> Iterator[IO[Any]]:
    """Write a file that appears under its name only once it is complete.

    The text or bytes go to a temporary file in the same folder, which replaces `path` when the
    block ends. If the block raises (or the process is interrupted) the old file, if any, is left as
    it was and nothing else stays behind.

    ```python
    with vertax.io.atomic_write("metrics.json") as file:
        json.dump(metrics, file)
    ```

    **Arguments:**

    - `path`: the file to write. A symbolic link keeps pointing where it did: its target is
        replaced.
    - `mode`: `"w"` for text, `"wb"` for bytes.
    - `encoding`: of text; UTF-8 unless told.
    - `newline`: as for `open`; pass `""` for the `csv` module.

    **Returns:** a context manager that gives the open file.

    **Raises:**

    - `ValueError` for another mode.
    - `FileNotFoundError` if the folder of `path` does not exist.
    - `IsADirectoryError` if `path` is a folder.
    """
    if mode not in ("w", "wb"):
        raise ValueError(f'Argument `mode` must be "w" or "wb", but is {mode!r}.')
    destination = Path(os.path.realpath(path))
    folder = destination.parent
    if not folder.is_dir():
        raise FileNotFoundError(f"Cannot write {os.fspath(path)!r}: there is no folder {folder}.")
    if destination.is_dir():
        raise IsADirectoryError(f"Cannot write {os.fspath(path)!r}: it is a folder.")
    # Exclusive creation ("x") by `open` and not `tempfile`: a file made by the latter is private to
    # its owner, and would stay so under its final name.
    temporary = folder / f".vertax-{secrets.token_hex(8)}.tmp"
    if mode == "w":
        encoding = encoding or "utf-8"
    try:
        with open(temporary, mode.replace("w", "x"), encoding=encoding, newline=newline) as file:
            yield file
            file.flush()
            # Without it a crash of the machine can leave the new name on an empty file.
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
    """A file that another program writes, and that appears under its name only once it is complete.

    **Arguments:**

    - `path`: the file to write.

    **Returns:** a context manager that gives the path of a draft with the same ending.

    **Raises:** as `atomic_write`.
    """
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"draft{Path(path).suffix}"
        with atomic_write(path, "wb") as file:  # what is wrong with `path` shows before the work
            yield draft
            with draft.open("rb") as content:
                shutil.copyfileobj(content, file)


def _sync_folder(folder: Path) -> None:
    """Make the new name itself durable, where the system can."""
    with contextlib.suppress(
        OSError
    ):  # Windows cannot open folders, some file systems not sync them
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
