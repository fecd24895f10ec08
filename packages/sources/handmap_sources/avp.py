"""`handmap track avp`: an Apple Vision Pro, by the app Tracking Streamer of VisionProTeleop.

The app is the server of `handtracking.proto`: https://github.com/Improbable-AI/VisionProTeleop.
"""

import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from time import monotonic, sleep
from typing import Annotated, Any

import grpc
import numpy as np
from tyro.conf import Positional, Suppress, arg

from handmap_qp.apps.refusals import naming
from handmap_qp.errors import InvalidInputError
from handmap_qp.human import HumanSample
from handmap_qp.se3 import Array
from .device import DeviceSource

messages, services = grpc.protos_and_services("handmap_sources/handtracking.proto")
PORT = 12345
JOINTS = 25
"""Joints of a hand in our layout, which are the first ones of the app."""
_ENTRIES = attrgetter(*(f"m{row}{column}" for row in range(4) for column in range(4)))
_ROWS, _SIGNS = [0, 2, 1, 3], np.array([[1.0], [-1.0], [1.0], [1.0]])
"""Take poses in the app's world, y up, to that of the layout, z up: x, -z, y."""
_DISCOVERY = 888.0
"""Marks a request that tells the address of its client."""
_VERSION = 25000.0
"""Version of the protocol, 2.50.0; the app sends nothing to older ones."""
_LOST = 0.2
"""Time after which a wrist that repeats exactly is one that the headset does not see [s]."""
_PAUSE = 0.2
"""Time before a lost connection is made again [s]."""
_OPTIONS = [
    # The headset is in the same network.
    ("grpc.enable_http_proxy", 0),
    # A network that is lost is noticed, and so is an address that nobody has.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.min_reconnect_backoff_ms", 3000),
]


@dataclass(eq=False, kw_only=True)
class TrackAvp(DeviceSource):
    """Track a hand with an Apple Vision Pro, by the app Tracking Streamer (VisionProTeleop).

    Start the app on the headset, and give the address that it shows. Samples have the time of their
    arrival, as the app sends none. A lost connection is made again.

    Examples:
        handmap track avp 192.168.1.20 --to 127.0.0.1 --robot allegro_right
        handmap track avp 192.168.1.20 --side left --record left.npz

    Attributes:
        host: Address of the headset; the port is 12345 unless given.
    """

    host: Positional[Annotated[str, arg(metavar="HOST[:PORT]")]]
    layout: Suppress[str] = "visionpro25"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.name = f"Vision Pro {self.host}"

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield a sample whenever the wrist has moved.

        Between two poses the app repeats the last one, and also if it does not see the hand.

        Raises:
            InvalidInputError: If the headset cannot be reached, or is another server.
        """
        moved = 0.0
        before = None
        for update in self._updates():
            if update is None:
                before = None
                continue
            now = monotonic()
            hand = getattr(update, f"{self.side}_hand")
            joints = _poses(hand.skeleton.jointMatrices)[:JOINTS]
            (wrist,) = _poses([hand.wristMatrix])
            if not len(joints):
                self.note("empty", "no joints: does the app ask for an update?")
            elif before is None or (wrist == before).all():
                if now - moved > _LOST:
                    yield self.unseen(now)
            elif sample := self.read(joints, now, wrist=_SIGNS * wrist[_ROWS]):
                moved = now
                yield sample
            before = wrist

    def _updates(self) -> Iterator[Any]:
        """Yield the app's messages, again after a lost connection; None before those of each.

        The first pose of a connection may be an old one, or none.
        """
        host, _, port = self.host.partition(":")
        with naming("HOST"), socket.socket(type=socket.SOCK_DGRAM) as probe:
            probe.connect((host, PORT))
            numbers = map(float, probe.getsockname()[0].split("."))
        places = ["m00", "m01", "m02", "m03", "m10", "m30"]
        head = dict(zip(places, [_DISCOVERY, *numbers, _VERSION], strict=True))
        request = messages.HandUpdate(Head=head)
        has_begun = False
        with grpc.insecure_channel(f"{host}:{port or PORT}", _OPTIONS) as channel:
            ask = services.HandTrackingServiceStub(channel).StreamHandUpdates
            while True:
                yield None
                try:
                    for update in ask(request, wait_for_ready=has_begun):
                        has_begun = True
                        yield update
                except grpc.RpcError as error:
                    if not has_begun:
                        raise InvalidInputError(
                            f"no Tracking Streamer answers at {self.host}",
                            argument="HOST",
                            advice="start it on the headset, in the same network",
                        ) from error
                self.note("disconnected", "the connection is lost, and made again")
                sleep(_PAUSE)


def _poses(matrices: Iterable[Any]) -> Array:
    """Return messages as poses, shape (n, 4, 4); the app uses last rows for something else."""
    poses = np.array([*map(_ENTRIES, matrices)]).reshape(-1, 4, 4)
    poses[:, 3] = 0.0, 0.0, 0.0, 1.0
    return poses
