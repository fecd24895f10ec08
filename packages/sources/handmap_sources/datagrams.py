"""`handmap track datagrams`: a glove, or any program, by UDP or ZeroMQ."""

import math
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from time import monotonic
from typing import Annotated, Any

import msgspec
import zmq
from tyro.conf import Positional, arg

from handmap_qp.errors import InvalidInputError, expect, reason_of
from handmap_qp.hands import Side
from handmap_qp.human import HumanSample
from .device import DeviceSource

LARGEST = 32768
"""Largest message [byte]; one of 127 joints as matrices has less."""
SILENCE = 1.0
"""Time without samples after which a sender counts as silent, and may have been restarted [s]."""
LEAP = 5.0
"""Longest time by which a sender's clock may be ahead of ours, since it was first heard [s]."""
_ADDRESS = re.compile(r"(udp|tcp)://[^:/]*:[1-9]\d{0,4}")
Sender = tuple[str, int]


class Message(msgspec.Struct):
    """One sample, as a JSON object or a MessagePack map; other fields are ignored.

    Attributes:
        joints: One sample of the layout: nested lists, a flat list, or numbers by name.
        time: Instant of the sender's own clock, which only ever increases [s]; that of arrival is
            used if omitted.
        side: Which hand; the one of `--side` if omitted.
        wrist: The wrist's pose beside the joints, as a matrix or as position and quaternion, for
            layouts that take one.
        valid: Whether the device sees the hand.
        confidence: The device's own, from 0 to 1.
    """

    joints: dict[str, float] | list[Any] | None = None
    time: float | None = None
    side: Side | None = None
    wrist: list[Any] | None = None
    valid: bool = True
    confidence: float = 1.0


@dataclass(eq=False, kw_only=True)
class TrackDatagrams(DeviceSource):
    """Track a hand with a glove, or any program, that sends its joints by UDP or ZeroMQ.

    Each message is one sample as JSON or MessagePack, such as {"time": 12.5, "side": "right",
    "joints": [[0.1, 0.2, 0.3], ...]}. Joints are in a layout of `handmap layouts`. Optional are
    time [s], side, wrist, valid and confidence. Without time, that of arrival is used.

    Examples:
        handmap track datagrams udp://:5580 --layout manus25 --record glove.npz
        handmap track datagrams tcp://192.168.1.7:5590 --layout openxr26 --to 127.0.0.1 --robot hey5

    Attributes:
        address: Where to listen for datagrams, udp://:PORT or udp://ADDRESS-OF-THIS-MACHINE:PORT;
            or a ZeroMQ publisher to subscribe to, tcp://HOST:PORT.
        layout: Layout of the joints: a name of `handmap layouts`, or the path of a table.
    """

    address: Positional[Annotated[str, arg(metavar="ADDRESS")]]
    layout: Annotated[str, arg(metavar="LAYOUT")]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.name = self.address
        self._sender: Sender | None = None
        self._offset = 0.0
        self._heard = self._last = -math.inf

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield the samples of one sender in the order of its clock.

        Raises:
            InvalidInputError: If the address cannot be listened at or subscribed to.
        """
        expected = "udp://:PORT, udp://HOST:PORT or tcp://HOST:PORT"
        is_address = _ADDRESS.fullmatch(self.address)
        expect(is_address, "ADDRESS", expected, value=self.address)
        is_udp = self.address.startswith("udp")
        for packet in self._datagrams() if is_udp else self._frames():
            if packet is None:
                self.note("silent", f"nothing has arrived for {SILENCE:.0f} s")
            elif sample := self._sample(*packet):
                yield sample

    def _datagrams(self) -> Iterator[tuple[bytes, Sender] | None]:
        """Yield datagrams and who sent them; None after each silence."""
        host, port = self.address.removeprefix("udp://").split(":")
        with socket.socket(type=socket.SOCK_DGRAM) as receiver:
            try:
                receiver.bind((host, int(port)))
            except (OSError, OverflowError) as error:
                raise InvalidInputError(reason_of(error), argument="ADDRESS") from error
            receiver.settimeout(SILENCE)
            while True:
                try:
                    yield receiver.recvfrom(LARGEST + 1)
                except TimeoutError:
                    yield None

    def _frames(self) -> Iterator[tuple[bytes, Sender] | None]:
        """Yield the last frames of ZeroMQ messages; None after each silence."""
        with zmq.Context() as context, context.socket(zmq.SUB) as receiver:
            receiver.rcvtimeo = int(1e3 * SILENCE)
            receiver.subscribe(b"")
            try:
                receiver.connect(self.address)
            except zmq.ZMQError as error:
                raise InvalidInputError(str(error), argument="ADDRESS") from error
            while True:
                try:
                    yield receiver.recv_multipart()[-1], (self.address, 0)
                except zmq.Again:
                    yield None

    def _message(self, packet: bytes) -> Message | None:
        """Return the message of a packet; None, after a note, if it is damaged."""
        if len(packet) > LARGEST:
            return self.note("too large", f"a message has more than {LARGEST} bytes")
        form = msgspec.json if packet.lstrip()[:1] == b"{" else msgspec.msgpack
        try:
            return form.decode(packet, type=Message)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            return self.note("damaged", f"a message cannot be read: {error}")

    def _sample(self, packet: bytes, sender: Sender) -> HumanSample | None:
        """Return the sample of a message; None, after a note, if it must not be mapped."""
        message = self._message(packet)
        if message is None:
            return None
        if message.side not in (None, self.side):
            return self.note(
                "other hand", f"there are samples of a {message.side} hand"
            )
        now = monotonic()
        is_silent = now - self._heard > SILENCE
        known = self._sender or sender
        if sender != known and not (is_silent and sender[0] == known[0]):
            return self.note("another sender", "{}:{} sends, too".format(*sender))
        offset, time = self._offset, now
        if message.time is not None:
            # A program that starts again has another clock, and for UDP another port.
            is_next = self._last < message.time + offset < now + LEAP
            if sender != self._sender or (is_silent and not is_next):
                offset = now - message.time
            time = message.time + offset
        # Also false for NaN.
        if not self._last < time < now + LEAP:
            text = "samples arrive late or twice, or their time leaps"
            return self.note("not in order", text)
        if message.valid:
            more = {"wrist": message.wrist, "confidence": message.confidence}
            sample = self.read(message.joints, time, **more)
        else:
            sample = self.unseen(time)
        if sample:
            self._sender, self._offset = sender, offset
            self._heard, self._last = now, time
        return sample
