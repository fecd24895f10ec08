"""The commands `handmap hands`: list, show, init, migrate, check and match."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from handmap_qp.apps.arguments import HandName, InputArguments, hinted
from handmap_qp.apps.onboarding.check import Rows, check_hand
from handmap_qp.apps.onboarding.collision_pairs import with_collision_pairs
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.match import match_hand
from handmap_qp.apps.onboarding.migrate import migrate, read_dex_configuration
from handmap_qp.apps.onboarding.picture import draw_hand, draw_match, picture_path
from handmap_qp.apps.onboarding.write import check_free, open_source, write_hand
from handmap_qp.apps.tables import print_rows, print_table, progress
from handmap_qp.errors import expect
from handmap_qp.hands.hand import LONGEST_STOP, Hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_files, load_hand, missing_hands
from handmap_qp.hands.sources import urdf_path
from handmap_qp.hands.spec import Side, read_hand_spec
from handmap_qp.output_files import check_output

RobotName = Annotated[str | None, hinted("NAME", "(default: the robot's name)")]
"""Name of the hand that is written."""
OutFile = Annotated[Path, tyro.conf.arg(metavar="FILE.yaml")]
"""The hand.yaml to write."""
_WROTE = "wrote {0}; check it with: handmap hands check {0}"


def _print_found(
    hand: Hand,
    found: Detection,
    rows: Rows,
) -> None:
    """Print what was found of a hand."""
    followers = hand.all_joint_roles.count("follower")
    print_rows(
        f"{hand.name}: {len(hand.joint_names)} joints, {followers} followers", rows
    )
    for note in found.notes:
        print(f"note: {note}")


def list_hands() -> Rows:
    """List all hands that have a name; those of other packages come last.

    Returns:
        Name, side, number of joints, mount, point sets of each, and whether it is installed, or
        what installs it.
    """
    missing = missing_hands()
    specs = {name: read_hand_spec(file) for name, file in hand_files().items()}
    return [
        {
            "name": name,
            "side": spec.side,
            "joints": len(spec.joints),
            "wrist": spec.wrist.mount,
            "point sets": ", ".join(spec.sets),
            "available": f"no: {missing[name]}" if name in missing else "yes",
        }
        for name, spec in specs.items()
    ]


def describe_hand(hand: str | Path) -> dict[str, Any]:
    """Describe one hand in plain values for JSON: frames, joints with limits, reference points.

    Args and errors are those of `load_hand`.
    """
    found = load_hand(hand)
    columns = {
        "joint": found.joint_names,
        "lower rad": found.lower_limits.tolist(),
        "upper rad": found.upper_limits.tolist(),
        "speed rad/s": found.velocity_limits.tolist(),
        "stop": found.stop_distances.tolist(),
        "rest rad": found.rest.tolist(),
    }
    return {
        "name": found.name,
        "side": found.side,
        "urdf": str(urdf_path(found.spec)),
        "wrist": f"{found.mount}, link {found.spec.wrist.link}",
        "palm": f"link {found.spec.palm.link}",
        "stops within": f"{LONGEST_STOP:g} s",
        "joints": [
            dict(zip(columns, row, strict=True))
            for row in zip(*columns.values(), strict=True)
        ],
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
        if self.json:
            print(json.dumps(rows))
        else:
            print_rows("Hands", rows)


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

    hand: tyro.conf.Positional[HandName]
    json: bool = False

    def run(self) -> None:
        """Print the description."""
        rows = describe_hand(self.hand)
        if self.json:
            print(json.dumps(rows))
            return
        print_table(
            rows["name"],
            {key: value for key, value in rows.items() if not isinstance(value, list)},
        )
        print_rows("Joints", rows["joints"])
        print_rows("Reference points", rows["points"])


@dataclass(frozen=True)
class HandsInit:
    """Find a hand in a URDF or MJCF file and write its description, hand.yaml.

    Finds palm, fingers, thumb, fingertips, side and a rest posture from the kinematics, and prints
    how each was found and how certain it is. Check the result with `handmap hands check`.

    An MJCF file is compiled by MuJoCo and converted: a URDF and its meshes are written beside the
    hand.yaml. `robot_descriptions:NAME` is a robot of the package robot_descriptions, which clones
    it at first use.

    Examples:
        handmap hands init my_hand.urdf
        handmap hands init scene.xml --out my_hand/hand.yaml
        handmap hands init robot_descriptions:leap_hand_v1_description
        handmap hands init humanoid.urdf --root left_wrist_link --out left/hand.yaml
        handmap hands init humanoid.urdf --root left_wrist_link --base torso_link

    Attributes:
        urdf: URDF or MJCF file of the hand or of a robot with a hand, or its name.
        root: Link at which the hand begins, in the URDF of a whole robot.
        base: Fixed link of the arm; the joints between it and the hand then move the wrist.
        side: Side of the hand.
        thumb: Name of a link or joint of the thumb.
        name: Name of the hand.
        out: File to write.
        overwrite: Replace the file if it exists.
        json: Print one JSON object instead of a table.
    """

    urdf: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="ROBOT")]]
    root: Annotated[str | None, hinted("LINK", "(default: the root of the URDF)")] = (
        None
    )
    base: Annotated[str | None, hinted("LINK", "(default: the wrist floats)")] = None
    side: Annotated[Side | None, hinted("{right,left}", "(default: found)")] = None
    thumb: Annotated[str | None, hinted("LINK", "(default: found)")] = None
    name: RobotName = None
    out: OutFile = Path("hand.yaml")
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Find the hand, write its description, load it, and print how each part was found."""
        check_free(self.out, overwrite=self.overwrite)
        source = open_source(self.urdf, self.out.parent, overwrite=self.overwrite)
        found = detect(
            source.urdf,
            root=self.root,
            base=self.base,
            side=self.side,
            thumb=self.thumb,
            name=self.name,
        )
        spec = msgspec.structs.replace(found.spec, urdf=source.reference)
        found = found._replace(spec=spec, notes=(*source.notes, *found.notes))
        write_hand(found, self.out, overwrite=self.overwrite)
        hand = load_hand(self.out)
        found = with_collision_pairs(found, hand)
        write_hand(found, self.out, overwrite=True)
        rows = [
            {"what": c.what, "found": c.answer, "certainty": c.certainty, "how": c.how}
            for c in found.clues
        ]
        if self.json:
            said = {"name": hand.name, "out": str(self.out)}
            print(json.dumps(said | {"found": rows, "notes": found.notes}))
            return
        _print_found(hand, found, rows)
        for path in source.written:
            print(f"wrote {path}, with the kinematics of {self.urdf}")
        print(_WROTE.format(self.out))


@dataclass(frozen=True)
class HandsMigrate:
    """Turn a configuration of dex-retargeting into a hand.yaml.

    The links that the configuration names become reference points. Palm, rest posture and the rest
    are found in its URDF, as by `handmap hands init`. Settings without a counterpart are named.

    Examples:
        handmap hands migrate allegro_hand_right.yml --urdf allegro_hand_right.urdf
        handmap map recording.npz --robot hand.yaml

    Attributes:
        config: YAML file of dex-retargeting, with the table `retargeting`.
        urdf: The URDF that it means.
        name: Name of the hand.
        out: File to write.
        overwrite: Replace the file if it exists.
    """

    config: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CONFIG.yml")]]
    urdf: Annotated[
        Path | None,
        hinted("ROBOT.urdf", "(default: as the configuration says, from its folder)"),
    ] = None
    name: RobotName = None
    out: OutFile = Path("hand.yaml")
    overwrite: bool = False

    def run(self) -> None:
        """Read the configuration, write the description, and print what was taken over."""
        check_free(self.out, overwrite=self.overwrite)
        configuration = read_dex_configuration(self.config)
        urdf = self.urdf or self.config.parent / configuration.urdf
        found = migrate(configuration, urdf, name=self.name)
        write_hand(found, self.out, overwrite=self.overwrite)
        hand = load_hand(self.out)
        rows = [
            {"reference point": point.name, "link": point.link}
            for point in hand.spec.points
        ]
        _print_found(hand, found, rows)
        print(_WROTE.format(self.out))


@dataclass(frozen=True)
class HandsCheck:
    """Check a hand.yaml against its URDF, and draw the hand with its labels.

    Checks frames, limits, mimic rules, reference points and weights. Measures how far each finger
    reaches, the hand's size relative to a person's, self-collisions at rest, and which human
    postures are out of reach, and where an arm goes as the hand goes up, left or forward, as seen
    by a headset. Every finding says what to change.

    Examples:
        handmap hands check my_hand.yaml
        handmap hands check allegro_right --picture allegro.png

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        picture: Picture to draw, PNG, SVG or PDF.
        motion: Map motions of a human hand to it (takes seconds; without the core, half a minute).
        json: Print one JSON object instead of tables.
    """

    hand: tyro.conf.Positional[HandName]
    picture: Annotated[
        Path | None,
        hinted(
            "FILE", "(default: beside the hand.yaml; none for a hand of the package)"
        ),
    ] = None
    motion: bool = True
    json: bool = False

    def run(self) -> None:
        """Check the hand, draw it, and print the findings."""
        with progress("checking"):
            report = check_hand(self.hand, has_motion=self.motion)
        if report.hand is None and not self.json:
            # A table of one error would say it twice.
            report.raise_if_unusable()
        picture = self.picture or picture_path(self.hand)
        if picture is not None and report.hand is not None:
            draw_hand(report.hand, picture, *report.measured.get("Directions", []))
        if self.json:
            print(json.dumps(report.document(picture), allow_nan=False))
        else:
            for title, rows in report.tables().items():
                print_rows(title, rows)
            if picture is not None:
                print(f"wrote {picture}")
        report.raise_if_unusable()


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
        recording: Recording in which the person's hand is measured, as for `handmap map`.
        picture: Picture to draw: the human at rest, the robot at rest, the robot matched. PNG.
        json: Print one JSON object instead of a table.
    """

    hand: tyro.conf.Positional[HandName]
    human_length: Annotated[
        float | None, hinted("METRES", "(default: the standard hand's)")
    ] = None
    recording: Annotated[
        Path | None, hinted("RECORDING", "(default: the standard hand)")
    ] = None
    picture: Annotated[Path | None, hinted("FILE.png", "(default: none)")] = None
    json: bool = False

    def run(self) -> None:
        """Solve the posture, print it, and draw it if requested."""
        robot = load_hand(self.hand)
        expect(robot.name not in HUMAN_HANDS, "hand", "a robot hand", value=robot.name)
        if self.picture is not None:
            check_output("--picture", self.picture, (".png",))
        source = self.recording
        recording = None if source is None else InputArguments().read(source)
        match = match_hand(robot, recording=recording, human_length=self.human_length)
        if self.picture is not None:
            draw_match(match, self.picture)
        written = [] if self.picture is None else [str(self.picture)]
        if self.json:
            said = {"name": robot.name, "joints": match.rows, "written": written}
            print(json.dumps(said))
            return
        print_rows(
            f"{robot.name}: the posture that matches the resting human's", match.rows
        )
        print(
            f"to use this posture for everyone, paste into hand.yaml:\n{match.text}",
            end="",
        )
        for path in written:
            print(f"wrote {path}")
