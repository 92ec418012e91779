"""What is installed on request only: the extras of the package."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

# Modules that are called otherwise than their packages.
_PACKAGES = {"skimage": "scikit-image", "PIL": "pillow", "tomli_w": "tomli-w"}


@contextlib.contextmanager
def requires_extra(extra: str, who: str) -> Iterator[None]:
    """Around imports of what an extra brings: if it is missing, say how to install it.

    ```python
    with requires_extra("files", "Writing VTK files"):
        import meshio
    ```

    **Arguments:**

    - `extra`: its name in `pyproject.toml`.
    - `who`: what needs it, the beginning of the message.

    **Returns:** a context manager.

    **Raises:**

    - `ImportError` with the command that installs the extra, if an import in the block fails.
    """
    try:
        yield
    except ImportError as error:
        module = (error.name or "").partition(".")[0]
        # A fault of ours, or something that is missing further down and was said there.
        if module == "vertax" or "pip install" in str(error):
            raise
        package = _PACKAGES.get(module, module) or f"what the extra [{extra}] brings"
        raise ImportError(
            f'{who} needs {package}: pip install "vertax[{extra}]" ({error}).', name=error.name
        ) from error
