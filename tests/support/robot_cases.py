"""A robot with two hands on arms, in files of a test: the G1, whose right side mirrors its left."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from handmap_core.human.sample import human_name
from handmap_qp import HumanLengths, load_hand
from handmap_qp.hands import Side
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import hand_files

LENGTH = 0.18
"""Length of the person's hands [m]."""
PEOPLE: dict[Side, Hand] = {
    side: load_hand(human_name(side), lengths=HumanLengths.from_hand_length(LENGTH))
    for side in ("left", "right")
}
"""The hands of a person."""
_TRACKED = {side: hand.with_points("landmarks") for side, hand in PEOPLE.items()}
_TURNING = ("roll", "hand")
"""Parts of the names of joints that turn the other way on the right."""


def write_robot(folder: Path) -> Path:
    """Write the description of the robot `twin` and of both hands; return that of the robot."""
    text = hand_files()["g1_arm_left"].read_text(encoding="utf-8")
    left = yaml.safe_load(text)
    swapped = text.replace("left", "LEFT").replace("right", "left")
    right = yaml.safe_load(swapped.replace("LEFT", "right"))
    palm: dict[str, Any] = right["palm"]
    palm |= {"xyz": _mirrored(palm["xyz"]), "dorsal": _mirrored(palm["dorsal"])}
    for joint, at in right["rest"].items():
        if any(part in joint for part in _TURNING):
            right["rest"][joint] = -at
    for point in right["points"]:
        point["xyz"] = _mirrored(point.get("xyz", [0.0, 0.0, 0.0]))
    for name, hand in (("left", left), ("right", right)):
        text = yaml.safe_dump(hand, sort_keys=False)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    file = folder / "robot.yaml"
    hands = "{left: {hand: left.yaml}, right: {hand: right.yaml}}"
    file.write_text(f"name: twin\nhands: {hands}\n", encoding="utf-8")
    return file


def _mirrored(at: list[float]) -> list[float]:
    return [at[0], -at[1], -at[2]]


def landmarks_at(side: Side, time: float, shift: float = 0.0) -> np.ndarray:
    """Return landmarks of a hand that moves about and opens and closes [m], shape (21, 3).

    Args:
        side: The hand.
        time: The instant [s].
        shift: Added to all coordinates [m].
    """
    hand = _TRACKED[side]
    sign = 1.0 if side == "left" else -1.0
    half = 0.2 * (hand.upper_limits - hand.lower_limits)
    q = np.clip(
        hand.rest + half * np.sin(2.0 * time + sign),
        hand.lower_limits,
        hand.upper_limits,
    )
    wrist = np.eye(4)
    wrist[:3, 3] = 0.3 * sign, 0.08 * np.sin(2.0 * time), 1.0 + 0.1 * np.sin(time)
    return hand.points(q, wrist) + shift
