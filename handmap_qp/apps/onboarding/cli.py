"""The commands `handmap hands`, and of `handmap robots` list, show and check."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec.structs import replace
from tyro.conf import Positional, arg

from handmap_qp.apps.arguments import HandName, InputArguments, InputFlags, hinted
from handmap_qp.apps.tables import (
    print_result,
    print_rows,
    progress,
    rows_of,
)
from handmap_qp.errors import expect
from handmap_qp.hands import (
    BASE,
    HUMAN_HANDS,
    LONGEST_STOP,
    Hand,
    HandSpec,
    Side,
    Values,
    hand_files,
    load_hand,
    load_robot,
    parse_urdf,
    read_hand_spec,
    read_hands,
    read_robot_spec,
    robot_files,
    urdf_path,
    why_missing,
)
from handmap_qp.output_files import check_output
from .check import check_hand, check_robot
from .detect import Detection, detect_hands
from .edit import described
from .findings import Rows
from .match import match_hand
from .measure import palm_rows
from .migrate import migrate
from .picture import draw_hand, draw_match, draw_robot, picture_path
from .speeds import with_speed
from .write import RobotSource, check_free, open_source, write_hand, write_robot

OwnName = Annotated[str | None, hinted("NAME", "(default: the robot's name)")]
"""Name of the hand that is written."""
RobotName = Annotated[str, arg(metavar="ROBOT")]
"""Name of a robot of the package, or path of a robot.yaml."""
PictureFile = Annotated[
    Path | None,
    hinted("FILE", "(default: beside the description; none for one of the package)"),
]
"""Picture of what is checked."""
OutFile = Annotated[Path, arg(metavar="FILE.yaml")]
"""The hand.yaml to write."""
# Links that stand on the base of a composed robot.
_BASES = f"joint/parent[@link='{BASE}']/../child"
_TITLES = {"points": "Reference points"}
_WROTE = "wrote {0}; check it with: handmap {1} check {0}"


def _print_found(hand: Hand, found: Detection, rows: Rows) -> None:
    """Print what was found of a hand."""
    followers = hand.all_joint_roles.count("follower")
    print_rows(
        f"{hand.name}: {len(hand.joint_names)} joints, {followers} followers", rows
    )
    for note in found.notes:
        print(f"note: {note}")


def list_hands() -> Rows:
    """List all hands that have a name, and what installs them; those of others come last."""
    return [
        {
            "name": spec.name,
            "side": spec.side,
            "joints": len(spec.joints),
            "wrist": spec.wrist.mount,
            "point sets": ", ".join(spec.sets),
            "available": _available(spec),
        }
        for spec in map(read_hand_spec, hand_files().values())
    ]


def list_robots() -> Rows:
    """List the robots of the package with their hands, and what installs a missing one."""
    rows = []
    for name, file in robot_files().items():
        hands = read_hands(read_robot_spec(file)).values()
        names = ", ".join(hand.name for hand in hands)
        rows.append({"name": name, "hands": names, "available": _available(*hands)})
    return rows


def _available(*hands: HandSpec) -> str:
    """Return whether hands are installed, or what installs the first that is missing."""
    missing = [*filter(None, map(why_missing, hands))]
    return f"no: {missing[0]}" if missing else "yes"


def describe_hand(given: str | Path) -> Values:
    """Describe one hand in plain values for JSON: frames, joints with limits, reference points.

    Args and errors are those of `load_hand`.
    """
    found = load_hand(given)
    return {
        "name": found.name,
        "side": found.side,
        "urdf": str(urdf_path(found.spec)),
        "wrist": f"{found.mount}, link {found.spec.wrist.link}",
        "palm": f"link {found.spec.palm.link}",
        "stops within": f"{LONGEST_STOP:g} s",
        "speeds from": found.spec.speeds or "not said",
        "joints": _joint_rows(found),
        "points": [
            {
                "point": point.name,
                "link": point.link,
                "finger": point.finger or "",
                "weight": point.weight,
                "in use": "yes" if point in found.reference_points else "",
            }
            for point in found.spec.points
        ],
    }


def describe_robot(given: str | Path) -> Values:
    """Describe a robot in plain values for JSON: its hands, and its joints by part.

    Args and errors are those of `load_robot`.
    """
    found = load_robot(given)
    first = found.hands[0]
    bases = parse_urdf(first.urdf_text).iterfind(_BASES)
    return {
        "name": found.name,
        "base": ", ".join(child.get("link", "") for child in bases),
        "hands": palm_rows(found),
        "joints": _joint_rows(first, part=_parts(found)),
    }


def _parts(robot: Hand) -> list[str]:
    """Return what each joint is part of: `left arm`, `left hand`, ..., or `shared` by both."""
    hands = robot.hands
    arms = np.array([hand.moves_wrist for hand in hands])
    parts = np.full(arms.shape[1], "other", dtype=object)
    for hand, arm, own in zip(hands, arms, robot.finger_joints, strict=True):
        parts[own] = f"{hand.side} hand"
        parts[arm] = f"{hand.side} arm"
    parts[arms.sum(axis=0) > 1] = "shared"
    return parts.tolist()


def _joint_rows(hand: Hand, **more: Sequence[str]) -> Rows:
    """Return a row for each joint with its limits; `more` are further columns."""
    columns = {
        "joint": hand.joint_names,
        **more,
        "lower rad": hand.lower_limits,
        "upper rad": hand.upper_limits,
        "speed rad/s": hand.velocity_limits,
        "stop": hand.stop_distances,
        "rest rad": hand.rest,
    }
    return rows_of(columns)


def print_description(said: Values, *, as_json: bool) -> None:
    """Print a description: its single values as a table, and each list of rows as another."""
    tables = {
        _TITLES.get(key, key.capitalize()): rows
        for key, rows in said.items()
        if isinstance(rows, list)
    }
    facts = {key: fact for key, fact in said.items() if not isinstance(fact, list)}
    print_result(said, {said["name"]: facts} | tables, as_json=as_json)


@dataclass(frozen=True)
class HandsList:
    """List the hands of the package.

    Examples:
        handmap hands list

    Attributes:
        json: Print JSON instead of a table.
    """

    json: bool = False
    _list = staticmethod(list_hands)
    _title = "Hands"

    def run(self) -> None:
        """Print the list."""
        rows = self._list()
        print_result(rows, {self._title: rows}, as_json=self.json)


@dataclass(frozen=True)
class HandsShow:
    """Describe a hand: joints, limits and reference points.

    Shows joints with their limits [rad or m, and per second], reference points [m] and point sets.

    Examples:
        handmap hands show allegro_right
        handmap hands show my_hand.yaml

    Attributes:
        hand: Hand: a name of `handmap hands list`, or the path of its hand.yaml.
        json: Print JSON instead of tables.
    """

    hand: Positional[HandName]
    json: bool = False
    _describe = staticmethod(describe_hand)

    def run(self) -> None:
        """Print the description."""
        print_description(self._describe(self.hand), as_json=self.json)


@dataclass(frozen=True)
class HandsInit:
    """Find a hand, or both of a robot, in a URDF or MJCF file: write a hand.yaml.

    Finds palm, fingers, thumb, fingertips, side and a rest posture from the kinematics, and prints
    how each was found and how certain it is. Check the result with `handmap hands check`.

    An MJCF file is compiled by MuJoCo and converted: a URDF and its meshes are written beside the
    hand.yaml. `robot_descriptions:NAME` is a robot of the package robot_descriptions, which clones
    it at first use.

    A robot with two hands gets left.yaml and right.yaml, each with its arm and with the torso that
    both share, and a robot.yaml that names them. Legs, head and all other joints are locked.

    Examples:
        handmap hands init my_hand.urdf
        handmap hands init scene.xml --out my_hand/hand.yaml
        handmap hands init humanoid.urdf --out humanoid/robot.yaml
        handmap hands init robot_descriptions:leap_hand_v1_description
        handmap hands init humanoid.urdf --root left_wrist_link --out left/hand.yaml
        handmap hands init humanoid.urdf --root left_wrist_link --base torso_link

    Attributes:
        urdf: URDF or MJCF file of the hand or of a robot with a hand, or its name.
        root: Link at which the hand begins, for one hand of a whole robot.
        base: Fixed link of the arm; the joints between it and the hand then move the wrist. For two
            hands it is the root of the robot unless given.
        side: Side of the hand.
        thumb: Name of a link or joint of the thumb.
        speed: Speed limit of all joints of the hand, where those of the URDF are placeholders, and
            of their followers [rad/s or m/s]. Where the maker's is known, init says so.
        name: Name of the hand or robot.
        out: File to write; for two hands, left.yaml, right.yaml and robot.yaml in its folder.
        overwrite: Replace the files if they exist.
        json: Print one JSON object instead of tables.
    """

    urdf: Positional[Annotated[Path, arg(metavar="ROBOT")]]
    root: Annotated[str | None, hinted("LINK", "(default: the root of the URDF)")] = (
        None
    )
    base: Annotated[str | None, hinted("LINK", "(default: the wrist floats)")] = None
    side: Annotated[Side | None, hinted("{right,left}", "(default: found)")] = None
    thumb: Annotated[str | None, hinted("LINK", "(default: found)")] = None
    speed: Annotated[float | None, hinted("SPEED", "(default: as the URDF says)")] = (
        None
    )
    name: OwnName = None
    out: OutFile = Path("hand.yaml")
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Find the hands, write and load their descriptions, and print how each part was found."""
        # Two hands are written to other files than that of the default.
        check_free(self.out, overwrite=self.overwrite or self.out == HandsInit.out)
        source = open_source(self.urdf, self.out.parent, overwrite=self.overwrite)
        urdf, reference, _ = source
        hands = detect_hands(
            urdf,
            root=self.root,
            base=self.base,
            side=self.side,
            thumb=self.thumb,
            name=self.name,
        )
        if len(hands) == 1:
            result = self._write(source, hands[0], self.out, hands[0].spec.name)
        else:
            result = self._write_robot(source, hands)
        if self.json:
            print(json.dumps(result))
            return
        # What lies beside the hand.yaml is a file, and not that which was given.
        if reference == str(urdf) != str(self.urdf):
            print(f"wrote {urdf}, with the kinematics of {self.urdf}")
        for hand in result.get("hands", ()):
            print(f"wrote {hand['out']}")
        kind = "robots" if "hands" in result else "hands"
        print(_WROTE.format(result["out"], kind))

    def _write_robot(self, source: RobotSource, hands: list[Detection]) -> Values:
        """Write the left and the right hand of a robot, and its `robot.yaml`."""
        out = self.out.with_name("robot.yaml")
        files = [out.with_name(f"{hand.spec.side}.yaml") for hand in hands]
        for file in (out, *files):
            check_free(file, overwrite=self.overwrite)
        name = self.name or hands[0].spec.name.removesuffix("_left")
        said = [
            self._write(source, hand, file, f"{name}_{hand.spec.side}")
            for hand, file in zip(hands, files, strict=True)
        ]
        write_robot(name, out)
        load_robot(out)
        return {"name": name, "out": str(out), "hands": said}

    def _write(
        self, source: RobotSource, found: Detection, out: Path, name: str
    ) -> Values:
        """Write a hand, and print what was found unless JSON is to be printed; return that."""
        spec = replace(found.spec, name=name)
        if (speed := self.speed) is not None:
            expect(speed > 0.0, "--speed", "a speed > 0", value=speed)
            spec = with_speed(spec, speed)
        check_free(out, overwrite=self.overwrite)
        found = described(found._replace(spec=spec), source)
        write_hand(found, out)
        rows = [
            {"what": c.what, "found": c.answer, "certainty": c.certainty, "how": c.how}
            for c in found.clues
        ]
        if not self.json:
            _print_found(load_hand(found.spec), found, rows)
        return {"name": name, "out": str(out), "found": rows, "notes": found.notes}


@dataclass(frozen=True)
class HandsMigrate:
    """Turn a configuration of dex-retargeting into a hand.yaml.

    The links that the configuration names become reference points. Palm, rest posture and the rest
    are found in its URDF, as by `handmap hands init`. Settings without a counterpart are named.

    Examples:
        handmap hands migrate allegro_hand_right.yml --urdf allegro_hand_right.urdf
        handmap retarget recording.npz --robot hand.yaml

    Attributes:
        config: YAML file of dex-retargeting, with the table `retargeting`.
        urdf: The URDF that it means.
        name: Name of the hand.
        out: File to write.
        overwrite: Replace the file if it exists.
    """

    config: Positional[Annotated[Path, arg(metavar="CONFIG.yml")]]
    urdf: Annotated[
        Path | None,
        hinted("ROBOT.urdf", "(default: as the configuration says, from its folder)"),
    ] = None
    name: OwnName = None
    out: OutFile = Path("hand.yaml")
    overwrite: bool = False

    def run(self) -> None:
        """Read the configuration, write the description, and print what was taken over."""
        check_free(self.out, overwrite=self.overwrite)
        found = migrate(self.config, self.urdf, self.name)
        write_hand(found, self.out)
        hand = load_hand(self.out)
        rows = [
            {"reference point": point.name, "link": point.link}
            for point in hand.spec.points
        ]
        _print_found(hand, found, rows)
        print(_WROTE.format(self.out, "hands"))


@dataclass(frozen=True)
class HandsCheck:
    """Check a hand.yaml against its URDF, and draw the hand with its labels.

    Checks frames, limits, mimic rules, reference points and weights. Measures how far each finger
    reaches, the hand's size relative to a person's, self-collisions at rest, and which human
    postures are out of reach, and where an arm goes as the hand goes up, left or forward, as seen
    by a headset. Every finding says what to change. The exit code is 1 after a warning: the
    description contradicts names, limits, shapes or gestures.

    Examples:
        handmap hands check my_hand.yaml
        handmap hands check allegro_right --picture allegro.png

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        picture: Picture to draw, PNG, SVG or PDF.
        motion: Map motions of a human hand to it (takes seconds).
        json: Print one JSON object instead of tables.
    """

    hand: Positional[HandName]
    picture: PictureFile = None
    motion: bool = True
    json: bool = False
    # What is checked, and how it is checked and drawn.
    _steps: ClassVar[Any] = "hand", check_hand, draw_hand

    def run(self) -> None:
        """Check it, draw it, and print the findings."""
        kind, check, draw = self._steps
        with progress("checking"):
            report = check(self.hand, has_motion=self.motion)
        picture = self.picture or picture_path(self.hand, kind)
        if picture and report.hand:
            draw(report.hand, picture, *report.measured.get("Directions", []))
        report.print(picture, as_json=self.json)


@dataclass(frozen=True)
class HandsMatch:
    """Find the robot posture that corresponds to the resting human hand.

    Teleoperation starts from this pair of postures. It is solved for each person and robot unless
    the hand.yaml has a key `matched`. Look at the posture with --picture. Correct it in the
    hand.yaml if the fingers of both hands do not show the same.

    Examples:
        handmap hands match allegro_right --picture matched.png
        handmap hands match my_hand.yaml --recording recording.npz

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        human_length: Length of the person's hand from wrist crease to middle fingertip [m].
        recording: Recording in which the person's hand is measured, as for `handmap retarget`.
        picture: Picture to draw: the human at rest, the robot at rest, the robot matched. PNG.
        json: Print one JSON object instead of a table.
        inputs: How the recording is to be read.
    """

    hand: Positional[HandName]
    human_length: Annotated[
        float | None, hinted("METRES", "(default: the standard hand's)")
    ] = None
    recording: Annotated[
        Path | None, hinted("RECORDING", "(default: the standard hand)")
    ] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    json: bool = False
    inputs: InputFlags = InputArguments()

    def run(self) -> None:
        """Solve the posture, print it, and draw it if requested."""
        robot = load_hand(self.hand)
        expect(robot.name not in HUMAN_HANDS, "hand", "a robot hand", value=robot.name)
        if self.picture:
            check_output("--picture", self.picture, (".png",))
        source = self.recording
        recording = self.inputs.read(source, robot.side) if source else None
        match = match_hand(robot, recording=recording, human_length=self.human_length)
        written = []
        if self.picture:
            draw_match(match, self.picture)
            written = [str(self.picture)]
        said = {"name": robot.name, "joints": match.rows, "written": written}
        title = f"{robot.name}: the posture that matches the resting human's"
        print_result(said, {title: match.rows}, written, as_json=self.json)
        if not self.json:
            advice = "to use this posture for everyone, paste into hand.yaml:"
            print(f"{advice}\n{match.text}", end="")


@dataclass(frozen=True)
class RobotsList(HandsList):
    """List the robots of the package: a left and a right hand in one model.

    Examples:
        handmap robots list

    Attributes:
        json: Print JSON instead of a table.
    """

    _list = staticmethod(list_robots)
    _title = "Robots"


@dataclass(frozen=True)
class RobotsShow(HandsShow):
    """Describe a robot: its hands, and its joints with their limits, by part.

    Shows where each palm is at rest, how far the wrist moves from there, and which joints move both
    palms. Positions are in the robot's base.

    Examples:
        handmap robots show g1
        handmap robots show humanoid/robot.yaml

    Attributes:
        hand: Robot: a name of `handmap robots list`, or the path of its robot.yaml.
        json: Print JSON instead of tables.
    """

    hand: Positional[RobotName]
    _describe = staticmethod(describe_robot)


@dataclass(frozen=True)
class RobotsCheck(HandsCheck):
    """Check a robot.yaml and both of its hands, and draw the robot.

    Checks each hand as `handmap hands check` does, and looks for links of arms, hands and body that
    overlap at rest. Every finding says what to change. The exit code is 1 after a warning: the
    description contradicts names, limits, shapes or gestures.

    Examples:
        handmap robots check humanoid/robot.yaml
        handmap robots check g1 --picture g1.png

    Attributes:
        hand: Path of a robot.yaml, or name of a robot of the package.
        picture: Picture to draw, PNG, SVG or PDF.
        motion: Map motions of a human hand to each hand (takes seconds).
        json: Print one JSON object instead of tables.
    """

    hand: Positional[RobotName]
    _steps = "robot", check_robot, draw_robot
