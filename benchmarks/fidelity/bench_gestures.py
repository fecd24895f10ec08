"""Static gestures after one another: the thumb, the worst finger, and fingers that stay caught.

    python benchmarks bench_gestures
    python benchmarks bench_gestures --robots leap_right --caught --start
    python benchmarks bench_gestures --robots svh_right --paces half-second wait own --sheets sheets

Every labelled pose of a right hand follows every other one, half a second between them (minimum
jerk) and half a second each. The palm stays. Poses and reader are those of `handmap score`. A
finger counts as caught where, at the end of its pose, it points or bends more than 60 degrees off
the person's. *read* is the share of poses that the reader, who has seen people only, names right.
*still* counts samples in which the person moves, and no joint of the robot does. `start` maps one
recording from 20 cuts: the share of samples whose joints differ by more than 5 degrees, a second
later, from those of the whole recording. An *open* thumb's tip is 50 mm and more from all bones of
the other fingers; *visible* is its part from the MCP joint to the tip. *kink* is how much more an
index or middle finger bends than the person's that is straight (95th percentile).

*arrival* is the time from the person's last motion until every finger, thumb included, is within 15
degrees of where it ends, in direction and bend (median and 95th percentile). It is infinite where
a finger still turns by more than 10 degrees a second when the next pose begins.

`--paces` has a row each: `half-second`; `wait` holds every pose until the robot is at rest, at most
8 s; with `own`, motions are as slow as the robot's joints need too. So `own` counts fingers that
stay caught, and no finger that is on its way. `--caught` names them, with the reason: no posture of
the finger shows more; it is under way; it is caught too where the robot meets the pose at rest; or
it is caught after the pose before. `--sheets` draws these poses. `--transitions` takes random
pairs.

`--held-back` has poses that no mapping was tuned on (`tests/data/held_back`), without a reader.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shared_hands
from arrivals import FingerMeter, arrival_time
from caught_fingers import CaughtFinger, find_caught
from gesture_tours import (
    PACES,
    RATE,
    Pose,
    TourMotion,
    compare,
    extensions,
    map_tour,
    random_tour,
    read_held_back,
    read_poses,
    settle,
    thumb_away,
    thumb_errors,
    tour,
)
from handmap_score.reader import Reader

from handmap_qp import Hand, HandmapError, HandMapper, Recording, read_recording
from handmap_qp.apps.drawing.contact_sheet import contact_sheet, sheet_rows
from handmap_qp.apps.offline.hand_trace import trace_human, trace_robot
from handmap_qp.apps.offline.surface_gaps import GapMeter, whose_shapes
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.hands import FINGERS
from handmap_qp.hands.human import HumanLengths
from handmap_qp.human.measure import scaled_human
from handmap_qp.stream.measurement import measure_person

ROBOTS = ("allegro_right", "leap_right", "shadow_right", "wuji_right", "orca_right")
_ROWS = 8
"""Poses on a sheet."""
_CUTS, _LATER, _APART = 20, 1.0, 5.0
_OPEN = 0.05
"""Distance from all fingers at which a thumb is open [m]."""
_STRAIGHT = 0.97
"""Share of its reach at which a person's finger is straight."""


class CaughtPose(NamedTuple):
    """The end of a pose with caught fingers.

    Attributes:
        names: The pose before and this one.
        fingers: What is caught.
        landmarks: The person, shape (21, 3).
        q: The robot's joints, shape (n,).
        settled: Its joints where it meets the pose at rest, shape (n,).
    """

    names: str
    fingers: list[CaughtFinger]
    landmarks: np.ndarray
    q: np.ndarray
    settled: np.ndarray


def measure(
    name: str, preset: str, pace: str, poses: Sequence[Pose], order: list[int]
) -> tuple[dict[str, Any], list[CaughtPose]]:
    """Measure a hand; return its row, and the poses in which fingers are caught."""
    given = shared_hands.load(name)
    settled = settle(given, poses, preset)
    motion = map_tour(given, poses, order, preset, PACES[pace], settled)
    robot, q = motion.robot, motion.q
    shown = np.array([poses[k].landmarks for k in order])
    human = trace_human(shown, HumanLengths.from_hand_length(0.19))
    own = trace_robot(robot, q, motion.wrist)
    errors = compare(human, own)
    is_straight = extensions(shown) > _STRAIGHT
    kinks = [
        errors.bend[is_straight[:, FINGERS.index(finger) - 1], column]
        for column, finger in enumerate(errors.names)
        if finger in ("index", "middle")
    ]
    kink = np.concatenate(kinks) if kinks else np.zeros(0)
    is_thumb = np.array([finger == "thumb" for finger in errors.names])
    others = np.array([finger in FINGERS[1:4] for finger in errors.names])
    thumb = errors.direction[:, is_thumb].ravel()
    is_open = thumb_away(shown) > _OPEN
    visible = thumb_errors(robot, q, shown)[is_open]
    last = errors.last[:, is_thumb].ravel()
    worst = errors.direction[:, others].max(axis=1)
    caught = find_caught(human, motion, settled[order])
    meter = GapMeter(robot)
    _, first = np.unique(order, return_index=True)
    right = []
    for source in dict.fromkeys(pose.source for pose in poses):
        if source is None:
            continue
        is_own = np.array([poses[k].source == source for k in order])
        names = tuple(poses[k].name for k in order if poses[k].source == source)
        reader = Reader(source, robot.side, tuple(errors.names))
        read = reader.read(own.part(is_own, errors.names), names)
        right += np.equal(read, names).tolist()
    row = {
        "robot": name,
        "preset": preset,
        "pace": pace,
        "poses": len(order),
        "thumb": np.median(thumb),
        "thumb p95": np.percentile(thumb, 95),
        "last bone": np.median(last),
        "open, visible": np.median(visible),
        "open, last bone": np.median(last[is_open]),
        "kink": np.percentile(kink, 95) if len(kink) else float("nan"),
        "worst finger": np.median(worst),
        "worst p95": np.percentile(worst, 95),
        "caught": len({each.pose for each in caught}),
        **arrivals(motion),
        "still": motion.still,
        "read": np.mean(right) if right else float("nan"),
        "closed": pinches_closed(meter, q, shown, errors.names),
        "deepest_mm": 1e3 * min(0.0, meter.nearest(q[first]).min()),
    }
    by_pose: dict[int, list[CaughtFinger]] = {}
    for each in caught:
        by_pose.setdefault(each.pose, []).append(each)
    found = []
    for i, fingers in by_pose.items():
        names = " -> ".join(poses[k].name for k in order[max(0, i - 1) : i + 1])
        found.append(CaughtPose(names, fingers, shown[i], q[i], settled[order[i]]))
    return row, found


def arrivals(motion: TourMotion) -> dict[str, float]:
    """Return columns of arrival times [s]: median and 95th percentile."""
    meter = FingerMeter(motion.robot)
    times = [
        arrival_time(np.arange(len(q)) / RATE, meter.shapes(q)) for q in motion.held
    ]
    # No mean of two values: one of them may be infinite.
    median, high = np.percentile(times, [50, 95], method="higher")
    return {"arrival": median, "arrival p95": high}


def pinches_closed(
    meter: GapMeter, q: np.ndarray, landmarks: np.ndarray, names: list[str]
) -> float:
    """Return the share of the human's pinches (gap below 15 mm) that the robot closes to 3 mm."""
    found = []
    gaps = np.linalg.norm(landmarks[:, [8, 12, 16, 20]] - landmarks[:, 4:5], axis=2)
    chosen = np.flatnonzero((gaps < 0.015).any(axis=1))
    if not len(chosen):
        return float("nan")
    measured = meter.pinches(q[chosen])
    for finger, column in zip(FINGERS[1:], gaps[chosen].T, strict=True):
        if finger in measured and finger in names:
            found += (measured[finger][column < 0.015] < 0.003).tolist()
    return float(np.mean(found)) if found else float("nan")


def start_dependence(name: str, recording: Recording) -> float:
    """Return the share of samples, a second after a cut, with a joint more than 5 deg apart."""
    robot = shared_hands.load(name)
    person = measure_person(recording)
    human = scaled_human(recording, points="landmarks", lengths=person.lengths)
    whole = map_recording(HandMapper(human, robot), recording)
    apart = []
    count = len(recording)
    for cut in np.linspace(0, 0.7 * count, _CUTS, dtype=int)[1:]:
        part = recording.part(slice(cut, count))
        found = map_recording(HandMapper(human, robot), part)
        later = part.time >= part.time[0] + _LATER
        differences = np.abs(found.q - whole.q[cut:])[later]
        apart.append(np.degrees(differences).max(axis=1) > _APART)
    return float(np.concatenate(apart).mean())


def print_caught(title: str, caught: list[CaughtPose], *, to_stderr: bool) -> None:
    """Print every transition after which fingers are caught, and how often for which reason."""
    out = sys.stderr if to_stderr else sys.stdout
    print(f"{title}:", file=out)
    for pose in caught:
        fingers = "; ".join(map(str, pose.fingers))
        print(f"  {pose.names}: {fingers}", file=out)
    reasons = Counter(
        f"{each.finger}: {each.reason}" for pose in caught for each in pose.fingers
    )
    for reason, count in reasons.most_common():
        print(f"  {count} x {reason}", file=out)


def draw_sheets(
    folder: Path, title: str, robot: Hand, caught: list[CaughtPose]
) -> None:
    """Draw poses with caught fingers: the person, the robot, and the robot that met them at rest.

    Of transitions to the same pose with the same fingers caught, the first one is drawn.
    """
    first: dict[tuple[str, ...], CaughtPose] = {}
    for pose in caught:
        key = pose.names.split(" -> ")[-1], *(each.finger for each in pose.fingers)
        first.setdefault(key, pose)
    drawn = list(first.values())
    columns = [(title, robot), ("met at rest", robot)]
    for start in range(0, len(drawn), _ROWS):
        part = drawn[start : start + _ROWS]
        landmarks = np.array([pose.landmarks for pose in part])
        seen = np.ones(len(part), dtype=bool)
        recording = Recording("caught", np.arange(len(part)), landmarks, seen, "right")
        motions = [np.array([p.q for p in part]), np.array([p.settled for p in part])]
        samples: dict[str, int | None] = {str(i): i for i in range(len(part))}
        rows = [
            row._replace(
                label=pose.names.split(" -> ")[-1].replace("_HAND_", " ").lower(),
                note="\n".join(
                    f"{each.finger} {each.direction:.0f}, {each.bend:+.0f}"
                    for each in pose.fingers
                ),
            )
            for row, pose in zip(
                sheet_rows(recording, samples, motions), part, strict=True
            )
        ]
        file = folder / f"{title}_{start:03d}.png"
        contact_sheet(columns, rows).savefig(file, dpi=100)
        print(f"wrote {file}", file=sys.stderr)


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the angles and the caught fingers of every hand and preset."""
    from matplotlib.figure import Figure

    panels = ("thumb", "thumb p95", "last bone", "worst p95", "caught")
    figure = Figure(
        figsize=(2.4 * len(panels), 1.2 + 0.3 * len(rows)), layout="constrained"
    )
    names = [f"{row['robot']}, {row['preset']}, {row['pace']}" for row in rows][::-1]
    for axes, key in zip(
        figure.subplots(1, len(panels), sharey=True), panels, strict=True
    ):
        axes.barh(names, [row[key] for row in rows][::-1], color=common.PALETTE[1])
        unit = "of all poses" if key == "caught" else "deg"
        axes.set(title=key, xlabel=unit)
    return figure


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = common.make_parser("Static gestures after one another.")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), metavar="HAND")
    parser.add_argument("--presets", nargs="+", default=["teleoperation"])
    parser.add_argument("--caught", action="store_true", help="list transitions")
    parser.add_argument("--start", action="store_true", help="map recordings from cuts")
    parser.add_argument(
        "--held-back", action="store_true", help="poses that nothing was tuned on"
    )
    parser.add_argument(
        "--paces",
        nargs="+",
        choices=PACES,
        default=["half-second"],
        help="how fast the person is (default: half-second)",
    )
    parser.add_argument(
        "--transitions",
        type=int,
        metavar="N",
        help="N random transitions (default: every pair)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of --transitions (default: 0)"
    )
    parser.add_argument(
        "--sheets", type=Path, metavar="FOLDER", help="draw poses with caught fingers"
    )
    return parser


def starts_of(name: str, folder: Path) -> list[dict[str, Any]]:
    """Return the start dependence of a hand in every recording of a right hand."""
    rows = []
    for file in common.find_recordings(folder):
        recording = read_recording(file)
        if recording.side == "right":
            share = start_dependence(name, recording)
            rows.append({"robot": name, "recording": file.stem, "apart": share})
    return rows


def order_of(arguments: argparse.Namespace, count: int) -> list[int]:
    """Return which of the poses follow each other."""
    if arguments.transitions is None:
        return tour(count)
    if arguments.transitions < 1:
        common.stop(f"--transitions {arguments.transitions}: expected 1 or more")
    return random_tour(count, arguments.transitions, arguments.seed)


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    arguments: argparse.Namespace = common.parse_arguments(make_parser(), words)
    poses = read_held_back() if arguments.held_back else read_poses()
    if arguments.quick:
        poses, arguments.robots = poses[:4], arguments.robots[:1]
    order = order_of(arguments, len(poses))
    if arguments.sheets:
        arguments.sheets.mkdir(parents=True, exist_ok=True)
    is_json = arguments.json == "-"
    rows, starts, surfaces = [], [], {}
    for name in arguments.robots:
        try:
            robot = shared_hands.load(name)
        except (HandmapError, FileNotFoundError) as error:
            print(f"without {name}: {error}", file=sys.stderr)
            continue
        surfaces[name] = whose_shapes(robot)
        for preset, pace in product(arguments.presets, arguments.paces):
            row, caught = measure(name, preset, pace, poses, order)
            rows.append(row)
            if arguments.caught:
                print_caught(f"{name}, {preset}, {pace}", caught, to_stderr=is_json)
            if arguments.sheets and caught:
                title = f"{name}_{preset}_{pace}"
                draw_sheets(arguments.sheets, title, robot, caught)
        if arguments.start:
            starts += starts_of(name, arguments.recordings)
    common.print_table(
        "Gestures, degrees",
        rows,
        to_stderr=is_json,
        caption="closed, deepest_mm: " + "; ".join(surfaces.values()),
    )
    if starts:
        common.print_table("Start dependence", starts, to_stderr=is_json)
    common.save_picture(arguments.picture, lambda: draw(rows))
    common.write_json(
        arguments.json, "bench_gestures", {"rows": rows, "starts": starts}
    )


if __name__ == "__main__":
    main()
