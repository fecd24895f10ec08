"""An object goes from one hand of a robot to the other, simulated: `handmap_qp` with MuJoCo.

    python benchmarks hand_over --robots ur5_pair g1 --seed 101
    python benchmarks hand_over --robots ur5_pair --trials 1 --picture hand_over.png

The recording of both hands is that of `passing.py`, made from the human model; the person starts in
the robot's posture. `RobotMapper` maps it, and the robot is simulated with the bar: links collide
with the bar, and the mapping keeps them from each other.

Before that the person practises with the robot and one bar, the nominal one, and changes what is
seen to be wrong: fingers that come to the bar before the index finger are bent less, and the left
hand is turned and moved by what its pads miss the bar that hangs from the right hand. Bars differ
from the nominal one in width (18 to 30 mm), mass (20 to 60 g), friction (0.6 to 1) and place (2 mm
standard deviation along each axis). The person does not see by how much.

A bar stands where the empty right pads meet, along the palm's x, and its faces are square to the
pads. A stand carries its weight as a table does, until the right pads press on it, or for 0.3 s
after they should have met it. A bar is passed if at the end the left thumb and a left finger press
on it between their pads, and the right hand does not touch it. The table counts how others end.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from passing import CLOSING, FINGERS, HANGS, HELD_AT, RATE, SIDES, Person

from handmap_qp import Hand
from handmap_qp.apps.simulation.pads import Pads
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch_rows import success_rate
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.hands import Side
from handmap_qp.hands.pads import find_pads
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.objects import Box
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.se3 import affine, inverse_pose, transform_points, unit


class Bar(NamedTuple):
    """A bar and its place: width [m], mass [kg], friction, displacement [m]."""

    width: float
    mass: float
    friction: float
    offset: np.ndarray


LENGTH = 0.28
"""Length of a bar [m]."""
NOMINAL = Bar(0.024, 0.04, 0.8, np.zeros(3))
"""The bar that the person practises with."""
FAR = affine(np.eye(3), (0.0, 0.0, 100.0))
"""Where nothing is touched."""
# From the middle between the robot's palms at rest to where the hands meet [m].
_AHEAD = np.array([0.08, 0.0, 0.0])
# How much a finger is bent for what its tip lacks to the bar [rad/m].
_BEND = 10.0


class Grip(NamedTuple):
    """Where the pads of a hand are at an instant.

    Attributes:
        gap: Distance between the surfaces of the pads, across a bar along the palm's x [m].
        middle: The point between them [m], shape (3,).
        axes: Axes of a bar there: x from thumb to finger, z along the palm's x, shape (3, 3).
        palm: Pose of the palm, shape (4, 4).
        tips: How far the pad of each finger is from the middle, across the bar [m].
    """

    gap: float
    middle: np.ndarray
    axes: np.ndarray
    palm: np.ndarray
    tips: dict[str, float]


@dataclass
class Outcome:
    """Which hands have a bar at the end, and the robot and the bar at every sample."""

    end: str
    q: list[np.ndarray]
    bar: list[np.ndarray]


class Scene:
    """A robot that follows a person who has practised with it, and bars for it."""

    def __init__(self, robot: Hand) -> None:
        self.robot = robot
        self.pads = {side: Pads(hand) for side, hand in robot.by_side.items()}
        self.tips, self.own = {}, {}
        for side, hand in robot.by_side.items():
            names = ["world", *hand.model.names[1:]]
            pads = find_pads(hand)
            self.tips[side] = {n: (names[p.joint], p.offset) for n, p in pads.items()}
            wrist = hand.wrist_frame.parentJoint
            self.own[side] = {names[k] for k in hand.model.subtrees[wrist]}
        rest = next(iter(robot.by_side.values())).rest
        starts = {s: hand.frame_pose("palm", rest) for s, hand in robot.by_side.items()}
        meeting = (starts["left"] + starts["right"])[:3, 3] / 2.0 + _AHEAD
        self.people = {side: Person(side, starts[side], meeting) for side in SIDES}
        self._follow()
        for change in (self._bend, self._bend, self._aim, self._aim):
            change()
            self._follow()

    def _follow(self) -> None:
        """Map the recording, and see how the empty hands of the robot move."""
        people = self.people
        mapper = RobotMapper(self.robot, {side: people[side].hand for side in SIDES})
        samples = zip(*(people[side].landmarks() for side in SIDES), strict=True)
        steps = [
            mapper.map_landmarks(dict(zip(SIDES, each, strict=True)), dt=1.0 / RATE)
            for each in samples
        ]
        self.whole = mapper.robot
        self.q = [step.command.q for step in steps]
        simulator = self._start(NOMINAL, FAR)
        self.empty = [{side: self._grip(simulator, side) for side in SIDES}]
        for q in self.q[1:]:
            simulator.follow(simulator.hand.configuration_vector(q, None), 1.0 / RATE)
            self.empty.append({side: self._grip(simulator, side) for side in SIDES})

    def _start(self, bar: Bar, pose: np.ndarray) -> Simulator:
        """Put a bar on its stand, and the robot where the recording starts."""
        shape = Box((bar.width, bar.width, LENGTH))
        # By the torques of the URDFs alone.
        physics = Physics(mass=bar.mass, friction=bar.friction, torque=1e3)
        simulator = Simulator(self.whole, shape, physics)
        simulator.reset(simulator.hand.configuration_vector(self.q[0], None), pose)
        simulator.set_stand(holds=True)
        return simulator

    def _grip(self, simulator: Simulator, side: Side) -> Grip:
        """Return where the pads of a hand are."""
        pads = self.pads[side]
        palm = self.robot.by_side[side].frame_pose("palm", simulator.q)
        along = palm[:3, 0]
        places = pads.places(simulator)
        heights = (places - places.mean(axis=0)) @ along
        # As if beside each other.
        level = places - np.outer(heights, along)
        across = unit(level[1] - level[0])
        middle = pads.pair.middle(level)
        tips = {
            name: (transform_points(simulator.body_pose(body), place) - middle) @ across
            for name, (body, place) in self.tips[side].items()
        }
        axes = np.column_stack([across, np.cross(along, across), along])
        return Grip(pads.pair.gap(level), middle, axes, palm, tips)

    def _met(self, side: Side, width: float) -> int:
        """Return the sample at which empty pads are first as near as a bar is wide."""
        start, end = (round(time * RATE) for time in CLOSING[side])
        grips = self.empty[start : end + round(0.5 * RATE)]
        gaps = np.array([grip[side].gap for grip in grips])
        is_near = gaps <= width
        return start + int(is_near.argmax() if is_near.any() else gaps.argmin())

    def _bend(self) -> None:
        """Bend fingers so that those of the robot come to the bar at once."""
        for side in SIDES:
            tips = self.empty[self._met(side, NOMINAL.width)][side].tips
            for k, name in enumerate(FINGERS):
                off = tips.get(name, tips["index"]) - tips["index"]
                self.people[side].bend[k] += _BEND * off

    def _aim(self) -> None:
        """Turn and move the left hand to the bar that hangs from the right one."""
        hangs = round(HANGS * RATE)
        met = self._met("left", NOMINAL.width)
        before, after = (self.empty[k]["right"].palm for k in (hangs, met))
        # The right hand carries it on.
        bar = after @ inverse_pose(before) @ self.run(NOMINAL, hangs + 1).bar[-1]
        left, aim = self.empty[met]["left"], self.people["left"].aim
        end = transform_points(bar, np.array([0.0, 0.0, HELD_AT]))
        # The left palm's x points up, the bar's z down.
        axes = np.column_stack([bar[:3, 0], -bar[:3, 1], -bar[:3, 2]])
        turn = axes @ left.axes.T
        place = aim[:3, 3] + end - left.middle
        self.people["left"].aim = affine(turn @ aim[:3, :3], place)

    def run(self, bar: Bar, until: int | None = None) -> Outcome:
        """Simulate one bar.

        Args:
            bar: The bar.
            until: Number of samples; all if omitted.
        """
        met = self._met("right", bar.width)
        grip = self.empty[met]["right"]
        place = grip.middle + HELD_AT * grip.axes[:, 2] + bar.offset
        pose = affine(grip.axes, place)
        simulator = self._start(bar, pose)
        found = Outcome("", [self.q[0]], [pose])
        stands = True
        for k, q in enumerate(self.q[1:until], 1):
            simulator.follow(simulator.hand.configuration_vector(q, None), 1.0 / RATE)
            is_late = k > met + 0.3 * RATE
            if stands and (is_late or self.pads["right"].is_pinched(simulator)):
                simulator.set_stand(holds=False)
                stands = False
            found.q.append(simulator.q)
            found.bar.append(simulator.object_pose)
        found.end = self._end(simulator, bar)
        return found

    def _end(self, simulator: Simulator, bar: Bar) -> str:
        """Return which hand has a bar: "left" only if it is between the pads."""
        touching = {*simulator.pressing()}
        names = [side for side in SIDES if touching & self.own[side]]
        if names != ["left"]:
            return " and ".join(names) or "none"
        middle = self._grip(simulator, "left").middle
        x, y, z = transform_points(inverse_pose(simulator.object_pose), middle)
        is_between = np.hypot(x, y) < bar.width and abs(z) < LENGTH / 2.0
        is_held = is_between and self.pads["left"].is_pinched(simulator)
        return "left" if is_held else "on the left"


def bars(count: int, seed: int) -> list[Bar]:
    """Draw bars and places."""
    random = np.random.default_rng(seed)
    return [
        Bar(
            random.uniform(0.018, 0.03),
            random.uniform(0.02, 0.06),
            random.uniform(0.6, 1.0),
            random.normal(0.0, 0.002, 3),
        )
        for _ in range(count)
    ]


def draw(scene: Scene, outcome: Outcome, bar: Bar) -> Any:
    """Draw the robot and the bar at six instants."""
    from matplotlib.figure import Figure

    from handmap_qp.apps.drawing.hands import load_shape, solid
    from handmap_qp.apps.drawing.raster import Camera, merged, render
    from handmap_qp.mapping.objects import surface

    shape = load_shape(next(iter(scene.robot.by_side.values())))
    body = solid(surface(Box((bar.width, bar.width, LENGTH))), (0.85, 0.45, 0.1))
    times = (2.2, 3.8, 5.0, 6.9, 8.2, 9.9)
    around = [outcome.bar[round(time * RATE) - 1][:3, 3] for time in times]
    around += [grip.palm[:3, 3] for grip in scene.empty[-1].values()]
    around = np.concatenate([np.add(around, off) for off in (-0.15, 0.15)])
    camera = Camera.framing(around, (420, 380), azimuth=25.0, elevation=15.0)
    figure = Figure((8.4, 5.6), layout="constrained")
    for axes, time in zip(figure.subplots(2, 3).flat, times, strict=True):
        k = round(time * RATE) - 1
        moved = body.moved(outcome.bar[k])
        image = render(merged([shape.triangles(outcome.q[k]), moved]), camera)
        axes.imshow(1.0 + image[..., 3:] * (image[..., :3] - 1.0))
        axes.set(title=f"{time:.1f} s")
        axes.set_axis_off()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("An object goes from one hand of a robot to the other.")
    parser.add_argument("--robots", nargs="+", default=["ur5_pair", "g1"])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=101)
    arguments: argparse.Namespace = common.parse_arguments(parser, words)
    if arguments.quick:
        arguments.robots, arguments.trials = arguments.robots[:1], 2
    drawn = bars(arguments.trials, arguments.seed)
    rows: list[dict[str, Any]] = []
    shown: Any = None
    for name in arguments.robots:
        scene = Scene(load_robot(name))
        outcomes = [scene.run(bar) for bar in drawn]
        ends = [outcome.end for outcome in outcomes]
        rate, low, high = success_rate(ends.count("left"), len(ends))
        row = {"robot": name, "bars": len(ends), "passed %": 100.0 * rate}
        row["95 % interval"] = f"{100.0 * low:.0f}-{100.0 * high:.0f}"
        for end in ("on the left", "left and right", "right", "none"):
            row[end] = ends.count(end)
        rows.append(row)
        best = ends.index("left") if "left" in ends else 0
        shown = shown or (scene, outcomes[best], drawn[best])
    title = f"Bars passed from hand to hand, seed {arguments.seed}"
    common.print_table(title, rows, to_stderr=arguments.json == "-")
    common.save_picture(arguments.picture, lambda: draw(*shown))
    common.write_json(arguments.json, "hand_over", {"rows": rows})


if __name__ == "__main__":
    main()
