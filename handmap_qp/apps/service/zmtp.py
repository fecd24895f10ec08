"""ZMTP 3 without encryption, the server's end: bytes in, whole messages out.

libzmq speaks it too, in a thread of its own and behind a gate that bounds what it stores
(`connection_gate`): each message then passes the event loop three times and that thread twice. Here
it passes the event loop once. A peer is stored for no more than twice its longest message.

The protocol is that of https://rfc.zeromq.org/spec/37, with the mechanism NULL. The socket is a
ROUTER, to which DEALER, REQ and ROUTER may connect.
"""

from collections.abc import Callable

from .safety import Bucket

GREETING = 64
"""Bytes that each side sends first."""
OLDER = "a client speaks an older protocol than ZMTP 3"
"""Why a peer is refused whose greeting `is_older`."""
_VERSION = 3
_MECHANISM = slice(12, 32)
_NULL = b"NULL".ljust(20, b"\0")
_MORE = 0x01
_LONG = 0x02
_COMMAND = 0x04
_CALLERS = (b"DEALER", b"REQ", b"ROUTER")
"""Kinds of sockets that may connect."""
_READY = b"\x05READY"
_PING = b"\x04PING"
_PONG = b"\x04PONG"
_TTL = 2
"""Bytes of the time to live behind `PING`; the rest is its context."""
_LONGEST_COMMAND = 4096
# Commands of a peer in a second, and at once: heartbeats come once a second and more rarely.
_COMMANDS_PER_SECOND = 5.0
_COMMANDS = 50.0


class PeerError(Exception):
    """A peer whose connection must end.

    Attributes:
        is_handshake: Whether the handshake failed.
    """

    def __init__(self, reason: str, *, is_handshake: bool = False) -> None:
        super().__init__(reason)
        self.is_handshake = is_handshake


def is_older(greeting: bytes | bytearray) -> bool:
    """Return whether a peer's greeting is not that of ZMTP 3, but older."""
    return greeting[0] != 0xFF or not greeting[9] & 1 or greeting[10] < _VERSION


def head_size(flags: int) -> int:
    """Return how many bytes of a frame come before its body: flags and length."""
    return 9 if flags & _LONG else 2


def frame(body: bytes, flags: int = 0) -> bytes:
    """Return a frame."""
    if len(body) > 0xFF:
        size = len(body).to_bytes(8, "big")
        return bytes((flags | _LONG,)) + size + body
    return bytes((flags, len(body))) + body


def _property(name: bytes, value: bytes) -> bytes:
    """Return a property of `READY`."""
    return bytes((len(name),)) + name + len(value).to_bytes(4, "big") + value


_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + _NULL + bytes(32)
_ROUTER = _property(b"Socket-Type", b"ROUTER") + _property(b"Identity", b"")
HELLO = _GREETING + frame(_READY + _ROUTER, _COMMAND)
"""What the server sends first."""
PING = frame(_PING + bytes(_TTL), _COMMAND)
"""Asks a peer whether it is still there."""


def message(payload: bytes, *, has_envelope: bool) -> bytes:
    """Return the frames of a message.

    Args:
        payload: The message.
        has_envelope: Whether an empty frame comes first, as REQ has it.
    """
    return frame(b"", _MORE) + frame(payload) if has_envelope else frame(payload)


class Peer:
    """A peer: `receive` takes what arrives, `next_message` returns its messages.

    Args:
        longest: Bytes of a frame.
        most: Frames of a message.
        send: Sends bytes to the peer.

    Attributes:
        is_ready: Whether the handshake is over.
    """

    def __init__(self, longest: int, most: int, send: Callable[[bytes], None]) -> None:
        self.is_ready = False
        self._longest = longest
        self._most = most
        self._send = send
        self._is_greeted = False
        self._data = bytearray()
        self._parts: list[bytes] = []
        self._commands = Bucket(_COMMANDS_PER_SECOND, _COMMANDS)

    def receive(self, data: bytes) -> None:
        """Take bytes, whose messages `next_message` then returns."""
        self._data += data

    def next_message(self) -> list[bytes] | None:
        """Return the next message that is whole, as its frames; None if there is none yet.

        Raises:
            PeerError: If the connection must end.
        """
        if not self._is_greeted:
            self._read_greeting()
        while self._is_greeted and (found := self._next_frame()):
            flags, body = found
            if flags & _COMMAND:
                if not self._commands.take():
                    raise PeerError("too many commands")
                self._obey(body)
                continue
            if not self.is_ready:
                raise PeerError("a message before READY", is_handshake=True)
            parts = self._parts
            parts.append(body)
            if len(parts) > self._most:
                raise PeerError("a message has too many parts")
            if not flags & _MORE:
                self._parts = []
                return parts
        return None

    def _read_greeting(self) -> None:
        data = self._data
        if len(data) < GREETING:
            return
        if is_older(data):
            raise PeerError(OLDER)
        if data[_MECHANISM] != _NULL:
            raise PeerError("another mechanism", is_handshake=True)
        del data[:GREETING]
        self._is_greeted = True

    def _next_frame(self) -> tuple[int, bytes] | None:
        """Take a whole frame, its flags and content; None if there is none yet."""
        data = self._data
        if len(data) < 2:
            return None
        flags = data[0]
        head = head_size(flags)
        if len(data) < head:
            return None
        size = int.from_bytes(data[1:head], "big")
        if size > (_LONGEST_COMMAND if flags & _COMMAND else self._longest):
            raise PeerError("a message is too long")
        if len(data) < head + size:
            return None
        body = bytes(data[head : head + size])
        del data[: head + size]
        return flags, body

    def _obey(self, command: bytes) -> None:
        """Carry out a command; others than these have no meaning for a ROUTER."""
        if not self.is_ready:
            if not command.startswith(_READY):
                raise PeerError("another command than READY", is_handshake=True)
            kind = _properties(command[len(_READY) :]).get(b"socket-type", b"")
            if kind not in _CALLERS:
                raise PeerError("another kind of socket", is_handshake=True)
            self.is_ready = True
        elif command.startswith(_PING):
            context = command[len(_PING) + _TTL :]
            self._send(frame(_PONG + context, _COMMAND))


def _properties(data: bytes) -> dict[bytes, bytes]:
    """Read the properties of `READY`, by their names in lower case.

    Raises:
        PeerError: If they break off.
    """
    found = {}
    at = 0
    while at < len(data):
        name_end = at + 1 + data[at]
        value = name_end + 4
        end = value + int.from_bytes(data[name_end:value], "big")
        if end > len(data):
            raise PeerError("READY breaks off", is_handshake=True)
        found[data[at + 1 : name_end].lower()] = data[value:end]
        at = end
    return found
