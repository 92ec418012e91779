"""What a job or an experiment of `vertax run` needs: configuration, folder, and tables.

`__init__.pyi` lists the public names, which are imported at their first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
