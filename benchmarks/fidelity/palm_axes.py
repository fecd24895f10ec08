"""Palm axes: which direction of a person's palm is to lie on `distal` of a robot's.

    python benchmarks palm_axes
    python benchmarks palm_axes --robots allegro_right leap_right

The preset `teleoperation` maps every recording with the person's palm axes turned about the normal:
as they are, or with y to the middle knuckle, at right angles to the row of knuckles, or along the
stretched fingers. The same line of the robot counts as its y axis, unless only the person's is
asked for. The palm of the robot is held on the person's, so `direction` is what an observer in the
world sees of the fingers (knuckle to tip). `turned` is the same after the best rotation of all
fingers of a recording (Kabsch 1976), which favours no axes.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
from collections.abc import Sequence

import numpy as np
import shared_hands
from msgspec.structs import replace

from handmap_qp import Hand, read_recording
from handmap_qp.apps.offline.comparison import Take, own_method, prepare_take
from handmap_qp.apps.offline.fidelity import SETTLING, angles_between, assess_fidelity
from handmap_qp.apps.offline.hand_trace import KNUCKLE, TIP, HandTrace, trace_robot
from handmap_qp.hands import THUMB
from handmap_qp.se3 import rigid_fit, unit
from handmap_qp.stream.measurement import measure_person

ROBOTS = (
    *("allegro_right", "leap_right", "shadow_right"),
    *("svh_right", "ability_right", "inspire_right"),
)
AXES = ("palm", "middle, person", "middle", "row", "fingers")
_OPEN = 0.95
"""A person's fingers are stretched beyond this share of their reach."""
_KEYS = (
    "extension_correlation",
    "tip_error_knuckles_mm",
    "object_rotation_deg",
    "object_translation_mm",
    "pinch_closed",
    "pinch_false",
)


def yaw(vector: np.ndarray) -> float:
    """Return a direction's turn from y about z [deg], positive to a right hand's thumb."""
    return float(np.degrees(np.arctan2(-vector[0], vector[1])))


def yaws(trace: HandTrace, is_open: np.ndarray) -> dict[str, float]:
    """Return the turn of each definition's y axis in a hand's palm axes [deg]."""
    local = np.median(trace.local[is_open], axis=0)
    others = [i for i, name in enumerate(trace.names) if name != THUMB]
    knuckles = local[others, KNUCKLE]
    fingers = unit(local[others, TIP] - knuckles).mean(axis=0)
    row = np.cross([0.0, 0.0, 1.0], knuckles[-1] - knuckles[0])
    middle = yaw(local[trace.names.index("middle"), KNUCKLE])
    found = (0.0, middle, middle, yaw(row), yaw(fingers))
    return dict(zip(AXES, found, strict=True))


def turned_takes(file: str, robot: Hand) -> dict[str, Take]:
    """Describe a recording once for each definition of the person's axes."""
    recording = read_recording(file)
    take = prepare_take(recording)
    # Of the recording as it is taken: mirrored, if it is a left hand's.
    person = measure_person(take.recording)
    is_open = (take.trace.extension[:, 1:] > _OPEN).all(axis=1) & take.recording.valid
    human = yaws(take.trace, is_open)
    flat = trace_robot(robot, robot.zero[None])
    own = yaws(flat, np.ones(1, bool)) | {"middle, person": 0.0}
    takes = {}
    for name in AXES:
        angle = np.radians(human[name] - own[name])
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        lengths = replace(person.lengths, bases=person.lengths.bases @ turn)
        takes[name] = prepare_take(recording, person=replace(person, lengths=lengths))
    return takes


def measure(take: Take, robot: Hand) -> dict[str, float]:
    """Map a take; return angles of the fingers [deg] and some metrics of `handmap compare`."""
    motion = own_method("teleoperation").map_take(take, robot)
    human, other = take.trace, trace_robot(robot, motion.q, motion.wrist)
    time, valid = take.recording.time, take.recording.valid
    counts = valid & (time >= time[0] + SETTLING)
    shared = [name for name in human.names if name in other.names]
    a, b = (hand.part(counts, shared).local for hand in (human, other))
    a, b = (unit(points[:, :, TIP] - points[:, :, KNUCKLE]) for points in (a, b))
    # Opposite pairs: their centre is the origin, so that the fit is a rotation about it.
    one, two = (np.concatenate([v, -v]).reshape(-1, 3) for v in (a, b))
    best = rigid_fit(one, two)[:3, :3]
    apart = angles_between(a, b)
    found = assess_fidelity(human, other, time, valid, motion, take.q)
    return {
        "direction": apart.mean(),
        "thumb": np.median(apart[:, shared.index(THUMB)]),
        "turned": angles_between(a @ best.T, b).mean(),
    } | {key: found.values[key] for key in _KEYS}


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("Palm axes of people and robots.", draws=False)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), metavar="HAND")
    arguments: argparse.Namespace = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)
    if arguments.quick:
        files, arguments.robots = files[:1], arguments.robots[:1]
    rows = []
    for name in arguments.robots:
        robot = shared_hands.load(name)
        found: dict[str, list[dict[str, float]]] = {axes: [] for axes in AXES}
        for file in files:
            for axes, take in turned_takes(str(file), robot).items():
                found[axes].append(measure(take, robot))
        for axes, each in found.items():
            means = {key: np.nanmean([row[key] for row in each]) for key in each[0]}
            rows.append({"robot": name, "axes": axes} | means)
    for axes in AXES:
        each = [row for row in rows if row["axes"] == axes]
        keys = [key for key in each[0] if key not in ("robot", "axes")]
        means = {key: np.mean([row[key] for row in each]) for key in keys}
        rows.append({"robot": "all", "axes": axes} | means)
    common.print_table("Palm axes", rows, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "palm_axes", {"rows": rows})


if __name__ == "__main__":
    main()
