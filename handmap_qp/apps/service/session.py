"""One session: a human hand that leads and a robot hand that follows, or two and a robot.

A session has no sockets and no clock of its own; its caller passes messages and times. `safety` has
its states, and what keeps its robot within its limits.

Every posture that leaves was admitted by a gate: the mapper's while the robot moves as the mapper
says, else the robot's own. If the postures of robot and mapper differ for good, after a return to
rest or an exception in the mapper, the mapper continues from the robot's motion at the next sample,
which is then the reference.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import compress
from typing import Any

import numpy as np
from msgspec import structs

from handmap_core.client.messages import (
    About,
    AnyReply,
    AssumedSpeed,
    Command,
    Configure,
    Detail,
    Done,
    Fist,
    HandSample,
    HandState,
    Lengths,
    Measured,
    Open,
    Opened,
    Pose,
    Reset,
    State,
    Step,
)
from handmap_core.core import core
from handmap_core.errors import HandmapError, RefusedError
from handmap_core.se3 import Array
from handmap_qp.hands import LONGEST_STOP, Hand, Side, Values
from handmap_qp.human import UNSEEN, HumanSample, PalmShape
from handmap_qp.ik import Instant, Motion, When
from handmap_qp.mapping import (
    AssumedSpeeds,
    HandMapper,
    MapStep,
    Placement,
    RobotCommand,
    RobotMapper,
    check_joints,
)
from handmap_qp.stream import (
    FollowingCheck,
    ObjectFollower,
    RobotFollower,
    RobotGripFollower,
)
from handmap_qp.trackers import LAYOUTS
from .haptics import fingers_by_joint
from .opening import (
    Calibration,
    Gripping,
    Hands,
    naming_field,
    naming_option,
    read_choice,
    read_grip,
    refused,
    reopened,
    upright_of,
)
from .safety import (
    START_TOLERANCE,
    CommandedRobot,
    Event,
    SessionClock,
    SessionState,
    next_state,
    refuse_if,
)
from .store import Posture, Record

Humans = dict[Side, Any]
"""What each hand of a sample is, by side: its `HumanSample`; None if it has no landmarks."""
_FIELDS = ("hands", "q", "landmarks", "points", "values")
_STAGES = (
    "motion",
    "motion_rigid",
    "motion_deformation",
    "stretches",
    "human_points",
    "targets",
    "points",
)
"""What a detail has of a step under the same names."""
_OF_HELD = {
    "object_centre": "a grip and measured joints of one hand",
    "object_pose": "object",
}
"""What fields of a sample need in the session."""
_FRESH = 0.05
"""Joints that a driver measured so long ago are where the robot is now [s]."""
_HELD_FIELDS = (*_OF_HELD, "object_deviation")
_BARE = dict.fromkeys(("q", "points", *_HELD_FIELDS)) | structs.asdict(HandSample())
"""Fields of a hand in a sample that has `hands`."""


class SampleForm:
    """What the samples of a session hold: one hand, or the hands of a robot.

    Args:
        request: The request that opened the session.
        robot: The robot hand, or the robot.

    Raises:
        RefusedError: If there is no such layout, or it is given with another kind of samples.
    """

    def __init__(self, request: Open, robot: Hand) -> None:
        self._request = request
        self._sides = [hand.side for hand in robot.parts]
        self._field = self._wanted = request.input
        self._layout: Any = None
        name = request.layout
        if name is not None:
            refuse_if(self._field != "landmarks", "needs input=landmarks", "layout")
            # Only layouts of the package: a name must not open files of the server.
            message = f"no layout {name!r}; there are {', '.join(LAYOUTS)}"
            refuse_if(name not in LAYOUTS, message, "layout")
            self._layout = LAYOUTS[name]
            self._field, self._wanted = "values", f"values of {name}"
        self._place = _FIELDS.index(self._field)

    def each(self, sample: Step, work: Callable[[Side, Step], Any]) -> Humans:
        """Return what `work` makes of each hand of a sample, by side.

        Raises:
            RefusedError: If the hands are not those of the robot.
            HandmapError: As in `work`; with the hand at fault if a robot has several.
        """
        if not self._sides:
            side = self._request.side
            return {side: work(side, sample)}
        hands = sample.hands or {}
        is_bare = sample == structs.replace(sample, **_BARE)
        is_right = is_bare and hands and hands.keys() <= set(self._sides)
        message = f"expected {' or '.join(self._sides)}, and nothing of a hand beside"
        refuse_if(not is_right, message, "hands")
        done = {}
        for side, hand in hands.items():
            part = structs.replace(sample, hands=None, **structs.asdict(hand))
            try:
                done[side] = work(side, part)
            except HandmapError as error:
                wrong = refused(error)
                place = f"hands.{side}.{wrong.field}"
                raise RefusedError(wrong.code, str(wrong), field=place) from error
        return done

    def read(self, side: Side, sample: Step) -> HumanSample | None:
        """Return the landmarks of one hand of a sample; None if it has joint angles or points.

        Raises:
            RefusedError: If the session was opened for another kind, with the field at fault.
            HandmapError: If the numbers are not of the layout.
        """
        values = (
            sample.hands,
            sample.q,
            sample.landmarks,
            sample.points,
            sample.values,
        )
        # Nearly all samples have the field that is wanted, and no other.
        is_right = values.count(None) == len(values) - 1
        if not (is_right and values[self._place] is not None):
            self._check_fields(sample.valid, values)
        if self._request.input != "landmarks":
            refuse_if(not sample.valid, "only landmarks may be invalid", "valid")
            is_bare = self._field == "q" and sample.wrist is None
            refuse_if(is_bare, "missing; it must come with q", "wrist")
            return None
        common: Values = {
            "time": sample.time,
            "side": side,
            "wrist": None if sample.wrist is None else sample.wrist.matrix,
            "valid": sample.valid,
            "confidence": sample.confidence,
        }
        if sample.values is not None:
            return self._layout.read(np.array(sample.values), **common)
        landmarks = UNSEEN
        if sample.landmarks is not None:
            landmarks = core.array_of_rows(sample.landmarks)
        # Messages were checked, except for their number of landmarks.
        is_hand = landmarks.shape == UNSEEN.shape
        make = HumanSample.of_checked if is_hand else HumanSample
        return make(landmarks=landmarks, **common)

    def _check_fields(self, is_valid: bool, values: Sequence[object]) -> None:
        """Refuse a sample whose numbers are not of the session's kind; it may have none if invalid.

        Args:
            is_valid: Whether the tracker saw the hand.
            values: What it has in each of `_FIELDS`.
        """
        pairs = zip(_FIELDS, values, strict=True)
        given = {field for field, value in pairs if value is not None}
        if is_valid or given:
            wrong = min(given ^ {self._field}, key=_FIELDS.index, default="")
            refuse_if(wrong, f"this session was opened for {self._wanted}", wrong)

    def held(self, sample: Step, measured: Array | None, *, grips: bool) -> Values:
        """Return what a follower takes of robot and object, by name.

        Args:
            sample: The sample.
            measured: Joints as they were measured of late [rad or m], shape (n,); None if they were
                not.
            grips: Whether the session holds what it meets.

        Raises:
            RefusedError: If the sample has what the session cannot use, or lacks what it needs.
        """
        holds_object = self._request.object is not None
        given: Values = {}
        if holds_object:
            pose = sample.object_pose
            given["object_pose"] = None if pose is None else pose.matrix
        elif sample.object_pose is not None:
            raise _alien("object_pose")
        if grips:
            given["measured_q"] = measured
            if measured is None and self._request.grip is not None:
                message = "missing; it must come with a grip"
                raise RefusedError("invalid", message, field="measured_q")
        if sample.object_centre is not None:
            if not grips or measured is None or self._sides:
                raise _alien("object_centre")
            given["object_centre"] = sample.object_centre
            if sample.object_deviation is not None:
                given["object_deviation"] = sample.object_deviation
        return given


def _alien(field: str) -> RefusedError:
    """Return the refusal of a field that the session was not opened for."""
    message = f"needs a session with {_OF_HELD[field]}"
    return RefusedError("invalid", message, field=field)


class Session:
    """A session, driven by its caller.

    Args:
        request: The request that opened it.
        hands: The hands that `prepare_hands` made of the request.
        name: Public name.
        now: The present on a monotonic clock [s].
        former: Record of the session to continue; the request decides if omitted.
        owner: Its owner, see `Caller.owner`. The epoch of another owner ends.
        account: Whose share of the service it uses, see `Caller.account`.
        motion: How the robot of that session moves, if it is running; at rest if omitted.
        waited: Time since the last command of that session [s].
        totals: Counts of the service, which count the session's holds, too.

    Attributes:
        request: The request that opened it, with all changes of options since.
        name: Public name.
        robot: The robot hand.
        counts: Counts of what happened.
        last_request: Time of the last request with the session's secret [s].
        seq: Number of that request.
        payload: That request as received.
        answer: Its answer, which is sent again if the same request arrives again.
        owner: Its owner.
        account: As given.

    Raises:
        RefusedError: If the robot cannot be where the request says, or there is no such layout.
    """

    def __init__(
        self,
        request: Open,
        hands: Hands,
        name: str,
        now: float,
        *,
        former: Record | None = None,
        owner: str = "",
        account: str = "",
        motion: Motion | None = None,
        waited: float = 0.0,
        totals: Counter[str] | None = None,
    ) -> None:
        self.request = request
        self.name = name
        self.owner = owner
        self.account = account
        self.robot = hands.mapper.robot
        self._has_arm = bool(self.robot.moves_wrist.any())
        self.counts = Counter[str]()
        self._totals = Counter[str]() if totals is None else totals
        self.last_request = self._opened_at = now
        self.seq = self._stamped = request.seq
        self.payload = b""
        self.answer: AnyReply = Done()
        self._form = SampleForm(request, self.robot)
        self._following: FollowingCheck | None = None
        # When a driver measured joints last.
        self._measured_at = -math.inf
        self._hands = hands
        self._assumed = AssumedSpeeds(self.robot)
        start = self._start(self.robot.rest, None, request)
        self._place(*(start if former is None else former.posture), motion)
        self._clock = SessionClock(request, now, waited)
        self._state = SessionState.WAITING
        self._epoch = former.epoch if former and former.owner == owner else _new_epoch()
        self._stamp = 0.0
        self._dt = 0.0
        self._when: When = 0.0
        self._stop = 0
        self._is_lost = False
        self._reset_mapper()
        # The server's record is newer than the client's belief.
        if request.is_released if former is None else former.is_released:
            self.release()

    @property
    def posture(self) -> Posture:
        """The posture last commanded."""
        return self._commanded.posture

    @property
    def motion(self) -> Motion:
        """How the robot moves."""
        return self._commanded.motion

    def since_command(self, now: float) -> float:
        """Return the time since the last command [s]."""
        return self._clock.since_command(now)

    @property
    def mode(self) -> str:
        """What the robot does, as clients read it."""
        is_led = self._state is SessionState.FOLLOWING
        return "calibrating" if self._hands.calibration and is_led else self._state.mode

    @property
    def record(self) -> Record:
        """Posture, epoch, release and owner, for a session that continues from here."""
        q, wrist = self.posture
        return Record(
            self.name,
            self.robot.name,
            to_row(q),
            None if wrist is None else to_row(wrist.ravel()),
            self._epoch,
            self._state.is_released,
            self._stop,
            self.owner,
        )

    @property
    def will_move(self) -> bool:
        """Whether silence makes the robot move yet, to its rest posture."""
        return self._clock.will_return(self._state) and not self._is_at_rest

    @property
    def _fist(self) -> Fist | None:
        """How long the robot takes for a fist, as clients read it."""
        found = self._hands.fist
        if found is None:
            return None
        return Fist(found.time, found.joint, found.is_slow, found.is_assumed)

    @property
    def _assumed_speed(self) -> AssumedSpeed | None:
        """How often assumed speed limits held the robot, as clients read it."""
        counted = self._assumed
        if not counted.has_any:
            return None
        return AssumedSpeed(counted.share, counted.joint, counted.is_often)

    def opened(self, seq: int, stream_port: int) -> Opened:
        """Answer `open`."""
        robot = self.robot
        human = self._hands.mapper.human
        return Opened(
            seq=seq,
            name=self.name,
            joint_names=robot.joint_names,
            lower=to_row(robot.lower_limits),
            upper=to_row(robot.upper_limits),
            speed=to_row(robot.velocity_limits),
            q=to_row(self._commanded.q),
            human_joint_names=human.joint_names,
            human_point_names=tuple(point.name for point in human.reference_points),
            is_floating=robot.is_floating,
            stream_port=stream_port,
            stop_time=LONGEST_STOP,
            stop_distance=to_row(robot.stop_distances),
            fist=self._fist,
        )

    def state(self, seq: int, version: str, stream_port: int, now: float) -> State:
        """Answer `status`."""
        choice = self._hands.choice
        measured = self._hands.lengths
        wanted = self.request
        shared = {name: getattr(wanted, name) for name in About.__struct_fields__}
        about: Values = shared | {
            "upright": upright_of(wanted),
            "robot": self.robot.name,
            "lengths": measured
            and Lengths(*(part.tolist() for part in structs.astuple(measured)[:3])),
            "preset": choice.preset,
            "options": choice.method.values,
            "ik": choice.ik.values,
        }
        return State(
            seq=seq,
            version=version,
            uptime=now - self._opened_at,
            names=(self.name,),
            mode=self.mode,
            is_released=self._state.is_released,
            stop=self._stop,
            counts=dict(self.counts),
            q=to_row(self._commanded.q),
            stream_port=stream_port,
            about=About(**about),
            fist=self._fist,
            assumed_speed=self._assumed_speed,
            fingers=fingers_by_joint(self.robot),
        )

    def step(self, sample: Step, now: float) -> Command:
        """Map one sample.

        Args:
            sample: The sample; its numbers are finite.
            now: The present [s].

        Raises:
            RefusedError: If the sample cannot be used. The robot and the watchdog then ignore it.
        """
        try:
            humans = self._form.each(sample, self._form.read)
            if sample.measured_q is not None:
                self.measure(sample, now)
            dt, flags = self._clock.grant(sample.time, now)
            self._grant(dt)
            if self.request.resume == "engage" and self._state.is_silent:
                self._reset_mapper()
            if calibration := self._hands.calibration:
                return self._calibrate(calibration, humans, sample, now)
            self._prepare_mapper()
            step = self._map(humans, sample, now)
        except HandmapError as error:
            self.counts["refused"] += 1
            raise refused(error) from error
        except Exception:
            # Unexpected exception: hold, and restart the mapper from the last command.
            self._reset_mapper()
            raise
        command = step.command
        self._effort = command.effort
        status = step.status
        is_held = step.is_held
        if rule := step.rule:
            flags.append(rule)
        if is_held:
            # The sample makes no sense: the robot holds, and the watchdog ignores the sample.
            self.counts["held"] += 1
            self._hold_or_return()
        else:
            self.counts["steps"] += 1
            flags = self._accept(now) + flags
            if self._state is SessionState.FOLLOWING:
                flags += self._follow(command)
                self._assumed.add(step)
                self._measure_gap(sample.time, humans)
            else:
                self._commanded.brake(self._when)
            flags += step.stages.summary.flags
        if self._state.is_halted:
            # Also where the hand is lost: drivers stop the motors by this word.
            status = self._state.mode
        trust = self._trust(step, rule, humans)
        diagnostics = {} if is_held else self._diagnostics(step, sample, humans)
        return self._command(now, status, flags, sample, **trust, **diagnostics)

    def tick(self, now: float) -> Command | None:
        """Let time pass.

        Args:
            now: The present [s].

        Returns:
            A command of the watchdog to send out, with the flag `watchdog`; None if none is due.
        """
        if self._following and self._following.is_lost(now):
            self._lose()
        while event := self._clock.event(self._state, now):
            if event == "return" and self._is_at_rest:
                break
            if event == "silence":
                self._count_hold("watchdog")
            self._handle(event)
        # A heartbeat counts too: the driver starts its next motion there.
        if not (dt := self._clock.take_turn(self._state, now, self._commanded)):
            return None
        self._grant(dt)
        status = self._state.mode
        self._hold_or_return()
        flags = ["watchdog"] + ["at_rest"] * self._is_at_rest
        return self._command(now, status, flags)

    @property
    def due(self) -> float:
        """When `tick` may do something next if no request comes [s]; in the past for at once."""
        due = self._clock.due(self._state)
        return min(due, self._following.lost_at) if self._following else due

    def release(self) -> None:
        """Let the robot hold its posture until `clutch`."""
        self._hands.mapper.disengage()
        self._handle("release")

    def stop(self, number: int = 0) -> None:
        """Stop the robot until `clear`; 0 makes a new number. A second stop changes nothing."""
        if not self._state.is_stopped:
            self._stop = number or _new_epoch()
            self._hands.mapper.disengage()
            self._handle("stop")
            self._clock.hasten()

    def clear(self, number: int) -> None:
        """Clear an emergency stop; the robot is then released.

        Args:
            number: Number of the stop, so that nobody clears another one than the one seen.

        Raises:
            RefusedError: If no such stop is in force.
        """
        got = f"stop {self._stop} is" if self._stop else "no stop is"
        refuse_if(number != self._stop, f"{got} in force, not {number}", "stop")
        self._stop = 0
        self._handle("clear")

    def clutch(self) -> None:
        """Make the next sample the reference; the robot continues from where it is.

        Raises:
            RefusedError: If an emergency stop is in force.
        """
        self._prepare_to_engage()
        self._handle("clutch")
        self._reset_mapper()

    def measure(self, request: Measured | Step, now: float) -> None:
        """Take where the robot's joints are, if a request says it.

        Raises:
            RefusedError: If the robot has another number of joints.
        """
        if request.measured_q is None:
            return
        if self._following is None:
            wanted = self.request
            limits = wanted.following_error, wanted.following_time
            self._following = FollowingCheck(self.robot, *limits)
        q = np.array(request.measured_q)
        with naming_field("measured_q"):
            self._following.measure(q, now, goes_on=isinstance(request, Measured))
        self._measured = np.clip(q, *self.robot.limits)
        if isinstance(request, Measured):
            self._measured_at = now

    def configure(self, request: Configure) -> None:
        """Change options; the reference stays, and the robot continues from where it is.

        Raises:
            RefusedError: With the option at fault. The session is then unchanged.
        """
        self._choose(
            self._hands, reopened(self.request, self._hands.choice.preset, request)
        )

    def reset(self, request: Reset, now: float) -> None:
        """Start again.

        Args:
            request: Where the robot is now. If it does not say, the robot moves to its rest posture
                within its speed limits.
            now: The present [s].

        Raises:
            RefusedError: If the robot cannot be there, or an emergency stop is in force.
        """
        self._prepare_to_engage()
        goal = self.robot.rest
        if request.robot_q is not None or request.robot_wrist is not None:
            self._place(*self._start(*self.posture, request))
            self._epoch = _new_epoch()
            goal = None
        self._clock.last_sample = now
        self._handle("reset")
        self._reset_mapper(goal)

    @property
    def _is_at_rest(self) -> bool:
        return np.array_equal(self._commanded.q, self.robot.rest)

    def _start(self, q: Array, wrist: Array | None, request: Open | Reset) -> Posture:
        """Return a posture with the parts that a request gives, which the robot must reach."""
        if request.robot_q is not None:
            with naming_field("robot_q"):
                q, _ = check_joints(
                    self.robot, request.robot_q, "robot_q", START_TOLERANCE
                )
        refuse_if(
            request.robot_wrist is not None and not self.robot.is_floating,
            f"{self.robot.name} has a fixed wrist: leave it out",
            "robot_wrist",
        )
        return q, wrist if request.robot_wrist is None else request.robot_wrist.matrix

    def _place(
        self, q: Array, wrist: Array | None, motion: Motion | None = None
    ) -> None:
        """Take the robot to be at a posture, or in a motion if that is one of this robot."""
        if self._following:
            self._following.restart()
        # The robot's clock goes on.
        time = self._hands.mapper.point_ik.gate.time
        self._commanded = CommandedRobot(self.robot, q, wrist, time)
        nq = self.robot.model.nq
        if motion is not None and len(motion.q) == nq and wrist is not None:
            self._commanded.motion = motion
        self._commanded.obey(self._hands.mapper.point_ik)

    def _lose(self) -> None:
        """Let the robot hold where it is, because it does not go where it is commanded."""
        before = self._state
        self._handle("loss")
        if self._state is not before:
            self._count_hold("not_following")
            self._is_lost = True
            self._hands.mapper.disengage()
            self._be_where_measured()
            self._clock.hasten()

    def _count_hold(self, reason: str) -> None:
        """Count a hold that no client asked for, here and among those of the service."""
        self.counts[reason] += 1
        self._totals[reason] += 1

    def _be_where_measured(self) -> None:
        """Take the robot to be where it was measured last, and go on to watch it."""
        self._place(self._measured, self._commanded.wrist)
        self._epoch = _new_epoch()

    def _prepare_to_engage(self) -> None:
        """Refuse while a stop is in force; go on from where a robot is that did not follow."""
        refuse_if(
            self._state.is_stopped,
            f"the robot was stopped: clear the stop {self._stop} first",
            code="stopped",
        )
        if self._is_lost:
            self._is_lost = False
            self._be_where_measured()

    def _handle(self, event: Event) -> None:
        self._state = next_state(self._state, event)

    def _grant(self, dt: float) -> None:
        """Grant time to the next command [s].

        Where more has passed, limits of acceleration hold in all of it.
        """
        self._dt = dt
        self._when = dt
        if self._clock.waited > dt:
            self._when = Instant(self._commanded.time + self._clock.waited, dt)

    def _map(self, humans: Humans, sample: Step, now: float) -> MapStep:
        """Map a sample within the time granted."""
        mapper = self._hands.mapper
        follower = self._hands.follower
        is_measured = sample.measured_q is not None or now - self._measured_at <= _FRESH
        measured = self._measured if is_measured else None
        grips = isinstance(follower, Gripping)
        held = self._form.held(sample, measured, grips=grips)
        if sample.base is not None:
            if not isinstance(mapper, RobotMapper):
                message = "a hand alone has no floating base"
                raise RefusedError("invalid", message, field="base")
            mapper.base_pose = sample.base.matrix
        held["dt"] = self._when
        if self.request.input != "landmarks":
            # `prepare_hands` refuses other samples of a robot with two hands.
            assert isinstance(mapper, HandMapper)
            # The core takes arrays; of tuples it leaves the sample to Python.
            wrist = None if sample.wrist is None else sample.wrist.matrix
            if self.request.input == "q":
                # `SampleForm.read` refuses joint angles without a wrist.
                assert wrist is not None
                return mapper.map_step(np.array(sample.q), wrist, **held)
            # `SampleForm.read` refuses samples without points.
            assert sample.points is not None
            return mapper.map_points(core.array_of_rows(sample.points), wrist, **held)
        held["arrival"] = now if self.request.time_from == "server" else None
        if isinstance(follower, RobotFollower | RobotGripFollower):
            return follower.map_samples(humans, **held)
        human = humans[self.request.side]
        step = follower.map_sample(human, **held)
        if step.rule == "size":
            # Other units than metres are a mistake of the client, which must know.
            PalmShape(mapper.human).check(human.landmarks)
        return step

    def _calibrate(
        self, calibration: Calibration, humans: Humans, sample: Step, now: float
    ) -> Command:
        """Collect landmarks until the human hand is measured.

        The robot holds meanwhile, unless a reset sent it to rest. If it moves, because its session
        was restored or because it was returning to rest, it brakes first.
        """
        added = self._form.each(sample, lambda side, _: calibration.add(humans[side]))
        first, *others = added.values()
        rule = first if all(others) else ""
        hands = calibration.result()
        self.counts["held"] += bool(rule)
        flags = [rule] if rule else self._accept(now)
        if rule or self._state is not SessionState.FOLLOWING or self._goal is None:
            # The watchdog does not brake while samples arrive.
            self._hold_or_return()
        else:
            is_there = self._commanded.move_to(self._goal, None, self._when, stops=True)
            flags += ["slewing"] * (not is_there)
        command = self._command(
            now,
            self._state.mode if self._state.is_halted else "calibrating",
            flags,
            sample,
            rule=rule,
            confidence=sample.confidence,
        )
        if hands is not None:
            # Options may have changed since the hands were prepared.
            self._choose(hands, self.request)
            self._reset_mapper(self._goal)
        return command

    def _hold_or_return(self) -> None:
        """Move the robot in a command that no mapping leads: brake, or return to rest.

        Samples that make no sense do not interrupt a return, because the watchdog ignores them.
        """
        if self._state is not SessionState.RETURNING:
            self._commanded.brake(self._when)
            return
        share = self.request.return_speed
        self._commanded.move_to(self.robot.rest, None, self._when, share, stops=True)
        # The mapper starts again from there, even if the client has clutched meanwhile.
        self._reset_mapper()
        if self._is_at_rest:
            self._handle("arrival")

    def _measure_gap(self, time: float, humans: Humans) -> None:
        """Let touches correct the contact gap, by small steps, while the tips are apart.

        With `picking` above 0, rows of pinches have weight there, and the robot may move a little.
        """
        meter = self._hands.gap_meter
        human = humans.get(self.request.side)
        if meter is None or human is None or "contact_gap" in self.request.options:
            return
        if meter.add(time, human.landmarks):
            self._choose(self._hands, self.request)

    def _choose(self, hands: Hands, wanted: Open) -> None:
        """Make these the hands, with the options of a request; all or nothing."""
        mapper = hands.mapper
        human = mapper.human
        if hands.gap_meter is not None:
            human = human.with_contact_gap(hands.gap_meter.gap)
        choice = read_choice(wanted, human, hands.robot)
        method = None if choice.method == hands.choice.method else choice.method
        grip = read_grip(wanted)
        with naming_option(hands.robot, choice):
            mapper.configure(method, ik=choice.ik)
        follower = hands.follower
        if grip and isinstance(follower, Gripping | ObjectFollower):
            follower.grip = grip
        self.request = wanted
        self._hands = hands._replace(choice=choice)
        self._commanded.obey(mapper.point_ik)

    def _prepare_mapper(self) -> None:
        """Let the mapper go on from the robot's motion."""
        if self._is_slewing:
            return
        mapper = self._hands.mapper
        if self._commanded.moves_as(mapper.point_ik.gate):
            return
        # It may have braked meanwhile, or a sample was refused half-way.
        motion = self._commanded.motion
        is_known = mapper.placement is Placement.KNOWN
        if not (is_known and all(map(np.array_equal, motion, mapper.motion))):
            mapper.motion = motion

    def _accept(self, now: float) -> list[str]:
        """Note a sample that can be used, which ends a hold; return flags for its command."""
        self._clock.feed(now)
        if self._state is SessionState.FOLLOWING:
            return []
        flags = ["resumed"] * self._state.is_silent
        self._handle("sample")
        return flags

    def _follow(self, target: RobotCommand) -> list[str]:
        """Move the robot to the mapper's posture within its limits; return flags."""
        solver = self._hands.mapper.point_ik
        if solver.options.has_velocity_limits and not self._is_slewing:
            self._commanded.follow_command(solver.gate, target)
            return []
        is_there = self._commanded.move_to(target.q, target.wrist, self._when)
        self._is_slewing = not is_there
        return ["slewing"] * self._is_slewing

    def _reset_mapper(self, q: Array | None = None) -> None:
        """Reset the mapper to the robot, or to q (n,); the next sample is the reference."""
        self._effort = None
        # Where the mapper is, on the way to which the robot is; None if it is where the robot is.
        self._goal = q
        mapper = self._hands.mapper
        robot = self._commanded
        self._is_slewing = q is not None or not robot.is_placed
        if self._is_slewing:
            inside = np.clip(robot.q if q is None else q, *self.robot.limits)
            wrist = {"robot_wrist": robot.wrist} if self.robot.is_floating else {}
            mapper.reset(robot_q=inside, **wrist)
        else:
            mapper.engage()
        if self._state.is_released:
            mapper.disengage()

    def _trust(self, step: MapStep, rule: str, humans: Humans) -> Values:
        """Return the fields of a command that say what a sample is worth."""
        consistency = step.consistency
        return {
            "rule": rule,
            "consistency": None if math.isnan(consistency) else consistency,
            "confidence": step.confidence,
            "hands": self._hand_states(step, humans) if self.robot.parts else {},
        }

    def _diagnostics(self, step: MapStep, sample: Step, humans: Humans) -> Values:
        """Return the fields of a command that say where a sample led."""
        summary = step.stages.summary
        wants_detail = self.request.has_detail
        human = humans.get(self.request.side)
        return {
            "point_error": tuple(summary.point_error),
            "residual": summary.residual,
            "at_limit": tuple(compress(self.robot.joint_names, summary.at_bound)),
            "out_of_range": step.out_of_range,
            "solve_time": step.duration,
            "detail": self._detail(step, human, sample.q) if wants_detail else None,
            "wrist_error": tuple(summary.wrist_error),
            "arm_held_by": step.arm_held_by if self._has_arm else "",
        }

    def _hand_states(self, step: MapStep, humans: Humans) -> dict[Side, HandState]:
        """Return what a command says of each hand of a robot."""
        hands: dict[Side, MapStep] = getattr(step, "hands", {})
        return {
            side: HandState(
                each.status,
                each.rule,
                Pose.from_matrix(each.command.wrist),
                tuple(each.stages.summary.wrist_error),
                each.arm_held_by,
                self._detail(each, humans[side]) if side in humans else None,
            )
            for side, each in hands.items()
        }

    def _detail(self, step: MapStep, human: Any, q: Any = None) -> Detail | None:
        """Return every stage of a step, if they are wanted and its method has a T."""
        is_wanted = self.request.has_detail and not step.is_held
        if not is_wanted or "motion" not in step.diagnostics:
            return None
        arrays = {name: getattr(step, name).tolist() for name in _STAGES}
        return Detail(
            held_by=step.held_by,
            human_q=q,
            human_wrist=to_pose(step.human_wrist),
            landmarks=human and human.landmarks.tolist(),
            pivot=step.diagnostics["pivot_image"].tolist(),
            **arrays,
        )

    def _command(
        self,
        now: float,
        status: str,
        flags: list[str],
        sample: Step | None = None,
        **diagnostics: Any,
    ) -> Command:
        """Return a command that answers a sample, or the last sample again if omitted."""
        if sample is not None:
            self._stamp = sample.time
            self._stamped = sample.seq
        state = self._state
        q, wrist = self.posture
        if self._following:
            self._following.command(q, now)
        released = ["released"] * state.is_released + ["stopped"] * state.is_stopped
        return Command(
            seq=self._stamped,
            name=self.name,
            time=self._stamp,
            server_time=self._clock.note_command(),
            joint_names=self.robot.joint_names,
            q=to_row(q),
            wrist=to_pose(wrist),
            status=status,
            flags=tuple(flags + released),
            epoch=self._epoch,
            dt=self._dt,
            effort=() if self._effort is None else to_row(self._effort),
            following_error=to_row(self._following.error) if self._following else (),
            **diagnostics,
        )


def _new_epoch() -> int:
    """Return a number that no session has had on any server: microseconds since 1970."""
    return time.time_ns() // 1000


def to_row(values: Array) -> tuple[float, ...]:
    """Convert an array (n,) to floats."""
    return tuple(values.tolist())


def to_pose(matrix: Array | None) -> Pose | None:
    """Convert a pose (4, 4), if there is one, to position and quaternion."""
    return None if matrix is None else Pose.from_matrix(matrix)
