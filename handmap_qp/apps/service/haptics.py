"""What the fingers of a robot feel, on its way from a driver to who subscribed to it."""

from handmap_core.client.messages import HAPTICS_END, Haptics, Subscribe, Touch
from handmap_qp.hands import Hand, Names, finger_by_joint
from .safety import refuse_if


def finger_names(robot: Hand) -> Names:
    """Return the fingers of a robot hand as haptics name them.

    Args:
        robot: The hand, or hands that are moved as one; their names begin with the side.
    """
    return tuple(
        dict.fromkeys(
            _name(robot, hand, point.finger)
            for hand in robot.hands
            for point in hand.reference_points
            if point.finger is not None
        )
    )


def fingers_by_joint(robot: Hand) -> dict[str, str]:
    """Return the finger of each joint that moves one finger alone, as haptics name it.

    A driver takes them from the state of its session: it need not have the robot's description.

    Args:
        robot: See `finger_names`.
    """
    return {
        joint: _name(robot, hand, finger)
        for hand in robot.hands
        for joint, finger in finger_by_joint(hand).items()
    }


def _name(robot: Hand, hand: Hand, finger: str) -> str:
    return f"{hand.side}.{finger}" if robot.parts else finger


def haptics_of(request: Touch, name: str, robot: Hand) -> Haptics:
    """Return the message for who subscribed to a session's haptics.

    Args:
        request: What a driver says.
        name: Public name of the session.
        robot: Its robot.

    Raises:
        RefusedError: If it names a finger that the robot does not have, or nothing at all.
    """
    is_empty = request.forces is None and request.efforts is None
    refuse_if(is_empty, "expected forces or efforts by finger", "forces")
    known = finger_names(robot)
    forces, efforts = request.forces or {}, request.efforts or {}
    for field, values in (("forces", forces), ("efforts", efforts)):
        for finger in values:
            message = f"no finger {finger!r}; there are {', '.join(known)}"
            refuse_if(finger not in known, message, f"{field}.{finger}")
    return Haptics(name=name, time=request.time, forces=forces, efforts=efforts)


def session_of(stream: str) -> str:
    """Return the name of the session that a stream is of."""
    return stream.removesuffix(HAPTICS_END)


def stream_of(request: Subscribe) -> str:
    """Return the name of the stream that a client subscribes to."""
    return request.name + (HAPTICS_END if request.stream == "haptics" else "")
