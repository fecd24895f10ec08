"""What the library takes of Pinocchio for rotations, by the compiled core; see `taken.py`."""

from __future__ import annotations

from handmap_core.core import core

exp3 = core.exp3
log3 = core.log3


class SE3:
    """Stands for the type of Pinocchio's poses, which nobody has here."""


def neutral(model):
    """Return the configuration of a model at zero, shape (nq,)."""
    return model.neutral
