"""Whether robots touch an object where the person does, and move it in the hand as the person does.

    python benchmarks bench_objects --json objects.json --picture objects.png
    python benchmarks bench_objects --robots allegro_right --objects cube --motions "turn +1x"

A person made of the human model holds an object between thumb, index and middle finger, and moves
or turns it in the hand (`holding.py`): where the fingers touch is known exactly. Every robot maps
it with the object (`ObjectFollower`) and without. From where the fingers touch:

- place: distance of the pads of the robot's fingers from the same places of the surface [mm]
- inside: how deep the deepest link is in the object [mm], < 0 for none
- carried: share of the object's motion in the hand that the pads make, by a rigid fit to them

Two further rows a robot are aims of their own, for robots that know of the object:

- a cap that is turned by 90 degrees about its axis, 15 by the fingers and the rest by the wrist:
  its drift is how far a rigid fit to the pads turns against it, about its axis and in all [deg]
- a mouse, whose surface all five fingertips of the person are 8 mm away from (the landmarks: the
  skin touches): the largest distance of the robot's pads from their places, by medians over samples

It is kinematics: no friction, no forces. Numbers are medians and 95th percentiles over samples;
`carried` is the median over motions, with the least, the most, and the share of motions that carry
the object's within a fifth; `within 10 mm` counts motions by their median place.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pinocchio as pin
from holding import FINGERS, MOTIONS, Hold, add_choices, hold, hold_mouse
from pad_places import depth, pads_of

from handmap_qp import HandMapper, load_hand
from handmap_qp.apps.offline.trajectory import Trajectory, map_recording
from handmap_qp.hands.fingers import FINGERS as ALL_FINGERS
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.mapping.objects import geometry_of, parse_object
from handmap_qp.se3 import inverse_pose, rigid_fit, transform_points

HUMAN = load_hand("human", points="landmarks")


def measured(
    made: Hold, motion: str, trajectory: Trajectory, poses: np.ndarray
) -> dict[str, float]:
    """Measure what a robot does with an object at poses in its world, shape (T, 4, 4)."""
    robot = trajectory.robot
    pads = robot_fingers(robot).pads
    radii = np.array([pads[finger].radius for finger in FINGERS])
    aims = made.places + radii[:, None] * made.normals
    shape = geometry_of(parse_object(made.recording.object_shape))
    off, deep, ends = [], [], []
    for i in range(made.closed, len(poses)):
        placed, now = pads_of(robot, trajectory.q[i], trajectory.wrist[i])
        off.append(np.linalg.norm(now - transform_points(poses[i], aims), axis=1))
        deep.append(depth(robot, placed, shape, poses[i]))
        palm = trajectory.wrist[i] @ robot.wrist_to_palm
        ends.append(transform_points(inverse_pose(palm), now))
    first, last = poses[made.closed], poses[-1]
    palms = [
        trajectory.wrist[i] @ robot.wrist_to_palm for i in (made.closed, len(poses) - 1)
    ]
    # The object's motion in the robot's palm, and the pads'.
    before, after = (
        inverse_pose(p) @ o for p, o in zip(palms, (first, last), strict=True)
    )
    wanted = pin.log6(pin.SE3(after @ inverse_pose(before))).vector
    fitted = rigid_fit(ends[0], ends[-1])
    own = pin.log6(pin.SE3(fitted)).vector
    part = slice(3, 6) if motion.startswith("turn") else slice(0, 3)
    # A motion of the pads about the object, not about the palm.
    if part.start == 0:
        middle = before[:3, 3]
        own = np.append(transform_points(fitted, middle) - middle, own[3:])
        wanted = np.append(after[:3, 3] - middle, wanted[3:])
    carried = own[part] @ wanted[part] / (wanted[part] @ wanted[part])
    found = 1e3 * np.array(off)
    return {
        "place mm": float(np.median(found)),
        "place p95 mm": float(np.percentile(found, 95.0)),
        "inside mm": float(1e3 * np.median(deep)),
        "inside max mm": float(1e3 * np.max(deep)),
        "carried %": float(100.0 * carried),
    }


def both(robot: str, made: Hold, motion: str) -> dict[str, dict[str, float]]:
    """Measure a robot that knows of the object, and one that does not."""
    hand = load_hand(robot)
    aware = map_recording(HandMapper(HUMAN, hand, "teleoperation"), made.recording)
    poses = aware.object_pose
    assert poses is not None
    plain = map_recording(
        HandMapper(HUMAN, hand, "teleoperation"), without_object(made)
    )
    return {
        "with the object": measured(made, motion, aware, poses),
        "without": measured(made, motion, plain, poses),
    }


def aims(robot: str, seed: int) -> dict[str, Any]:
    """Return what a robot does with a cap and with a mouse, in a row of a table."""
    hand = load_hand(robot)
    pads = robot_fingers(hand).pads
    shown: dict[str, Any] = {"": robot}

    def placed(made: Hold, fingers: Sequence[str]) -> tuple[list[np.ndarray], ...]:
        """Return pads in the object's frame, distances from their places, and depths [m]."""
        mapper = HandMapper(HUMAN, hand, "teleoperation")
        trajectory = map_recording(mapper, made.recording)
        shape = geometry_of(parse_object(made.recording.object_shape))
        poses = np.asarray(trajectory.object_pose)
        radii = np.array([[pads[finger].radius] for finger in fingers])
        count = len(fingers)
        wanted = made.places[:count] + radii * made.normals[:count]
        ends, off, deep = [], [], []
        for i in range(made.closed, len(poses)):
            at, now = pads_of(hand, trajectory.q[i], trajectory.wrist[i], fingers)
            ends.append(transform_points(inverse_pose(poses[i]), now))
            off.append(np.linalg.norm(ends[-1] - wanted, axis=1))
            deep.append(depth(hand, at, shape, poses[i]))
        return ends, off, deep

    made = hold("cap", "turn +1z", seed, wrist=np.radians(75.0))
    ends, off, deep = placed(made, FINGERS)
    turned = pin.log3(rigid_fit(ends[0], ends[-1])[:3, :3])
    shown["cap: drift deg"] = round(float(np.degrees(abs(turned[2]))), 1)
    shown["in all deg"] = round(float(np.degrees(np.linalg.norm(turned))), 1)
    shown["inside max mm"] = round(1e3 * max(deep), 1)
    with TemporaryDirectory() as folder:
        made = hold_mouse(Path(folder), seed)
        fingers = [finger for finger in ALL_FINGERS if finger in pads]
        _, off, deep = placed(made, fingers)
    worst = 1e3 * np.median(off, axis=0)
    shown["mouse: pads"] = len(fingers)
    shown["farthest mm"] = round(float(worst.max()), 1)
    shown["median mm"] = round(float(np.median(worst)), 1)
    shown["deepest mm"] = round(1e3 * max(deep), 1)
    shown["deep median mm"] = round(1e3 * float(np.median(deep)), 1)
    return shown


def without_object(made: Hold) -> Any:
    """Return the recording of a hand alone."""
    return replace(made.recording, object_pose=None, object_shape="")


def row(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarise motions in a row of a table."""
    shown: dict[str, Any] = {"": name, "motions": len(found)}
    for key in ("place mm", "place p95 mm", "inside mm"):
        shown[key] = round(float(np.median([each[key] for each in found])), 1)
    shown["inside max mm"] = round(max(each["inside max mm"] for each in found), 1)
    shown["within 10 mm"] = sum(each["place mm"] < 10.0 for each in found)
    carried = np.array([each["carried %"] for each in found])
    shown["carried %"] = round(float(np.median(carried)))
    shown["from"], shown["to"] = round(carried.min()), round(carried.max())
    shown["within a fifth %"] = round(100.0 * np.mean(np.abs(carried - 100.0) < 20.0))
    return shown


def draw_places(found: Sequence[dict[str, Any]]) -> Any:
    """Draw how far pads are from their places, over the motions of each robot."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axes = figure.subplots()
    robots = list(dict.fromkeys(each["robot"] for each in found))
    names = list(dict.fromkeys(each["mapping"] for each in found))
    for k, name in enumerate(names):
        boxes = [
            [e["place mm"] for e in found if (e["robot"], e["mapping"]) == (r, name)]
            for r in robots
        ]
        axes.boxplot(
            boxes,
            positions=[place + 0.3 * (k - 0.5) for place in range(len(robots))],
            widths=0.25,
            patch_artist=True,
            boxprops={"facecolor": common.PALETTE[k]},
            medianprops={"color": "black"},
        )
        axes.plot([], [], color=common.PALETTE[k], linewidth=6, label=name)
    axes.set_xticks(range(len(robots)), robots)
    axes.set(ylabel="pads from their places [mm]", ylim=(0.0, None))
    axes.legend()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Map all motions by all robots, print the tables, and write them."""
    parser = common.make_parser((__doc__ or "").splitlines()[0])
    add_choices(parser, tuple(MOTIONS))
    arguments = common.parse_arguments(parser, words)
    if arguments.quick:
        arguments.robots, arguments.objects = ["allegro_right"], ["cube"]
        arguments.motions = ["turn +1x"]
    found: list[dict[str, Any]] = []
    total = len(arguments.objects) * len(arguments.motions)
    with common.progress("holding", total) as done:
        for what in arguments.objects:
            for motion in arguments.motions:
                made = hold(what, motion, arguments.seed)
                for robot in arguments.robots:
                    for mapping, values in both(robot, made, motion).items():
                        where = {"robot": robot, "mapping": mapping, "object": what}
                        found.append(where | {"motion": motion} | values)
                done()
    to_stderr = arguments.json == "-"
    every = ("mapping",)
    keys = [every, *((key, *every) for key in ("robot", "object", "motion"))]
    common.print_groups(found, keys, row, to_stderr=to_stderr)
    met = [aims(robot, arguments.seed) for robot in arguments.robots]
    common.print_table("A cap and a mouse", met, to_stderr=to_stderr)
    common.save_picture(arguments.picture, lambda: draw_places(found))
    results = {"seed": arguments.seed, "motions": found, "aims": met}
    common.write_json(arguments.json, "bench_objects", results)


if __name__ == "__main__":
    main()
