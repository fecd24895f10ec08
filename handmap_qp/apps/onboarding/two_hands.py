"""Which of two hands is the left one: by the token in which their names differ, else by place."""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from handmap_qp.hands import OTHER_SIDE, Side
from .finger_names import TOKEN
from .robot import Robot, carriers

# Palms lie beside each other if they are this many times farther apart across the robot than along
# it, and at least this far [m].
_BESIDE = 1.0
_LEAST_APART = 0.02


class PairedSide(NamedTuple):
    """The side of one of two hands, by what tells it from the other one.

    Attributes:
        side: The side.
        how: Evidence for it.
        is_forced: Whether it counts more than where the hand's own thumb is.
    """

    side: Side
    how: str
    is_forced: bool = False


def paired_sides(robot: Robot, palms: tuple[str, str]) -> list[PairedSide]:
    """Return the sides of two hands of a robot by their names, else by their places.

    A robot stands with x ahead and z up, as ROS does (REP 103), so that its left hand is at the
    larger y.

    Args:
        robot: The robot.
        palms: Links of both palms.

    Returns:
        The sides, in the order of the palms; empty if neither tells them.
    """
    if first := side_by_difference(*(_names_of(robot, palm) for palm in palms)):
        sides = (first, OTHER_SIDE[first])
        how = "by the names in which both hands differ"
    else:
        x, y, _ = robot.link_poses(palms, robot.rest)[:, :3, 3].T
        across = y[0] - y[1]
        if abs(across) < max(_LEAST_APART, _BESIDE * abs(x[0] - x[1])):
            return []
        sides = ("left", "right") if across > 0.0 else ("right", "left")
        how = "by its place beside the other hand"
    return [PairedSide(side, how) for side in sides]


def side_by_difference(one: Iterable[str], other: Iterable[str]) -> Side | None:
    """Return the side of the first of two hands by the tokens in which their names differ.

    Args:
        one: Names of links and joints of a hand.
        other: Those of the other hand.
    """
    mine, theirs = (Counter(_tokens(names)) for names in (one, other))
    # Jaws that are `l` and `r` in both hands cancel.
    more, fewer = mine - theirs, theirs - mine
    votes = sum(
        min(count, fewer[token]) * (_is_pair(first, token) - _is_pair(token, first))
        for first, count in more.items()
        for token in fewer
    )
    return None if votes == 0 else "left" if votes > 0 else "right"


def _tokens(names: Iterable[str]) -> list[str]:
    return [token.lower() for name in names for token in TOKEN.findall(name)]


def _is_pair(left: str, right: str) -> bool:
    """Return whether two tokens are the same but for their sides."""
    whole = left.replace("left", "#") == right.replace("right", "#")
    starts = left[:1] + right[:1] == "lr" and left[1:] == right[1:]
    ends = left[-1:] + right[-1:] == "lr" and left[:-1] == right[:-1]
    return left != right and (whole or starts or ends)


def _names_of(robot: Robot, palm: str) -> list[str]:
    """Return the names of a palm, and of all links and joints that hang from it."""
    links = [link for link in robot.elements if palm in carriers(robot.parents, link)]
    bodies = {robot.frames[link].parentJoint for link in links}
    inner = bodies - {robot.frames[palm].parentJoint}
    return [*links, *(robot.model.names[body] for body in inner)]
