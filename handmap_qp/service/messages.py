"""The messages of the mapping service as types, with their decoding and checks.

They travel as msgpack (ZeroMQ, WebSocket binary) or JSON (WebSocket text). `type` is the name of
the class in lower case. Requests with unknown fields are refused; replies may get further fields.
SI and radians; poses are of the wrist frame. `schema` describes the types.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

import msgspec

PROTOCOL = 2
"""Version of the messages."""
PROTOCOLS = (1, 2)
"""Versions that the server answers. Version 2 adds `stop` and `clear`."""
TOPIC_END = b"\0"
"""Separator between a session's name and the message in its stream."""


def _doc(text: str, **bounds: Any) -> msgspec.Meta:
    return msgspec.Meta(description=text, **bounds)


Vector = tuple[float, float, float]
Numbers = Annotated[tuple[float, ...], msgspec.Meta(max_length=256)]
Points = Annotated[tuple[Vector, ...], msgspec.Meta(max_length=256)]
Values = Annotated[tuple[float, ...], msgspec.Meta(max_length=1024)]
Preset = Annotated[str, msgspec.Meta(max_length=64)]
Length = Annotated[float, msgspec.Meta(gt=0, le=1)]
Gap = Annotated[float, msgspec.Meta(ge=0, le=0.04)]
Duration = Annotated[float, msgspec.Meta(ge=0, le=3600)]
Matrix = tuple[tuple[float, ...], ...]
_NAME = "1 to 64 of A-Z a-z 0-9 _ . -"
Name = Annotated[str, msgspec.Meta(title=_NAME, pattern=r"^[A-Za-z0-9_.-]{1,64}\Z")]


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rigid pose in a right-handed world."""

    position: Annotated[Vector, _doc("Origin [m].")]
    quat_xyzw: Annotated[tuple[float, float, float, float], _doc("Unit quaternion, scalar last.")]


class Lengths(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A measured hand of a person: rows thumb, index, middle, ring, little.

    Lengths are those of a right hand; mirror a left one in x = 0.
    """

    bases: Annotated[
        tuple[Vector, Vector, Vector, Vector, Vector],
        _doc("First joint of each finger in the palm frame [m]."),
    ]
    segments: Annotated[
        tuple[Vector, Vector, Vector, Vector, Vector], _doc("Bone lengths outwards from there [m].")
    ]
    rolls: Annotated[
        tuple[float, float, float, float, float],
        _doc("Turn of each finger's joint axes about the palm's y axis [rad]."),
    ] = (0.0, 0.0, 0.0, 0.0, 0.0)


class Request(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field="type",
    tag=str.lower,
):
    """A request of a client."""

    protocol: Annotated[int, _doc("Version of the messages.")]
    seq: Annotated[
        int, _doc("Number of the request, increasing; the answer has it too.", ge=1, le=2**53)
    ]
    session: Annotated[
        str,
        _doc(
            "Secret of the session: 16 to 64 random characters that its client chose.",
            max_length=64,
        ),
    ] = ""


def _rename_options(request: Open | Configure) -> None:
    """Take options by the names that they had before methods could be added."""
    if request.mapping or request.teleoperation:
        if isinstance(request, Open) and request.preset is None:
            preset = "paper" if request.mapping else "teleoperation"
            msgspec.structs.force_setattr(request, "preset", preset)
        options = request.mapping | request.teleoperation | request.options
        msgspec.structs.force_setattr(request, "options", options)


def misplaced_option(request: Open, preset: str) -> str:
    """Return the field of an option that a former name gives to another preset; empty if none."""
    wrong = "mapping" if preset == "teleoperation" else "teleoperation"
    return next((f"{wrong}.{name:.64}" for name in sorted(getattr(request, wrong))), "")


def field_of_option(request: Open, option: str) -> str:
    """Return the field in which a request gives options of the method, by the name it used."""
    former = (name for name in ("mapping", "teleoperation") if getattr(request, name))
    return f"{next(former, 'options')}.{option:.64}"


class Open(Request, frozen=True):
    """Open a session: one human hand that leads one robot hand. The answer is `opened`."""

    robot: Annotated[str, _doc("Name of a robot hand on the server.", max_length=64)]
    name: Annotated[
        Name | None,
        _doc("Public name of the session and its stream; the server makes one if omitted."),
    ] = None
    input: Annotated[Literal["q", "landmarks", "points"], _doc("What samples hold.")] = "q"
    layout: Annotated[
        Name | None,
        _doc(
            "Layout of the numbers in `values`, such as webxr25 (`handmap layouts` lists them); "
            "only with input=landmarks, whose 21 landmarks it replaces."
        ),
    ] = None
    side: Annotated[Literal["right", "left"], _doc("The human hand.")] = "right"
    hand_length: Annotated[Length | None, _doc("From wrist crease to middle fingertip [m].")] = None
    lengths: Annotated[
        Lengths | None,
        _doc("The measured hand. With neither, the first landmarks measure it."),
    ] = None
    contact_gap: Annotated[
        Gap | None,
        _doc(
            "Distance of thumb and finger landmarks where the skin touches [m]. Without it, and "
            "without the option of teleoperation, touches measure it during the session."
        ),
    ] = None
    human_points: Annotated[Name | None, _doc("Set of reference points on the human hand.")] = None
    robot_points: Annotated[Name | None, _doc("Set of reference points on the robot hand.")] = None
    mount: Annotated[
        Literal["floating", "fixed"] | None,
        _doc("Mount of the robot's wrist, in place of the hand's own."),
    ] = None
    preset: Annotated[
        Preset | None,
        _doc(
            "What the mapping is for; see the list. If omitted: teleoperation if the robot's "
            "fingers have partners, else object, or fixed_wrist if its wrist is fixed; another one "
            "if `options` has what this one does not have."
        ),
    ] = None
    options: Annotated[
        dict[str, Any], _doc("Options of the preset's method; others are the preset's.")
    ] = {}
    mapping: Annotated[
        dict[str, Any], _doc("Former name of `options`; without `preset`, for the preset paper.")
    ] = {}
    teleoperation: Annotated[
        dict[str, Any], _doc("Former name of `options` for the preset teleoperation.")
    ] = {}
    ik: Annotated[
        dict[str, Any],
        _doc("Fields of IkOptions; others are the preset's. The solver must be daqp."),
    ] = {}
    robot_q: Annotated[
        Numbers | None, _doc("Joint angles where the robot is now [rad]; at rest if omitted.")
    ] = None
    robot_wrist: Annotated[
        Pose | None, _doc("Pose of its wrist; at the palm of the first sample if omitted.")
    ] = None
    restore: Annotated[
        bool,
        _doc(
            "Continue where the last session of this name left the robot: its owner in the same "
            "epoch, without keys others too, in a new one, when the owner is silent for 2 s."
        ),
    ] = False
    is_released: Annotated[bool, _doc("Start released: the robot holds still until `clutch`.")] = (
        False
    )
    max_dt: Annotated[
        float,
        _doc(
            "Longest time that one command may account for [s]; about two samples.", ge=1e-4, le=1
        ),
    ] = 1 / 30
    time_from: Annotated[
        Literal["server", "client"],
        _doc("Clock for speed limits; `client` needs --simulated-time."),
    ] = "server"
    watchdog: Annotated[
        float, _doc("Time without a sample after which the robot holds [s].", ge=0.01, le=10)
    ] = 0.25
    return_after: Annotated[
        Duration | None,
        _doc("Time of a hold after which the robot returns to rest [s]; null for never."),
    ] = None
    return_speed: Annotated[
        float, _doc("Share of its speed limits that it returns at.", gt=0, le=1)
    ] = 0.1
    resume: Annotated[
        Literal["follow", "clutch"],
        _doc("After a hold: follow the human, or take a new reference."),
    ] = "follow"
    has_detail: Annotated[bool, _doc("Whether commands carry every stage of the mapping.")] = False
    is_shared: Annotated[
        bool, _doc("Whether others may release, clutch, configure and clear it by its name.")
    ] = False

    def __post_init__(self) -> None:
        """Take options by their former names."""
        _rename_options(self)


class Step(Request, frozen=True):
    """One sample of the human hand: `q`, `landmarks` or `points`, as `open` chose.

    The answer is `command`.
    """

    time: Annotated[float, _doc("Time stamp of any clock of the client [s].")]
    q: Annotated[
        Numbers | None, _doc("Joint angles in the order of `human_joint_names` [rad].")
    ] = None
    landmarks: Annotated[
        Points | None,
        _doc("21 landmarks in MediaPipe's order [m]; may be omitted if `valid` is false."),
    ] = None
    points: Annotated[
        Points | None, _doc("Reference points in the order of `human_point_names` [m].")
    ] = None
    values: Annotated[
        Values | None,
        _doc("Numbers of the session's `layout`, row by row, in its axes and unit."),
    ] = None
    wrist: Annotated[
        Pose | None,
        _doc(
            "The human's wrist: required with `q`; optional with `landmarks`, whose palm gives it "
            "otherwise; with `points`, required by teleoperation and rigid_from=wrist. With "
            "`values`, in the axes and unit of the layout."
        ),
    ] = None
    valid: Annotated[
        bool, _doc("Whether the tracker saw the hand; only with `landmarks`. If not, it holds.")
    ] = True
    confidence: Annotated[
        float, _doc("The tracker's own confidence; 0 counts as not seen.", ge=0, le=1)
    ] = 1.0


class Sample(Step, frozen=True):
    """A sample without an answer: its command is in the stream.

    If several samples wait, the newest is mapped.
    """


class Named(Request, frozen=True, kw_only=True):
    """A request that clients other than the session's own may send too.

    It is idempotent, because such requests have no protection against repetition.
    """

    name: Annotated[Name | None, _doc("Public name of a session, in place of the secret.")] = None


class Clutch(Named, frozen=True):
    """Engage, or engage again: the next sample is the reference.

    The robot continues from where it is. With the presets teleoperation and object only the palm
    has a reference: the fingers go to the human's posture within their speed limits.
    """


class Release(Named, frozen=True):
    """Disengage: the robot holds its posture until `clutch`."""


class Stop(Named, frozen=True):
    """Emergency stop: the robot brakes and holds its posture, whatever comes, until `clear`.

    Every client that is admitted may stop every session by its name. Without name and session, all
    sessions are stopped. The stop outlives the client, the session and, with `--state`, the server.
    The session's owner and supervisors may clear it, and everyone if the session is shared.
    """

    reason: Annotated[str, _doc("Reason for the log.", max_length=200)] = ""


class Clear(Named, frozen=True):
    """Clear an emergency stop on purpose. The robot is then released: `clutch` engages it."""

    stop: Annotated[int, _doc("Number of the stop, as `status` reports it.", ge=1)]


class Configure(Named, frozen=True):
    """Change options: the reference stays, and the robot continues from where it is."""

    preset: Annotated[
        Preset | None,
        _doc(
            "Another preset, with its own options where none are given here. `max_acceleration` "
            "and `avoids_self_collision` stay."
        ),
    ] = None
    options: Annotated[
        dict[str, Any],
        _doc("Options of the preset's method; without `preset`, others stay as they are."),
    ] = {}
    mapping: Annotated[dict[str, Any], _doc("Former name of `options`.")] = {}
    teleoperation: Annotated[dict[str, Any], _doc("Former name of `options`.")] = {}
    ik: Annotated[
        dict[str, Any], _doc("Fields of IkOptions; without `preset`, others stay as they are.")
    ] = {}
    has_detail: Annotated[
        bool | None, _doc("Whether commands carry every stage of the mapping.")
    ] = None

    def __post_init__(self) -> None:
        """Take options by their former names."""
        _rename_options(self)


class Reset(Request, frozen=True):
    """Start again: the next sample is the reference."""

    robot_q: Annotated[
        Numbers | None,
        _doc("Joint angles where the robot is now [rad]. Without them, it stays where it is."),
    ] = None
    robot_wrist: Annotated[
        Pose | None,
        _doc("Pose of its wrist. Without both, the robot moves to rest within its speed limits."),
    ] = None


class Status(Named, frozen=True):
    """Ask for the state of a session; of the server without one. The answer is `state`."""


class Close(Request, frozen=True):
    """End the session."""


class Subscribe(Request, frozen=True):
    """Subscribe to the stream of a session (WebSocket only)."""

    name: Annotated[Name, _doc("Public name of a session.")]


class Reply(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    """A reply of the server. Clients ignore fields that they do not know."""

    seq: Annotated[int, _doc("Number of the request that it answers.")] = 0


class Opened(Reply, frozen=True):
    """The session is open."""

    name: Annotated[str, _doc("Public name of the session and its stream.")]
    joint_names: Annotated[
        tuple[str, ...],
        _doc("The robot's joints as its URDF names them, in the order of every robot q."),
    ]
    lower: Annotated[Numbers, _doc("Their lower limits [rad].")]
    upper: Annotated[Numbers, _doc("Their upper limits [rad].")]
    speed: Annotated[Numbers, _doc("Their speed limits [rad/s].")]
    q: Annotated[
        Numbers,
        _doc("Assumed posture of the robot [rad]; compare it with the real one before you engage."),
    ]
    human_joint_names: Annotated[tuple[str, ...], _doc("Order of a sample's `q`.")]
    human_point_names: Annotated[tuple[str, ...], _doc("Order of a sample's `points`.")]
    is_floating: Annotated[bool, _doc("Whether the robot's wrist is free to move.")]
    stream_port: Annotated[
        int, _doc("Port of the stream of commands (ZeroMQ PUB); 0 on WebSocket.")
    ] = 0
    stop_time: Annotated[
        float,
        _doc("Longest time in which the robot stops, whatever limits are configured [s]."),
    ] = 0.0
    stop_distance: Annotated[
        Numbers, _doc("How far each joint moves at most meanwhile [rad].")
    ] = ()


class Detail(msgspec.Struct, frozen=True, kw_only=True):
    """Every stage of a step. Matrices are row by row."""

    human_points: Annotated[Points, _doc("In the human's world [m].")]
    human_q: Annotated[Numbers | None, _doc("Joint angles [rad]; null if the sample had none.")]
    human_wrist: Annotated[
        Pose | None, _doc("In the human's world, given or fitted to landmarks; null if not known.")
    ]
    landmarks: Annotated[Points | None, _doc("As in the sample; null if it had none.")]
    motion: Annotated[
        Matrix,
        _doc(
            "T (eqs. 5-6), 4x4: from the reference; in teleoperation and with reference=rest, from "
            "the human's rest posture with the palm of the reference."
        ),
    ]
    motion_rigid: Annotated[
        Matrix, _doc("T_rb (eq. 2), 4x4; in teleoperation the motion of the palm.")
    ]
    motion_deformation: Annotated[
        Matrix, _doc("T_def (eq. 2), 4x4; in teleoperation all the rest of T.")
    ]
    stretches: Annotated[Numbers, _doc("Of T, before clamping.")]
    pivot: Annotated[
        Vector, _doc("Image of the human's pivot under T, about which it deforms [m].")
    ]
    targets: Annotated[
        Points, _doc("Targets of the robot points that the method moves (eq. 7) [m].")
    ]
    points: Annotated[Points, _doc("The same points after the step [m].")]


class Command(Reply, frozen=True):
    """A command for the robot's driver."""

    name: Annotated[str, _doc("Public name of the session.")]
    time: Annotated[float, _doc("Time stamp of the sample that it answers [s].")]
    server_time: Annotated[float, _doc("Time of the command on the server's monotonic clock [s].")]
    joint_names: Annotated[tuple[str, ...], _doc("As the URDF names them, in the order of `q`.")]
    q: Annotated[Numbers, _doc("Joint angles [rad].")]
    wrist: Annotated[
        Pose | None, _doc("The wrist frame in the robot's world; null before it is known.")
    ]
    status: Annotated[
        str,
        _doc(
            "converged, limited, unreachable, unsettled, failed, released, held, gliding, "
            "hold, returning, stopped or calibrating."
        ),
    ]
    flags: Annotated[
        tuple[str, ...], _doc("Conditions that a driver should know; see the list.")
    ] = ()
    point_error: Annotated[
        Numbers, _doc("Distance of each robot point that the method moves from its target [m].")
    ] = ()
    residual: Annotated[
        float, _doc("Residual of T: RMS over the human points that it is estimated from [m].")
    ] = 0.0
    at_limit: Annotated[tuple[str, ...], _doc("Joints at a position or speed limit.")] = ()
    out_of_range: Annotated[
        tuple[str, ...], _doc("Human joints outside their limits, within the tolerance.")
    ] = ()
    epoch: Annotated[
        int,
        _doc(
            "Commands are continuous within an epoch; if it changes, the robot state was "
            "re-initialised."
        ),
    ] = 0
    dt: Annotated[float, _doc("Time granted to the speed limits [s].")] = 0.0
    solve_time: Annotated[float, _doc("Time spent on the mapping [s].")] = 0.0
    detail: Annotated[
        Detail | None, _doc("Every stage of the mapping, if `has_detail` is set.")
    ] = None
    rule: Annotated[
        str, _doc("What is wrong with the sample: one of the rules in the list; empty if nothing.")
    ] = ""
    consistency: Annotated[
        float | None,
        _doc("RMS difference of bones and palm from the person's [m]; null if not measured."),
    ] = None
    confidence: Annotated[float, _doc("Confidence of the sample, as the client sent it.")] = 1.0


class About(msgspec.Struct, frozen=True, kw_only=True):
    """The hands and options of a session, for clients that watch it."""

    robot: Annotated[str, _doc("Name of the robot hand.")]
    side: Annotated[str, _doc("The human hand.")]
    input: Annotated[str, _doc("Kind of the samples.")]
    layout: Annotated[str | None, _doc("Layout of the samples' values; null for none.")] = None
    lengths: Annotated[Lengths | None, _doc("The measured human hand; null for the model's own.")]
    human_points: Annotated[
        str | None, _doc("Set of reference points on the human hand; null for the default one.")
    ]
    robot_points: Annotated[
        str | None, _doc("Set of reference points on the robot hand; null for the default one.")
    ]
    mount: Annotated[str | None, _doc("Mount of the robot's wrist; null for the hand's own.")]
    preset: Annotated[str, _doc("The preset in force.")]
    options: Annotated[
        dict[str, Any], _doc("All options of its method; in JSON, null stands for infinity.")
    ]
    mapping: Annotated[
        dict[str, Any], _doc("Former name of `options`, empty in teleoperation.")
    ] = {}
    teleoperation: Annotated[
        dict[str, Any], _doc("Former name of `options`, empty in other presets.")
    ] = {}
    ik: Annotated[dict[str, Any], _doc("All of IkOptions.")]
    has_detail: Annotated[bool, _doc("Whether commands carry every stage of the mapping.")]
    is_shared: Annotated[
        bool, _doc("Whether others may release, clutch, configure and clear the session.")
    ]

    def __post_init__(self) -> None:
        """Give options their former names too."""
        former = "teleoperation" if self.preset == "teleoperation" else "mapping"
        msgspec.structs.force_setattr(self, former, self.options)


class State(Reply, frozen=True):
    """The state of a session or of the server."""

    version: Annotated[str, _doc("Version of the package on the server.")]
    uptime: Annotated[float, _doc("Time since the session was opened, or the server started [s].")]
    names: Annotated[tuple[str, ...], _doc("The session's name, or those of all open sessions.")]
    mode: Annotated[
        str,
        _doc(
            "waiting, following, released, hold, returning, stopped, calibrating; of the server: "
            "serving."
        ),
    ] = "serving"
    counts: Annotated[
        dict[str, int],
        _doc("Numbers of samples answered, replaced by newer ones, refused, and so on."),
    ] = {}
    robots: Annotated[
        tuple[str, ...], _doc("Robot hands that clients may open; only of the server.")
    ] = ()
    missing: Annotated[
        dict[str, str],
        _doc("Robot hands that are not installed, and what installs each; only of the server."),
    ] = {}
    is_released: Annotated[
        bool, _doc("Whether the robot is released, also while the watchdog holds it.")
    ] = False
    stop: Annotated[
        int, _doc("Number of the emergency stop in force, which `clear` takes; 0 for none.")
    ] = 0
    protocols: Annotated[
        tuple[int, ...], _doc("Versions of the messages that the server answers.")
    ] = PROTOCOLS
    q: Annotated[Numbers, _doc("Joint angles of the last command [rad].")] = ()
    stream_port: Annotated[int, _doc("Port of the streams (ZeroMQ PUB).")] = 0
    about: Annotated[About | None, _doc("Hands and options of the session.")] = None


class Done(Reply, frozen=True):
    """The server carried the request out."""


class Error(Reply, frozen=True):
    """The server refused the request; the session is unchanged."""

    code: Annotated[str, _doc("One word; see the list.")]
    message: Annotated[str, _doc("What was expected, and what was received.")]
    field: Annotated[
        str, _doc("The field at fault, such as `q[3]` or `mapping.ridge`; empty if there is none.")
    ] = ""
    protocols: Annotated[
        tuple[int, ...], _doc("With the code `protocol`: the versions that the server answers.")
    ] = ()


AnyReply = Opened | Command | State | Done | Error
AnyRequest = (
    Open
    | Step
    | Sample
    | Clutch
    | Release
    | Stop
    | Clear
    | Configure
    | Reset
    | Status
    | Close
    | Subscribe
)

LARGEST = 1e3
"""Largest coordinate [m] and angle [rad]; larger numbers are mistakes."""
_LARGEST_VALUE = 1e6
"""Largest number of a layout, in millimetres or degrees too."""
LATEST = 1e15
"""Largest time stamp [s]."""
_QUAT_TOLERANCE = 1e-2
_STOP_PROTOCOL = 2


class _Head(msgspec.Struct):
    """The fields that identify a request which is invalid elsewhere."""

    protocol: Any = None
    seq: Any = 0


# Invalid UTF-8 and excessive nesting raise errors other than msgspec's.
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
        payload: The message as received.
        is_json: Whether it is JSON; msgpack otherwise.

    Returns:
        The request; or the error to answer with, which has the field at fault, and the number of
        the request if it can be read.
    """
    if isinstance(payload, str):
        payload = payload.encode(errors="replace")
    try:
        request = _DECODE[is_json](payload)
    except msgspec.ValidationError as error:
        protocol, seq = _head(payload, is_json)
        if type(protocol) is int and protocol not in PROTOCOLS:
            return _wrong_protocol(seq, protocol)
        message, path = split_validation_error(error)
        return Error(seq=seq, code="invalid", message=_explain(message, path), field=path)
    except _UNREADABLE as error:
        kind = "JSON" if is_json else "msgpack"
        return Error(code="invalid", message=f"not a {kind} message: {error}"[:200])
    is_newer = isinstance(request, Stop | Clear) and request.protocol < _STOP_PROTOCOL
    if request.protocol not in PROTOCOLS or is_newer:
        return _wrong_protocol(request.seq, request.protocol)
    found = _bad_number(request)
    if found is not None:
        field, message = found
        return Error(seq=request.seq, code="invalid", message=message, field=field)
    return request


def encode_reply(reply: AnyReply, *, is_json: bool = False) -> bytes:
    """Encode one reply."""
    return _ENCODE[is_json](reply)


def _head(payload: bytes, is_json: bool) -> tuple[Any, int]:
    """Return protocol and number of a request that is invalid elsewhere."""
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
        message=f"expected version {' or '.join(map(str, PROTOCOLS))}, got {protocol}",
        protocols=PROTOCOLS,
    )


def split_validation_error(error: msgspec.ValidationError) -> tuple[str, str]:
    """Split the text of msgspec's error into its message and the path of the value at fault.

    msgspec has no attributes for them. It appends a JSON path to its message, as in "Expected
    `float`, got `str` - at `$.q[1]`". For a missing or unknown field of the message itself, it
    quotes the field instead, as in "Object missing required field `time`".

    Returns:
        The message, and a path such as `q[1]`; the path of the message as a whole is empty.
    """
    message, separator, path = str(error).rpartition(" - at `$")
    if separator:
        return message, path.rstrip("`").lstrip(".")
    named = re.search(r"field `(\w+)`$", path)
    return path, named[1] if named else ""


def _explain(message: str, path: str) -> str:
    """Replace messages of msgspec that would not help a client."""
    if "matching regex" in message:
        return f"expected {_NAME}"
    if path == "name" and message.startswith("Object contains unknown field"):
        return (
            "by a session's name you may only watch it, and steer it if it is shared; "
            "this request requires its secret"
        )
    return message


def _bad_number(request: Request) -> tuple[str, str] | None:
    """Return field and message of the first number that is not finite, or out of range.

    Also check the norm of quaternions.
    """
    if isinstance(request, Step):
        if not abs(request.time) <= LATEST:
            return "time", f"expected a number within {LATEST:g} of 0, got {request.time:g}"
        return (
            _bad_row("q", request.q)
            or _bad_points("landmarks", request.landmarks)
            or _bad_points("points", request.points)
            or _bad_row("values", request.values, _LARGEST_VALUE)
            or _bad_pose("wrist", request.wrist)
        )
    if isinstance(request, Open) and request.lengths is not None:
        lengths = request.lengths
        found = (
            _bad_points("lengths.bases", lengths.bases)
            or _bad_points("lengths.segments", lengths.segments)
            or _bad_row("lengths.rolls", lengths.rolls)
        )
        if found is not None:
            return found
    if isinstance(request, Open | Reset):
        return _bad_row("robot_q", request.robot_q) or _bad_pose("robot_wrist", request.robot_wrist)
    return None


def _bad_row(
    field: str, row: tuple[float, ...] | None, largest: float = LARGEST
) -> tuple[str, str] | None:
    # `not a <= b` also rejects NaN.
    for i, value in enumerate(row or ()):
        if not -largest <= value <= largest:
            return f"{field}[{i}]", f"expected a number within {largest:g} of 0, got {value:g}"
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
