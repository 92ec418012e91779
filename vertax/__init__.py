"""A differentiable vertex model of epithelial tissue, on JAX and Equinox.

What is public is listed in `__init__.pyi`, and imported when it is first used: `import vertax` alone brings
neither JAX nor Matplotlib.
"""

import lazy_loader

_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":  # reading it takes milliseconds, which an import alone does not need
        from importlib import metadata

        try:
            return metadata.version("vertax")
        except metadata.PackageNotFoundError:  # run from the source folder
            return "(not installed)"
    return _imported(name)
