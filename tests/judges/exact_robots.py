"""Proof by hostile steps of robots with two hands: limits, overlaps, numbers, exceptions.

    python tests/judges exact_robots --steps 100000
    python tests/judges exact_robots --robots ur5_pair --seed 7 --steps 5000

Both hands of a person wander, jump, cross, are lost one at a time, and send samples that cannot be
used. `checker.py`, which shares no code with the mapping, judges every command of the whole robot:
position, speed and acceleration limits, and overlaps of all links of left hand, right hand and body
that may collide. The run fails (exit code 1) on a violation, a number that is not finite, or an
undocumented exception.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import sys
from collections.abc import Sequence

import hostile
import numpy as np
import pinocchio as pin
from checker import Checker

from handmap_core.human.sample import human_name
from handmap_core.ik.motion import Motion
from handmap_core.mapping.robot_step import RobotStep
from handmap_qp import HandmapError, load_hand
from handmap_qp.hands.robot import load_robot, robot_files
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.se3 import nearest_rotation

_STEPS_PER_RUN = 1000


class RobotRun:
    """Steps of the mapping of both hands to one robot.

    Args:
        name: The robot.
        seed: Seed of the random numbers.
    """

    def __init__(self, name: str, seed: int) -> None:
        self.name = f"{name}, seed {seed}"
        self._rng = np.random.default_rng(seed)
        robot = load_robot(name)
        self._humans = {
            side: load_hand(human_name(side), points="landmarks")
            for side in robot.by_side
        }
        self._mapper = RobotMapper(robot, self._humans, "teleoperation")
        collisions = self._mapper.point_ik.gate.collisions
        assert collisions is not None
        geometry = collisions.bounds.geometry
        shapes = ShapePairs(geometry, ("",) * len(geometry.collisionPairs))
        self.checker = Checker(self._mapper.robot, shapes, 10)
        self._q = {side: human.rest.copy() for side, human in self._humans.items()}
        self._wrist = dict.fromkeys(self._humans, np.eye(4))
        self._start()

    def advance(self, count: int, tally: hostile.Tally) -> None:
        """Take steps into the tally."""
        mapper = self._mapper
        for _ in range(count):
            before = mapper.motion.q.copy()
            dt = float(10.0 ** self._rng.uniform(-4, -1))
            try:
                self._interrupt()
                step = self._map(dt)
            except HandmapError as error:
                tally.refused[type(error).__name__] += 1
                if not np.array_equal(mapper.motion.q, before):
                    tally.undocumented.append(
                        f"{self.name}: moved by a rejected sample"
                    )
                continue
            except Exception as error:
                tally.undocumented.append(f"{self.name}: {error!r}")
                self._start()
                continue
            tally.statuses[step.status] += 1
            tally.check_finite(
                step.command.q, step.targets, step.points, step.ik.wrists
            )
            vector = mapper.robot.configuration_vector(step.command.q)
            time = self.checker.time + dt
            self.checker.take(vector, time, mapper.ik.max_acceleration)

    def _start(self) -> None:
        self._mapper.reset()
        self.checker.start(self._mapper.motion.q)

    def _interrupt(self) -> None:
        mapper = self._mapper
        kind = self._rng.integers(100)
        if kind == 0:
            mapper.release()
        elif kind > 94:
            mapper.clutch()
        elif kind == 1:
            for hand in mapper.hands.values():
                hand.clutch()
        elif kind == 3:
            limit = hostile.LIMITS[self._rng.integers(len(hostile.LIMITS))]
            ik = get_preset("teleoperation").ik.replaced(max_acceleration=limit)
            mapper.configure(ik=ik)
        elif kind == 4:
            motion = mapper.motion
            mapper.motion = Motion.at_rest(motion.q, mapper.point_ik.configuration.nv)
            self.checker.start(motion.q, self.checker.time)

    def _map(self, dt: float) -> RobotStep:
        rng = self._rng
        for side, human in self._humans.items():
            self._q[side] = np.clip(
                self._q[side] + 0.1 * rng.normal(size=len(human.rest)),
                human.lower_limits,
                human.upper_limits,
            )
            way = pin.exp6(0.05 * rng.normal(size=6)).homogeneous
            self._wrist[side] = self._wrist[side] @ way
            if rng.random() < 0.02:
                self._wrist[side] = pin.exp6(rng.normal(size=6)).homogeneous
                self._wrist[side][:3, 3] *= 10.0 ** rng.uniform(-2, 4)
            self._wrist[side][:3, :3] = nearest_rotation(self._wrist[side][:3, :3])
        seen = [side for side in self._humans if rng.random() < 0.9]
        q = {side: self._q[side] for side in seen}
        if seen and rng.random() < 0.02:
            q[seen[-1]] = q[seen[-1]] * np.nan
        return self._mapper.map_step(q, self._wrist, dt=dt)


def main(words: Sequence[str] | None = None) -> int:
    """Run the judge; return 1 if anything was violated, else 0."""
    parser = argparse.ArgumentParser(
        description="Random steps of robots with two hands."
    )
    parser.add_argument("--steps", type=int, default=20_000, help="number of steps")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run")
    parser.add_argument(
        "--robots", nargs="+", default=["g1", "ur5_pair"], help="robots"
    )
    parser.add_argument("--json", metavar="FILE", help="write all numbers to FILE or -")
    parser.add_argument("--quick", action="store_true", help="400 steps")
    parser.set_defaults(picture=None)
    arguments = common.parse_arguments(parser, words)
    for name in set(arguments.robots) - robot_files().keys():
        common.stop(f"--robots {name}: expected one of {', '.join(robot_files())}")
    wanted = 400 if arguments.quick else arguments.steps
    tally = hostile.Tally()
    seed = arguments.seed
    with common.progress("steps", wanted) as advance:
        while tally.steps < wanted:
            name = arguments.robots[seed % len(arguments.robots)]
            count = min(_STEPS_PER_RUN, wanted - tally.steps)
            hostile.take(RobotRun(name, seed), count, tally)
            for _ in range(count):
                advance()
            seed += 1
    for line in (*tally.found, *tally.undocumented):
        print(line, file=sys.stderr)
    results = {
        "is_exact": tally.is_exact,
        "steps": tally.steps,
        "postures_examined": tally.postures,
        "violations": tally.violations.total(),
        "not_finite": tally.not_finite,
        "undocumented": len(tally.undocumented),
        "statuses": dict(tally.statuses),
        "refused": dict(tally.refused),
        "worst": tally.worst,
    }
    is_json = arguments.json == "-"
    plain = {
        name: value for name, value in results.items() if not isinstance(value, dict)
    }
    common.print_table("Steps of two hands", [plain], to_stderr=is_json)
    for name in ("worst", "statuses", "refused"):
        common.print_table(name.capitalize(), [getattr(tally, name)], to_stderr=is_json)
    if arguments.json:
        common.write_json(arguments.json, "exact_robots", results)
    return 0 if tally.is_exact else 1


if __name__ == "__main__":
    sys.exit(main())
