"""A differentiable vertex model of epithelial tissue, on JAX and Equinox.

What is public is listed in `__init__.pyi`, and imported when it is first used: `import vertax` alone brings
neither JAX nor Matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
