"""The messages of the mapping service as types, which server and client share.

They travel as msgpack (ZeroMQ, WebSocket binary) or JSON (WebSocket text). `type` is the name of
the class in lower case. Requests with unknown fields are refused; replies may get further fields.
SI and radians; poses are of the wrist frame. `handmap serve --schema` prints these descriptions.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta, Struct
from msgspec.structs import fields, force_setattr

PROTOCOL = 2
"""Version of the messages."""
PROTOCOLS = (1, 2)
"""Versions that the server answers. Version 2 adds `stop` and `clear`."""
TOPIC_END = b"\0"
"""Separator between a session's name and the message in its stream."""

LARGEST = 1e3
"""Largest coordinate [m] and angle [rad] of a request; larger numbers are mistakes."""
# Bounds also reject NaN.
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Place = tuple[Number, Number, Number]
Angles = Annotated[tuple[Number, ...], Meta(max_length=256)]
FingerPlaces = tuple[Place, Place, Place, Place, Place]
Places = Annotated[tuple[Place, ...], Meta(max_length=256)]
# Numbers of a layout may be in millimetres or degrees.
Value = Annotated[float, Meta(ge=-1e6, le=1e6)]
Values = Annotated[tuple[Value, ...], Meta(max_length=1024)]
Stamp = Annotated[float, Meta(ge=-1e15, le=1e15)]
Vector = tuple[float, float, float]
Names = tuple[str, ...]
Numbers = tuple[float, ...]
Points = tuple[Vector, ...]
Short = Annotated[str, Meta(max_length=64)]
Preset = Short
Length = Annotated[float, Meta(gt=0.0, le=1.0)]
Gap = Annotated[float, Meta(ge=0.0, le=0.04)]
Confidence = Annotated[float, Meta(ge=0.0, le=1.0)]
Side = Literal["right", "left"]
Forces = Annotated[
    dict[Short, Annotated[float, Meta(ge=0.0, le=LARGEST)]], Meta(max_length=32)
]
Efforts = Annotated[dict[Short, Confidence], Meta(max_length=32)]
HAPTICS_END = "/haptics"
"""Follows a session's name in the topic of its haptics; no name of a session has a slash."""
HAPTICS_LIFE = 0.2
"""Time after which haptics no longer count [s]: a robot whose driver ends must not be felt."""
Duration = Annotated[float, Meta(ge=0.0, le=3600.0)]
Matrix = tuple[tuple[float, ...], ...]
Options = dict[str, Any]
"""Options by name."""
PROTECTING = ("max_acceleration", "avoids_self_collision")
"""Fields of `ik` that protect the robot: another preset leaves them as they are."""
SETUP = ("alignment",)
"""Options that describe the setup: another preset leaves them as they are."""
NAME = "1 to 64 of A-Z a-z 0-9 _ . -"
Name = Annotated[str, Meta(title=NAME, pattern=r"^[A-Za-z0-9_.-]{1,64}\Z")]
Solid = Annotated[
    str,
    Meta(
        title="such as box:0.03x0.04x0.1, sphere:0.04, cylinder:0.04x0.1",
        pattern=r"^(box|sphere|cylinder):[0-9.x]{1,32}\Z",
    ),
]
Upright = Annotated[
    str,
    Meta(
        title="such as +y up, -z forward",
        pattern=r"^[+-]([xyz]) up, [+-](?!\1)[xyz] forward\Z",
    ),
]


class Pose(Struct, frozen=True, forbid_unknown_fields=True):
    """A rigid pose in a right-handed world.

    Attributes:
        position: Origin [m].
        quat_xyzw: Unit quaternion, scalar last.
    """

    position: Vector
    quat_xyzw: tuple[float, float, float, float]

    @property
    def matrix(self) -> np.ndarray:
        """Return the pose as a homogeneous matrix, shape (4, 4)."""
        norm = math.hypot(*self.quat_xyzw)
        x, y, z, w = (part / norm for part in self.quat_xyzw)
        a, b, c = 2.0 * x, 2.0 * y, 2.0 * z
        across, up, along = self.position
        # For so few numbers, numpy takes several times as long as plain floats.
        rows = [
            [1.0 - b * y - c * z, a * y - c * w, a * z + b * w, across],
            [a * y + c * w, 1.0 - a * x - c * z, b * z - a * w, up],
            [a * z - b * w, b * z + a * w, 1.0 - a * x - b * y, along],
            [0.0, 0.0, 0.0, 1.0],
        ]
        return np.array(rows)

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> "Pose":
        """Convert a rigid transformation, shape (4, 4), which is not checked."""
        (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = matrix.tolist()
        # Each row is the quaternion times four times one of its parts, x, y, z and w. That of the
        # largest part is never small (Shepperd 1978); its part is four times the square.
        rows = (
            (1.0 + a - e - i, b + d, c + g, h - f),
            (b + d, 1.0 - a + e - i, f + h, c - g),
            (c + g, f + h, 1.0 - a - e + i, d - b),
            (h - f, c - g, d - b, 1.0 + a + e + i),
        )
        squares = rows[0][0], rows[1][1], rows[2][2], rows[3][3]
        qx, qy, qz, qw = row = rows[squares.index(max(squares))]
        norm = math.hypot(*row)
        return cls((x, y, z), (qx / norm, qy / norm, qz / norm, qw / norm))

    @classmethod
    def of(cls, pose: "Pose | npt.ArrayLike", name: str = "pose") -> "Pose":
        """Convert a homogeneous matrix, or seven numbers.

        Args:
            pose: Shape (4, 4), or shape (7,): x y z qx qy qz qw.
            name: Name of the argument, for the error message.

        Raises:
            ValueError: If it is not a rigid pose.
        """
        if isinstance(pose, Pose):
            return pose
        try:
            values = np.asarray(pose, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{name}: expected numbers, got {type(pose).__name__}"
            ) from error
        if values.shape == (7,):
            return cls(tuple(values[:3].tolist()), tuple(values[3:].tolist()))
        if values.shape != (4, 4):
            raise ValueError(
                f"{name}: expected shape (4, 4), or 7 numbers, got shape {values.shape}"
            )
        R = values[:3, :3]
        # Many trackers send zeros when tracking is lost. `not a <= b` also rejects NaN.
        if not (
            np.abs(R.T @ R - np.eye(3)).max() <= 1e-3
            and np.linalg.det(R) > 0.0
            and (values[3] == (0, 0, 0, 1)).all()
        ):
            raise ValueError(
                f"{name}: expected a rotation and a translation, got {values.tolist()}"
            )
        return cls.from_matrix(values)


class Lengths(Struct, frozen=True, forbid_unknown_fields=True):
    """A measured hand of a person: rows thumb, index, middle, ring, little.

    Lengths are those of a right hand; mirror a left one in x = 0.

    Attributes:
        bases: First joint of each finger in the palm frame [m].
        segments: Bone lengths outwards from there [m].
        rolls: Turn of each finger's joint axes about the palm's y axis [rad].
        palm_weights: Weight of each finger's first joint where the palm is fitted, from 0 to 1; the
            thumb's is not used.
    """

    bases: FingerPlaces
    segments: FingerPlaces
    rolls: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)
    palm_weights: tuple[Number, Number, Number, Number, Number] = (
        1.0,
        1.0,
        1.0,
        1.0,
        1.0,
    )


class Request(
    Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field="type",
    tag=str.lower,
):
    """A request of a client.

    Attributes:
        protocol: Version of the messages.
        seq: Number of the request, increasing; the answer has it too.
        session: Secret of the session: 16 to 64 random characters that its client chose.
    """

    protocol: int
    seq: Annotated[int, Meta(ge=1, le=2**53)]
    session: Short = ""


Former = Annotated[Options, Meta()]
"""A former name of `options`: that of a preset, or `mapping` for the preset paper."""


def _rename_options(request: "Open | Configure") -> None:
    """Replace former names of options, and of what they are set to, by their present ones."""
    if isinstance(request, Open) and request.resume == "clutch":
        force_setattr(request, "resume", "engage")
    for former in FORMER:
        if given := getattr(request, former):
            force_setattr(request, "options", given | request.options)
            force_setattr(request, former, {})
            if isinstance(request, Open) and request.preset is None:
                preset = "paper" if former == "mapping" else former
                force_setattr(request, "preset", preset)


class Open(Request):
    """Open a session: one human hand controls a robot hand, or both a robot; answered by `opened`.

    Attributes:
        robot: Name of a robot hand on the server, or of its family, such as `allegro`; then the
            hand of `side` is meant. Or of a robot with two hands; this one needs input=landmarks,
            and its samples have `hands`.
        name: Public name of the session and its stream; the server makes one if omitted.
        input: What samples hold; joint angles `q` if omitted.
        layout: Layout of the numbers in `values`, such as webxr25 (`handmap layouts` lists them);
            only with input=landmarks, whose 21 landmarks it replaces.
        upright: Axes of the samples' world that are up and forward; the layout's if omitted, else
            not known. For an arm, they set the option `alignment`.
        side: The human hand that controls a robot hand; the right one if omitted.
        hand_length: From wrist crease to middle fingertip [m].
        lengths: The measured hand, or both. With neither, the first landmarks measure it: each hand
            by its own, and a hand that was not seen enough is taken to be as large as the other.
        contact_gap: Distance of thumb and finger landmarks where the skin touches [m]. Without it,
            and without the option of teleoperation, touches measure it during the session.
        human_points: Set of reference points on the human hand.
        robot_points: Set of reference points on the robot hand.
        mount: Mount of the robot's wrist, in place of the hand's own.
        preset: What the mapping is for; see the list. If omitted: teleoperation if the robot's
            fingers have partners, else object, or fixed_wrist if its wrist is fixed; another one if
            `options` has what this one does not have.
        options: Options of the preset's method; others are the preset's.
        mapping: Former name of `options`; without `preset`, for the preset paper.
        teleoperation: Former name of `options` for the preset teleoperation.
        ik: Fields of IkOptions; others are the preset's. The solver must be daqp.
        robot_q: Joint angles where the robot is now [rad]; at rest if omitted.
        robot_wrist: Pose of its wrist; at the palm of the first sample if omitted.
        restore: Continue where the last session of this name left the robot: its owner in the same
            epoch, without keys others too, in a new one, when the owner is silent for 2 s.
        is_released: Start disengaged: the robot holds still until `engage`.
        max_dt: Longest time that one command may account for [s], about two samples; 1/30 if
            omitted.
        time_from: Clock for speed limits; the server's if omitted, and `client` needs
            --simulated-time.
        watchdog: Time without a sample after which the robot holds [s]; 0.25 if omitted.
        return_after: Time of a hold after which the robot returns to rest [s]; never if omitted.
        return_speed: Share of its speed limits that it returns at; 0.1 if omitted.
        resume: After a hold: follow the human, as if omitted, or `engage` again, which takes a new
            reference; `clutch` is its former name.
        has_detail: Whether commands carry every stage of the mapping.
        is_shared: Whether others may engage, disengage, configure and clear it by its name.
        following_error: Distance from all commands of the last 50 ms at which a measured joint does
            not follow [rad], at most half of its range. The robot then holds where it is
            (`not_following`) until `engage` or `reset`, as where measurements stay away for 150 ms.
            If omitted, errors are only reported. An object in the hand stops joints, too.
        following_time: How long it must last [s]; 0.05 if omitted.
        grip: Fields of GripOptions: thumb and finger hold what they meet, by `measured_q` of
            samples or a driver's `measured`, or all press on an `object`. If omitted, they do so
            wherever joints are measured and the hand can; false: never. Only with input=landmarks,
            as is `object`.
        object: The object that the person holds: `box:0.05`, `box:0.03x0.04x0.1`, `sphere:0.04`,
            `cylinder:0.04x0.1`, or the vertices of its convex hull [m]; samples have `object_pose`.
    """

    robot: Short
    name: Name | None = None
    input: Literal["q", "landmarks", "points"] = "q"
    layout: Name | None = None
    upright: Upright | None = None
    side: Side = "right"
    hand_length: Length | None = None
    lengths: Lengths | None = None
    contact_gap: Gap | None = None
    human_points: Name | None = None
    robot_points: Name | None = None
    mount: Literal["floating", "fixed"] | None = None
    preset: Preset | None = None
    options: Options = {}
    mapping: Former = {}
    teleoperation: Former = {}
    ik: Options = {}
    robot_q: Angles | None = None
    robot_wrist: Pose | None = None
    restore: bool = False
    is_released: bool = False
    max_dt: Annotated[float, Meta(ge=0.0001, le=1.0)] = 1 / 30
    time_from: Literal["server", "client"] = "server"
    watchdog: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.25
    return_after: Duration | None = None
    return_speed: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    resume: Literal["follow", "engage", "clutch"] = "follow"
    has_detail: bool = False
    is_shared: bool = False
    following_error: Annotated[float, Meta(gt=0.0)] | None = None
    following_time: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.05
    grip: Options | bool | None = None
    object: Solid | Places | None = None

    __post_init__ = _rename_options


FORMER = [field.name for field in fields(Open) if field.type is Former]
"""Former names of `options`."""


def with_changes(opened: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of the `open` that opens a session with changed options.

    A preset replaces all options but those that protect the robot, and of the setup.

    Args:
        opened: Fields of `open`, with all changes before.
        changes: Fields of `configure`; None and no options change nothing.
    """
    wanted = dict(opened)
    if changes.get("preset"):
        for of in wanted.keys() & {"options", *FORMER, "ik"}:
            given = wanted[of]
            wanted[of] = {n: given[n] for n in (*PROTECTING, *SETUP) if n in given}
    for name in Configure.__annotations__:
        if (value := changes.get(name)) not in (None, {}):
            is_options = isinstance(value, dict)
            wanted[name] = (wanted.get(name) or {}) | value if is_options else value
    return wanted


class HandSample(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One hand of a sample of both; its fields are as those of `step`.

    Attributes:
        landmarks: 21 landmarks [m]; may be omitted if `valid` is false.
        values: Numbers of the session's `layout`, in place of landmarks.
        wrist: The human's wrist; the landmarks of the palm give it if omitted.
        valid: Whether the tracker saw the hand. If not, this side of the robot holds.
        confidence: The tracker's own confidence; 0 counts as not seen.
    """

    landmarks: Places | None = None
    values: Values | None = None
    wrist: Pose | None = None
    valid: bool = True
    confidence: Confidence = 1.0


class Step(Request):
    """One sample of the human hand: `q`, `landmarks` or `points`, as `open` chose; or of both.

    The answer is `command`.

    Attributes:
        time: Time stamp of any clock of the client [s].
        q: Joint angles in the order of `human_joint_names` [rad].
        landmarks: 21 landmarks in MediaPipe's order [m]; may be omitted if `valid` is false.
        points: Reference points in the order of `human_point_names` [m].
        values: Numbers of the session's `layout`, row by row, in its axes and unit.
        wrist: The human's wrist: required with `q`; optional with `landmarks`, whose palm gives it
            otherwise; with `points`, required by teleoperation and rigid_from=wrist. With `values`,
            in the axes and unit of the layout.
        valid: Whether the tracker saw the hand; only with `landmarks`. If not, it holds.
        confidence: The tracker's own confidence; 0 counts as not seen.
        base: Where the floating base of a robot is in its world; as it was if omitted.
        hands: One or both hands by side, in place of all fields above but `time`; for a robot with
            two hands. Without one of them, its side of the robot goes on to what it was asked for
            last, and holds after 0.25 s.
        measured_q: Joint angles that the robot has now [rad], as in `measured`. With `grip`, either
            is required.
        object_centre: Middle of what the robot is to grip, in its world [m], if it is known: pads
            that close near it meet around it; only where joints are measured.
        object_deviation: Standard deviation of that along each axis [m]; 5 mm if omitted.
        object_pose: Pose of the person's `object`, in the axes of the landmarks; if it is omitted,
            the object is not seen.
    """

    time: Stamp
    q: Angles | None = None
    landmarks: Places | None = None
    points: Places | None = None
    values: Values | None = None
    wrist: Pose | None = None
    valid: bool = True
    confidence: Confidence = 1.0
    base: Pose | None = None
    hands: dict[Side, HandSample] | None = None
    measured_q: Angles | None = None
    object_centre: Place | None = None
    object_deviation: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    object_pose: Pose | None = None


class Sample(Step):
    """A sample without an answer: its command is in the stream.

    If several samples wait, the newest is mapped.
    """


class Named(Request, kw_only=True):
    """A request that clients other than the session's own may send too.

    It is idempotent, because such requests have no protection against repetition.

    Attributes:
        name: Public name of a session, in place of the secret.
    """

    name: Name | None = None


class Engage(Named):
    """Engage, or engage again: the next sample is the reference.

    The robot continues from where it is. With the presets teleoperation and object only the palm
    has a reference: the fingers go to the human's posture within their speed limits.
    """


class Clutch(Engage):
    """Former name of `engage`, which servers of earlier versions know alone."""


class Disengage(Named):
    """Disengage: the robot holds its posture until `engage`."""


class Release(Disengage):
    """Former name of `disengage`, which servers of earlier versions know alone."""


class Stop(Named):
    """Emergency stop: the robot brakes and holds its posture, whatever comes, until `clear`.

    Every client that is admitted may stop every session by its name. Without name and session, all
    sessions are stopped. The stop outlives the client, the session and, with `--state`, the server.
    The session's owner and supervisors may clear it, and everyone if the session is shared.

    Attributes:
        reason: Reason for the log.
    """

    reason: Annotated[str, Meta(max_length=200)] = ""


class Clear(Named):
    """Clear an emergency stop on purpose. The robot is then disengaged until `engage`.

    Attributes:
        stop: Number of the stop, as `status` reports it.
    """

    stop: Annotated[int, Meta(ge=1)]


class Configure(Named):
    """Change options: the reference stays, and the robot continues from where it is.

    Attributes:
        preset: Another preset, with its own options where none are given here. `max_acceleration`
            and `avoids_self_collision` stay.
        options: Options of the preset's method; without `preset`, others stay as they are.
        mapping: Former name of `options`.
        teleoperation: Former name of `options`.
        ik: Fields of IkOptions; without `preset`, others stay as they are.
        has_detail: Whether commands carry every stage of the mapping.
        grip: Fields of GripOptions, of a session that has a grip; others stay as they are.
    """

    preset: Preset | None = None
    options: Options = {}
    mapping: Former = {}
    teleoperation: Former = {}
    ik: Options = {}
    has_detail: bool | None = None
    grip: Options = {}

    __post_init__ = _rename_options


class Reset(Request):
    """Start again: the next sample is the reference.

    Attributes:
        robot_q: Joint angles where the robot is now [rad]. Without them, it stays where it is.
        robot_wrist: Pose of its wrist. Without both, the robot moves to rest within its speed
            limits.
    """

    robot_q: Angles | None = None
    robot_wrist: Pose | None = None


class Measured(Named):
    """Where the robot's joints are, as its driver reads them, in each period of its own.

    The session's owner and supervisors may say it by their keys, and everyone if the session is
    shared. A driver that has begun to must go on.

    Attributes:
        measured_q: Joint angles in the order of `joint_names` [rad].
    """

    measured_q: Angles


class Touch(Named):
    """What the fingers of the robot feel, as its driver or a simulation measures it.

    The server keeps nothing of it: who subscribed to the session's haptics gets `haptics`. The
    session's owner and supervisors may say it by their keys, and everyone if the session is shared.
    Say it again within 0.2 s, or it no longer counts. `forces` or `efforts` is required; fingers
    that are not named feel nothing.

    Attributes:
        time: Time stamp of the sender [s].
        forces: Contact force of fingers by name [N], at least 0. A robot with two hands has names
            such as `left.thumb`.
        efforts: Load of fingers by name, as a share of the largest, 0 to 1.
    """

    time: Stamp = 0.0
    forces: Forces | None = None
    efforts: Efforts | None = None


class Status(Named):
    """Ask for the state of a session; of the server without one. The answer is `state`."""


class Close(Request):
    """End the session."""


class Subscribe(Request):
    """Subscribe to the stream of a session (WebSocket only).

    Attributes:
        name: Public name of a session.
        stream: Its commands, or its haptics.
    """

    name: Name
    stream: Literal["commands", "haptics"] = "commands"


class Reply(Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    """A reply of the server. Clients ignore fields that they do not know.

    Attributes:
        seq: Number of the request that it answers.
    """

    seq: int = 0


class Fist(Struct, frozen=True):
    """How long the robot hand takes from a flat hand to a fist at its joints' speed limits.

    Attributes:
        time: Time of the joint that takes longest [s].
        joint: Its name.
        is_slow: Whether people are faster, so that the robot's fingers follow late.
        is_assumed: Whether the speed limits are assumed, and so the time is.
    """

    time: float
    joint: str
    is_slow: bool = False
    is_assumed: bool = False


class AssumedSpeed(Struct, frozen=True):
    """How often speed limits that are only assumed held the robot.

    Attributes:
        share: Share of the session's samples in which an assumed speed limit held a joint.
        joint: The joint that was held most often; empty if none was.
        is_often: Whether the share of enough samples is large enough to tell people.
    """

    share: float
    joint: str = ""
    is_often: bool = False


class Opened(Reply):
    """The session is open.

    Attributes:
        name: Public name of the session and its stream.
        joint_names: The robot's joints as its URDF names them, in the order of every robot q.
        lower: Their lower limits [rad].
        upper: Their upper limits [rad].
        speed: Their speed limits [rad/s].
        q: Assumed posture of the robot [rad]; compare it with the real one before you engage.
        human_joint_names: Order of a sample's `q`; of a robot with two hands, both have these.
        human_point_names: Order of a sample's `points`.
        is_floating: Whether the robot's wrist is free to move.
        stream_port: Port of the stream of commands (ZeroMQ PUB); 0 on WebSocket.
        stop_time: Longest time in which the robot stops, whatever limits are configured [s].
        stop_distance: How far each joint moves at most meanwhile [rad].
        fist: How long the robot takes for a fist; null if not known.
    """

    name: str
    joint_names: Names
    lower: Numbers
    upper: Numbers
    speed: Numbers
    q: Numbers
    human_joint_names: Names
    human_point_names: Names
    is_floating: bool
    stream_port: int = 0
    stop_time: float = 0.0
    stop_distance: Numbers = ()
    fist: Fist | None = None


class Detail(Struct, frozen=True, kw_only=True):
    """Every stage of a step. Matrices are row by row.

    Attributes:
        human_points: In the human's world [m].
        human_q: Joint angles [rad]; null if the sample had none.
        human_wrist: In the human's world, given or fitted to landmarks; null if not known.
        landmarks: As in the sample; null if it had none.
        motion: T (eqs. 5-6), 4x4: from the reference; in teleoperation and with reference=rest,
            from the human's rest posture with the palm of the reference.
        motion_rigid: T_rb (eq. 2), 4x4; in teleoperation the motion of the palm.
        motion_deformation: T_def (eq. 2), 4x4; in teleoperation all the rest of T.
        stretches: Of T, before clamping.
        pivot: Image of the human's pivot under T, about which it deforms [m].
        targets: Targets of the robot points that the method moves (eq. 7) [m].
        points: The same points after the step [m].
        held_by: Both links of the pair that keeps the hand from its targets; empty if none does.
    """

    human_points: Points
    human_q: Numbers | None
    human_wrist: Pose | None
    landmarks: Points | None
    motion: Matrix
    motion_rigid: Matrix
    motion_deformation: Matrix
    stretches: Numbers
    pivot: Vector
    targets: Points
    points: Points
    held_by: Names = ()


class HandState(Struct, frozen=True):
    """One hand of a robot with two hands, as the mapping has it.

    Attributes:
        status: As in `command`, for this hand; `released` if the whole robot brakes.
        rule: What is wrong with its sample; empty if nothing.
        wrist: Its wrist frame in the robot's world [m].
        wrist_error: How far that is from its target [m, rad].
        arm_held_by: What keeps it off its target: speed, limit or reach; empty if nothing.
        detail: Every stage of its step, if `has_detail` is set; null without a sample that counts.
    """

    status: str
    rule: str
    wrist: Pose
    wrist_error: Numbers
    arm_held_by: str
    detail: Detail | None = None


class Command(Reply):
    """A command for the robot's driver.

    Attributes:
        name: Public name of the session.
        time: Time stamp of the sample that it answers [s].
        server_time: Time of the command on the server's monotonic clock [s], by 1 us at least later
            than that of the command before.
        joint_names: As the URDF names them, in the order of `q`.
        q: Joint angles [rad].
        wrist: The wrist frame in the robot's world; null before it is known. That of the first hand
            of a robot with two.
        status: converged, limited, unreachable, unsettled, failed, released, held, gliding, hold,
            returning, stopped, not_following or calibrating.
        flags: Conditions that a driver should know; see the list.
        point_error: Distance of each robot point that the method moves from its target [m].
        residual: Residual of T: RMS over the human points that it is estimated from [m].
        at_limit: Joints at a position or speed limit.
        out_of_range: Human joints outside their limits, within the tolerance.
        epoch: Commands are continuous within an epoch; if it changes, the robot state was
            re-initialised.
        dt: Time granted to the speed limits [s].
        solve_time: Time spent on the mapping [s].
        detail: Every stage of the mapping, if `has_detail` is set; of two hands, `hands` has them.
        rule: What is wrong with the sample: one of the rules in the list; empty if nothing.
        consistency: RMS difference of bones and palm from the person's [m]; null if not measured.
        confidence: Confidence of the sample, as the client sent it.
        wrist_error: How far the wrist is from its target [m, rad]; empty if no sample was
            mapped.
        arm_held_by: What keeps the wrist of an arm off its target: speed, limit or reach; empty if
            nothing.
        hands: Each hand of a robot with two, by side. A hand whose sample makes no sense is `held`
            by itself; the robot is `held` if all are.
        following_error: How far each joint was from what was commanded when it was measured last
            [rad], in the order of `q`; empty if it never was.
        effort: Torques of a grip [N m] in the order of `q`, by which position control presses, too;
            empty without one.
    """

    name: str
    time: float
    server_time: float
    joint_names: Names
    q: Numbers
    wrist: Pose | None
    status: str
    flags: Names = ()
    point_error: Numbers = ()
    residual: float = 0.0
    at_limit: Names = ()
    out_of_range: Names = ()
    epoch: int = 0
    dt: float = 0.0
    solve_time: float = 0.0
    detail: Detail | None = None
    rule: str = ""
    consistency: float | None = None
    confidence: float = 1.0
    wrist_error: Numbers = ()
    arm_held_by: str = ""
    hands: dict[str, HandState] = {}
    effort: Numbers = ()
    following_error: Numbers = ()


class About(Struct, frozen=True, kw_only=True):
    """The hands and options of a session, for clients that watch it.

    Attributes:
        robot: Name of the robot hand, or of a robot with two hands.
        side: The human hand; a robot with two hands follows both.
        input: Kind of the samples.
        layout: Layout of the samples' values; null for none.
        upright: Axes of the samples' world that are up and forward; empty if not known.
        lengths: The measured human hand, of two one of them; null for the model's own.
        human_points: Set of reference points on the human hand; null for the default one.
        robot_points: Set of reference points on the robot hand; null for the default one.
        mount: Mount of the robot's wrist; null for the hand's own.
        preset: The preset in force.
        options: All options of its method; in JSON, null stands for infinity.
        mapping: Former name of `options`, empty in teleoperation.
        teleoperation: Former name of `options`, empty in other presets.
        ik: All of IkOptions.
        has_detail: Whether commands carry every stage of the mapping.
        is_shared: Whether others may engage, disengage, configure and clear the session.
    """

    robot: str
    side: str
    input: str
    layout: str | None = None
    upright: str = ""
    lengths: Lengths | None
    human_points: str | None
    robot_points: str | None
    mount: str | None
    preset: str
    options: Options
    mapping: Former = {}
    teleoperation: Former = {}
    ik: Options
    has_detail: bool
    is_shared: bool

    def __post_init__(self) -> None:
        """Give options their former names too."""
        former = self.preset if self.preset in FORMER else "mapping"
        force_setattr(self, former, self.options)


class State(Reply):
    """The state of a session or of the server.

    Attributes:
        version: Version of the package on the server.
        uptime: Time since the session was opened, or the server started [s].
        names: The session's name, or those of all open sessions.
        mode: waiting, following, released, hold, returning, not_following, stopped or calibrating;
            of the server: serving.
        counts: Numbers of samples answered, replaced by newer ones, refused, and so on.
        robots: Robot hands that clients may open; only of the server.
        missing: Robot hands that are not installed, and what installs each; only of the server.
        two_handed: Robots with two hands that clients may open; only of the server.
        is_released: Whether the robot is disengaged, also while the watchdog holds it.
        stop: Number of the emergency stop in force, which `clear` takes; 0 for none.
        protocols: Versions of the messages that the server answers.
        q: Joint angles of the last command [rad].
        stream_port: Port of the streams (ZeroMQ PUB).
        about: Hands and options of the session.
        fist: How long the session's robot takes for a fist; null if not known.
        assumed_speed: How often assumed speed limits held the session's robot; null if none is
            assumed.
        load: Share of the last second in which the server worked; null if not measured. Of a
            session: what its samples took.
        samples_per_second: Samples that the server mapped in the last second; only of the server.
        busy: Names of the sessions whose samples are answered `busy`.
        fingers: Finger of each joint of the session's robot that moves one finger alone, as haptics
            name it.
        haptics_life: Time after which haptics no longer count [s].
    """

    version: str
    uptime: float
    names: Names
    mode: str = "serving"
    counts: dict[str, int] = {}
    robots: Names = ()
    missing: dict[str, str] = {}
    two_handed: Names = ()
    is_released: bool = False
    stop: int = 0
    protocols: tuple[int, ...] = PROTOCOLS
    q: Numbers = ()
    stream_port: int = 0
    about: About | None = None
    fist: Fist | None = None
    assumed_speed: AssumedSpeed | None = None
    load: float | None = None
    samples_per_second: float = 0.0
    busy: Names = ()
    fingers: dict[str, str] = {}
    haptics_life: float = HAPTICS_LIFE


class Haptics(Reply):
    """What the fingers of a robot feel, in the stream of its session's haptics.

    It no longer counts 0.2 s after it arrived.

    Attributes:
        name: Public name of the session.
        time: Time stamp of the sender [s].
        forces: Contact force of fingers by name [N].
        efforts: Load of fingers by name, 0 to 1.
    """

    name: str
    time: float = 0.0
    forces: dict[str, float] = {}
    efforts: dict[str, float] = {}


class Done(Reply):
    """The server carried the request out."""


class Error(Reply):
    """The server refused the request; the session is unchanged.

    Attributes:
        code: One word; see the list.
        message: What was expected, and what was received.
        field: The field at fault, such as `q[3]` or `mapping.ridge`; empty if there is none.
        protocols: With the code `protocol`: the versions that the server answers.
    """

    code: str
    message: str
    field: str = ""
    protocols: tuple[int, ...] = ()


AnyReply = Opened | Command | State | Haptics | Done | Error
AnyRequest = (
    Open
    | Step
    | Sample
    | Engage
    | Disengage
    | Clutch
    | Release
    | Stop
    | Clear
    | Configure
    | Reset
    | Measured
    | Touch
    | Status
    | Close
    | Subscribe
)
