"""One session.

A human hand that leads and a robot hand that follows, without sockets or clocks of its own.

    waiting -> following <-> released     what the client asked for: by samples, `release`, `clutch`
    hold -> returning -> hold             what the watchdog makes of it while samples stay away,
    until the next one

Every posture that leaves goes through the `SpeedGuard`. Where mapper and guard come apart for good
(a return to rest, a failure inside the mapper), the mapper is seated where the guard is before the
next sample, which is then the reference.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from handmap_qp.errors import HandmapError, RefusedError
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.convert import (
    name_joints,
    to_detail,
    to_lengths,
    to_matrix,
    to_pose,
    to_row,
)
from handmap_qp.service.messages import About, Command, Configure, Open, Opened, Reset, State, Step
from handmap_qp.service.opening import (
    Calibration,
    Hands,
    name_options,
    read_ik,
    read_options,
    refused,
)
from handmap_qp.service.safety import SpeedGuard, StepClock, start_angles, start_wrist
from handmap_qp.service.store import Record

HEARTBEAT = 0.1
"""Time between commands that repeat a hold [s]."""
RETURN_PERIOD = 1.0 / 60.0
"""Time between commands on the way back to rest [s]."""

Posture = tuple[np.ndarray, np.ndarray | None]
"""Joint angles (n,) [rad] and the wrist's pose (4, 4), None where it is not known."""
Mode = Literal["waiting", "following", "released", "calibrating", "hold", "returning"]


class Session:
    """A session, driven by whoever reads messages and clocks.

    Args:
        request: What the client opened it with.
        hands: Made of it by `prepare_hands`.
        name: Public name.
        now: The present on a monotonic clock [s].
        calibration: Measures the human hand where `hands` says that it needs it.
        former: The session that this one goes on from; what the request says if omitted.

    Attributes:
        request: What the client opened it with.
        name: Public name.
        robot: The robot hand.
        counts: How often things happened.
        last_request: When the client was last heard of [s].

    Raises:
        RefusedError: If the robot cannot be where the request says.
    """

    def __init__(
        self,
        request: Open,
        hands: Hands,
        name: str,
        now: float,
        *,
        calibration: Calibration | None = None,
        former: Record | None = None,
    ) -> None:
        self.request = request
        self.name = name
        self.robot = hands.mapper.robot
        self.counts: Counter[str] = Counter()
        self.last_request = now
        self._hands = hands
        self._calibration = calibration if hands.needs_measuring else None
        self._has_detail = request.has_detail
        start = (
            start_angles(self.robot, request.robot_q),
            start_wrist(self.robot, request.robot_wrist),
        )
        q, wrist = start if former is None else former.posture
        self._guard = SpeedGuard(self.robot, q, wrist)
        self._clock = StepClock(request.max_dt, request.time_from, now)
        self._engaged: Literal["waiting", "following", "released"] = "waiting"
        self._watch: Literal["hold", "returning"] | None = None
        self._is_apart = self._needs_reference = False
        self._epoch = _new_epoch() if former is None else former.epoch
        self._opened_at = self._last_sample = self._last_output = self._held_since = now
        self._stamp, self._seq, self._dt = 0.0, request.seq, 0.0
        self._seat()
        # What the server knows is newer than what the client believes.
        if request.is_released if former is None else former.is_released:
            self.release()

    @property
    def posture(self) -> Posture:
        """What was commanded last."""
        return self._guard.q, self._guard.wrist

    @property
    def mode(self) -> Mode:
        """What the robot is doing."""
        if self._watch is not None:
            return self._watch
        return (
            "calibrating"
            if self._calibration is not None and self._engaged == "following"
            else self._engaged
        )

    @property
    def record(self) -> Record:
        """Where the robot is, for a session that is to go on from here."""
        q, wrist = self.posture
        pose = None if wrist is None else tuple(wrist.ravel().tolist())
        return Record(self.name, self.robot.name, to_row(q), pose, self._epoch, self._is_released)

    @property
    def is_attended(self) -> bool:
        """Whether its client sends samples.

        One that never did may have given up waiting for the session to open.
        """
        return self._last_sample > self._opened_at and self._watch is None

    @property
    def has_plans(self) -> bool:
        """Whether the robot is to go to rest yet."""
        return self._wants_return and not self._is_at_rest

    def opened(self, seq: int, stream_port: int) -> Opened:
        """The answer to `open`."""
        robot, human = self.robot, self._hands.mapper.human
        return Opened(
            seq=seq,
            name=self.name,
            joint_names=robot.joint_names,
            lower=to_row(robot.lower_limits),
            upper=to_row(robot.upper_limits),
            speed=to_row(robot.velocity_limits),
            q=to_row(self._guard.q),
            human_joint_names=human.joint_names,
            human_point_names=tuple(point.name for point in human.reference_points),
            is_floating=robot.is_floating,
            stream_port=stream_port,
        )

    def state(self, seq: int, version: str, stream_port: int, now: float) -> State:
        """The answer to `status`."""
        request, mapper = self.request, self._hands.mapper
        about = About(
            robot=self.robot.name,
            side=request.side,
            input=request.input,
            lengths=to_lengths(self._hands.lengths),
            human_points=request.human_points,
            robot_points=request.robot_points,
            mount=request.mount,
            mapping=asdict(mapper.options),
            ik=asdict(mapper.ik),
            has_detail=self._has_detail,
            is_shared=request.is_shared,
        )
        return State(
            seq=seq,
            version=version,
            uptime=now - self._opened_at,
            names=(self.name,),
            mode=self.mode,
            is_released=self._is_released,
            counts=dict(self.counts),
            q=to_row(self._guard.q),
            stream_port=stream_port,
            about=about,
        )

    def step(self, sample: Step, now: float) -> Command:
        """Map one sample.

        Args:
            sample: The sample; its numbers are finite.
            now: The present [s].

        Returns:
            The command.

        Raises:
            RefusedError: If the sample cannot be used. For robot and watchdog it is then as if it
                had not come.
        """
        try:
            self._check_kind(sample)
            if self._calibration is not None:
                return self._calibrate(self._calibration, sample, now)
            self._make_ready()
            step, human, flags = self._map(sample, now)
        except HandmapError as error:
            self.counts["refused"] += 1
            raise refused(error) from error
        except Exception:
            # A bug, or a number that no check foresaw: the robot stays where it is, and the mapper
            # starts afresh from there.
            self._is_apart = self._needs_reference = True
            raise
        flags = self._note(sample, now) + flags
        if self._engaged == "following":
            self._is_apart = not self._guard.advance(step.command.q, step.command.wrist, self._dt)
        if self._is_apart and self._engaged == "following":
            flags.append("slewing")
        if step.is_clamped:
            flags.append("stretch_clamped")
        self.counts["steps"] += 1
        return self._command(step.status, flags, **self._told(step, human))

    def tick(self, now: float) -> Command | None:
        """Let time pass: the watchdog.

        Args:
            now: The present [s].

        Returns:
            A command to send out, flagged `watchdog`; None where there is nothing to say.
        """
        if self._engaged == "waiting":
            return None
        if self._watch is None:
            if now - self._last_sample <= self.request.watchdog:
                return None
            self._watch, self._held_since, self._last_output = "hold", now, -np.inf
            self.counts["watchdog"] += 1
        is_at_rest, after = self._is_at_rest, self.request.return_after
        if self._watch == "hold" and self.has_plans and now - self._held_since >= (after or 0.0):
            self._watch = "returning"
        if now - self._last_output < (RETURN_PERIOD if self._watch == "returning" else HEARTBEAT):
            return None
        # A heartbeat counts too: to a driver, the next motion starts there.
        self._last_output, self._dt = now, self._clock.grant_tick(now)
        if self._watch == "returning":
            is_at_rest = self._guard.advance(
                self.robot.rest, None, self._dt, self.request.return_speed
            )
            # Also where the client has clutched meanwhile: the mapper's robot does not come along.
            self._is_apart = self._needs_reference = True
        command = self._command(
            self._watch, ["watchdog", "at_rest"] if is_at_rest else ["watchdog"]
        )
        if is_at_rest:
            self._watch = "hold"
        return command

    def release(self) -> None:
        """Let the robot hold still until `clutch`."""
        self._hands.mapper.release()
        self._engaged = "released"
        self._watch = "hold" if self._watch is not None else None

    def clutch(self) -> None:
        """Let the next sample be the reference; the robot goes on from where it is."""
        if self._is_apart:
            self._seat()
        else:
            self._hands.mapper.clutch()
        self._engaged = "waiting" if self._engaged == "waiting" else "following"

    def configure(self, request: Configure) -> None:
        """Change options: the reference stays what it was, and the robot goes on from where it is.

        Raises:
            RefusedError: Naming the option that cannot be; all is then as it was.
        """
        mapper = self._hands.mapper
        mapping = read_options("mapping", asdict(mapper.options) | request.mapping, MappingOptions)
        ik = read_ik(asdict(mapper.ik) | request.ik)
        name_options(self.robot, ik, lambda: mapper.configure(mapping, ik=ik))
        self._has_detail = self._has_detail if request.has_detail is None else request.has_detail

    def reset(self, request: Reset, now: float) -> None:
        """Start anew.

        Args:
            request: Where the robot is now; where it does not say, the robot goes from where it is
                to rest, within its limits.
            now: The present [s].

        Raises:
            RefusedError: If the robot cannot be there.
        """
        if request.robot_q is None and request.robot_wrist is None:
            self._seat(self.robot.rest)
            self._is_apart = True
        else:
            q = (
                self._guard.q
                if request.robot_q is None
                else start_angles(self.robot, request.robot_q)
            )
            wrist = (
                self._guard.wrist
                if request.robot_wrist is None
                else start_wrist(self.robot, request.robot_wrist)
            )
            self._guard = SpeedGuard(self.robot, q, wrist)
            self._seat()
            self._epoch = _new_epoch()
        self._watch, self._last_sample = None, now
        self._engaged = "waiting" if self._engaged == "waiting" else "following"

    @property
    def _is_released(self) -> bool:
        return self._engaged == "released"

    @property
    def _wants_return(self) -> bool:
        return self.request.return_after is not None and self._engaged == "following"

    @property
    def _is_at_rest(self) -> bool:
        return bool((self._guard.q == self.robot.rest).all())

    # -- the way of one sample
    # ------------------------------------------------------------------------------------------

    def _check_kind(self, sample: Step) -> None:
        """Refuse samples of another kind than the session was opened for."""
        wanted = self.request.input
        for kind in ("q", "landmarks", "points"):
            is_given = getattr(sample, kind) is not None
            if is_given != (kind == wanted):
                message = (
                    f"this session was opened for {wanted}"
                    if is_given
                    else "missing; this session was opened for it"
                )
                raise RefusedError("invalid", message, field=kind)
        if wanted == "q" and sample.wrist is None:
            raise RefusedError("invalid", "missing; it must come with q", field="wrist")
        if wanted == "landmarks" and sample.wrist is not None:
            raise RefusedError(
                "invalid", "it follows from the landmarks; leave it out", field="wrist"
            )

    def _calibrate(self, calibration: Calibration, sample: Step, now: float) -> Command:
        """Gather landmarks until the human hand has been measured.

        The robot holds still meanwhile.
        """
        landmarks = np.array(sample.landmarks)
        if landmarks.shape != (21, 3):
            raise RefusedError(
                "invalid", f"expected 21 points, got {len(landmarks)}", field="landmarks"
            )
        hands = calibration.add(landmarks)
        flags = self._note(sample, now)
        self._dt, _ = self._clock.grant(sample.time, now)
        command = self._command("calibrating", flags)
        if hands is not None:
            hands.mapper.configure(self._hands.mapper.options, ik=self._hands.mapper.ik)
            self._hands, self._calibration = hands, None
            self._seat()
            if self._is_released:
                hands.mapper.release()
        return command

    def _make_ready(self) -> None:
        """Seat the mapper where it has to start anew.

        After a failure or a return to rest, or a hold if so asked.
        """
        # A mapper that limits accelerations thinks that it still moves as before the hold, until it
        # is seated anew.
        wants_clutch = (
            self.request.resume == "clutch" or self._hands.mapper.ik.max_acceleration is not None
        )
        if not self._is_released and (
            self._needs_reference or (wants_clutch and self._watch is not None)
        ):
            self._seat()

    def _map(self, sample: Step, now: float) -> tuple[MapStep, Posture, list[str]]:
        """The mapper's answer, the human's joint angles (empty if unknown) and wrist, and the clock's flags."""
        mapper, fitter = self._hands.mapper, self._hands.fitter
        q, wrist = np.array(sample.q or (), dtype=float), to_matrix(sample.wrist)
        if fitter is not None:
            q, wrist, _ = fitter.fit(np.array(sample.landmarks))
        self._dt, flags = self._clock.grant(sample.time, now)
        if sample.points is not None:
            step = mapper.map_points(sample.points, wrist, dt=self._dt)
        else:
            step = mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=self._dt)
        return step, (q, wrist), flags

    def _note(self, sample: Step, now: float) -> list[str]:
        """A sample that can be used has come: end what the watchdog did. Flags for its command."""
        flags = [] if self._watch is None else ["resumed"]
        self._watch = None
        self._engaged = "following" if self._engaged == "waiting" else self._engaged
        self._last_sample = self._last_output = now
        self._stamp, self._seq = sample.time, sample.seq
        return flags

    def _seat(self, q: np.ndarray | None = None) -> None:
        """Put the mapper where the guard is (its joints elsewhere, if given).

        The next sample is the reference.
        """
        robot = self.robot
        angles = np.clip(self._guard.q if q is None else q, robot.lower_limits, robot.upper_limits)
        self._hands.mapper.reset(
            robot_q=angles, robot_wrist=self._guard.wrist if robot.is_floating else None
        )
        self._is_apart = self._needs_reference = False

    def _told(self, step: MapStep, human: Posture) -> dict[str, Any]:
        """What a command says about the mapping."""
        residuals = step.residuals
        return {
            "point_error": to_row(step.point_error),
            "residual": float(np.sqrt(residuals.dot(residuals) / len(residuals))),
            "at_limit": name_joints(self.robot, step.at_limit),
            "out_of_range": step.out_of_range,
            "solve_time": step.duration,
            "detail": to_detail(step, human[0] if len(human[0]) else None, human[1])
            if self._has_detail
            else None,
        }

    def _command(self, status: str, flags: list[str], **told: Any) -> Command:
        if self._is_released:
            flags.append("released")
        return Command(
            seq=self._seq,
            name=self.name,
            time=self._stamp,
            server_time=self._last_output,
            joint_names=self.robot.joint_names,
            q=to_row(self._guard.q),
            wrist=to_pose(self._guard.wrist),
            status=status,
            flags=tuple(flags),
            epoch=self._epoch,
            dt=self._dt,
            **told,
        )


def _new_epoch() -> int:
    """A number that no session has had, on this server or one before it.

    Microseconds of the calendar.
    """
    return time.time_ns() // 1000
