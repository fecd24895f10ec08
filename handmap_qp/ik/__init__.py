"""From targets to motion: a QP with limits.

Modules of `__init__.pyi` are imported at their first use: those that not every mapping needs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
