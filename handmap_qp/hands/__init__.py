"""Any hand: its description, its Pinocchio model, the hands that come with the package.

Modules of `__init__.pyi` are imported at their first use: those that not every hand needs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
