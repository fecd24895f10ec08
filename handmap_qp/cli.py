"""The command `handmap`: demo, map, view, hands, figures, serve, keys.

Every user error is one line on stderr and exit code 2; Ctrl-C is exit code 130, and 0 where it is
the way to end (`view`, `serve`). Results go to stdout, progress to stderr.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.experiments.cli import Figures
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.onboarding.cli import HandsCheck, HandsInit
from handmap_qp.service.cli import Keys, Serve
from handmap_qp.tables import check_output, print_rows, print_table, progress
from handmap_qp.viewer.cli import View


class Command(Protocol):
    """A subcommand: its fields are its arguments."""

    def run(self) -> None:
        """Do the work; raise `HandmapError` on a user error."""
        ...


@dataclass(frozen=True)
class Demo:
    """Carry a human hand's motion to a three-fingered robot hand, on embedded data.

    The wrist goes along the paper's arc (470 mm by 150 mm, Sec. IV) while the first postural
    synergy closes and opens the hand. Writes the robot's trajectory, a picture of both hands and
    plots of errors and joints.

    Attributes:
        out: Folder to write to; made if it does not exist.
    """

    out: Path = Path("demo")

    def run(self) -> None:
        """Run the demo and say what it made."""
        from handmap_qp.experiments.demo import run_demo

        with progress("mapping") as advance:
            result = run_demo(self.out, progress=advance)
        print_table(
            "The paper's arc with the first synergy, human hand to three_finger", result.summary()
        )
        for file in result.files:
            print(f"wrote {file}")


@dataclass(frozen=True)
class Map:
    """Map a recording of a human hand to a robot hand.

    The hand is measured, its landmarks become joint angles, and every sample goes through the
    mapper. The result is an .npz file with time, joint_names, q, wrist, targets, points,
    point_error, valid and versions.

    Examples: `handmap map recording.npz --robot three_finger`, or
    `handmap map recording.npz --robot my_hand.yaml --out my_hand.npz --rigid-from wrist --json`.

    Attributes:
        recording: Recording of a human hand: an .npz file with time, landmarks (T, 21, 3) and
            handedness.
        robot: Robot hand: a name that `handmap hands` lists, or the path of a hand.yaml.
        out: File to write; RECORDING_ROBOT.npz in the working folder if omitted.
        json: Print the summary as one JSON object instead of a table.
        human_points: Reference points on the human hand: the name of a set.
        robot_points: Reference points on the robot hand: the name of a set; its own default if
            omitted.
        mapping: How the human's motion becomes the robot's.
        ik: Weights and settings of the QP.
    """

    recording: tyro.conf.Positional[Path]
    robot: str
    out: Path | None = None
    json: bool = False
    human_points: str | None = None
    robot_points: str | None = None
    mapping: Annotated[MappingOptions, tyro.conf.arg(name="")] = field(
        default_factory=MappingOptions
    )
    ik: Annotated[IkOptions, tyro.conf.arg(name="ik")] = field(default_factory=IkOptions)

    def run(self) -> None:
        """Read, fit, map, write and sum up."""
        from handmap_qp.hands.library import load_hand
        from handmap_qp.mapping.mapper import HandMapper
        from handmap_qp.offline.summary import summarise, table_rows
        from handmap_qp.offline.trajectory import map_motion, save_npz
        from handmap_qp.trackers.landmarks import fit_recording
        from handmap_qp.trackers.recording import read_recording

        recording = read_recording(self.recording)
        robot = load_hand(self.robot, points=self.robot_points)
        out = check_output(
            "--out", self.out or Path(f"{recording.name}_{robot.name}.npz"), (".npz",)
        )
        with progress("fitting the human hand", len(recording)) as advance:
            motion = fit_recording(recording, advance)
        human = motion.human.with_points(self.human_points)
        mapper = HandMapper(human, robot, self.mapping, ik=self.ik)
        with progress(f"mapping to {robot.name}", len(recording)) as advance:
            trajectory = map_motion(mapper, motion, advance)
        save_npz(out, trajectory.columns)
        summary = {"recording": recording.name, **summarise(motion, trajectory), "out": str(out)}
        if self.json:
            print(json.dumps(summary, allow_nan=False))
            return
        print_table(f"{recording.name} to {robot.name}", table_rows(summary))
        print(f"wrote {out}")


@dataclass(frozen=True)
class Hands:
    """List the hands that come with the package, or describe one.

    `handmap hands init ROBOT.urdf` writes the description of a hand of your own, and `handmap hands
    check hand.yaml` looks it over; both have their own --help.

    Attributes:
        hand: Name of a hand or path of a hand.yaml to describe; lists all hands if omitted.
        json: Print one JSON object instead of a table.
    """

    hand: tyro.conf.Positional[str | None] = None
    json: bool = False

    def run(self) -> None:
        """Print the table."""
        from handmap_qp.hands.library import describe_hand, list_hands

        rows = list_hands() if self.hand is None else describe_hand(self.hand)
        if self.json:
            print(json.dumps(rows))
        elif isinstance(rows, list):
            print_rows("Hands", rows)
        else:
            print_table(
                rows["name"],
                {key: value for key, value in rows.items() if not isinstance(value, list)},
            )
            print_rows("Joints", rows["joints"])
            print_rows("Reference points", rows["points"])


_COMMANDS: dict[str, Any] = {
    "demo": Demo,
    "map": Map,
    "view": View,
    "hands": Hands,
    "figures": Figures,
    "serve": Serve,
    "keys": Keys,
}
_Any: Any = reduce(
    or_,
    (
        Annotated[kind, tyro.conf.subcommand(name, prefix_name=False)]
        for name, kind in _COMMANDS.items()
    ),
)
_NESTED: dict[tuple[str, str], Any] = {("hands", "init"): HandsInit, ("hands", "check"): HandsCheck}
"""Commands of a command that can also be used alone."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after `handmap`; those of the process if omitted.

    Returns:
        Exit code: 0, or 2 after a user error.
    """
    try:
        parse(sys.argv[1:] if arguments is None else arguments).run()
    except HandmapError as error:
        print(f"handmap: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader of stdout has gone (`| head`): say nothing, and keep Python from complaining
        # about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("handmap: interrupted, nothing was written", file=sys.stderr)
        return 130
    return 0


def parse(arguments: Sequence[str]) -> Command:
    """The command that the words ask for.

    Args:
        arguments: Words after `handmap`.

    Returns:
        The command, ready to run.

    Raises:
        InvalidInputError: On a mistake in the words, in one line.
        SystemExit: After help was asked for and printed.
    """
    complaint = io.StringIO()
    command, words, name = _Any, list(arguments), "handmap"
    for (first, second), nested in _NESTED.items():
        if words[:2] == [first, second]:
            command, words, name = nested, words[2:], f"handmap {first} {second}"
    try:
        with contextlib.redirect_stderr(complaint):
            description = (__doc__ or "").partition("\n")[0] if command is _Any else None
            return tyro.cli(command, prog=name, description=description, args=words)
    except SystemExit as end:
        if not end.code:
            raise
        if command is _Any and words and words[0] in _COMMANDS:
            name = f"handmap {words[0]}"
        raise InvalidInputError(
            f"{_first_sentences(complaint.getvalue())} (see {name} --help)"
        ) from end


def _first_sentences(box: str) -> str:
    """The message inside the box that tyro draws round it, on one line."""
    lines = [line.strip(" │╭╮╰╯─") for line in box.splitlines() if line.startswith("│")]
    ruled = [i for i, line in enumerate(lines) if not line]
    # Options that have no name of their own stand in a class of tyro's.
    return " ".join(lines[: ruled[0]] if ruled else lines).replace("__tyro-dummy-inner__.", "--")


if __name__ == "__main__":
    sys.exit(main())
