"""The messages of the mapping service, as types.

What decodes and checks them, and what the schema is made of.

They travel as msgpack (ZeroMQ, WebSocket binary) or JSON (WebSocket text). `type` tells which one
it is: the class's name in lower case. Requests with unknown fields are refused; replies may grow
fields. SI and radians; poses are of the wrist frame.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

import msgspec

PROTOCOL = 1
"""Version of the messages; the server answers no other."""
TOPIC_END = b"\0"
"""What stands between a session's name and the message in its stream."""


def _doc(text: str, **bounds: Any) -> msgspec.Meta:
    return msgspec.Meta(description=text, **bounds)


Vector = tuple[float, float, float]
Numbers = Annotated[tuple[float, ...], msgspec.Meta(max_length=256)]
Points = Annotated[tuple[Vector, ...], msgspec.Meta(max_length=256)]
Length = Annotated[float, msgspec.Meta(gt=0, le=1)]
Duration = Annotated[float, msgspec.Meta(ge=0, le=3600)]
Matrix = tuple[tuple[float, ...], ...]
_NAME = "1 to 64 of A-Z a-z 0-9 _ . -"
Name = Annotated[str, msgspec.Meta(title=_NAME, pattern=r"^[A-Za-z0-9_.-]{1,64}\Z")]


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rigid pose in a right-handed world."""

    position: Annotated[Vector, _doc("Origin [m].")]
    quat_xyzw: Annotated[
        tuple[float, float, float, float], _doc("Unit quaternion, its scalar last.")
    ]


class Lengths(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A person's hand, measured: rows thumb, index, middle, ring, little.

    As a right hand (a left one mirrored in x = 0).
    """

    bases: Annotated[
        tuple[Vector, Vector, Vector, Vector, Vector],
        _doc("First joint of each finger in the palm frame [m]."),
    ]
    segments: Annotated[
        tuple[Vector, Vector, Vector, Vector, Vector], _doc("Bone lengths outwards from there [m].")
    ]


class Request(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field="type",
    tag=str.lower,
):
    """What a client asks."""

    protocol: Annotated[int, _doc("Version of the messages.")]
    seq: Annotated[
        int, _doc("Number of the request, which the answer bears too; increases.", ge=1, le=2**53)
    ]
    session: Annotated[
        str,
        _doc(
            "Secret of the session: 16 to 64 random characters that its client chose.",
            max_length=64,
        ),
    ] = ""


class Open(Request, frozen=True):
    """Open a session: one human hand that leads one robot hand. Answered by `opened`."""

    robot: Annotated[str, _doc("A robot hand that the server knows by name.", max_length=64)]
    name: Annotated[
        Name | None,
        _doc("Public name of the session and of its stream; the server makes one if omitted."),
    ] = None
    input: Annotated[Literal["q", "landmarks", "points"], _doc("What samples hold.")] = "q"
    side: Annotated[Literal["right", "left"], _doc("The human hand.")] = "right"
    hand_length: Annotated[Length | None, _doc("From wrist crease to middle fingertip [m].")] = None
    lengths: Annotated[
        Lengths | None,
        _doc("The hand, measured. With neither, landmarks of the first samples give it."),
    ] = None
    human_points: Annotated[Name | None, _doc("Set of reference points on the human hand.")] = None
    robot_points: Annotated[Name | None, _doc("Set of reference points on the robot hand.")] = None
    mount: Annotated[
        Literal["floating", "fixed"] | None, _doc("The robot's wrist, overriding the hand's own.")
    ] = None
    mapping: Annotated[dict[str, Any], _doc("Fields of MappingOptions.")] = {}
    ik: Annotated[dict[str, Any], _doc("Fields of IkOptions; its solver is daqp.")] = {}
    robot_q: Annotated[
        Numbers | None, _doc("Where the robot is now [rad]; at rest if omitted.")
    ] = None
    robot_wrist: Annotated[
        Pose | None, _doc("Where its wrist is; at the first sample's palm if omitted.")
    ] = None
    restore: Annotated[
        bool,
        _doc(
            "Go on where the last session of this name left the robot; it ends, if its client is silent."
        ),
    ] = False
    is_released: Annotated[bool, _doc("Start released: the robot holds still until `clutch`.")] = (
        False
    )
    max_dt: Annotated[
        float,
        _doc("Most time that one command may account for [s]: about two samples.", ge=1e-4, le=1),
    ] = 1 / 30
    time_from: Annotated[
        Literal["server", "client"], _doc("Clock that speed limits count in; `client` needs leave.")
    ] = "server"
    watchdog: Annotated[
        float, _doc("Without a sample for so long, the robot holds [s].", ge=0.01, le=10)
    ] = 0.25
    return_after: Annotated[
        Duration | None, _doc("After holding for so long, it returns to rest [s].")
    ] = None
    return_speed: Annotated[
        float, _doc("Part of its speed limits that it returns at.", gt=0, le=1)
    ] = 0.1
    resume: Annotated[
        Literal["follow", "clutch"], _doc("After a hold: go after the human, or a new reference.")
    ] = "follow"
    has_detail: Annotated[bool, _doc("Whether commands carry every stage of the mapping.")] = False
    is_shared: Annotated[
        bool, _doc("Whether others may release, clutch and configure the session, by its name.")
    ] = False


class Step(Request, frozen=True):
    """One sample of the human hand: the one of `q`, `landmarks`, `points` that `open` named.

    Answered by `command`.
    """

    time: Annotated[float, _doc("Time stamp, of any clock of the client's [s].")]
    q: Annotated[
        Numbers | None, _doc("Joint angles in the order of `human_joint_names` [rad].")
    ] = None
    landmarks: Annotated[Points | None, _doc("21 landmarks in MediaPipe's order [m].")] = None
    points: Annotated[
        Points | None, _doc("Reference points in the order of `human_point_names` [m].")
    ] = None
    wrist: Annotated[
        Pose | None,
        _doc("The human's wrist; must come with `q`, may with `points`, not with `landmarks`."),
    ] = None


class Sample(Step, frozen=True):
    """The same without an answer: the command comes in the stream.

    Of several that wait, the newest counts.
    """


class Named(Request, frozen=True, kw_only=True):
    """What others than its client may ask of a session too.

    Asked twice, it is done twice, which does no harm.
    """

    name: Annotated[Name | None, _doc("Public name of a session, in place of the secret.")] = None


class Clutch(Named, frozen=True):
    """Take hold (again).

    The next sample is the reference, and the robot goes on from where it is.
    """


class Release(Named, frozen=True):
    """Let go: the robot holds still until `clutch`."""


class Configure(Named, frozen=True):
    """Change options: the reference stays what it was, and the robot goes on from where it is."""

    mapping: Annotated[
        dict[str, Any], _doc("Fields of MappingOptions; others stay as they are.")
    ] = {}
    ik: Annotated[dict[str, Any], _doc("Fields of IkOptions; others stay as they are.")] = {}
    has_detail: Annotated[
        bool | None, _doc("Whether commands carry every stage of the mapping.")
    ] = None


class Reset(Request, frozen=True):
    """Start anew: the next sample is the reference."""

    robot_q: Annotated[
        Numbers | None,
        _doc("Where the robot is now [rad]; if omitted it goes to rest within its limits."),
    ] = None
    robot_wrist: Annotated[Pose | None, _doc("Where its wrist is; if omitted it stays.")] = None


class Status(Named, frozen=True):
    """Ask how a session is, or without one the server. Answered by `state`."""


class Close(Request, frozen=True):
    """End the session."""


class Subscribe(Request, frozen=True):
    """WebSocket only: send the stream of the session of this name too."""

    name: Annotated[Name, _doc("Public name of a session.")]


class Reply(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    """What the server says. Clients skip fields that they do not know."""

    seq: Annotated[int, _doc("Number of the request answered.")] = 0


class Opened(Reply, frozen=True):
    """The session is open."""

    name: Annotated[str, _doc("Public name of the session and of its stream.")]
    joint_names: Annotated[
        tuple[str, ...],
        _doc("The robot's joints as its URDF names them, in the order of every robot q."),
    ]
    lower: Annotated[Numbers, _doc("Their lower limits [rad].")]
    upper: Annotated[Numbers, _doc("Their upper limits [rad].")]
    speed: Annotated[Numbers, _doc("Their speed limits [rad/s].")]
    q: Annotated[
        Numbers,
        _doc(
            "Where the robot is taken to be [rad]: compare it with the real one before you engage."
        ),
    ]
    human_joint_names: Annotated[tuple[str, ...], _doc("Order of a sample's `q`.")]
    human_point_names: Annotated[tuple[str, ...], _doc("Order of a sample's `points`.")]
    is_floating: Annotated[bool, _doc("Whether the robot's wrist is free to move.")]
    stream_port: Annotated[
        int, _doc("Port of the stream of commands (ZeroMQ PUB); 0 on WebSocket.")
    ] = 0


class Detail(msgspec.Struct, frozen=True, kw_only=True):
    """Every stage of a step, for those who watch. Matrices row by row."""

    human_points: Annotated[Points, _doc("In the human's world [m].")]
    human_q: Annotated[Numbers | None, _doc("[rad]; null where the sample was points.")]
    human_wrist: Annotated[Pose | None, _doc("In the human's world; null where nothing needed it.")]
    motion: Annotated[Matrix, _doc("T (eqs. 5-6), 4x4.")]
    motion_rigid: Annotated[Matrix, _doc("T_rb (eq. 2), 4x4.")]
    motion_deformation: Annotated[Matrix, _doc("T_def (eq. 2), 4x4.")]
    stretches: Annotated[Numbers, _doc("Of T, before clamping.")]
    pivot: Annotated[Vector, _doc("Where T takes the human's pivot, about which it deforms [m].")]
    targets: Annotated[Points, _doc("Where the robot's reference points should be (eq. 7) [m].")]
    points: Annotated[Points, _doc("Where the mapping has them [m].")]


class Command(Reply, frozen=True):
    """What a robot's driver takes."""

    name: Annotated[str, _doc("Public name of the session.")]
    time: Annotated[float, _doc("Time stamp of the sample answered [s].")]
    server_time: Annotated[
        float, _doc("When the command was made, on the server's monotonic clock [s].")
    ]
    joint_names: Annotated[tuple[str, ...], _doc("As the URDF names them, in the order of `q`.")]
    q: Annotated[Numbers, _doc("Joint angles [rad].")]
    wrist: Annotated[
        Pose | None, _doc("The wrist frame in the robot's world; null before it is known.")
    ]
    status: Annotated[
        str,
        _doc(
            "converged, limited, unreachable, unsettled, failed, released; hold, returning or calibrating."
        ),
    ]
    flags: Annotated[tuple[str, ...], _doc("What else a driver should know; see the list.")] = ()
    point_error: Annotated[
        Numbers, _doc("Distance of each reference point from its target [m].")
    ] = ()
    residual: Annotated[
        float, _doc("How far the human's motion is from a linear one: RMS over its points [m].")
    ] = 0.0
    at_limit: Annotated[tuple[str, ...], _doc("Joints that a position or speed limit holds.")] = ()
    out_of_range: Annotated[
        tuple[str, ...], _doc("Human joints outside their limits, within the tolerance.")
    ] = ()
    epoch: Annotated[
        int,
        _doc(
            "Only commands of one epoch are near each other: in another, the robot was said to be elsewhere."
        ),
    ] = 0
    dt: Annotated[float, _doc("Time that the speed limits were granted [s].")] = 0.0
    solve_time: Annotated[float, _doc("Time spent on the mapping [s].")] = 0.0
    detail: Annotated[Detail | None, _doc("Every stage, where `has_detail` asks for it.")] = None


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What a session maps, for those who look on."""

    robot: Annotated[str, _doc("Name of the robot hand.")]
    side: Annotated[str, _doc("The human hand.")]
    input: Annotated[str, _doc("What samples hold.")]
    lengths: Annotated[Lengths | None, _doc("The human hand, measured; null for the model's own.")]
    human_points: Annotated[
        str | None, _doc("Set of reference points on the human hand; null for the usual one.")
    ]
    robot_points: Annotated[
        str | None, _doc("Set of reference points on the robot hand; null for the usual one.")
    ]
    mount: Annotated[str | None, _doc("The robot's wrist; null for the hand's own.")]
    mapping: Annotated[
        dict[str, Any], _doc("All of MappingOptions; in JSON, null stands for what is infinite.")
    ]
    ik: Annotated[dict[str, Any], _doc("All of IkOptions.")]
    has_detail: Annotated[bool, _doc("Whether commands carry every stage of the mapping.")]
    is_shared: Annotated[
        bool, _doc("Whether others may release, clutch and configure the session.")
    ]


class State(Reply, frozen=True):
    """How a session is, or the server."""

    version: Annotated[str, _doc("Of the package on the server.")]
    uptime: Annotated[float, _doc("Of the session, or the server [s].")]
    names: Annotated[tuple[str, ...], _doc("The session's name, or those of all open sessions.")]
    mode: Annotated[
        str,
        _doc("waiting, following, released, hold, returning, calibrating; serving for the server."),
    ] = "serving"
    counts: Annotated[
        dict[str, int], _doc("Samples answered, replaced by newer ones, refused, and so on.")
    ] = {}
    robots: Annotated[
        tuple[str, ...], _doc("Robot hands that can be opened; of the server only.")
    ] = ()
    is_released: Annotated[
        bool, _doc("Whether the session was let go, also while its watchdog holds the robot.")
    ] = False
    q: Annotated[Numbers, _doc("The session's last command [rad].")] = ()
    stream_port: Annotated[int, _doc("Port of the streams (ZeroMQ PUB).")] = 0
    about: Annotated[About | None, _doc("What the session maps.")] = None


class Done(Reply, frozen=True):
    """The request was carried out."""


class Error(Reply, frozen=True):
    """The request was not carried out; the session goes on as it was."""

    code: Annotated[str, _doc("One word; see the list.")]
    message: Annotated[str, _doc("What was expected, and what came.")]
    field: Annotated[
        str, _doc("The field at fault, as `q[3]` or `mapping.ridge`; empty where none is.")
    ] = ""


AnyReply = Opened | Command | State | Done | Error
AnyRequest = (
    Open | Step | Sample | Clutch | Release | Configure | Reset | Status | Close | Subscribe
)

LARGEST = 1e3
"""Farthest that a coordinate may be from the origin [m], and the largest angle [rad].

Beyond it, numbers are mistakes.
"""
LATEST = 1e15
"""Farthest that a time stamp may be from 0 [s]."""
_QUAT_TOLERANCE = 1e-2


class _Head(msgspec.Struct):
    """What a message that cannot be read whole may still tell."""

    protocol: Any = None
    seq: Any = 0


# Texts that are no UTF-8 and depths that no message has are told by errors of their own.
_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
_DECODE = {
    False: msgspec.msgpack.Decoder(AnyRequest).decode,
    True: msgspec.json.Decoder(AnyRequest).decode,
}
_DECODE_HEAD = {
    False: msgspec.msgpack.Decoder(_Head).decode,
    True: msgspec.json.Decoder(_Head).decode,
}
_ENCODE = {False: msgspec.msgpack.Encoder().encode, True: msgspec.json.Encoder().encode}


def decode_request(payload: bytes | str, *, is_json: bool = False) -> AnyRequest | Error:
    """Read and check one request.

    Args:
        payload: What came over the wire.
        is_json: Whether it is JSON; msgpack otherwise.

    Returns:
        The request; or the error to answer with, which names the field and bears the request's
        number where that can be told.
    """
    try:
        request = _DECODE[is_json](payload)
    except msgspec.ValidationError as error:
        protocol, seq = _head(payload, is_json)
        if type(protocol) is int and protocol != PROTOCOL:
            return _wrong_protocol(seq, protocol)
        message, _, place = str(error).partition(" - at `$")
        field = place.rstrip("`").lstrip(".") or _field_in(message)
        return Error(seq=seq, code="invalid", message=_in_words(message, place), field=field)
    except _UNREADABLE as error:
        kind = "JSON" if is_json else "msgpack"
        return Error(code="invalid", message=f"is no {kind} message: {error}"[:200])
    if request.protocol != PROTOCOL:
        return _wrong_protocol(request.seq, request.protocol)
    found = _bad_number(request)
    if found is not None:
        field, message = found
        return Error(seq=request.seq, code="invalid", message=message, field=field)
    return request


def encode_reply(reply: AnyReply, *, is_json: bool = False) -> bytes:
    """One reply as it goes over the wire."""
    return _ENCODE[is_json](reply)


def _head(payload: bytes | str, is_json: bool) -> tuple[Any, int]:
    """Protocol and number of a request that is wrong elsewhere."""
    try:
        head = _DECODE_HEAD[is_json](payload)
    except _UNREADABLE:
        return None, 0
    return head.protocol, head.seq if type(head.seq) is int and 0 <= head.seq <= 2**53 else 0


def _wrong_protocol(seq: int, protocol: int) -> Error:
    return Error(
        seq=seq,
        code="protocol",
        field="protocol",
        message=f"expected version {PROTOCOL}, got {protocol}",
    )


def _field_in(message: str) -> str:
    """The field that msgspec names in its message where the place is the message as a whole."""
    named = re.search(r"field `(\w+)`", message)
    return named[1] if named else ""


def _in_words(message: str, place: str) -> str:
    """What msgspec says of a mistake, where its own words would not help."""
    if "matching regex" in message:
        return f"expected {_NAME}"
    if message == "Object contains unknown field `name`" and not place:
        return "by a session's name you may only watch it, and steer it if it is shared; this asks for its secret"
    return message


def _bad_number(request: Request) -> tuple[str, str] | None:
    """The first number that is not finite, much too large, or part of a quaternion that is none."""
    if isinstance(request, Step):
        if not abs(request.time) <= LATEST:
            return "time", f"expected a number within {LATEST:g} of 0, got {request.time:g}"
        return (
            _bad_row("q", request.q)
            or _bad_points("landmarks", request.landmarks)
            or _bad_points("points", request.points)
            or _bad_pose("wrist", request.wrist)
        )
    if isinstance(request, Open) and request.lengths is not None:
        lengths = request.lengths
        found = _bad_points("lengths.bases", lengths.bases) or _bad_points(
            "lengths.segments", lengths.segments
        )
        if found is not None:
            return found
    if isinstance(request, Open | Reset):
        return _bad_row("robot_q", request.robot_q) or _bad_pose("robot_wrist", request.robot_wrist)
    return None


def _bad_row(field: str, row: tuple[float, ...] | None) -> tuple[str, str] | None:
    # A NaN is within nothing.
    for i, value in enumerate(row or ()):
        if not -LARGEST <= value <= LARGEST:
            return f"{field}[{i}]", f"expected a number within {LARGEST:g} of 0, got {value:g}"
    return None


def _bad_points(field: str, points: tuple[Vector, ...] | None) -> tuple[str, str] | None:
    for i, point in enumerate(points or ()):
        found = _bad_row(f"{field}[{i}]", point)
        if found is not None:
            return found
    return None


def _bad_pose(field: str, pose: Pose | None) -> tuple[str, str] | None:
    if pose is None:
        return None
    norm = math.hypot(*pose.quat_xyzw)
    if not abs(norm - 1.0) <= _QUAT_TOLERANCE:
        return f"{field}.quat_xyzw", f"expected a unit quaternion, got norm {norm:g}"
    return _bad_row(f"{field}.position", pose.position)
