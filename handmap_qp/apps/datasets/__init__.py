"""Recordings by the thousand: convert files, and map whole data sets.

Modules of `__init__.pyi` are imported at their first use: they draw.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
