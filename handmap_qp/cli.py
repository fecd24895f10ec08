"""The command `handmap`: parse the arguments, run a subcommand, and report errors.

A user error is one line on stderr and exit code 2. Ctrl-C is exit code 130, but 0 for `view` and
`serve`, which end that way. Results go to stdout, progress to stderr.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

from handmap_qp.arguments import HandName, MappingArguments, PersonFile
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.experiments.cli import Compare, Figures
from handmap_qp.onboarding.cli import HandsCheck, HandsInit, HandsMatch
from handmap_qp.output_files import check_output
from handmap_qp.service.cli import Keys, Serve
from handmap_qp.tables import print_rows, print_table, progress
from handmap_qp.viewer.cli import View


class Command(Protocol):
    """A subcommand: its fields are its arguments."""

    def run(self) -> None:
        """Run the command; raise `HandmapError` on a user error."""
        ...


@dataclass(frozen=True)
class Demo:
    """Map a human hand's motion to a three-fingered robot hand; needs no data of your own.

    The wrist follows the paper's arc (470 mm by 150 mm, Sec. IV) while the first postural synergy
    closes and opens the hand. Writes the robot's trajectory (.npz), a picture of both hands, and
    plots of errors and joints (.png).

    Examples:
        handmap demo
        handmap demo --out results/demo

    Attributes:
        out: Folder to write to; created if it does not exist.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("demo")

    def run(self) -> None:
        """Run the demo, and print its errors and files."""
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

    Measures the human hand, maps the landmarks of every sample, and prints a summary of errors
    [mm], times [us] and limits. Writes an .npz file with time [s], joint_names, q [rad or m], wrist
    (poses), targets and points [m], point_error [m], valid, versions and more.

    Examples:
        handmap map recording.npz --robot three_finger
        handmap map recording.npz --robot my_hand.yaml --preset object --json
        handmap map recording.npz --robot allegro_right --person anna.yaml

    Attributes:
        recording: Recording of a human hand: an .npz file with handedness, time [s] of shape (T,)
            and landmarks [m] of shape (T, 21, 3).
        robot: Robot hand, by a name that `handmap hands` lists or by the path of its hand.yaml.
        out: File to write.
        person: File of the person's hand, of `handmap calibrate`.
        json: Print the summary as one JSON object instead of a table.
        arguments: Reference points and options.
    """

    recording: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RECORDING")]]
    robot: HandName
    out: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE.npz", help_behavior_hint="(default: RECORDING_ROBOT.npz)"),
    ] = None
    person: PersonFile = None
    json: bool = False
    arguments: Annotated[MappingArguments, tyro.conf.arg(name="")] = field(
        default_factory=MappingArguments
    )

    def run(self) -> None:
        """Read, fit and map the recording, write the trajectory, and print a summary."""
        from handmap_qp.mapping.mapper import HandMapper
        from handmap_qp.offline.summary import speed_note, summarise, table_rows
        from handmap_qp.offline.trajectory import map_recording, save_npz
        from handmap_qp.trackers.landmarks import scaled_human
        from handmap_qp.trackers.person import measure_person, read_person
        from handmap_qp.trackers.recording import read_recording

        recording = read_recording(self.recording)
        robot = self.arguments.load_robot(self.robot)
        out = check_output(
            "--out", self.out or Path(f"{recording.name}_{robot.name}.npz"), (".npz",)
        )
        person = measure_person(recording) if self.person is None else read_person(self.person)
        human = scaled_human(recording, points=self.arguments.human_points, lengths=person.lengths)
        preset = self.arguments.preset_for(human, robot, person.contact_gap)
        mapper = HandMapper(
            human, robot, preset.method, ik=preset.ik, smoothing=self.arguments.smoothing
        )
        with progress(f"mapping to {robot.name}", len(recording)) as advance:
            trajectory = map_recording(mapper, recording, advance)
        save_npz(out, trajectory.columns)
        summary = {"recording": recording.name, **summarise(trajectory), "out": str(out)}
        if self.json:
            print(json.dumps(summary, allow_nan=False))
            return
        print_table(f"{recording.name} to {robot.name}", table_rows(summary))
        if note := speed_note(summary):
            print(note)
        print(f"wrote {out}")


@dataclass(frozen=True)
class Calibrate:
    """Measure a person's hand in a recording, and keep it in a file.

    Measures bone lengths and palm, and the contact gap: the distance that the tracker gives between
    thumb and finger landmarks where the skin touches. Touch every finger with the thumb in the
    recording, and open the hand. `handmap map` and `handmap view` take the file by --person instead
    of measuring every recording again.

    Examples:
        handmap calibrate recording.npz --out anna.yaml
        handmap map another.npz --robot allegro_right --person anna.yaml

    Attributes:
        recording: Recording of a human hand, as for `handmap map`.
        out: File to write.
        overwrite: Replace the file if it exists.
        json: Print one JSON object instead of a table.
    """

    recording: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RECORDING")]]
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.yaml")] = Path("person.yaml")
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Measure the person, write the file, and print the measures."""
        from handmap_qp.trackers.person import measure_person, write_person
        from handmap_qp.trackers.recording import read_recording

        out = check_output("--out", self.out, (".yaml", ".yml"))
        if out.exists() and not self.overwrite:
            raise InvalidInputError(
                argument="--out",
                problem=f"{out} exists already",
                value=str(out),
                advice="give --overwrite to replace it",
            )
        recording = read_recording(self.recording)
        person = measure_person(recording)
        write_person(person, out)
        samples = int(recording.valid.sum())
        if self.json:
            measures = {
                "name": person.name,
                "samples": samples,
                "hand_length_m": person.hand_length,
                "contact_gap_m": person.contact_gap,
                "out": str(out),
            }
            print(json.dumps(measures))
            return
        rows = {
            "samples": samples,
            "hand length, wrist to middle tip": f"{1e3 * person.hand_length:.0f} mm",
            "contact gap": f"{1e3 * person.contact_gap:.1f} mm",
        }
        print_table(person.name, rows)
        print(f"wrote {out}")


@dataclass(frozen=True)
class Hands:
    """List the hands of the package, or describe one hand.

    A description shows joints with their limits [rad or m, and per second], reference points [m]
    and point sets. To use a hand of your own, write its description with `handmap hands init` and
    check it with `handmap hands check`. `handmap hands match` shows the posture that corresponds to
    the resting human hand. Each of the three has its own --help.

    Examples:
        handmap hands
        handmap hands allegro_right
        handmap hands init my_robot.urdf --out my_hand.yaml
        handmap hands check my_hand.yaml
        handmap hands match my_hand.yaml

    Attributes:
        hand: Hand to describe, by name or by the path of its hand.yaml.
        json: Print JSON instead of tables.
    """

    hand: tyro.conf.Positional[
        Annotated[
            str | None, tyro.conf.arg(metavar="[HAND]", help_behavior_hint="(default: list all)")
        ]
    ] = None
    json: bool = False

    def run(self) -> None:
        """Print the list or the description."""
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
    "calibrate": Calibrate,
    "compare": Compare,
    "view": View,
    "hands": Hands,
    "figures": Figures,
    "serve": Serve,
    "keys": Keys,
}
_NESTED: dict[str, Any] = {
    "hands init": HandsInit,
    "hands check": HandsCheck,
    "hands match": HandsMatch,
}
"""Subcommands of a command that also runs on its own."""
_ABOUT = """Map the motion of a human hand onto a robotic hand.

Lengths are in metres, angles in radians and times in seconds unless a unit is given.
`handmap COMMAND --help` explains a command and its options.

Examples:
    handmap demo
    handmap hands
    handmap map recording.npz --robot allegro_right
    handmap compare recording.npz --robot allegro_right
    handmap view recording.npz --robot allegro_right
"""


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
        # The reader closed stdout (`| head`): end quietly, also when Python flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("handmap: interrupted, nothing was written", file=sys.stderr)
        return 130
    return 0


def parse(arguments: Sequence[str]) -> Command:
    """Parse the command line.

    Args:
        arguments: Words after `handmap`.

    Returns:
        The command, ready to run.

    Raises:
        InvalidInputError: If the words are not a valid command, in one line.
        SystemExit: After printing the help that was asked for.
    """
    words, message, printed = list(arguments), io.StringIO(), _Page()
    commands = {**_COMMANDS, **_NESTED}
    name = next((key for key in (" ".join(words[:2]), *words[:1]) if key in commands), "")
    command = commands[name] if name else _any_command()
    program = f"handmap {name}".rstrip()
    about = (inspect.getdoc(command) or "").partition("\nAttributes:")[0] if name else _ABOUT
    try:
        with contextlib.redirect_stderr(message), contextlib.redirect_stdout(printed):
            return tyro.cli(
                command, prog=program, description=about, args=words[len(name.split()) :]
            )
    except SystemExit as end:
        if not end.code:
            encoding = sys.stdout.encoding or "utf-8"
            page = _wrapped(printed.getvalue())
            print(page.encode(encoding, "replace").decode(encoding), end="")
            raise
        raise InvalidInputError(
            problem=f"{_first_sentences(message.getvalue())} (see {program} --help)"
        ) from end


class _Page(io.StringIO):
    """Collect what would be printed, in colour if stdout is a terminal."""

    encoding = "utf-8"

    def __init__(self) -> None:
        super().__init__()
        self._is_terminal = sys.stdout.isatty()

    def isatty(self) -> bool:
        """Return whether stdout is a terminal."""
        return self._is_terminal


def _any_command() -> Any:
    """Return a type that lists all commands with the first line of their descriptions."""
    kinds = (
        Annotated[
            kind,
            tyro.conf.subcommand(
                name, description=(kind.__doc__ or "").partition("\n")[0], prefix_name=False
            ),
        ]
        for name, kind in _COMMANDS.items()
    )
    return reduce(or_, kinds)


def _wrapped(page: str) -> str:
    """Wrap the lines of a help page that tyro leaves too long: the description."""
    width = max(40, shutil.get_terminal_size().columns)
    lines = (
        line
        if len(line) <= width or line.startswith(("│", "╭", "╰"))
        else textwrap.fill(line, width)
        for line in page.splitlines(keepends=True)
    )
    return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)


def _first_sentences(box: str) -> str:
    """Return the message inside the box that tyro prints, on one line."""
    lines = [line.strip(" │╭╮╰╯─") for line in box.splitlines() if line.startswith("│")]
    ruled = [i for i, line in enumerate(lines) if not line]
    # tyro prefixes options of groups without a name.
    return " ".join(lines[: ruled[0]] if ruled else lines).replace("__tyro-dummy-inner__.", "--")


if __name__ == "__main__":
    sys.exit(main())
