"""The commands `handmap hands`, and of `handmap robots` list, show and check."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from handmap_core.errors import expect
from handmap_qp.apps.arguments import HandName, InputArguments, InputFlags, hinted
from handmap_qp.apps.tables import print_result, print_rows, progress
from handmap_qp.hands import HUMAN_HANDS, Hand, Names, Side, Values, load_hand
from handmap_qp.output_files import check_output
from .check import check_hand, check_robot
from .describe import describe_hand, describe_robot, list_hands, list_robots
from .findings import HandReport, Rows
from .init import DescribedHand, InitResult, init_hands
from .match import match_hand
from .migrate import migrate
from .pack import DEFAULT_TRIANGLES, pack_hand
from .picture import draw_hand, draw_match, draw_robot, picture_path
from .single_joints import FingerKind
from .write import check_free, write_hand

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
_TITLES = {"points": "Reference points"}
_WROTE = "wrote {0}; check it with: handmap {1} check {0}"


def _print_found(hand: Hand, notes: Names, rows: Rows) -> None:
    """Print what was found of a hand."""
    followers = hand.all_joint_roles.count("follower")
    print_rows(
        f"{hand.name}: {len(hand.joint_names)} joints, {followers} followers", rows
    )
    for note in notes:
        print(f"note: {note}")


def _evidence(hand: DescribedHand) -> Rows:
    """Return a row for each part of a hand: what was found, how, and how certain it is."""
    return [
        {"what": c.what, "found": c.answer, "certainty": c.certainty, "how": c.how}
        for c in hand.clues
    ]


def _init_document(result: InitResult) -> Values:
    """Return what `hands init` found and wrote, in plain values for JSON."""
    hands = [
        {
            "name": hand.hand.name,
            "out": str(hand.file),
            "found": _evidence(hand),
            "notes": hand.notes,
        }
        for hand in result.hands
    ]
    if not result.is_robot:
        return hands[0]
    return {"name": result.name, "out": str(result.file), "hands": hands}


def print_report(report: HandReport, picture: Path | None, *, as_json: bool) -> None:
    """Print all findings and tables of a check, and the name of a picture that was drawn.

    Raises:
        HandError: If the hand cannot be built.
        SystemExit: With the code 1 if there is a warning.
    """
    rows = [
        {"level": one.level, "key": one.key, "found": one.text, "change": one.change}
        for one in report.findings
    ]
    document = {
        "name": report.name,
        **report.measured,
        "findings": rows,
        "picture": picture and str(picture),
    }
    tables = {f"{report.name}: findings": rows, **report.measured}
    # A table of one error would say it twice.
    if as_json or not report.error:
        files = filter(None, [picture])
        print_result(document, tables, files, as_json=as_json)
    if report.error:
        raise report.error
    if not report.is_usable:
        raise SystemExit(1)


def print_description(description: Values, *, as_json: bool) -> None:
    """Print a description: its single values as a table, and each list of rows as another."""
    tables = {
        _TITLES.get(key, key.capitalize()): rows
        for key, rows in description.items()
        if isinstance(rows, list)
    }
    facts = {k: fact for k, fact in description.items() if not isinstance(fact, list)}
    name = description["name"]
    print_result(description, {name: facts} | tables, as_json=as_json)


@dataclass(frozen=True)
class HandsList:
    """List the hands of the package.

    Examples:
        handmap hands list

    Attributes:
        json: Print JSON instead of a table.
    """

    json: bool = False

    def run(self) -> None:
        """Print the list."""
        rows = list_hands()
        print_result(rows, {"Hands": rows}, as_json=self.json)


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

    def run(self) -> None:
        """Print the description."""
        print_description(describe_hand(self.hand), as_json=self.json)


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
        kind: What fingers with one joint each are: fingers are straight at zero, jaws are open at
            one end of their ranges.
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
    kind: Annotated[FingerKind | None, hinted("{fingers,jaws}", "(default: found)")] = (
        None
    )
    speed: Annotated[float | None, hinted("SPEED", "(default: as the URDF says)")] = (
        None
    )
    name: OwnName = None
    out: Annotated[Path | None, hinted("FILE.yaml", "(default: hand.yaml)")] = None
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Find the hands, write their descriptions, and print how each part was found."""
        with progress(f"reading {self.urdf}"):
            result = init_hands(
                self.urdf,
                out=self.out,
                root=self.root,
                base=self.base,
                side=self.side,
                thumb=self.thumb,
                kind=self.kind,
                speed=self.speed,
                name=self.name,
                overwrite=self.overwrite,
            )
        if self.json:
            print(json.dumps(_init_document(result)))
            return
        for hand in result.hands:
            _print_found(hand.hand, hand.notes, _evidence(hand))
        if result.converted:
            print(f"wrote {result.converted}, with the kinematics of {self.urdf}")
        if result.is_robot:
            for hand in result.hands:
                print(f"wrote {hand.file}")
        kind = "robots" if result.is_robot else "hands"
        print(_WROTE.format(result.file, kind))


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
        _print_found(hand, found.notes, rows)
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

    def run(self) -> None:
        """Check it, draw it, and print the findings."""
        with progress("checking"):
            report = check_hand(self.hand, has_motion=self.motion)
        picture = self.picture or picture_path(self.hand, "hand")
        if picture and report.hand:
            draw_hand(report.hand, picture, report.measured.get("Directions", []))
        print_report(report, picture, as_json=self.json)


@dataclass(frozen=True)
class HandsPack:
    """Write a hand into a folder of its own: description, URDF, small meshes and licence.

    The folder needs no other package. It can be copied to a robot, or passed on if the licence of
    the model allows it. The hand moves as before: meshes for collisions keep their vertices, or
    those of their convex hulls.

    Examples:
        handmap hands pack shadow_right --out shadow
        handmap view demo --robot shadow/hand.yaml

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        out: Folder to write.
        triangles: Most triangles of a mesh.
        overwrite: Replace the description in the folder if there is one.
    """

    hand: Positional[HandName]
    out: Annotated[Path, arg(metavar="FOLDER")]
    triangles: int = DEFAULT_TRIANGLES
    overwrite: bool = False

    def run(self) -> None:
        """Write the folder, and say how large it is and whose licence holds."""
        with progress("packing"):
            packed = pack_hand(
                self.hand,
                self.out,
                triangles=self.triangles,
                overwrite=self.overwrite,
            )
        print(
            f"wrote {packed.file}: {packed.meshes} meshes, {packed.size / 1e6:.1f} MB"
        )
        if packed.licence:
            print(
                f"licence of the model: {self.out / 'LICENSE'}, as in {packed.licence}"
            )
        else:
            print(
                "no licence lies beside the model: ask its maker before you pass it on"
            )


@dataclass(frozen=True)
class HandsMatch:
    """Find the robot posture that corresponds to the resting human hand.

    Teleoperation starts from this pair of postures. It is solved for each person and robot unless
    the hand.yaml has a key `neutral_match`. Look at the posture with --picture. Correct it in the
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
        document = {"name": robot.name, "joints": match.rows, "written": written}
        title = f"{robot.name}: the posture that matches the resting human's"
        print_result(document, {title: match.rows}, written, as_json=self.json)
        if not self.json:
            advice = "to use this posture for everyone, paste into hand.yaml:"
            print(f"{advice}\n{match.text}", end="")


@dataclass(frozen=True)
class RobotsList:
    """List the robots of the package: a left and a right hand in one model.

    Examples:
        handmap robots list

    Attributes:
        json: Print JSON instead of a table.
    """

    json: bool = False

    def run(self) -> None:
        """Print the list."""
        rows = list_robots()
        print_result(rows, {"Robots": rows}, as_json=self.json)


@dataclass(frozen=True)
class RobotsShow:
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
    json: bool = False

    def run(self) -> None:
        """Print the description."""
        print_description(describe_robot(self.hand), as_json=self.json)


@dataclass(frozen=True)
class RobotsCheck:
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
    picture: PictureFile = None
    motion: bool = True
    json: bool = False

    def run(self) -> None:
        """Check it, draw it, and print the findings."""
        with progress("checking"):
            report = check_robot(self.hand, has_motion=self.motion)
        picture = self.picture or picture_path(self.hand, "robot")
        if picture and report.hand:
            draw_robot(report.hand, picture)
        print_report(report, picture, as_json=self.json)
