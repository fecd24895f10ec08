"""Hands for a robot's computer: `handmap hands save`, and `saved_bytes`."""

from .records import saved_bytes

__all__ = ["saved_bytes"]
