"""`Follower`: lets a mapper follow the samples of a tracker that make sense.

The sessions of the service, `handmap retarget` and `handmap view` all follow in this way.
`handmap_core.stream.follower` follows; here its guard knows the orders of all layouts.
"""

from __future__ import annotations

from handmap_core.stream import follower
from handmap_core.stream.follower import map_with as map_with
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.smoothing import Smoothing
from handmap_qp.mapping import HandMapper
from .guard import StreamGuard


class Follower(follower.Follower[HandMapper]):
    """Lets a mapper follow the samples of a tracker.

    A new reference of the mapper (`HandMapper.engage`, `reset`) ends a return and the smoothing.

    Args:
        mapper: Maps the samples; its human hand must be scaled to the person.
        rejoin: How the robot comes back to the human after a hold: `glide` there, or stay where it
            is with its palm, as after a `clutch`.
        smoothing: How samples are smoothed before they are mapped; None for not at all.

    Attributes:
        mapper: As given.
        rejoin: As given.

    Raises:
        InvalidOptionsError: If `rejoin` is something else.
        InvalidInputError: If `smoothing` is.
        HandError: If the human hand has no landmarks.
    """

    def __init__(
        self,
        mapper: HandMapper,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        guard = StreamGuard(mapper.human)
        super().__init__(mapper, guard, rejoin=rejoin, smoothing=smoothing)
