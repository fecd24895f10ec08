"""The file of a saved hand: a head that every version can read, and the records."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TypeVar

import msgspec

from handmap_core.errors import HandError
from handmap_core.models import FollowerModel, encode, unpacked
from .records import HandFile, RobotFile

KIND = "handmap hand"
HAND = 9
ROBOT = 10
_FORMS = {HAND: ("one hand", "load"), ROBOT: ("a robot with two hands", "load_robot")}
"""What files of each form have, and what reads them."""

_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What msgspec raises at bytes that are not what was expected: nested ones, and other texts."""

AnyFile = TypeVar("AnyFile", HandFile, RobotFile)


class _Head(msgspec.Struct, frozen=True):
    """What a file has.

    Attributes:
        kind: `KIND`.
        version: Version of the library that saved it: another one may have other fields.
        checksum: CRC-32 of `body` and `core`, behind each other.
        body: A `HandFile` or a `RobotFile`, in msgpack again.
        form: Form of `body`. Files of forms 1 and 2 had fields by name, without types; the first
            ones did not name it. Those of 3 and 4 had one rest posture for all samples, those of
            5 and 6 no segments of fingers for a thumb to lie on, and those of 7 and 8 no `core`.
        core: A `FollowerModel`, in msgpack again, which C++ reads (`handmap/saved_hand.hpp`); empty
            where only Python follows.
    """

    kind: str
    version: str
    checksum: int
    body: bytes
    form: int = 1
    core: bytes = b""


def library_version() -> str:
    """Return the version of the library, which is that of its core."""
    # Files that are no saved hand are refused without it.
    from importlib.metadata import version

    return version("handmap-core")


def written(
    content: HandFile | RobotFile, follower: FollowerModel | None = None
) -> bytes:
    """Return the bytes of a file.

    Args:
        content: What Python follows by.
        follower: What C++ follows by; None where it cannot.
    """
    body = encode(content)
    part = b"" if follower is None else encode(follower)
    form = HAND if isinstance(content, HandFile) else ROBOT
    checksum = zlib.crc32(part, zlib.crc32(body))
    head = _Head(KIND, library_version(), checksum, body, form, part)
    return msgspec.msgpack.encode(head)


def read(path: Path, kind: type[AnyFile]) -> AnyFile:
    """Read a file.

    Args:
        path: The file.
        kind: What it must have.

    Raises:
        HandError: If it is none, a damaged one, of another form, or of another version.
        OSError: If it cannot be read.
    """
    body = _checked_body(path, HAND if kind is HandFile else ROBOT)
    try:
        return msgspec.msgpack.decode(body, type=kind, ext_hook=unpacked)
    except _UNREADABLE as error:
        raise misfit(path, error) from error


def misfit(path: Path, error: Exception) -> HandError:
    """Return the error of a file that does not fit this version."""
    problem = f"it does not fit this version ({error}); {_save_again()}"
    return HandError(problem, file=path)


def _save_again() -> str:
    return f"save it again, by handmap-qp {library_version()}"


def _checked_body(path: Path, form: int) -> bytes:
    """Return the body of a file that is whole, and of a form."""
    try:
        head = msgspec.msgpack.decode(path.read_bytes(), type=_Head)
    except _UNREADABLE:
        head = None
    if head is None or head.kind != KIND:
        expected = "expected a saved hand (handmap hands save)"
        raise HandError(f"{expected}, got another or a damaged file", file=path)
    if head.form > max(_FORMS):
        newer = f"it is of form {head.form}, expected {max(_FORMS)} or less"
        raise HandError(f"{newer}; install a newer handmap-core", file=path)
    if head.version != library_version():
        other = f"it is of version {head.version}, expected {library_version()}"
        raise HandError(f"{other}; {_save_again()}", file=path)
    if head.form not in _FORMS:
        older = f"it is of form {head.form}, expected {' or '.join(map(str, _FORMS))}"
        raise HandError(f"{older}; {_save_again()}", file=path)
    if zlib.crc32(head.core, zlib.crc32(head.body)) != head.checksum:
        raise HandError("it is damaged; copy it again", file=path)
    if head.form != form:
        name, function = _FORMS[head.form]
        raise HandError(f"it is {name}; {function} reads it", file=path)
    return head.body
