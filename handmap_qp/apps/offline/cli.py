"""The commands `handmap retarget`, `handmap align` and `handmap calibrate`."""

import json
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from handmap_core.errors import HandmapError, expect, warn
from handmap_qp.apps.arguments import (
    InputArguments,
    InputFlags,
    MappingArguments,
    MappingFlags,
    PersonFile,
    Recordings,
    hinted,
    person_of,
    read_long_robot,
)
from handmap_qp.apps.drawing import require_drawing
from handmap_qp.apps.tables import print_result, print_rows, progress
from handmap_qp.hands import Hand, Values, joined, load_hand
from handmap_qp.human import PALM, Recording, human_name, write_person
from handmap_qp.mapping import alignment_from_gestures
from handmap_qp.output_files import check_new, check_output, make_folder
from handmap_qp.stream import measure_person
from handmap_qp.trackers import (
    SIDES,
    LongRecording,
    all_long,
    in_memory,
    save_npz,
)
from .inputs import describe_input, input_notes, input_rows
from .long_motion import map_long
from .long_summary import summarise_long
from .moments import MappedMotion, save_moments
from .summary import compare_closing, notes, summarise, table_rows
from .trajectory import Trajectory, map_hands

PICTURE_FORMS = (".png", ".webp", ".svg", ".pdf")
"""Suffixes of the picture, the usual one first."""
_TOUCHES = "teleoperation of one hand, with a wrist that moves, at scale 1"
"""What can map an object."""


@dataclass(frozen=True)
class Retarget:
    """Map a recording of a human hand to a robot hand.

    Measures the human hand, maps the landmarks of every sample, and prints a summary of errors
    [mm], times [us] and limits. Writes an .npz file with time [s], joint_names, q [rad or m], wrist
    (poses), targets and points [m], point_error [m], valid, versions and more.

    Both hands are in one file or in two; --robots names a left and a right robot hand, each in a
    world of its own, and --robot a robot with both (`handmap robots list`). The forms of files are
    listed by `handmap convert --help`. `handmap map` is the same command by its former name.

    Look at --picture first: it has six moments of the recording, the person's hands beside the
    robot.

    Examples:
        handmap retarget demo --robot allegro_right
        handmap retarget pinch --robot g1 --picture g1.png
        handmap retarget recording.npz --robot my_hand.yaml --preset object --json
        handmap retarget recording.npz --robot allegro_right --person anna.yaml
        handmap retarget left.npz right.npz --robots allegro_left allegro_right
        handmap retarget left.npz right.npz --robot g1
        handmap retarget glove.csv --layout manus --side right --robot allegro_right

    Attributes:
        recordings: Recording of a human hand, or one of each hand: files as in `handmap convert`.
            `FILE::NAME` is one recording of several in a file; `demo` comes with the package.
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml; `allegro`
            is the Allegro of the recording's side. Or a robot with both hands: a name of
            `handmap robots list`, or the path of its robot.yaml.
        robots: A left and a right robot hand, for recordings of both human hands.
        out: File to write; with --robots the folder.
        picture: Picture of moments to draw, .png, .webp, .svg or .pdf; with --robots of both hands.
        mirror: Map the mirror image of a recording of the other hand.
        person: File of the person's hand, of `handmap calibrate`.
        json: Print the summary as one JSON object instead of a table; with --robots a list.
        inputs: How the recordings are to be read.
        arguments: Reference points and options.
    """

    recordings: Positional[
        Annotated[tuple[Path, ...], hinted("RECORDING [RECORDING]", "(required)")]
    ]
    robot: Annotated[str | None, hinted("HAND", "(or give --robots)")] = None
    robots: Annotated[
        tuple[str, str] | None, hinted("LEFT RIGHT", "(or give --robot)")
    ] = None
    out: Annotated[
        Path | None, hinted("FILE.npz", "(default: RECORDING_ROBOT.npz)")
    ] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    mirror: bool = False
    person: PersonFile = None
    json: bool = False
    inputs: InputFlags = InputArguments()
    arguments: MappingFlags = MappingArguments()

    def run(self) -> None:
        """Read, measure and map, write the trajectories, and print summaries."""
        # Files are checked before any work is done.
        if self.picture:
            check_output("--picture", self.picture, PICTURE_FORMS)
            require_drawing()
        with progress("reading"):
            read = self._read()
        moves = [
            (robot, used, self._out(in_memory(used[0]), robot)) for robot, used in read
        ]
        del read
        motions = []
        summaries = []
        for robot, used, out in moves:
            motion, summary = self._write(robot, used, out)
            summaries.append(summary)
            if self.picture:
                motions.append(motion)
            # Free it before that of the other hand is made.
            del motion
        if self.picture:
            with progress("drawing"):
                save_moments(self.picture, motions)
        if self.json:
            found = summaries if self.robots else summaries[0]
            print(json.dumps(found, allow_nan=False))
            return
        for summary in summaries:
            title = f"{summary['recording']} to {summary['robot']}"
            alignment = {"alignment": f"{summary['alignment']}"}
            assumed = input_rows(summary["inputs"])
            print_rows(title, table_rows(summary) | assumed | alignment)
            for note in [*notes(summary), *input_notes(summary["inputs"])]:
                print(note)
            print(f"wrote {summary['out']}")
        if self.picture:
            print(f"wrote {self.picture}")

    def _read(self) -> list[tuple[Hand, Sequence[Recording | LongRecording]]]:
        """Read each robot with the recordings of its hands, or open those that are long."""
        expect(
            (self.robot is None) != (self.robots is None),
            "--robot",
            "either --robot HAND or --robots LEFT RIGHT",
            advice="name hands of `handmap hands list`",
        )
        if self.robot is not None:
            return [read_long_robot(self.robot, self.recordings, self)]
        robots = [
            self.arguments.load_robot(name, side)
            for name, side in zip(self.robots or (), SIDES, strict=False)
        ]
        for robot, side in zip(robots, SIDES, strict=True):
            expect(
                robot.side == side,
                "--robots",
                "a left hand, then a right hand",
                got=f"{robot.name}, a {robot.side} one",
            )
        hands = self.inputs.read_both_long(
            self.recordings, self.person, mirror=self.mirror
        )
        return [(robot, [hands[robot.side]]) for robot in robots]

    def _out(self, recording: Recording, robot: Hand) -> Path:
        """Check the file to write."""
        out = Path(f"{recording.name}_{robot.name}.npz")
        if self.out:
            out = self.out / out if self.robots else self.out
        if self.robots:
            make_folder(out.parent, "--out")
        return check_output("--out", out, (".npz",))

    def _write(
        self, robot: Hand, used: Sequence[Recording | LongRecording], out: Path
    ) -> tuple[MappedMotion, Values]:
        """Map the recordings of a robot's hands, and write the motion; return its summary too."""
        long = all_long(used)
        recordings = [in_memory(each) for each in long or used]
        # Before there is a motion: in memory, that of an hour is as large as the recording.
        inputs = [*map(describe_input, recordings)]
        if long:
            motion, summary = self._map_long(robot, long, out)
        else:
            motion = self._map(robot, recordings)
            save_npz(out, motion.trajectory.all_columns)
            summary = summarise(motion.trajectory)
        return motion, self._summary(motion, summary, inputs, out)

    def _map(self, robot: Hand, used: list[Recording]) -> MappedMotion:
        """Map the recordings of a robot's hands."""
        person = person_of(used, self.person)
        with progress(f"mapping to {robot.name}", max(map(len, used))) as advance:
            trajectory, method, followed = map_hands(
                used, robot, person, self.arguments, advance
            )
        _warn_of_objects(trajectory, used)
        return MappedMotion(trajectory, used, method, followed)

    def _map_long(
        self, robot: Hand, used: list[LongRecording], out: Path
    ) -> tuple[MappedMotion, Values]:
        """Map long recordings, and write the motion; return its overview and its summary."""
        overviews = [each.overview for each in used]
        person = person_of(overviews, self.person)
        with ExitStack() as opened:
            with progress(f"mapping to {robot.name}", max(map(len, used))) as advance:
                motion = opened.enter_context(
                    map_long(used, robot, person, self.arguments, out, advance)
                )
            with progress("writing"):
                save_npz(out, motion.all_columns)
            blocks = max(used, key=len).blocks
            trajectory = motion.trajectory(*blocks)
            _warn_of_objects(trajectory, overviews)
            followed = motion.followed.blocks(blocks)
            return (
                MappedMotion(trajectory, overviews, motion.method, followed),
                summarise_long(motion, trajectory),
            )

    def _summary(
        self, motion: MappedMotion, summary: Values, inputs: list[Values], out: Path
    ) -> Values:
        """Return the summary of what was mapped and written."""
        trajectory, used, method, _ = motion
        return {
            "recording": " and ".join(each.name for each in used),
            **summary,
            "closing": self._closing(trajectory.robot, used)
            if summary["speed_limited_joints"]
            else None,
            "inputs": inputs,
            "alignment": getattr(method, "alignment", None),
            "out": str(out),
            "picture": self.picture and str(self.picture),
        }

    def _closing(self, robot: Hand, used: Sequence[Recording]) -> Values | None:
        """Compare how long robot and person take for a fist, where that can be measured."""
        # Whose size it is does not matter: see `fist_time`.
        humans = [load_hand(human_name(each.side)) for each in used]
        with suppress(HandmapError):
            return compare_closing(joined("human", *humans), robot, used)
        return None


def _warn_of_objects(trajectory: Trajectory, used: Sequence[Recording]) -> None:
    """Warn if a recording has an object, and the motion has none."""
    if trajectory.object_pose is None and any(each.object_shape for each in used):
        name = trajectory.robot.name
        warn(f"{name} is mapped without the object: {_TOUCHES} touches it")


@dataclass(frozen=True)
class Align:
    """Find how a tracker's world and a robot's are aligned, from three reaches in a recording.

    For trackers that do not say which axes are up and forward. Reach forward, from there to your
    left, and from there up, each along a straight line of 5 cm or more. Give the instants at which
    you began and ended. Prints the option `alignment` for a robot whose z is up and whose x is
    forward (REP 103).

    Examples:
        handmap align reaches.npz --at 1 2 4 6

    Attributes:
        recording: Recording of a human hand, as for `handmap retarget`.
        at: When you began, were forward, were left and were up, from the first sample on [s].
        inputs: How the recording is to be read.
    """

    recording: Positional[Annotated[Path, hinted("RECORDING", "(required)")]]
    at: tuple[float, float, float, float]
    inputs: InputFlags = InputArguments()

    def run(self) -> None:
        """Read the recording, and print the option."""
        recording = self.inputs.read(self.recording)
        is_order = self.at[0] >= 0.0 and np.all(np.diff(self.at) > 0.0)
        expect(is_order, "--at", "instants from 0 on, in order", value=self.at)
        samples = np.searchsorted(recording.time - recording.time[0], self.at)
        is_seen = np.append(recording.valid, False)[samples].all()
        expect(is_seen, "--at", "instants at which the hand is seen", value=self.at)
        places = recording.landmarks[samples][:, PALM].mean(axis=1)
        rotation = alignment_from_gestures(np.diff(places, axis=0))
        # YAML takes 1e-09 for a text.
        rows = [[f"{number:.9f}" for number in row] for row in rotation]
        print("--alignment", *np.ravel(rows))
        text = str(rows).replace("'", "")
        print(f"or, in a file for --options:\nalignment: {text}")


@dataclass(frozen=True)
class Calibrate:
    """Measure a person's hand in recordings, and keep it in a file.

    Measures bone lengths and palm, and the contact gap: the distance that the tracker gives between
    thumb and finger landmarks where the skin touches. Touch every finger with the thumb in the
    recording, and open the hand. Samples that make no sense (jumps, outliers and the like) do not
    count. The file is taken by --person of `handmap retarget`, `view`, `compare` and `track`
    instead of measuring every recording again.

    Examples:
        handmap calibrate recording.npz --out anna.yaml
        handmap calibrate left.npz right.npz --out anna.yaml
        handmap retarget another.npz --robot allegro_right --person anna.yaml

    Attributes:
        recordings: Recordings of the person's hands, as for `handmap retarget`; all count together.
        out: File to write.
        overwrite: Replace the file if it exists.
        json: Print one JSON object instead of a table.
        inputs: How the recording is to be read.
    """

    recordings: Recordings
    out: Annotated[Path, arg(metavar="FILE.yaml")] = Path("person.yaml")
    overwrite: bool = False
    json: bool = False
    inputs: InputFlags = InputArguments()

    def run(self) -> None:
        """Measure the person, write the file, and print the measures."""
        out = check_output("--out", self.out, (".yaml", ".yml"))
        check_new("--out", out, overwrite=self.overwrite)
        expect(self.recordings, "RECORDING", "at least one file", got="none")
        recordings = [self.inputs.read(file) for file in self.recordings]
        person = measure_person(*recordings)
        write_person(person, out)
        samples = sum(int(recording.valid.sum()) for recording in recordings)
        measures = {
            "name": person.name,
            "samples": samples,
            "hand_length_m": person.hand_length,
            "contact_gap_m": person.contact_gap,
            "out": str(out),
        }
        rows = {
            "samples": samples,
            "hand length, wrist to middle tip": f"{1e3 * person.hand_length:.0f} mm",
            "contact gap": f"{1e3 * person.contact_gap:.1f} mm",
        }
        print_result(measures, {person.name: rows}, [out], as_json=self.json)
