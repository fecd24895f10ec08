"""Whether robots hold an object that a person holds and moves: with a force, or by position alone.

    python benchmarks bench_holding --seed 1 --json holding.json --picture holding.png
    python benchmarks bench_holding --robots allegro_right --objects ball --motions "turn +1x"

A person made of the human model holds an object between thumb, index and middle finger, lifts it by
50 mm and moves or turns it in the hand (`holding.py`). The robot maps it with the object
(`ObjectFollower`), with a grip of 5 N and without one, and is simulated with an object of its own,
under gravity. The object stands where the mapping thinks that it is, off by 2 mm (standard
deviation) along each axis; 30 to 150 g, friction .5 to 1; the mapping is wrong about the stiffness
of the joints by up to 20 %. The stand lets go .2 s after the person's fingers have closed.

It is held if at the end it is within 20 mm and half its width of where the person's motion puts it.
`off` and `turned` are what is left to that place, `force` the sum of all normal forces on it, `by
others` the share of trials in which a link presses that is none of the three fingers'. A trial in
which the open hand overlaps the object is refused: it counts in no share.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from bench_grips import held_cells, medians
from holding import FINGERS, add_choices, hold

from handmap_qp import HandMapper, load_hand
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.human import sample_columns
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.mapping.objects import parse_object, surface
from handmap_qp.se3 import affine
from handmap_qp.stream import Follower, GripOptions, ObjectFollower

HUMAN = load_hand("human", points="landmarks")
_LOST = 0.02
_FREED = 12
# Samples from which on the simulation may start: the object has taken hold of the hand.
_EARLIEST, _LATEST = 26, 40


def tried(
    robot: str, what: str, motion: str, seed: int, force: float | None
) -> dict[str, Any]:
    """Return what became of an object; the same object for every force."""
    random = np.random.default_rng((seed, *map(ord, robot + what + motion)))
    made = hold(what, motion, seed)
    recording = made.recording
    assert recording.object_pose is not None
    gain = random.uniform(0.8, 1.2)
    mass, friction = random.uniform(0.03, 0.15), random.uniform(0.5, 1.0)
    offset = random.normal(0.0, 0.002, 3)
    hand, shape = load_hand(robot), parse_object(recording.object_shape)
    physics = Physics(
        mass=mass,
        friction=friction,
        gravity=(0.0, -9.81, 0.0),
    )
    grip = None
    if force is not None:
        stiffness = gain * physics.joint_stiffness
        grip = GripOptions(stiffness=stiffness, force=force)
    follower = Follower(HandMapper(HUMAN, hand, "teleoperation"))
    holding = ObjectFollower(follower, shape, grip=grip)
    columns = sample_columns(recording)
    steps = [
        holding.map_sample(columns.sample(i), pose)
        for i, pose in enumerate(recording.object_pose)
    ]
    poses = [step.diagnostics["object_pose"] for step in steps]
    simulator = Simulator(hand, shape, physics)
    for start in range(_LATEST, _EARLIEST, -1):
        command = steps[start].command
        simulator.reset(
            hand.configuration_vector(command.q, command.wrist),
            affine(np.eye(3), offset) @ poses[start],
        )
        if simulator.clearance() > 0.0:
            break
    else:
        return {"held": None}
    simulator.set_stand(holds=True)
    bodies = ["world", *hand.model.names[1:]]
    chains = robot_fingers(hand).chains
    own = {bodies[j] for finger in FINGERS for j in chains[finger].joints}
    forces, others, torque = [], 0.0, 0.0
    for i in range(start + 1, len(steps)):
        if i == made.closed + _FREED:
            simulator.set_stand(holds=False)
        command = steps[i].command
        wait = recording.time[i] - recording.time[i - 1]
        simulator.follow(hand.configuration_vector(command.q, command.wrist), wait)
        if i > made.closed + _FREED:
            pressing = simulator.pressing()
            forces.append(sum(pressing.values()))
            others = max(others, *(f for n, f in pressing.items() if n not in own), 0.0)
            torque = max(torque, np.abs(simulator.data.actuator_force).max())
    left = np.linalg.inv(poses[-1]) @ simulator.object_pose
    off = float(np.linalg.norm(left[:3, 3]))
    return {
        "held": bool(off < _LOST + surface(shape).extents[0] / 2.0),
        "off mm": 1e3 * off,
        "turned deg": float(np.degrees(np.linalg.norm(pin.log3(left[:3, :3])))),
        "force N": float(np.median(forces)),
        "torque N m": float(torque),
        "by others": others > 0.5,
    }


def row(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarise trials in a row of a table."""
    shown, done, held = held_cells(name, found)
    if not done:
        return shown
    shown |= medians(held, ("off mm", "turned deg", "force N", "torque N m"))
    shown["by others %"] = round(100.0 * np.mean([each["by others"] for each in done]))
    return shown


def draw_left(found: Sequence[dict[str, Any]]) -> Any:
    """Draw how far each object that is held ends from its place, over the force on it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axes = figure.subplots()
    for k, robot in enumerate(dict.fromkeys(each["robot"] for each in found)):
        held = [each for each in found if each["robot"] == robot and each["held"]]
        off = [each["off mm"] for each in held]
        forces = [each["force N"] for each in held]
        axes.plot(forces, off, "o", color=common.PALETTE[k], label=robot)
    axes.set(xlabel="force on the object [N]", ylabel="off its place [mm]")
    axes.set(xlim=(0.0, None), ylim=(0.0, None))
    axes.legend()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Simulate all trials, print the tables, and write them."""
    parser = common.make_parser((__doc__ or "").splitlines()[0])
    add_choices(parser, ("move +1y", "turn +1z"))
    parser.add_argument("--force", type=float, default=5.0, help="of a grip [N]")
    arguments = common.parse_arguments(parser, words)
    if arguments.quick:
        arguments.robots, arguments.objects = ["allegro_right"], ["ball"]
        arguments.motions = ["turn +1z"]
    found: list[dict[str, Any]] = []
    total = len(arguments.objects) * len(arguments.motions) * len(arguments.robots)
    mappings = {"with the force": arguments.force, "by position": None}
    with common.progress("holding", total) as done:
        for what in arguments.objects:
            for motion in arguments.motions:
                for robot in arguments.robots:
                    for mapping, force in mappings.items():
                        where = {"robot": robot, "object": what, "motion": motion}
                        became = tried(robot, what, motion, arguments.seed, force)
                        found.append(where | {"mapping": mapping} | became)
                    done()
    to_stderr = arguments.json == "-"
    keys = ("mapping",), ("robot", "mapping"), ("object", "mapping")
    ending = f", seed {arguments.seed}"
    common.print_groups(found, keys, row, ending, to_stderr=to_stderr)
    common.save_picture(arguments.picture, lambda: draw_left(found))
    results = {"seed": arguments.seed, "force": arguments.force, "trials": found}
    common.write_json(arguments.json, "bench_holding", results)


if __name__ == "__main__":
    main()
