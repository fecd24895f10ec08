"""`handmap view`: both hands, targets, errors and options in a browser.

Modules of `__init__.pyi` are imported at their first use: they need the extra `service`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
