"""Static gestures after one another: the thumb, the worst finger, and fingers that stay caught.

    python benchmarks bench_gestures
    python benchmarks bench_gestures --robots leap_right --caught --start

Every labelled pose of a right hand follows every other one, half a second between them (minimum
jerk) and half a second each. The palm stays. Poses and reader are those of `handmap score`. A
finger counts as caught where, at the end of its pose, it points or bends more than 60 degrees off
the person's. *read* is the share of poses that the reader, who has seen people only, names right.
*still* counts samples in which the person moves, and no joint of the robot does. `start` maps one
recording from 20 cuts: the share of samples whose joints differ by more than 5 degrees, a second
later, from those of the whole recording. An *open* thumb's tip is 50 mm and more from all bones of
the other fingers; *visible* is its part from the MCP joint to the tip. *kink* is how much more an
index or middle finger bends than the person's that is straight (95th percentile).

`--held-back` has poses that no mapping was tuned on (`tests/data/held_back`), without a reader.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import shared_hands
from gesture_tours import (
    CAUGHT,
    Pose,
    compare,
    extensions,
    map_tour,
    read_held_back,
    read_poses,
    thumb_away,
    thumb_errors,
    tour,
)
from handmap_score.reader import Reader

from handmap_qp import HandmapError, HandMapper, Recording, read_recording
from handmap_qp.apps.offline.hand_trace import trace_human, trace_robot
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.hands import FINGERS
from handmap_qp.hands.human import HumanLengths
from handmap_qp.human.measure import scaled_human
from handmap_qp.stream.measurement import measure_person

ROBOTS = ("allegro_right", "leap_right", "shadow_right", "wuji_right", "orca_right")
_CUTS, _LATER, _APART = 20, 1.0, 5.0
_OPEN = 0.05
"""Distance from all fingers at which a thumb is open [m]."""
_STRAIGHT = 0.97
"""Share of its reach at which a person's finger is straight."""


def measure(
    name: str, preset: str, poses: Sequence[Pose]
) -> tuple[dict[str, Any], Any]:
    """Measure a hand; return its row, and what a sheet is drawn of."""
    robot = shared_hands.load(name)
    order = tour(len(poses))
    robot, q, wrist, still = map_tour(robot, poses, order, preset)
    shown = np.array([poses[k].landmarks for k in order])
    lengths = HumanLengths.from_hand_length(0.19)
    own = trace_robot(robot, q, wrist)
    errors = compare(trace_human(shown, lengths), own)
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
    off = np.maximum(errors.direction, np.abs(errors.bend))[:, ~is_thumb]
    caught = (off > CAUGHT).any(axis=1)
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
        "poses": len(order),
        "thumb": np.median(thumb),
        "thumb p95": np.percentile(thumb, 95),
        "last bone": np.median(last),
        "open, visible": np.median(visible),
        "open, last bone": np.median(last[is_open]),
        "kink": np.percentile(kink, 95) if len(kink) else float("nan"),
        "worst finger": np.median(worst),
        "worst p95": np.percentile(worst, 95),
        "caught": int(caught.sum()),
        "still": still,
        "read": np.mean(right) if right else float("nan"),
        "closed": pinches_closed(meter, q, shown, errors.names),
        "deepest_mm": 1e3 * min(0.0, meter.nearest(q[first]).min()),
    }
    pairs = [f"{poses[a].name} -> {poses[b].name}" for a, b in pairwise(order)]
    return row, [pairs[i - 1] for i in np.flatnonzero(caught) if i]


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


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the angles and the caught fingers of every hand and preset."""
    from matplotlib.figure import Figure

    panels = ("thumb", "thumb p95", "last bone", "worst p95", "caught")
    figure = Figure(
        figsize=(2.4 * len(panels), 1.2 + 0.3 * len(rows)), layout="constrained"
    )
    names = [f"{row['robot']}, {row['preset']}" for row in rows][::-1]
    for axes, key in zip(
        figure.subplots(1, len(panels), sharey=True), panels, strict=True
    ):
        axes.barh(names, [row[key] for row in rows][::-1], color=common.PALETTE[1])
        unit = "of all poses" if key == "caught" else "deg"
        axes.set(title=key, xlabel=unit)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("Static gestures after one another.")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), metavar="HAND")
    parser.add_argument("--presets", nargs="+", default=["teleoperation"])
    parser.add_argument("--caught", action="store_true", help="list transitions")
    parser.add_argument("--start", action="store_true", help="map recordings from cuts")
    parser.add_argument(
        "--held-back", action="store_true", help="poses that nothing was tuned on"
    )
    arguments: argparse.Namespace = common.parse_arguments(parser, words)
    poses = read_held_back() if arguments.held_back else read_poses()
    if arguments.quick:
        poses, arguments.robots = poses[:4], arguments.robots[:1]
    rows, starts = [], []
    for name in arguments.robots:
        try:
            shared_hands.load(name)
        except (HandmapError, FileNotFoundError) as error:
            print(f"without {name}: {error}", file=sys.stderr)
            continue
        for preset in arguments.presets:
            row, caught = measure(name, preset, poses)
            rows.append(row)
            if arguments.caught:
                print(f"{name}, {preset}:", *caught, sep="\n  ")
        if arguments.start:
            for file in common.find_recordings(arguments.recordings):
                recording = read_recording(file)
                if recording.side == "right":
                    share = start_dependence(name, recording)
                    starts.append(
                        {"robot": name, "recording": file.stem, "apart": share}
                    )
    is_json = arguments.json == "-"
    common.print_table("Gestures, degrees", rows, to_stderr=is_json)
    if starts:
        common.print_table("Start dependence", starts, to_stderr=is_json)
    common.save_picture(arguments.picture, lambda: draw(rows))
    common.write_json(
        arguments.json, "bench_gestures", {"rows": rows, "starts": starts}
    )


if __name__ == "__main__":
    main()
