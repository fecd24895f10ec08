"""Both hands of a person on one robot: palms, fingers, contacts, and what a step costs.

    python benchmarks bench_robots
    python benchmarks bench_robots --robots g1 ur5_pair --json robots.json
    python benchmarks bench_robots --robots g1 --mirrored leap_pinch_move_right

Recordings are those of a left and a right hand with one name, and `meeting hands`: palms that go
from 285 mm to 60 mm apart and back while the fingers open and close. `--mirrored` adds recordings
of one hand, each beside its mirror image: of people whose other hand was not recorded. `palms` is
by how much the distance of the robot's palms differs from the person's while these are within 200
mm of each other. `overlap` is the largest one of left hand, right hand and body, as `overlap.py`
measures it. `d` columns are each hand's figures minus those of the same hand without an arm, of the
robot's own description, where the person's palms are farther apart: correlation of the extensions,
direction of the fingers [deg], closed pinches; the worse hand counts. `cost` is the CPU time of a
step over that of one hand without an arm, measured in turns. `palm_deg` is the angle between the
directions of the robot's and the person's palm in the robot's world, in the median, and `palm_mm`
how far the robot's is from where the person's is, but for the median offset, RMS; both from when
the robot's palm has turned to the person's on, and of the worse hand. `lean` is how far the joint
of a waist or torso that is farthest from rest is there, in the median [deg, mm where it slides],
and `bent` the share of samples in which one is at a limit; `--waist` gives them other weights
(`joint_weights` of a robot.yaml).
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import dataclasses
import time
from collections.abc import Sequence
from itertools import compress
from typing import Any

import numpy as np
from meeting_hands import Hands, meeting_hands
from msgspec.structs import replace
from overlap import OverlapMeter
from scipy.spatial.transform import Rotation
from streams import ROBOTS

from handmap_qp import Hand, HandMapper, Recording, load_hand, read_recording
from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.apps.offline.fidelity import assess_fidelity
from handmap_qp.apps.offline.hand_trace import trace_robot
from handmap_qp.apps.offline.leaning import measure_leaning
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.hands import Side
from handmap_qp.hands.robot import (
    load_robot,
    read_hands,
    read_robot_spec,
    robot_files,
)
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.hands.sources import read_urdf
from handmap_qp.hands.spec import HandSpec
from handmap_qp.hands.urdf import cut_subtree, joints_by_name, parse_urdf
from handmap_qp.human import mirrored
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.alignment import Alignment, rotation_of
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.se3 import lengths, transform_points

_FIGURES = (
    ("extension", "extension_correlation"),
    ("direction", "finger_direction_deg"),
    ("pinches", "pinch_closed"),
)
_PALMS = ("palm_deg", "palm_mm")
TURNED = 2.5
"""When the robot's palms have turned to the person's, from the first sample on [s]."""
APART = 0.3
"""How far a hand is from its mirror image at least [m]."""
NEAR = 0.2
"""Distance of the person's palms from which on the robot's go by it [m]."""


def find_pairs(files: Sequence[Any]) -> list[Hands]:
    """Read the recordings of both hands with one name."""
    by_name: dict[str, dict[Side, Recording]] = {}
    for file in files:
        recording = read_recording(file)
        stem = recording.name.removesuffix(f"_{recording.side}")
        by_name.setdefault(stem, {})[recording.side] = recording
    return [hands for hands in by_name.values() if len(hands) == 2]


def beside_mirror_image(recording: Recording) -> Hands:
    """Return the recording of one hand and its mirror image, as those of both hands.

    The person's +x is to the right. The hands are moved sideways, so that they are `APART` or more
    apart.
    """
    hands = {each.side: each for each in (recording, mirrored(recording))}
    x = {side: each.landmarks[each.valid][..., 0] for side, each in hands.items()}
    room = max(0.0, 0.5 * (APART - (x["right"].min() - x["left"].max())))
    signs: dict[Side, float] = {"left": -1.0, "right": 1.0}
    return {
        side: dataclasses.replace(
            hands[side],
            name=f"{recording.name}, mirrored",
            landmarks=hands[side].landmarks + np.array([sign * room, 0.0, 0.0]),
            wrist=None,
        )
        for side, sign in signs.items()
    }


def with_waist(name: str, weight: float | None) -> Hand:
    """Load a robot whose waist or torso has a weight of its own; the usual one if None."""
    robot = load_robot(name)
    if weight is None:
        return robot
    named = compress(robot.joint_names, robot.carries_limbs)
    spec = read_robot_spec(robot_files()[name])
    return load_robot(replace(spec, joint_weights=dict.fromkeys(named, weight)))


def measure(
    name: str, robot: Hand, hands: Hands, alignment: Alignment
) -> dict[str, Any]:
    """Map recordings of both hands at the instants at which both are seen."""
    preset = get_preset("teleoperation")
    method = preset.method.replaced(alignment=alignment)
    humans = {side: scaled_human(each) for side, each in hands.items()}
    tracked = {side: human.with_points("landmarks") for side, human in humans.items()}
    mapper = RobotMapper(robot, tracked, method, ik=preset.ik)
    bare = without_arms(name)
    side = next(iter(bare))
    single = HandMapper(tracked[side], bare[side])
    meter = overlap_meter(mapper)
    turn = rotation_of(alignment)
    count = min(map(len, hands.values()))
    both = np.all([each.valid[:count] for each in hands.values()], axis=0)
    samples = np.flatnonzero(both)
    off, near, overlaps, costs, motion, wrists = [], [], [], [], [], []
    dt = float(np.median(hands[side].steps))
    for k in samples:
        points = {s: each.landmarks[k] for s, each in hands.items()}
        began = time.thread_time()
        single.map_landmarks(points[side], dt=dt)
        between = time.thread_time()
        step = mapper.map_landmarks(points, dt=dt)
        costs.append((time.thread_time() - between, between - began))
        motion.append(step.command.q)
        wrists.append([each.wrist_error[0] for each in step.hands.values()])
        overlaps.append(meter.depth(mapper.motion.q))
        requests: list[Any] = [hand.request for hand in mapper.hands.values()]
        ends = [
            transform_points(each.command.wrist @ hand.robot.wrist_to_palm, anchor)
            for each, hand, anchor in zip(
                step.hands.values(),
                mapper.hands.values(),
                [request.map.robot_anchor for request in requests],
                strict=True,
            )
        ]
        here, there = (request.map.person_at(request.pose) for request in requests)
        near.append(lengths((there - here)[:3, 3]))
        off.append(lengths(ends[1] - ends[0] - (there - here)[:3, 3]))
    near, off = np.array(near), np.array(off)
    is_near = near < NEAR
    row: dict[str, Any] = {"robot": name, "recording": hands["left"].name}
    row["palms, least_mm"] = 1e3 * near.min()
    row["off_mm"] = 1e3 * np.median(off[is_near]) if is_near.any() else np.nan
    row["off, most_mm"] = 1e3 * off[is_near].max() if is_near.any() else np.nan
    row["wrist, median_mm"] = 1e3 * np.median(wrists)
    row["wrist_mm"] = 1e3 * np.percentile(wrists, 95)
    row["overlap_mm"] = 1e3 * max(overlaps)
    q = np.array(motion)
    leaning = measure_leaning(robot, q)
    row |= {"lean": leaning.median, "bent": leaning.bent_share}
    changes = [
        changed(robot.by_side[s], hand, hands[s], q, samples, ~is_near, turn)
        for s, hand in bare.items()
    ]
    row |= {key: max(each[key] for each in changes) for key in _PALMS}
    for short, _ in _FIGURES:
        values = [change[short] for change in changes]
        worst = max if short == "direction" else min
        row[f"d {short}"] = worst(values)
    two, one = np.median(costs, axis=0)
    row["step_us"] = 1e6 * two
    row["cost"] = two / one
    return row


def overlap_meter(mapper: RobotMapper) -> OverlapMeter:
    """Return what measures overlaps of all links that are kept apart."""
    collisions = mapper.point_ik.gate.collisions
    assert collisions is not None
    geometry = collisions.bounds.geometry
    shapes = ShapePairs(geometry, ("",) * len(geometry.collisionPairs))
    return OverlapMeter(mapper.robot, shapes)


def changed(
    robot: Hand,
    bare: Hand,
    recording: Recording,
    q: np.ndarray,
    samples: np.ndarray,
    counts: np.ndarray,
    turn: np.ndarray,
) -> dict[str, float]:
    """Return the figures of a robot's hand minus those of the same hand alone, and of its palm."""
    take = prepare_take(recording, recording.side)
    alone = HandMapper(take.human.with_points("landmarks"), bare)
    dt = float(np.median(recording.steps))
    steps = [alone.map_landmarks(recording.landmarks[k], dt=dt) for k in samples]
    trace = take.trace.part(samples, take.trace.names)
    clock = recording.time[samples]
    wrist = np.array([step.command.wrist for step in steps])
    found = []
    for hand, angles in (
        (robot, q),
        (bare, np.array([step.command.q for step in steps])),
    ):
        other = trace_robot(hand, angles, wrist if hand.is_floating else None)
        motion = RobotMotion(hand, clock, angles, wrist, np.full(len(clock), np.nan))
        fidelity = assess_fidelity(trace, other, clock, counts, motion)
        found.append(fidelity.values)
    changes = {short: found[0][key] - found[1][key] for short, key in _FIGURES}
    has_turned = clock >= clock[0] + TURNED
    palms = [each.palm[has_turned] for each in (trace, trace_robot(robot, q))]
    return changes | compare_palms(*palms, turn)


def compare_palms(
    person: np.ndarray, robot: np.ndarray, turn: np.ndarray
) -> dict[str, float]:
    """Compare the poses of two palms, shape (T, 4, 4), in the robot's world.

    Args:
        person: The person's palm in the tracker's world.
        robot: The robot's palm.
        turn: From the tracker's world to the robot's, shape (3, 3).
    """
    apart = (turn @ person[:, :3, :3]).swapaxes(1, 2) @ robot[:, :3, :3]
    offset = robot[:, :3, 3] - person[:, :3, 3] @ turn.T
    off = lengths(offset - np.median(offset, axis=0))
    return {
        "palm_deg": float(
            np.median(np.degrees(Rotation.from_matrix(apart).magnitude()))
        ),
        "palm_mm": 1e3 * float(np.sqrt(np.mean(off**2))),
    }


def without_arms(name: str) -> dict[Side, Hand]:
    """Load the hands of a robot without their arms."""
    specs = read_hands(read_robot_spec(robot_files()[name]))
    return {
        side: load_hand(without_arm(spec), mount="floating")
        for side, spec in specs.items()
    }


def without_arm(spec: HandSpec) -> HandSpec:
    """Return the description of a hand without its arm: what hangs from its wrist."""
    if spec.arm is not None:
        return replace(spec, arm=None)
    tree = parse_urdf(read_urdf(spec))
    cut_subtree(tree, spec.wrist.link)
    joints = joints_by_name(tree)
    keys = "rest", "locked", "limits", "mimic"
    kept = {
        key: {name: at for name, at in getattr(spec, key).items() if name in joints}
        for key in keys
    }
    return replace(spec, root=spec.wrist.link, joints=(*kept["rest"],), **kept)


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw by how much the palms of each robot are off."""
    from matplotlib.figure import Figure

    figure = Figure((7.0, 1.2 + 0.25 * len(rows)), layout="constrained")
    axes = figure.subplots()
    names = ["{robot}, {recording}".format(**row) for row in rows][::-1]
    axes.barh(names, [row["off_mm"] for row in rows][::-1], color=common.PALETTE[1])
    axes.set(title="distance of the palms less the person's, median", xlabel="mm")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("Both hands of a person on one robot.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    parser.add_argument(
        "--waist", nargs="+", type=float, default=[None], metavar="WEIGHT"
    )
    parser.add_argument(
        "--mirrored",
        nargs="+",
        default=[],
        metavar="RECORDING",
        help="recordings of one hand with +y up, by name, to take beside their mirror images",
    )
    arguments: argparse.Namespace = common.parse_arguments(parser, words)
    meeting = meeting_hands()
    if arguments.quick:
        few = slice(None, None, 4)
        meeting = {side: each.part(few) for side, each in meeting.items()}
    pairs: list[tuple[Alignment, Hands]] = [("world", meeting)]
    if arguments.quick:
        arguments.robots = arguments.robots[:1]
    else:
        files = common.find_recordings(arguments.recordings)
        # Headsets have +y up.
        pairs += [("y-up", hands) for hands in find_pairs(files)]
        pairs += [
            ("y-up", beside_mirror_image(read_recording(file)))
            for file in files
            if file.stem in arguments.mirrored
        ]
    rows = [
        measure(name, with_waist(name, weight), hands, alignment)
        | {"waist": weight or "usual"}
        for name in arguments.robots
        for weight in arguments.waist
        for alignment, hands in pairs
    ]
    common.print_table("Robots with two hands", rows, to_stderr=arguments.json == "-")
    common.save_picture(arguments.picture, lambda: draw(rows))
    common.write_json(arguments.json, "bench_robots", {"rows": rows})


if __name__ == "__main__":
    main()
