"""A hand of one's own: from any URDF to a `hand.yaml`, and a look at whether it is right.

Modules of `__init__.pyi` are imported at their first use: those that draw.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
