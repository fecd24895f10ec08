"""Commands of the mappings of `handmap compare`: `map_commands`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.offline.comparison import ComparedMethod, Take, outside_methods, own_method
from handmap_qp.simulation.commands import Commands


def map_commands(method: ComparedMethod, take: Take, hand: Hand) -> Commands:
    """Map a recording by one mapping.

    A mapping that moves no wrist has the robot's palm on the human's, as in `handmap compare`.

    Args:
        method: The mapping.
        take: The recording, prepared.
        hand: The robot hand.
    """
    motion = method.map_take(take, hand)
    time, wrist = np.asarray(take.recording.time), motion.wrist_in(take, hand)
    return Commands(method.name, hand, time, motion.q, wrist)


def chosen_methods(names: tuple[str, ...], peers: Path | None, robot: str) -> list[ComparedMethod]:
    """Return mappings by name: of this package, and of an outside program.

    Raises:
        InvalidInputError: If there is no such mapping.
    """
    outside = {m.name: m for m in outside_methods(peers, robot)} if peers is not None else {}
    return [outside[name] if name in outside else own_method(name) for name in names]
