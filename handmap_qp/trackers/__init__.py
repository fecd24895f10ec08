"""From files and devices to samples of a human hand, and checks that they are what they say.

Names of `__init__.pyi` are imported at their first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
