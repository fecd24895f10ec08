"""Limits and overlaps of a session's commands after what may make it jump.

A recording leads a robot through the service's session, without sockets. In the middle of it, a
client clutches, pauses, reconnects, changes options and so on. The table has the largest values in
the run, over several places in the recording. With --random, such events and changes of the
acceleration limit come at random. `checker.py` judges every command, at and between samples. The
exit code is 1 if it finds a violation.

    python tests/judges reengagement --json reengagement.json
    nice python tests/judges reengagement --random 1000000 --robots allegro_right three_finger
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
from checker import Checker

from handmap_core.human.recording import Recording, mirrored
from handmap_qp.apps.service.opening import HandCache, Hands, prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.client.messages import (
    PROTOCOL,
    Command,
    Configure,
    Open,
    Pose,
    Reset,
    Step,
)
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs, named_pairs
from handmap_qp.trackers.formats import read_recording

PERIOD = 1.0 / 60.0
LIMITS = (None, 100.0, 20.0)
_SECRET = "a-secret-of-the-benchmark"
_BEFORE, _AFTER = 60, 60
_KINDS = ("position", "speed", "acceleration", "overlap")
_HERE = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Run:
    """A session that a recording leads at 60 Hz, and the commands that it sent.

    Args:
        robot: Name of the robot hand.
        recording: The recording, of a right hand.
        limit: Acceleration limit [rad/s^2]; None for none.
        start: Time in the recording at the beginning [s].
    """

    cache = HandCache()

    def __init__(
        self,
        robot: str,
        recording: Recording,
        limit: float | None,
        start: float,
        **choices: Any,
    ) -> None:
        self._recording, self._time, self._shift = recording, start, 0.0
        self.limit = self._first_limit = limit
        self.period, self.stands = PERIOD, False
        self._request = Open(
            protocol=PROTOCOL,
            seq=1,
            session=_SECRET,
            robot=robot,
            name="lab",
            input="landmarks",
            hand_length=0.19,
            watchdog=0.2,
            return_after=0.3,
            ik={"avoids_self_collision": True, "max_acceleration": limit},
            **choices,
        )
        self._now, self._seq = 0.0, 1
        self.session = Session(self._request, self._hands(), "lab", self._now)
        self.commands: list[Command] = []
        self.limits: list[float | None] = []

    @property
    def now(self) -> float:
        """The present on the server's clock [s]."""
        return self._now

    def _hands(self) -> Hands:
        return prepare_hands(self._request, self.cache)

    def lead(self, count: int, *, is_seen: bool = True) -> None:
        """Send samples at 60 Hz."""
        for _ in range(count):
            self._advance()
            self._seq += 1
            times = self._recording.time - self._recording.time[0]
            valid = np.flatnonzero(self._recording.valid)
            i = valid[
                np.argmin(np.abs(times[valid] - (self._time + self._shift) % times[-1]))
            ]
            rows = tuple(map(tuple, self._recording.landmarks[i].tolist()))
            sample = Step(
                protocol=PROTOCOL,
                seq=self._seq,
                session=_SECRET,
                time=self._time,
                landmarks=rows,
                valid=is_seen,
            )
            self._note(self.session.step(sample, self._now))

    def wait(self, seconds: float) -> None:
        """Send nothing for some time."""
        for _ in range(round(seconds / self.period)):
            self._advance()
            if (command := self.session.tick(self._now)) is not None:
                self._note(command)

    def reopen(self, former: Record | None) -> None:
        """Continue in a new session, as a client that reconnects does."""
        self.limit = self._first_limit
        running = self.session if former is None else None
        self.session = Session(
            self._request,
            self._hands(),
            "lab",
            self._now,
            former=self.session.record if former is None else former,
            motion=running.motion if running else None,
            waited=running.since_command(self._now) if running else 0.0,
        )

    def shift(self, seconds: float) -> None:
        """Let the hand be where it is at another time of the recording, at once."""
        self._shift += seconds

    def _note(self, command: Command) -> None:
        self.commands.append(command)
        self.limits.append(self.limit)

    def _advance(self) -> None:
        self._now += self.period
        self._time += self.period


def _restart(run: Run) -> None:
    """Read the record from a file, as a server that was started again does."""
    with tempfile.TemporaryDirectory() as folder:
        with PostureStore(Path(folder) / "state") as store:
            store.note(run.session.record)
        with PostureStore(Path(folder) / "state") as store:
            joints = len(run.session.robot.joint_names)
            former = store.find("lab", run.session.robot.name, joints)
    run.reopen(former)
    # The robot stands: it has had no commands while there was no server.
    run.stands = True


def _reconnect(run: Run) -> None:
    """Take the session over once its client is silent; the server refuses it before."""
    run.wait(0.5)
    run.reopen(None)


def _configure(run: Run, **changes: Any) -> None:
    run.session.configure(
        Configure(protocol=PROTOCOL, seq=1, session=_SECRET, **changes)
    )


def _release_and_clutch(run: Run) -> None:
    run.session.release()
    run.lead(30)
    run.session.clutch()


def _stop_and_clear(run: Run) -> None:
    run.session.stop()
    run.lead(30)
    run.session.clear(run.session.record.stop)
    run.session.clutch()


def _reset(run: Run) -> None:
    run.session.reset(Reset(protocol=PROTOCOL, seq=1, session=_SECRET), run._now)


EVENTS: dict[str, Callable[[Run], None]] = {
    "nothing": lambda run: None,
    "clutch": lambda run: run.session.clutch(),
    "release, then clutch": _release_and_clutch,
    "stop, clear, clutch": _stop_and_clear,
    "hand lost for 0.5 s": lambda run: run.lead(30, is_seen=False),
    "silence for 0.3 s": lambda run: run.wait(0.3),
    "silence, on the way to rest": lambda run: run.wait(1.0),
    "silence, back at rest": lambda run: run.wait(20.0),
    "reset": _reset,
    "reconnect": _reconnect,
    "restart": _restart,
    "configure: weights": lambda run: _configure(run, ik={"rest_weight": 5.0}),
    "configure: another preset": lambda run: _configure(run, preset="object"),
}


class Judge:
    """Judges the commands of a run as they come; those of a new epoch begin at rest.

    Args:
        run: The run.
        shapes: Pairs of the robot's shapes that must not overlap.

    Attributes:
        checker: What it found.
        longest_stop: Longest time for which a robot moved after an emergency stop [s].
    """

    def __init__(self, run: Run, shapes: ShapePairs) -> None:
        self._run, self._hand = run, run.session.robot
        self.checker, self.longest_stop = Checker(self._hand, shapes), 0.0
        self._epoch, self._stopping = run.session.record.epoch, 0.0
        self._q = self._vector(*run.session.posture)
        self.checker.start(self._q, run.now)

    def take(self) -> None:
        """Judge the commands since the last time."""
        run = self._run
        if run.stands:
            self.checker.start(self._q, self.checker.time)
            run.stands = False
        for command, limit in zip(run.commands, run.limits, strict=True):
            wrist = command.wrist
            matrix = None if wrist is None else wrist.matrix
            q = self._vector(np.array(command.q), matrix)
            if command.epoch != self._epoch:
                self._epoch = command.epoch
                self.checker.start(q, command.server_time)
            else:
                before = self.checker.time
                self.checker.take(q, command.server_time, limit)
                is_stopping = command.status == "stopped" and not np.allclose(
                    q, self._q, atol=1e-12
                )
                self._stopping += self.checker.time - before
                self._stopping *= is_stopping
                self.longest_stop = max(self.longest_stop, self._stopping)
            self._q = q
        run.commands.clear()
        run.limits.clear()

    def _vector(self, q: np.ndarray, wrist: np.ndarray | None) -> np.ndarray:
        return self._hand.configuration_vector(
            q, wrist if self._hand.is_floating else None
        )


def measure(
    robot: str, recording: Recording, limit: float | None, places: int
) -> list[Any]:
    """Measure all events with one robot and limit; return rows of the table."""
    rows, hand = [], Run.cache.robot(robot, None, None)
    spec = hand.spec.collision
    for name, cause in EVENTS.items():
        worst, violations, jerk = dict[str, float](), 0, 0.0
        for place in range(places):
            run = Run(robot, recording, limit, 0.5 + 1.37 * place, robot_wrist=_HERE)
            judge = Judge(run, named_pairs(hand, spec.pairs if spec else ()))
            run.lead(_BEFORE)
            judge.take()
            cause(run)
            run.lead(_AFTER)
            jerk = max(jerk, _jerk(run.commands))
            judge.take()
            for what, value in judge.checker.worst.items():
                worst[what] = max(worst.get(what, -np.inf), value)
            violations += judge.checker.violations.total()
        rows.append(
            {
                "robot": robot,
                "limit [rad/s^2]": "none" if limit is None else f"a {limit:g}",
                "after": name,
                "speed / limit": worst["speed"],
                "acceleration / limit": worst["acceleration"],
                "jerk [rad/s^3]": jerk,
                "overlap [mm]": 1e3 * worst.get("overlap", 0.0),
                "violations": violations,
            }
        )
    return rows


def _jerk(commands: Sequence[Command]) -> float:
    """Return the largest jerk of a joint [rad/s^3]."""
    q = np.array([command.q for command in commands])
    dt = np.diff([command.server_time for command in commands])[:, None]
    acceleration = np.diff(np.diff(q, axis=0) / dt, axis=0) / dt[1:]
    return float(np.abs(np.diff(acceleration, axis=0) / dt[2:]).max())


def drive_randomly(
    robot: str, recording: Recording, count: int, seed: int
) -> dict[str, Any]:
    """Drive a robot with random events and limits; return a row of the table."""
    rng, started = np.random.default_rng(seed), time.process_time()
    run = Run(robot, recording, 20.0, 0.5, robot_wrist=_HERE)
    judge = Judge(run, all_pairs(run.session.robot))
    while judge.checker.commands < count:
        run.period = float(rng.choice([PERIOD, 0.2 * PERIOD, 1.9 * PERIOD]))
        run.lead(int(rng.integers(1, 25)))
        judge.take()
        kind = rng.integers(len(RANDOM_EVENTS))
        RANDOM_EVENTS[kind](run, rng)
        judge.take()
    checker = judge.checker
    return {
        "robot": robot,
        "commands": checker.commands,
        **{
            what: checker.violations[what]
            for what in ("position", "speed", "acceleration", "overlap")
        },
        "speed / limit": checker.worst["speed"],
        "acceleration / limit": checker.worst["acceleration"],
        "overlap [mm]": 1e3 * checker.worst["overlap"],
        "longest stop [s]": judge.longest_stop,
        "CPU [s]": time.process_time() - started,
    }


def _change_limit(run: Run, rng: np.random.Generator) -> None:
    limit = (None, 0.5, 2.0, 20.0, 100.0, 1000.0)[rng.integers(6)]
    run.limit = limit
    ik = {"max_acceleration": limit, "has_velocity_limits": bool(rng.random() < 0.8)}
    if rng.random() < 0.3:
        ik |= {"point_weight": float(10.0 ** rng.uniform(-1, 6)), "error_damping": 0.0}
    _configure(run, ik=ik)


def _stop_for_a_while(run: Run, rng: np.random.Generator) -> None:
    run.session.stop()
    for _ in range(int(rng.integers(1, 4))):
        run.wait(float(rng.uniform(0.02, 0.4)))
        run.lead(int(rng.integers(0, 5)))
    run.session.clear(run.session.record.stop)
    run.session.clutch()


def _release_for_a_while(run: Run, rng: np.random.Generator) -> None:
    run.session.release()
    run.lead(int(rng.integers(1, 40)))
    run.session.clutch()


def _go_elsewhere(run: Run, rng: np.random.Generator) -> None:
    """Let the hand be somewhere else at once, or turned."""
    run.shift(float(rng.uniform(0.0, 60.0)))


def _take_over(run: Run, rng: np.random.Generator) -> None:
    run.wait(float(rng.uniform(0.0, 0.6)))
    run.reopen(None)


RANDOM_EVENTS: tuple[Callable[[Run, np.random.Generator], None], ...] = (
    _change_limit,
    _change_limit,
    _stop_for_a_while,
    _release_for_a_while,
    _go_elsewhere,
    _take_over,
    lambda run, rng: run.wait(float(rng.uniform(0.05, 3.0))),
    lambda run, rng: run.lead(int(rng.integers(1, 60)), is_seen=False),
    lambda run, _: run.session.clutch(),
    lambda run, _: _reset(run),
)


def main(words: Sequence[str] | None = None) -> None:
    """Run all events, print the table."""
    parser = common.make_parser("Commands of a session at re-engagement.", draws=False)
    parser.add_argument(
        "--robots", nargs="+", default=["allegro_right", "three_finger"]
    )
    parser.add_argument(
        "--random", type=int, default=0, help="commands under random events in sum"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the random events")
    arguments = common.parse_arguments(parser, words)
    file = arguments.recordings / "leap_hmd_right.npz"
    recording = read_recording(file if file.exists() else "demo::right")
    recording = mirrored(recording) if recording.side == "left" else recording
    rows: list[dict[str, Any]] = []
    runs = [(robot, limit) for robot in arguments.robots for limit in LIMITS]
    if arguments.random:
        count = 300 if arguments.quick else arguments.random // len(arguments.robots)
        with common.progress("robots", len(arguments.robots)) as advance:
            for i, robot in enumerate(arguments.robots):
                rows.append(drive_randomly(robot, recording, count, arguments.seed + i))
                advance()
    else:
        with common.progress("robots and limits", len(runs)) as advance:
            for robot, limit in runs:
                rows += measure(robot, recording, limit, 1 if arguments.quick else 4)
                advance()
    common.print_table("After what", rows, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "reengagement", {"rows": rows})
    if any(row.get(kind) for row in rows for kind in ("violations", *_KINDS)):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
