"""The commands `handmap map` and `handmap calibrate`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from handmap_qp.arguments import HandName, MappingArguments, PersonFile
from handmap_qp.errors import InvalidInputError
from handmap_qp.output_files import check_output
from handmap_qp.tables import print_table, progress


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
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml.
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
