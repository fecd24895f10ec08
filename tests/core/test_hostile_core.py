"""Every function of the compiled core, with arguments that nobody should give it.

They may raise; they must not read or write what is not theirs. `make sanitize` shows where they do.
A crash would end the tests, so the calls are made in a process of their own.
"""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from handmap_qp.models import encode, unpacked

ROUNDS = 60  # hostile calls of each function


class Watched:
    """An object that notes which of its attributes are read."""

    def __init__(self, real: Any) -> None:
        self.real = real
        self.names: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        self.names.add(name)
        return getattr(self.real, name)


class Altered:
    """An object of which some attributes are others."""

    def __init__(self, real: Any, others: dict[str, Any]) -> None:
        self.real = real
        self.others = others

    def __getattr__(self, name: str) -> Any:
        return self.others[name] if name in self.others else getattr(self.real, name)


def hostile_array(rng: random.Random, array: np.ndarray) -> Any:
    """Return an array that is like another one, but for size, shape, kind or numbers."""
    if array.dtype.kind not in "biuf":
        return array[:0]
    wild = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300, 1e9, -1.0, 1e6]
    if array.dtype.kind == "f":
        changed = array.copy()
    else:
        wild = [-1, -1000, 1, 1000, 99_999, 2**31 - 1]
        changed = array.astype(np.int64)
    for _ in range(rng.choice([1, 1, 3, changed.size]) if changed.size else 0):
        changed.flat[rng.randrange(changed.size)] = rng.choice(wild)
    flat = array.ravel()
    rows = np.atleast_1d(array)
    return rng.choice(
        [
            changed,
            changed,
            changed.astype(array.dtype),
            flat[:-1],
            np.append(flat, flat[:2]),
            np.repeat(rows, 3, axis=0),
            array[..., None],
            array.T,
            flat[:0],
            rows[:0],
            rows[:, None],
            np.zeros(()),
            flat.astype(np.float32),
            np.asfortranarray(rows[::-1]),
            array.tolist(),
        ]
    )


def hostile_bytes(rng: random.Random, content: bytes) -> bytes:
    """Return the bytes of a model with a hostile field, or with damage."""
    try:
        model = msgspec.msgpack.decode(content, ext_hook=unpacked)
    except (msgspec.DecodeError, ValueError):
        # The bytes of a state.
        model = None
    if isinstance(model, dict) and rng.random() < 0.7:
        at = model
        while True:
            place = rng.choice([*at] if isinstance(at, dict) else [*range(len(at))])
            if not isinstance(at[place], list | dict) or not at[place]:
                break
            at = at[place]
        at[place] = hostile(rng, at[place], [])
        try:
            return encode(model)
        except (TypeError, ValueError, OverflowError):
            return b""
    damaged = bytearray(content)
    for _ in range(rng.choice([1, 3, 30])):
        damaged[rng.randrange(len(damaged))] = rng.choice([0, 1, 0x80, 0xC0, 0xFF])
    return bytes(damaged[: rng.choice([len(damaged), rng.randrange(len(damaged))])])


def hostile(rng: random.Random, value: Any, others: list[Any]) -> Any:
    """Return something in the place of an argument or an attribute."""
    if isinstance(value, np.ndarray) and rng.random() < 0.85:
        return hostile_array(rng, value)
    if isinstance(value, bytes) and value and rng.random() < 0.85:
        return hostile_bytes(rng, value)
    if isinstance(value, list | tuple) and value and rng.random() < 0.7:
        items = list(value)
        place = rng.randrange(len(items))
        items[place] = hostile(rng, items[place], others)
        whole = rng.choice([items, items[:-1], items * 3, items[:0]])
        return type(value)(whole) if type(value) in (list, tuple) else whole
    numbers = [
        0,
        -1,
        1,
        1000,
        99_999,
        2**31,
        2**62,
        0.0,
        -1.0,
        1e300,
        np.nan,
        np.inf,
        1e-300,
    ]
    if isinstance(value, int | float) and rng.random() < 0.8:
        return rng.choice(numbers)
    return rng.choice(
        [None, "", "x" * 999, b"", [], {}, (), object(), *numbers, *others]
    )


def altered(rng: random.Random, value: Any, names: set[str], others: list[Any]) -> Any:
    """Return an object with hostile attributes among those that were read."""
    chosen = rng.sample(sorted(names), min(len(names), rng.choice([1, 1, 2])))
    return Altered(value, {n: hostile(rng, getattr(value, n), others) for n in chosen})


Call = tuple[Callable[..., Any], tuple[Any, ...]]


def calls_of(core: Any) -> dict[str, Call]:
    """Return a call of each function with arguments that are right."""
    from handmap_core.human.recording import sample_columns
    from handmap_core.ik.options import ik_model
    from handmap_qp import Follower, HandMapper, load_hand, read_recording
    from handmap_qp.errors import MapperBusyError
    from handmap_qp.hands import core_tree
    from handmap_qp.hands.collision_shapes import shape_model
    from handmap_qp.hands.compiled import hand_model

    recording = read_recording("demo", "right").part(slice(0, 60))
    columns = sample_columns(recording)
    human = load_hand("human", points="landmarks")
    robot = load_hand("allegro_right")
    follower = Follower(HandMapper(human, robot, "paper"))
    mapper = follower.mapper
    teleoperated = HandMapper(human, robot)
    for each in (mapper, teleoperated):
        each.map_landmarks(recording.landmarks[0])
    follower.map_sample(columns.sample(0))
    ik = teleoperated.point_ik
    robot = ik.hand
    gate, tree = ik.gate, core_tree(robot)
    assert gate.collisions is not None
    bounds = gate.collisions.bounds
    points = ik.configuration.points
    motion = gate.motion
    wrist = np.eye(4)
    dt = 1.0 / 60.0
    teleoperation: Any = teleoperated.target_map
    task = teleoperation.method.distances
    aims = np.ones(len(task.first))
    size = gate.limits.size
    goal = (
        points,
        wrist[None],
        robot.rest,
        dt,
        None,
        1.0,
        np.ones(len(robot.joint_names)),
        [(task.core, aims, aims)],
        [([1, 5], np.zeros((2, 3)), np.zeros(3), 1.0)],
        lambda q: [(np.ones(2), np.ones((2, size)), np.ones(size))],
    )
    shapes = [
        encode(shape_model(each.geometry))
        for each in bounds.geometry.geometryObjects[:2]
    ]
    parts = encode(gate.limits), bounds.core, encode(gate.collisions.model)
    solver = ik.core
    still = np.zeros(gate.limits.size)

    def posed() -> Any:
        """Return the rows of the next command: those of a former one are refused."""
        return core.PosedRows(solver, dt, still - 0.1, still + 0.1, None)

    calls: dict[str, Call] = {
        "measure_shape": (
            core.measure_shape,
            (recording.landmarks, recording.landmarks[0, [0, 5, 9, 13, 17]], 0.8),
        ),
        "raise_if_busy": (core.raise_if_busy, (MapperBusyError,)),
        "model_fields": (core.model_fields, ()),
        "log3": (core.log3, (np.eye(3),)),
        "exp3": (core.exp3, (np.ones(3),)),
        "quat_xyzw": (core.quat_xyzw, (np.eye(3),)),
        "smallest_gap": (
            core.smallest_gap,
            (recording.time, recording.landmarks, 0.1, 1.0),
        ),
        "solve_qp": (
            core.solve_qp,
            (np.eye(3), *np.ones((3, 3)), np.ones((2, 3)), np.ones(2)),
        ),
        "measure_shapes": (
            core.measure_shapes,
            (*shapes[:1], wrist, *shapes[1:], 2.0 * wrist),
        ),
        "Tree": (core.Tree, (encode(hand_model(robot)),)),
        "Tree.moved": (
            core_tree(human).moved,
            (["index_MCP_abduction"], np.ones((1, 3)), np.ones(1)),
        ),
        "Tree.points": (tree.points, (robot.rest,)),
        "Tree.points_on_links": (
            tree.points_on_links,
            (robot.rest, ["palm_link", "palm_link"], np.zeros((2, 3))),
        ),
        "Tree.points_on_joints": (
            tree.points_on_joints,
            (robot.rest, [0, 3], np.zeros((2, 3))),
        ),
        "Tree.joint_poses": (tree.joint_poses, (motion.q,)),
        "Tree.posture": (tree.posture, (motion.q,)),
        "Tree.nearest_posture": (
            tree.nearest_posture,
            (points, np.ones(len(points)), 0.1, robot.rest),
        ),
        "Tree.smallest_distances": (
            tree.smallest_distances,
            (bounds.core, robot.rest[None], 1.0),
        ),
        "PairBounds": (core.PairBounds, (encode(bounds.model()),)),
        "PointDistances": (core.PointDistances, (encode(task.model()),)),
        "Gate": (core.Gate, (tree, *parts)),
        "Gate.set_motion": (
            solver.set_motion,
            (motion.q, motion.displacement, dt, motion.stop_times),
        ),
        "Gate.follow": (solver.follow, (solver,)),
        "Gate.interval": (solver.interval, (dt,)),
        "Gate.bounds": (solver.bounds, (dt, 1.0)),
        "Gate.admit": (solver.admit, (still, still, dt)),
        "Gate.brake": (solver.brake, (dt,)),
        "Gate.advance": (solver.advance, (motion.q, dt, 1.0, False)),
        "PosedRows": (core.PosedRows, (solver, dt, still, still, None)),
        "PosedRows.behind": (lambda *given: posed().behind(*given), (still,)),
        "PosedRows.at_end": (lambda *given: posed().at_end(*given), (still,)),
        "PosedRows.admit": (
            lambda *given: posed().admit(*given),
            (still, still, lambda rows: still),
        ),
        "PosedRows.pressed_pair": (
            lambda *given: posed().pressed_pair(*given),
            (still, still),
        ),
        "loosened": (
            core.loosened,
            (np.ones((2, 3)), np.ones(2), -np.ones(3), np.ones(3), 0.0, np.zeros(3)),
        ),
        "Ik": (
            core.Ik,
            (tree, encode(ik_model(ik.hand, ik.options)), *parts),
        ),
        "Ik.hold": (solver.hold, (dt,)),
        "Ik.solve": (solver.solve, goal),
        "task_rows": (core.task_rows, (tree, motion.q, goal[7][0])),
        "task_rows of an offset": (core.task_rows, (tree, motion.q, goal[8][0])),
        "smoothstep": (core.smoothstep, (points,)),
        "Ik.go_on": (solver.go_on, (list(solver.detours),)),
    }
    return (
        calls
        | stream_calls(core, follower, columns)
        | sample_calls(core, follower, teleoperated.target_map, columns)
        | robot_calls(core, recording.landmarks[0])
    )


def stream_calls(core: Any, follower: Any, columns: Any) -> dict[str, Call]:
    """Return calls of what judges and smooths a stream, with the columns of 60 samples."""
    from handmap_core.human.sample import landmarks_at_rest
    from handmap_qp.models import GuardModel
    from handmap_qp.trackers.plausibility import known_orders

    guard, smoother = follower._guard, follower._smoother
    wrist, dt = np.eye(4), 1.0 / 60.0
    wrists = np.tile(wrist, (60, 1, 1))
    sample = columns.sample(1)
    judged = sample.time, sample.landmarks, None, True, 1.0
    pose = core.HumanPose(sample.landmarks, wrist)
    given = columns.time, columns.landmarks, columns.valid, np.ones(60), wrists
    samples = core.Samples(*given)
    valid, at_bounds = np.ones(60, dtype=bool), np.zeros((60, 16), dtype=bool)
    orders = known_orders().core
    check = core.InputCheck("right", orders)
    track = core.Track(0.0, sample.landmarks)
    rest = landmarks_at_rest(follower.mapper.human)
    person = GuardModel(side="right", landmarks=rest)
    return {
        "measure_episode": (
            core.measure_episode,
            (samples, valid, np.ones((60, 5)), at_bounds, at_bounds, np.ones((60, 16))),
        ),
        "Samples": (core.Samples, given),
        "StreamGuard.check": (guard.core.check, (*judged, None)),
        "StreamGuard.holds": (guard.core.holds, (samples,)),
        "StreamGuard.restore": (guard.core.restore, (guard.core.save(),)),
        "InputCheck": (core.InputCheck, ("right", orders)),
        "InputCheck.update": (check.update, (0.1, sample.landmarks, wrist)),
        "InputCheck.examine": (check.examine, (samples,)),
        "InputCheck.restore": (check.restore, (check.save(),)),
        "LandmarkOrders": (
            core.LandmarkOrders,
            ([[*range(21)], [*range(20, -1, -1)]],),
        ),
        "SampleClock.advance": (core.SampleClock().advance, (0.1,)),
        "SampleClock.at": (core.SampleClock().at, (0.1,)),
        "ArrivalCredit.spend": (core.ArrivalCredit().spend, (dt, 0.1)),
        "RateCheck.update": (core.RateCheck().update, (0.1, 0.1)),
        "Track": (core.Track, (0.1, sample.landmarks)),
        "change_between": (core.change_between, (track, track, dt)),
        "array_of_rows": (core.array_of_rows, (((0.0, 1.0, 2.0), (3.0, 4.0, 5.0)),)),
        "tip_gaps": (core.tip_gaps, (columns.landmarks[0],)),
        "log_size": (core.log_size, (columns.landmarks,)),
        "misfit": (core.misfit, (columns.landmarks,)),
        "palmar_evidence": (core.palmar_evidence, (columns.landmarks,)),
        "palm_axes": (core.palm_axes, (columns.landmarks, 1.0)),
        "Smoother": (core.Smoother, (0.4, 12.0)),
        "Smoother.restore": (smoother.core.restore, (smoother.core.save(),)),
        "Smoother.smooth": (smoother.core.smooth, (pose, dt)),
        "Smoother.wait": (smoother.core.wait, (dt,)),
        "StreamGuard": (core.StreamGuard, (encode(person), orders)),
    }


def sample_calls(
    core: Any, follower: Any, teleoperation: Any, columns: Any
) -> dict[str, Call]:
    """Return calls of what maps samples: a follower of one map, and another map."""
    from handmap_core.mapping.step import step_views
    from handmap_core.stream.step_table import StepTable
    from handmap_qp import load_hand
    from handmap_qp.hands import core_tree

    mapper = follower.mapper
    guard, smoother, reader = follower._guard, follower._smoother, mapper.landmarks.core
    own_map, in_core = mapper.target_map, mapper.core
    wrist, dt = np.eye(4), 1.0 / 60.0
    sample = columns.sample(1)
    points = sample.landmarks
    pose = reader.read(points, None)
    judged = sample.time, sample.landmarks, None, True, 1.0
    samples = core.Samples(columns.time, columns.landmarks, columns.valid)
    table = StepTable(mapper.robot, len(columns.time))
    views = step_views(own_map.targets_of, mapper.robot, mapper.point_ik.gate.links)
    palm = encode(teleoperation.palm_model())
    palm_map = core.PalmMap(palm)
    led = core.LedPalm(palm_map, wrist)
    joints = load_hand("human")
    following = encode(teleoperation.method.palm_model)
    offset, _ = core.offset_of_return(pose, pose, True, 1.0)
    return {
        "minimum_jerk": (core.minimum_jerk, (0.5,)),
        "offset_of_return": (core.offset_of_return, (pose, pose, True, 1.0)),
        "pose_with_offset": (core.pose_with_offset, (pose, offset, 0.5, True)),
        "palm_of_reference": (core.palm_of_reference, (following, wrist, wrist)),
        "start_palm": (core.start_palm, (following, wrist)),
        "HumanPose": (core.HumanPose, (points, wrist)),
        "StepViews": (core.StepViews, (list, list, list, list)),
        "HandMapper": (
            core.HandMapper,
            (mapper.point_ik.core, own_map.make_core(), views),
        ),
        "HandMapper.follow": (in_core.follow, (pose, dt, 1.0)),
        "TargetSource": (
            core.TargetSource,
            (mapper.point_ik.core, own_map.make_core(), views, own_map),
        ),
        "HandMapper.map": (
            in_core.map,
            (reader, sample.landmarks, None, dt),
        ),
        "HandMapper.map_sample": (
            in_core.map_sample,
            (guard.core, smoother.core, reader, *judged, dt, None, 0.0),
        ),
        "HandMapper.run": (
            in_core.run,
            (
                guard.core,
                smoother.core,
                reader,
                0.0,
                samples,
                2,
                9,
                table.rows,
            ),
        ),
        "TeleoperationMap": (
            core.TeleoperationMap,
            (encode(teleoperation.model), palm),
        ),
        "PalmMap": (core.PalmMap, (palm,)),
        "PalmMap.follow": (palm_map.follow, (wrist,)),
        "PalmMap.person_at": (palm_map.person_at, (wrist,)),
        "LedPalm": (core.LedPalm, (palm_map, wrist)),
        "LedPalm.turn": (led.turn, (wrist, 0.5)),
        "LedPalm.meeting": (led.meeting, (wrist, led, wrist, 0.4, 0.2)),
        "HomogeneousMap": (core.HomogeneousMap, (encode(own_map.model()),)),
        "LandmarkReader": (core.LandmarkReader, (encode(mapper.landmarks.model),)),
        "LandmarkReader.read": (
            reader.read,
            (sample.landmarks, wrist),
        ),
        "LandmarkReader.pose_of": (reader.pose_of, (sample.landmarks, wrist)),
        "JointReader": (core.JointReader, (core_tree(joints),)),
        "JointReader.read": (
            core.JointReader(core_tree(joints)).read,
            (joints.rest, wrist),
        ),
        "JointReader.pose_of": (
            core.JointReader(core_tree(joints)).pose_of,
            (joints.rest, wrist),
        ),
    }


def robot_calls(core: Any, right: np.ndarray) -> dict[str, Call]:
    """Return calls of what moves a robot, given the landmarks of a right hand (21, 3)."""
    from handmap_qp.hands.robot import load_robot
    from handmap_qp.mapping.robot_mapper import RobotMapper

    mapper = RobotMapper(load_robot("g1"))
    views = core.StepViews(list, list, list, list)
    for _ in range(2):
        mapper.map_landmarks({"right": right, "left": right * (-1.0, 1.0, 1.0)})
    requests = [hand.request for hand in mapper.hands.values()]
    solver = mapper.point_ik.core
    in_core = mapper.core
    assert in_core is not None
    worlds = np.tile(np.eye(4), (2, 1, 1))
    return {
        "RobotMapper": (core.RobotMapper, (solver, encode(mapper.model()), views)),
        "RobotMapper.move": (
            in_core.move,
            (requests, [0.1, 0.1], worlds, 1.0 / 60.0),
        ),
    }


def attack(core: Any, seed: int) -> int:
    """Make hostile calls of every function; return how many raised."""
    rng = random.Random(seed)
    calls = calls_of(core)
    others = [value for _, values in calls.values() for value in values]
    raised = 0
    for name, (function, right) in calls.items():
        watched = [Watched(value) for value in right]
        try:
            function(*right)
            function(*watched)
        except Exception:
            pass
        for _ in range(ROUNDS):
            values = list(right)
            for i in rng.sample(
                range(len(right)), min(len(right), rng.choice([1, 1, 2]))
            ):
                names = watched[i].names
                if names and rng.random() < 0.7:
                    values[i] = altered(rng, right[i], names, others)
                else:
                    values[i] = hostile(rng, right[i], others)
            print(name, file=sys.stderr, flush=True)
            try:
                function(*values)
            except Exception:
                raised += 1
    return raised


@pytest.mark.parametrize("seed", ["1", pytest.param("2", marks=pytest.mark.full)])
def test_no_argument_ends_the_process(seed: str) -> None:
    run = subprocess.run(
        [sys.executable, __file__, seed],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert int(run.stdout) > 1000


def test_the_calls_are_right_and_all_there_are() -> None:
    from handmap_core.core import core

    calls = calls_of(core)
    for function, values in calls.values():
        function(*values)
    functions = {n for n, v in vars(core).items() if callable(v) and n[0].islower()}
    assert functions <= calls.keys()


def test_every_hand_of_the_library_is_taken() -> None:
    from handmap_qp import IkOptions, hand_names, load_hand
    from handmap_qp.ik import PointIk

    for name in hand_names():
        # A hand that it does not take would move on the slow path, without a word.
        assert PointIk(load_hand(name), IkOptions()).core is not None, name


if __name__ == "__main__":
    tests = Path(__file__).parents[1]
    sys.path[:0] = [str(tests / "support"), str(tests.parent)]
    import os

    if "HANDMAP_CORE" in os.environ:
        import other_core  # noqa: F401
    from handmap_core.core import core as loaded

    print(attack(loaded, int(sys.argv[1])))
