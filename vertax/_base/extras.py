"""Optional dependencies: the extras of the package."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

# Modules with another name than their package on PyPI.
_PACKAGES = {"skimage": "scikit-image", "PIL": "pillow", "tomli_w": "tomli-w"}


@contextlib.contextmanager
def requires_extra(extra: str, feature: str) -> Iterator[None]:
    """Wrap imports of an extra; if one fails, the error states the command that installs the extra.

    ```python
    with requires_extra("files", "Writing VTK files"):
        import meshio
    ```

    **Arguments:**

    - `extra`: its name in `pyproject.toml`.
    - `feature`: what needs the extra; the beginning of the message.

    **Returns:** a context manager.

    **Raises:**

    - `ImportError` with the command that installs the extra, if an import in the block fails.
    """
    try:
        yield
    except ImportError as error:
        module = (error.name or "").partition(".")[0]
        # A bug in vertax, or an error that already states a command.
        if module == "vertax" or "pip install" in str(error):
            raise
        package = _PACKAGES.get(module, module) or f"what the extra [{extra}] brings"
        raise ImportError(
            f'{feature} needs {package}: pip install -e ".[{extra}]" in a copy of the repository of vertax '
            f"({error}).",
            name=error.name,
        ) from error
