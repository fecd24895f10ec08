"""Version of the installed package."""

from importlib.metadata import version

PACKAGE = "handmap-qp"
"""Name of the distribution."""
__version__ = version(PACKAGE)
