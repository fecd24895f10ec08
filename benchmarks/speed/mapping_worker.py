"""Map the samples that a parent process asks for, and time each one: `interleaved.Worker`.

    python benchmarks mapping_worker SAMPLES.npz ROBOT PRESET CALL

The script imports the `handmap_qp` of PYTHONPATH, which may be that of another checkout, older ones
among them. So it keeps to public names. CALL is `map_landmarks`, `map_points` or `map_step`. PRESET
is the name of a preset, with `:free` behind it for no contact rows, `:guard` for samples that go
through the follower's guard, or `:shifted` for landmarks that are moved by 1e-15 m, which tells how
much rounding changes.

Requests and answers are lines of JSON. A request names a range of samples, and whether to start
again. An answer holds the thread's CPU time of each call less the timer's [ns], the robot's joints
and wrist after it, and the CPU time of one `pin.computeJointJacobians` of the same robot in between
[ns].
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
from peers.timer import timer_cost

from handmap_qp import (
    Follower,
    HandMapper,
    HumanLengths,
    HumanSample,
    MappingOptions,
    load_hand,
)

_JACOBIANS = 200
_SHIFT = 1e-15


def make_mapper(inputs: Any, robot: Any, preset: str) -> Any:
    """Return a mapper for the person in the inputs.

    Args:
        inputs: Arrays of `interleaved.Inputs`.
        robot: The robot hand.
        preset: As of the command line.
    """
    preset, _, variant = preset.partition(":")
    lengths = None
    if "bases" in inputs:
        lengths = HumanLengths(bases=inputs["bases"], segments=inputs["segments"])
    name = "human" if str(inputs["side"]) == "right" else "human_left"
    points = str(inputs["points"]) or None
    human = load_hand(name, points=points, lengths=lengths)
    if preset == "paper":
        return HandMapper(human, robot, MappingOptions())
    from handmap_qp.mapping.presets import preset_choice

    human = human.with_contact_gap(float(inputs["contact_gap"]))
    choice = preset_choice(preset, human)
    if variant == "free":
        choice = choice.with_changes({"avoids_contact": False})
    return HandMapper(human, robot, choice.method, ik=choice.ik)


def arguments_of(
    call: str, inputs: Any, human: Any, preset: str
) -> list[tuple[Any, ...]]:
    """Return the positional arguments of every call."""
    if preset.endswith(":guard"):
        times = np.cumsum(inputs["dt"])
        rows = zip(times, inputs["landmarks"], strict=True)
        return [(HumanSample(t, human.side, landmarks),) for t, landmarks in rows]
    if call == "map_landmarks":
        shift = _SHIFT if preset.endswith(":shifted") else 0.0
        return [(sample,) for sample in inputs["landmarks"] + shift]
    postures = list(zip(inputs["q"], inputs["wrist"], strict=True))
    if call == "map_points":
        return [(human.points(q, wrist), wrist) for q, wrist in postures]
    return postures


def serve(
    mapper: Any,
    call: str,
    samples: list[tuple[Any, ...]],
    steps: list[float],
    preset: str,
) -> None:
    """Answer requests until the input ends."""
    model = mapper.robot.model
    rest = mapper.robot.configuration_vector(mapper.robot.rest)
    jacobian = partial(pin.computeJointJacobians, model, model.createData(), rest)
    function = getattr(mapper, call)
    timer = timer_cost()
    print(json.dumps({"ready": True, "variables": model.nv}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if request["starts"]:
            mapper.reset()
            if preset.endswith(":guard"):
                function = Follower(mapper).map_sample
        first, last = request["samples"]
        times, joints, wrists, iterations = [], [], [], []
        started = time.thread_time_ns()
        for _ in range(_JACOBIANS):
            jacobian()
        one = (time.thread_time_ns() - started) / _JACOBIANS
        for i in range(first, last):
            given, dt = samples[i], steps[i]
            started = time.thread_time_ns()
            step = function(*given, dt=dt)
            # The core makes arrays when they are asked for.
            q = step.command.q
            times.append(time.thread_time_ns() - started - timer)
            joints.append(q.tolist())
            wrists.append(step.command.wrist.tolist())
            iterations.append(step.iterations)
        answer = {"ns": times, "jacobian_ns": one, "iterations": iterations}
        print(json.dumps({**answer, "q": joints, "wrist": wrists}), flush=True)


def main() -> None:
    """Load hands and samples, then serve."""
    file, robot_name, preset, call = sys.argv[1:]
    inputs = np.load(file)
    robot = load_hand(Path(robot_name) if robot_name.endswith(".yaml") else robot_name)
    if preset.startswith("teleoperation"):
        # Solving it anew would compare two solutions of another problem.
        matched = dict(zip(robot.joint_names, inputs["matched"].tolist(), strict=True))
        robot = load_hand(msgspec.structs.replace(robot.spec, neutral_match=matched))
    mapper = make_mapper(inputs, robot, preset)
    samples = arguments_of(call, inputs, mapper.human, preset)
    serve(mapper, call, samples, inputs["dt"].tolist(), preset)


if __name__ == "__main__":
    main()
