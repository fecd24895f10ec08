"""From an `open` request to the hands and the mapper of a session.

Runs in a thread, because it takes some 100 ms.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import HandmapError, InvalidInputError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.human.landmarks import PalmShape, human_name
from handmap_qp.mapping.hand_pair import HandPair, hand_pair
from handmap_qp.mapping.landmarks import LandmarkReader
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.presets import Choice, default_preset
from handmap_qp.service.choosing import read_choice
from handmap_qp.service.hand_cache import HandCache
from handmap_qp.service.messages import Open
from handmap_qp.service.refusals import with_field_errors, with_option_errors
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.rejoin import RejoinKind


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """The hands of a session and what maps between them.

    Attributes:
        mapper: Maps the human hand to the robot hand.
        follower: Lets the mapper follow samples of landmarks.
        robot: The robot hand with the reference points of the request.
        choice: Preset and options of the mapper.
        palm: Recognises landmarks of another size; None if samples are joint angles or points.
        lengths: The measured human hand; None for the model's own.
        contact_gap: The measured contact gap [m]; None if it was not measured yet.
        needs_measuring: Whether the first landmarks measure the human hand. Until then it is the
            model's own.
        pair: Both hands, matched for teleoperation; kept so that `configure` finds it at once. None
            if their fingers do not correspond.
    """

    mapper: HandMapper
    follower: Follower
    robot: Hand
    choice: Choice
    palm: PalmShape | None
    lengths: HumanLengths | None
    contact_gap: float | None
    needs_measuring: bool = False
    pair: HandPair | None = None


def prepare_hands(
    request: Open,
    cache: HandCache,
    lengths: HumanLengths | None = None,
    contact_gap: float | None = None,
) -> Hands:
    """Make the mapper of a session.

    Args:
        request: The client's request.
        cache: The hands that clients may open.
        lengths: The human hand as measured from landmarks; the request decides if omitted.
        contact_gap: The contact gap as measured from landmarks [m], unless the request gives one.

    Returns:
        The mapper and the hands.

    Raises:
        RefusedError: With the field at fault.
    """
    if request.hand_length is not None and request.lengths is not None:
        raise RefusedError("invalid", "give hand_length or lengths, not both", field="lengths")
    contact_gap = contact_gap if request.contact_gap is None else request.contact_gap
    robot = cache.robot(request.robot, request.robot_points, request.mount)
    if lengths is None:
        lengths = with_field_errors("lengths", lambda: _human_lengths(request))
    human = with_field_errors("human_points", lambda: _human(request, cache, lengths))
    palm = None
    if request.input == "landmarks":
        palm = PalmShape(human)
        # Reject reference points that are no landmarks now, not at the first sample.
        with_field_errors("human_points", lambda: LandmarkReader(human))
    choice = read_choice(request, human, robot, contact_gap)
    rejoin: RejoinKind = "clutch" if request.resume == "clutch" else "glide"
    mapper = with_option_errors(
        request,
        robot,
        choice,
        lambda: HandMapper(human, robot, choice.method, ik=choice.ik),
    )
    pair = None
    if default_preset(human, robot) == "teleoperation":
        # `configure` may ask for it in the event loop; matching the hands takes some 100 ms.
        with suppress(HandmapError):
            pair = hand_pair(human, robot)
    needs_measuring = palm is not None and lengths is None
    follower = Follower(mapper, rejoin=rejoin)
    return Hands(mapper, follower, robot, choice, palm, lengths, contact_gap, needs_measuring, pair)


def _human(request: Open, cache: HandCache, lengths: HumanLengths | None) -> Hand:
    """Return the human hand with the reference points of the request."""
    if lengths is None:
        return cache.human(request.side, request.human_points)
    return load_hand(human_name(request.side), points=request.human_points, lengths=lengths)


def _human_lengths(request: Open) -> HumanLengths | None:
    """Return the measured hand if the request has one."""
    lengths = request.lengths
    if lengths is None:
        return (
            None
            if request.hand_length is None
            else HumanLengths.from_hand_length(request.hand_length)
        )
    if not all(0.0 < math.hypot(*row) < 1.0 for row in (*lengths.bases, *lengths.segments)):
        raise InvalidInputError(argument="lengths", expected="lengths between 0 and 1 m")
    return HumanLengths(*map(np.array, (lengths.bases, lengths.segments, lengths.rolls)))
