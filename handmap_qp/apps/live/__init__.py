"""Live input: sources of human samples, led to the mapping service or into a file.

Modules of `__init__.pyi` are imported at their first use: they need the extra `service`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
