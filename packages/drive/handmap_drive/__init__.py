"""Motors: drivers of robot hands, and the loop that gives them the commands of a session.

Other packages add drivers by entry points of the group `handmap_qp.drivers`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from handmap_qp.hands import Names
from handmap_qp.plugins import Plugins
from .ability import Ability
from .driver import Driver
from .inspire import Inspire
from .servos import Servos
from .simulated import Simulated

DRIVERS: Mapping[str, Callable[[str, Names, Path | None], Driver]] = Plugins(
    "handmap_qp.drivers",
    lambda: {
        "leap": partial(Servos, "leap"),
        "servos": partial(Servos, ""),
        "inspire_right": partial(Inspire, "inspire_right"),
        "inspire_left": partial(Inspire, "inspire_left"),
        "ability": partial(Ability, "ability"),
        "simulated": Simulated,
    },
    "collections.abc:Callable",
)
"""Makers of drivers by name: of a port, the session's joints, and the file of `--motors`."""
