"""The matched posture of a robot hand: solve it, and print it for a hand.yaml."""

from typing import NamedTuple

import numpy as np
import yaml

from handmap_core.errors import expect
from handmap_core.se3 import Array
from handmap_qp.apps.tables import rows_of
from handmap_qp.hands import Hand, Values, load_hand
from handmap_qp.human import Recording, human_name, mirrored, scaled_human
from handmap_qp.mapping import HandPair

# Positions are written with four decimals: 0.1 mrad or 0.1 mm.
_SCALE = 1e4


class Match(NamedTuple):
    """The posture of a robot that corresponds to a resting human hand.

    Attributes:
        human: The human hand; its reference points are the 21 landmarks.
        robot: The robot hand.
        q: The robot's joint positions in the order of `robot.joint_names` [rad or m], inside their
            limits and rounded to four decimals, shape (n,).
    """

    human: Hand
    robot: Hand
    q: Array

    @property
    def rows(self) -> list[Values]:
        """Return a table row for every joint of the hand: limits, rest and matched position."""
        robot = self.robot
        columns = {
            "joint": robot.joint_names,
            "lower": robot.lower_limits,
            "upper": robot.upper_limits,
            "rest": robot.rest,
            "matched": self.q.tolist(),
        }
        if robot.neutral_match is not None:
            columns["in hand.yaml"] = robot.neutral_match
        return [r for r in rows_of(columns) if r["joint"] in robot.spec.joints]

    @property
    def text(self) -> str:
        """Return the key `neutral_match` of a hand.yaml."""
        matched = {row["joint"]: row["matched"] for row in self.rows}
        return yaml.safe_dump(
            {"neutral_match": matched}, sort_keys=False, allow_unicode=True
        )


def match_hand(
    robot: Hand,
    *,
    recording: Recording | None = None,
    human_length: float | None = None,
) -> Match:
    """Solve the robot posture that corresponds to the human hand at rest.

    Args:
        robot: The robot hand. A matched posture of its description is not used.
        recording: A recording to measure the person's hand in. The other hand's is mirrored.
        human_length: Length of the person's hand from wrist crease to middle fingertip [m]. If
            both are omitted, the human is the standard one.

    Raises:
        InvalidInputError: If the recording or the length cannot be used, or both are given.
        InvalidOptionsError: If the description names no finger.
    """
    is_one = None in (recording, human_length)
    expect(is_one, "--human-length", "none beside --recording", value=human_length)
    if recording is None:
        human = load_hand(
            human_name(robot.side), points="landmarks", hand_length=human_length
        )
    else:
        same = recording if recording.side == robot.side else mirrored(recording)
        human = scaled_human(same, points="landmarks")
    q = np.round(HandPair(human, robot).solve_matched() * _SCALE)
    lower, upper = robot.limits
    # Rounding must not leave the limits, which may have more decimals.
    q = np.clip(q, np.ceil(lower * _SCALE), np.floor(upper * _SCALE)) / _SCALE
    return Match(human, robot, np.clip(q, lower, upper))
