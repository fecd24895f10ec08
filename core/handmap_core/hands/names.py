"""Names and numbers that all hands share, and their types."""

from __future__ import annotations

from typing import Any, Literal

Names = tuple[str, ...]
Values = dict[str, Any]
"""Values by name."""
Side = Literal["right", "left"]
SIDES: tuple[Side, ...] = ("left", "right")
OTHER_SIDE: dict[Side, Side] = {"right": "left", "left": "right"}
UPRIGHT = r"^[+-]([xyz]) up, [+-](?!\1)[xyz] forward\Z"
"""Pattern of the axes of a world that are up and forward, such as `+y up, -z forward`."""

FINGERS = ("thumb", "index", "middle", "ring", "little")
"""The fingers, in the order of the rows of `HumanLengths`."""
THUMB = FINGERS[0]
"""The finger that opposes the others."""
CONTACT_GAP = 0.013
"""Contact gap of a person of whom none was measured [m]."""

LINK_MARGIN = 0.001
"""Margin between all links but those that pinch [m]."""
LONGEST_STOP = 0.5
"""Longest time in which a robot stops, whatever its acceleration limit is [s]."""
