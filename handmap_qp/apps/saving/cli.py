"""`handmap hands save`: a hand for a robot's computer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from handmap_core.errors import HandError, expect
from handmap_qp.apps.arguments import (
    HandName,
    MappingArguments,
    MappingFlags,
    PersonFile,
    hinted,
)
from handmap_qp.apps.tables import print_rows
from handmap_qp.hands import Side, load_hand, load_whole
from handmap_qp.human import human_name, read_person
from handmap_qp.mapping import HandMapper, RobotMapper
from handmap_qp.output_files import check_output, replaced_file
from .records import saved_bytes


@dataclass(frozen=True)
class HandsSave:
    """Save a hand and how it follows, for a robot's computer that has `handmap-core` alone.

    The file has all that the compiled core needs of the robot's hand, or of a robot with two, and
    of the person's: no URDF, mesh or package is read there. It is for the person and the options
    that are given here, and for this version.

    Examples:
        handmap hands save allegro_right --person anna.yaml
        handmap hands save g1 --person anna.yaml
        handmap hands save my_hand.yaml --preset object --out my.hand
        handmap hands save my_hand.yaml --out my.hand --check

    Attributes:
        hand: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml. Or a robot
            with two: a name of `handmap robots list`, or the path of its robot.yaml.
        out: File to write.
        person: File of the person's hand, of `handmap calibrate`.
        side: Side of the human hand.
        check: Write nothing: tell whether the file is what would be written, or something has
            changed since.
        arguments: Reference points and options.
    """

    hand: Positional[HandName]
    out: Annotated[Path | None, hinted("FILE.hand", "(default: HAND.hand)")] = None
    person: Annotated[
        PersonFile, hinted("PERSON.yaml", "(default: a typical hand)")
    ] = None
    side: Annotated[Side | None, hinted("SIDE", "(default: the robot hand's)")] = None
    check: bool = False
    arguments: MappingFlags = MappingArguments()

    def run(self) -> None:
        """Bind both hands, and write or compare the file."""
        robot = load_whole(self.hand, self.arguments.robot_points)
        out = check_output("--out", self.out or Path(f"{robot.name}.hand"), (".hand",))
        is_one = not robot.parts
        expect(
            is_one or not self.side, "--side", "none for both hands", value=self.side
        )
        lengths = read_person(self.person).lengths if self.person else None
        points = self.arguments.human_points
        humans = {
            side: load_hand(human_name(side), points=points, lengths=lengths)
            for side in ([self.side] if self.side else robot.by_side)
        }
        human, *_ = humans.values()
        preset, method, ik = self.arguments.preset_for(human, robot.hands[0])
        if is_one:
            content = saved_bytes(HandMapper(human, robot, method, ik=ik))
        else:
            content = saved_bytes(RobotMapper(robot, humans, method, ik=ik))
        if self.check:
            expect(out.is_file(), "--out", "a file that was saved", value=str(out))
            if out.read_bytes() != content:
                problem = "it is not what would be saved now: hand, person, options or version"
                raise HandError(f"{problem} have changed; save it again", file=out)
            print(f"{out} is up to date")
            return
        with replaced_file(out, "--out") as stream:
            stream.write(content)
        rows = {
            "preset": preset,
            "human": ", ".join(each.name for each in humans.values()),
            "joints": f"{len(robot.joint_names)}",
            "size": f"{len(content) / 1e3:.0f} kB",
        }
        print_rows(robot.name, rows)
        print(f"wrote {out}")
