"""Faults of trackers: found or not, and how fast the robot moves across each of them.

Every recording is mapped to an Allegro hand in teleoperation: as it is, and with each fault put in
at several times. Within the time of a fault and of the way back from it, the largest speeds and
accelerations of the command are compared with those of the clean recording in the same time, and
with those of a mapping that follows every sample (`map_landmarks`, as before there was a guard).

A driver takes commands at the rate of the tracker, so differences are taken over at most three
usual periods, however long a hold lasted.

    python benchmarks bench_faults --json faults.json --picture faults.png
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import common
import numpy as np
import pinocchio as pin
from injection import FAULT_KINDS, inject, parse_faults

from handmap_core.human.recording import mirrored, sample_columns
from handmap_core.human.sample import HumanSample
from handmap_core.mapping.step import MapStep
from handmap_core.stream.rejoin import RejoinKind
from handmap_qp import HandMapper, load_hand, read_recording
from handmap_qp.errors import HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.measurement import measure_person

FAULTS = (
    "dropout@{}",
    "dropout@{}+0.03",
    "silence@{}",
    "frozen@{}+0.8",
    "jump@{}:0.2",
    "jump@{}:0.05",
    "flip@{}",
    "flip@{}+1.2",
    "mirror@{}",
    "zero@{}",
    "outlier@{}:0.05",
    "outlier@{}+0.04:0.1",
    "noise@{}+0.5:0.005",
    "clock@{}:5",
    "clock@{}:-5",
    "clock@{}:-0.5",
    "jitter@{}+1:0.002",
    "late@{}",
    "duplicate@{}",
)
"""Faults of the tracker, each at a time to be filled in [s]."""
BEFORE, AFTER = 1.0, 2.5
"""Time that is mapped before the begin of a fault and after its end [s]."""
MEASURES = {
    "joint_speed": "rad/s",
    "joint_acceleration": "rad/s^2",
    "palm_speed": "m/s",
    "palm_turn": "rad/s",
}
RUNS = ("clean", "guarded", "followed")


@dataclass
class Course:
    """Commands of one run, at the times of arrival.

    Attributes:
        time: Times of arrival [s].
        q: Joint angles [rad].
        wrist: Wrist poses.
        rules: The rule that each sample broke.
        states: `MapStep.status` of each.
    """

    time: list[float] = field(default_factory=list)
    q: list[np.ndarray] = field(default_factory=list)
    wrist: list[np.ndarray] = field(default_factory=list)
    rules: list[str] = field(default_factory=list)
    states: list[str] = field(default_factory=list)

    def add(self, time: float, step: MapStep) -> None:
        """Note a command; one that arrives together with another one takes its place."""
        if self.time and self.time[-1] == time:
            for column in (self.time, self.q, self.wrist, self.rules, self.states):
                column.pop()
        self.time.append(time)
        self.q.append(step.command.q)
        self.wrist.append(step.command.wrist)
        self.rules.append(step.rule)
        self.states.append(step.status)


def arrivals(
    samples: Sequence[HumanSample], fault: str
) -> Iterator[tuple[float, HumanSample]]:
    """Yield samples with a fault, and the time at which each of them arrives [s]."""
    now = [0.0]

    def sent() -> Iterator[HumanSample]:
        for sample in samples:
            now[0] = sample.time
            yield sample

    source = inject(sent(), parse_faults(fault)) if fault else sent()
    for sample in source:
        yield now[0], sample


def run_guarded(
    follower: Follower, samples: Sequence[HumanSample], fault: str
) -> Course:
    """Map a stream as live input is mapped."""
    course = Course()
    for time, sample in arrivals(samples, fault):
        course.add(time, follower.map_sample(sample))
    return course


def run_followed(
    mapper: HandMapper, samples: Sequence[HumanSample], fault: str
) -> Course:
    """Map every sample that is valid and can be mapped, whatever it shows."""
    course, stamp, step = Course(), None, None
    for time, sample in arrivals(samples, fault):
        dt = 1.0 / 60.0 if stamp is None else sample.time - stamp
        stamp = sample.time
        if sample.valid:
            with suppress(HandmapError):
                step = mapper.map_landmarks(
                    sample.landmarks, dt=min(max(dt, 1e-3), 0.1)
                )
        if step is not None:
            course.add(time, step)
    return course


def largest(
    course: Course, start: float, end: float, period: float
) -> dict[str, float]:
    """Return the largest speeds and accelerations of the commands in some time."""
    time, q, wrist = np.array(course.time), np.array(course.q), np.array(course.wrist)
    dt = np.minimum(np.diff(time), 3.0 * period)
    speed = np.diff(q, axis=0) / dt[:, None]
    acceleration = np.diff(speed, axis=0) / (0.5 * (dt[1:] + dt[:-1]))[:, None]
    travel = np.linalg.norm(np.diff(wrist[:, :3, 3], axis=0), axis=1) / dt
    turn = [
        np.linalg.norm(pin.log3(before[:3, :3].T @ after[:3, :3]))
        for before, after in pairwise(wrist)
    ] / dt
    inside = (time[1:] >= start) & (time[1:] <= end)
    return {
        "joint_speed": float(np.abs(speed)[inside].max(initial=0.0)),
        "joint_acceleration": float(np.abs(acceleration)[inside[1:]].max(initial=0.0)),
        "palm_speed": float(travel[inside].max(initial=0.0)),
        "palm_turn": float(turn[inside].max(initial=0.0)),
    }


class Stage:
    """A recording, and the mappers for it."""

    def __init__(self, file: Path, robot: Hand) -> None:
        recording = read_recording(file)
        if recording.side != robot.side:
            recording = mirrored(recording)
        person = measure_person(recording)
        self.name = recording.name
        self.samples = [*sample_columns(recording)]
        self.period = float(np.median(np.diff(recording.time)))
        self._human = scaled_human(recording, lengths=person.lengths)
        self._robot = robot
        self._choice = preset_choice("teleoperation", self._human)

    def mapper(self) -> HandMapper:
        """Return a fresh mapper."""
        return HandMapper(
            self._human, self._robot, self._choice.method, ik=self._choice.ik
        )

    def follower(self, rejoin: RejoinKind) -> Follower:
        """Return a fresh follower."""
        return Follower(self.mapper(), rejoin=rejoin)

    def part(self, begin: float, end: float) -> list[HumanSample]:
        """Return the samples of some time, from the first sample on [s]."""
        first = self.samples[0].time
        return [s for s in self.samples if begin <= s.time - first <= end]


def measure(
    stage: Stage, fault: str, at: float, rejoin: RejoinKind
) -> dict[str, Any] | None:
    """Put a fault into a recording at a time, and compare the three runs.

    Args:
        stage: The recording.
        fault: The fault, with its time to be filled in.
        at: Its time, from the first sample on [s].
        rejoin: How the robot comes back.

    Returns:
        A row of the table; None if the tracker lost the hand around that time by itself.
    """
    name, _, rest = fault.partition("@{}")
    duration = min(float(rest[1:].partition(":")[0]) if rest[:1] == "+" else 1e9, 10.0)
    duration = min(duration, FAULT_KINDS[name].duration, 2.0)
    samples = stage.part(at - BEFORE, at + duration + AFTER)
    if not all(sample.valid for sample in samples):
        return None
    begin = samples[0].time
    start = next(s.time for s in samples if s.time - begin >= BEFORE)
    text = fault.format(f"{start - begin:.6f}")
    guarded = run_guarded(stage.follower(rejoin), samples, text)
    clean = run_guarded(stage.follower(rejoin), samples, "")
    followed = run_followed(stage.mapper(), samples, text)
    # The way back ends when the robot glides no more.
    busy = [
        time
        for time, state in zip(guarded.time, guarded.states, strict=True)
        if state in ("held", "gliding") and time >= start
    ]
    end = max([start + duration, *busy]) + 2.0 * stage.period
    found = [
        (time, rule)
        for time, rule in zip(guarded.time, guarded.rules, strict=True)
        if rule and start - 1e-6 <= time <= start + duration + 0.3
    ]
    row: dict[str, Any] = {
        "recording": stage.name,
        "fault": fault.replace("@{}", ""),
        "rule": found[0][1] if found else "-",
        "after_ms": 1e3 * (found[0][0] - start) if found else float("nan"),
        "held_s": stage.period * sum(state == "held" for state in guarded.states),
        "back_s": end - start - duration,
    }
    for run, course in zip(RUNS, (clean, guarded, followed), strict=True):
        for measure_name, value in largest(course, start, end, stage.period).items():
            row[f"{measure_name}_{run}"] = value
    return row


def by_fault(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise the rows of each fault: the largest of every number."""
    table = []
    for fault in dict.fromkeys(row["fault"] for row in rows):
        of = [row for row in rows if row["fault"] == fault]
        found = [row for row in of if row["rule"] != "-"]
        names = sorted({row["rule"] for row in found})
        entry: dict[str, Any] = {
            "fault": fault,
            "events": len(of),
            "found_%": round(100.0 * len(found) / len(of), 1),
            "rules": "/".join(names) or "none",
            "after_ms": max((row["after_ms"] for row in found), default=float("nan")),
            "back_s": max(row["back_s"] for row in of),
        }
        for name in MEASURES:
            entry[f"{name}_excess"] = max(
                row[f"{name}_guarded"] - row[f"{name}_clean"] for row in of
            )
        for name in MEASURES:
            for run in RUNS:
                entry[f"{name}_{run}"] = max(row[f"{name}_{run}"] for row in of)
        table.append(entry)
    return table


def printed(table: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the table for reading: clean / guarded / followed in one cell."""
    labels = {
        name: f"{name.replace('_', ' ')} [{unit}]" for name, unit in MEASURES.items()
    }
    rows = []
    for entry in table:
        row = {key: entry[key] for key in ("fault", "events", "found_%", "rules")}
        row["found after [ms]"] = f"{entry['after_ms']:.0f}"
        row["back [s]"] = f"{entry['back_s']:.2f}"
        for name, label in labels.items():
            row[label] = " / ".join(
                f"{entry[f'{name}_{run}']:.4g}" for run in (*RUNS, "excess")
            )
        rows.append(row)
    return rows


def clean_rows(stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Describe what the guard finds in the recordings as they are."""
    rows = []
    for stage in stages:
        course = run_guarded(stage.follower("glide"), stage.samples, "")
        begins = [
            f"{rule} {time - course.time[0]:.2f} s"
            for i, (time, rule) in enumerate(
                zip(course.time, course.rules, strict=True)
            )
            if rule and (i == 0 or not course.rules[i - 1])
        ]
        rows.append(
            {
                "recording": stage.name,
                "samples": len(course.time),
                "held": sum(state == "held" for state in course.states),
                "found": ", ".join(begins) or "nothing",
            }
        )
    return rows


def draw(table: Sequence[dict[str, Any]]) -> Any:
    """Draw the largest speeds and accelerations of each fault."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(MEASURES), figsize=(13, 6.5), sharey=True)
    places = np.arange(len(table))
    colours = dict(zip(RUNS, ("#8a929c", "#2f7d6b", "#c8452f"), strict=True))
    for axis, (name, unit) in zip(axes, MEASURES.items(), strict=True):
        for k, run in enumerate(RUNS):
            values = [entry[f"{name}_{run}"] for entry in table]
            axis.barh(
                places + 0.27 * (k - 1), values, 0.25, label=run, color=colours[run]
            )
        axis.set_title(f"{name.replace('_', ' ')} [{unit}]")
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(places, [entry["fault"] for entry in table])
    axes[0].invert_yaxis()
    axes[-1].legend(loc="lower right")
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Detection of tracker faults, and the robot's motion across them."
    )
    parser.add_argument("--rejoin", choices=("glide", "clutch"), default="glide")
    arguments = common.parse_arguments(parser)
    files = common.find_recordings(arguments.recordings)
    if arguments.quick:
        files = [min(files, key=lambda file: file.stat().st_size)]
    faults = FAULTS[:: 9 if arguments.quick else 1]
    robot = load_hand("allegro_right")
    stages = [Stage(file, robot) for file in files]
    rows, shares = [], (0.5,) if arguments.quick else (0.3, 0.55, 0.8)
    with common.progress("faults", len(stages) * len(faults) * len(shares)) as advance:
        for stage in stages:
            span = stage.samples[-1].time - stage.samples[0].time
            for fault in faults:
                for share in shares:
                    row = measure(stage, fault, share * span, arguments.rejoin)
                    rows += [] if row is None else [row]
                    advance()
    table, found = by_fault(rows), clean_rows(stages)
    to_stderr = arguments.json == "-"
    common.print_table("Recordings as they are", found, to_stderr=to_stderr)
    common.print_table(
        "Largest in the time of a fault and of the way back: clean / guarded / followed / excess",
        printed(table),
        to_stderr=to_stderr,
        caption="clean: the recording without the fault in the same time; guarded: map_sample; "
        "followed: every valid sample is followed; excess: guarded over clean in one event.",
    )
    common.write_json(
        arguments.json, "faults", {"clean": found, "table": table, "rows": rows}
    )
    common.save_picture(arguments.picture, lambda: draw(table))


if __name__ == "__main__":
    main()
