"""The stiffness of position control that is assumed where nobody has measured it."""

STIFFNESS = 3.0
"""Of joints that turn [N m/rad]."""
SLIDING_STIFFNESS = 2000.0
"""Of joints that slide, such as those of jaws [N/m]."""
