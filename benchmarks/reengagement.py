"""Speed, acceleration, jerk and overlap of a session's commands after what may make it jump.

A recording leads a robot through the service's session, without sockets. In the middle of it, a
client clutches, pauses, reconnects, changes options and so on. The table has the largest values in
the second after each, over several places in the recording. The exit code is 1 if a speed or an
acceleration limit is exceeded, or links overlap by more than 0.1 mm at or between samples.

    python benchmarks/reengagement.py --json reengagement.json
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
from overlap import OverlapMeter

from handmap_qp.hands.shape_pairs import named_pairs
from handmap_qp.service.hand_cache import HandCache
from handmap_qp.service.messages import PROTOCOL, Command, Configure, Open, Reset, Step
from handmap_qp.service.opening import Hands, prepare_hands
from handmap_qp.service.session import Session
from handmap_qp.service.store import PostureStore, Record
from handmap_qp.trackers.recording import Recording, mirrored, read_recording

PERIOD = 1.0 / 60.0
LIMITS = (None, 100.0, 20.0)
_SECRET = "a-secret-of-the-benchmark"
_BEFORE, _AFTER = 60, 60


class Run:
    """A session that a recording leads at 60 Hz, and the commands that it sent.

    Args:
        robot: Name of the robot hand.
        recording: The recording, of a right hand.
        limit: Acceleration limit [rad/s^2]; None for none.
        start: Time in the recording at the beginning [s].
    """

    cache = HandCache()

    def __init__(self, robot: str, recording: Recording, limit: float | None, start: float) -> None:
        self._recording, self._time = recording, start
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
        )
        self._now, self._seq = 0.0, 1
        self.session = Session(self._request, self._hands(), "lab", self._now)
        self.commands: list[Command] = []

    def _hands(self) -> Hands:
        return prepare_hands(self._request, self.cache)

    def lead(self, count: int, *, is_seen: bool = True) -> None:
        """Send samples at 60 Hz."""
        for _ in range(count):
            self._advance()
            self._seq += 1
            times = self._recording.time - self._recording.time[0]
            valid = np.flatnonzero(self._recording.valid)
            i = valid[np.argmin(np.abs(times[valid] - self._time % times[-1]))]
            rows = tuple(map(tuple, self._recording.landmarks[i].tolist()))
            sample = Step(
                protocol=PROTOCOL,
                seq=self._seq,
                session=_SECRET,
                time=self._time,
                landmarks=rows,
                valid=is_seen,
            )
            self.commands.append(self.session.step(sample, self._now))

    def wait(self, seconds: float) -> None:
        """Send nothing for some time."""
        for _ in range(round(seconds / PERIOD)):
            self._advance()
            if (command := self.session.tick(self._now)) is not None:
                self.commands.append(command)

    def reopen(self, former: Record | None) -> None:
        """Continue in a new session, as a client that reconnects does."""
        former = self.session.record if former is None else former
        self.session = Session(self._request, self._hands(), "lab", self._now, former=former)

    def _advance(self) -> None:
        self._now += PERIOD
        self._time += PERIOD


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
    run.commands.clear()


def _reconnect(run: Run) -> None:
    """Take the session over once its client is silent; the server refuses it before."""
    run.wait(0.5)
    run.reopen(None)


def _configure(run: Run, **changes: Any) -> None:
    run.session.configure(Configure(protocol=PROTOCOL, seq=1, session=_SECRET, **changes))


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


def extremes(run: Run, first: int, meter: OverlapMeter) -> tuple[float, float, float, float]:
    """Return the largest figures after an event.

    Args:
        run: The session's run.
        first: Index of the first command after the event.
        meter: Measures the robot's overlaps.

    Returns:
        Speed over its limit; acceleration [rad/s^2]; jerk [rad/s^3]; overlap at and between
        samples [mm].
    """
    commands = run.commands[max(first - 3, 0) :]
    q = np.array([command.q for command in commands])
    dt = np.array([command.dt for command in commands])[1:, None]
    speed = np.diff(q, axis=0) / dt
    acceleration = np.diff(speed, axis=0) / dt[1:]
    jerk = np.diff(acceleration, axis=0) / dt[2:]
    robot = run.session.robot
    limits = robot.velocity_limits
    # Postures between samples too; those that repeat are measured once.
    ways = np.concatenate([q, 0.5 * (q[1:] + q[:-1])])
    depths = [
        meter.depth(robot.configuration_vector(each, np.eye(4))) for each in np.unique(ways, axis=0)
    ]
    return (
        float((np.abs(speed) / limits).max()),
        float(np.abs(acceleration).max()),
        float(np.abs(jerk).max()),
        1e3 * max(depths),
    )


def measure(robot: str, recording: Recording, limit: float | None, places: int) -> list[Any]:
    """Measure all events with one robot and limit; return rows of the table."""
    rows, hand = [], Run.cache.robot(robot, None, None)
    meter = OverlapMeter(hand, named_pairs(hand))
    for name, cause in EVENTS.items():
        worst = np.zeros(4)
        for place in range(places):
            run = Run(robot, recording, limit, 0.5 + 1.37 * place)
            run.lead(_BEFORE)
            first = len(run.commands)
            cause(run)
            first = min(first, len(run.commands))
            run.lead(_AFTER)
            worst = np.maximum(worst, extremes(run, first, meter))
        rows.append(
            {
                "robot": robot,
                "limit [rad/s^2]": "none" if limit is None else f"a {limit:g}",
                "after": name,
                "speed / limit": worst[0],
                "acceleration [rad/s^2]": worst[1],
                "jerk [rad/s^3]": worst[2],
                "overlap [mm]": worst[3],
                "is_kept": bool(
                    worst[0] <= 1.0 + 1e-6
                    and (limit is None or worst[1] <= limit * (1.0 + 1e-6))
                    and worst[3] <= 0.1
                ),
            }
        )
    return rows


def main(words: Sequence[str] | None = None) -> None:
    """Run all events, print the table."""
    parser = common.make_parser("Commands of a session at re-engagement.", draws=False)
    parser.add_argument("--robots", nargs="+", default=["allegro_right", "three_finger"])
    arguments = common.parse_arguments(parser, words)
    file = arguments.recordings / "leap_hmd_right.npz"
    recording = read_recording(file if file.exists() else "demo::right")
    recording = mirrored(recording) if recording.side == "left" else recording
    rows: list[dict[str, Any]] = []
    runs = [(robot, limit) for robot in arguments.robots for limit in LIMITS]
    with common.progress("robots and limits", len(runs)) as advance:
        for robot, limit in runs:
            rows += measure(robot, recording, limit, 1 if arguments.quick else 4)
            advance()
    shown = [{key: row[key] for key in row if key != "is_kept"} for row in rows]
    common.print_table("After what", shown, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "reengagement", {"rows": rows})
    broken = [row for row in rows if not row["is_kept"]]
    for row in broken:
        print(f"exceeded: {row['robot']}, {row['limit [rad/s^2]']}, {row['after']}")
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
