"""`RobotMapper`: both hands of a person move one robot, by one QP and one command.

It has a `RobotHand` with a `TargetSource` for each hand, and one `MovingRobot`. Soon after its
reference, the robot's palm has the directions of the person's. Where the person's palms are near
each other, the robot's have their offset, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Generic

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError, expect
from handmap_core.hands import LINK_MARGIN, Hand, Side
from handmap_core.human import Verdict
from handmap_core.ik import When
from handmap_core.models import RobotHandModel, RobotModel, encode
from handmap_core.se3 import (
    Array,
    PoseLike,
    check_pose,
    inverse_pose,
    smoothstep,
)
from .bound_method import BoundMethod
from .command_time import check_when
from .exclusive import WorkLock, exclusively
from .hand_mapper import Source
from .hands_as_one import rest_as_one, stages_as_one, targets_as_one
from .mapper import Mapper
from .moving_robot import AnySolver, MovingRobot
from .readers import JointReader, LandmarkReader, check_joints
from .robot_hand import HOME, RobotHand
from .robot_step import (
    RequestStep,
    RobotStep,
    part_step,
    whole_step,
)
from .step import AnyStages, MapStep
from .target_source import TargetSource
from .targets import Targets
from .two_palms import (
    NEAR,
    TOGETHER,
    TOGETHER_SHARE,
    aimed,
    brought_together,
)

AnySource = TargetSource[Hand, BoundMethod]
ReaderOf = Callable[[AnySource], LandmarkReader | JointReader]
"""Returns what reads the samples of a hand as they come in."""


def _landmark_reader(source: AnySource) -> LandmarkReader:
    return source.landmarks


def _joint_reader(source: AnySource) -> JointReader:
    return source.joints


def _robot_targets(parts: list[Array], is_clamped: bool) -> Targets:
    """Return the targets of a robot, whose points and wrist the core has."""
    flags = ("stretch_clamped",) if is_clamped else ()
    points, wrist = parts
    return Targets(points, wrist, flags=flags)


class RobotMapper(Mapper[core.RobotMapper, AnySolver], Generic[Source, AnySolver]):
    """Turns the motion of a person's hands into the motion of a robot.

    The first sample of each hand is its reference; the robot is at rest there. A copy continues
    from the same state on its own.

    Args:
        sources: The human's side of each hand, by side.
        solver: The QP that moves the robot.
        dt: Usual time between samples [s], where a step gives none of its own.
        pinching: Which pairs of shapes of each hand pinch; see there.
        turns_in: Time after a reference until the robot's palms have the directions of the person's
            [s]; infinite to keep how they differ at the reference.

    Attributes:
        hands: Each hand of the robot, by side. Its reference and clutch are its own.
        moving_robot: The robot's side.
        turns_in: As given [s].
        pinching: Which r pairs of shapes of each hand pinch: their indices among all pairs and
            among those of the hand, shape (2, r). Empty if no method keeps links apart.
        core: What moves the robot in the compiled core; None where Python has to look at the next
            samples.

    Raises:
        InvalidInputError: If a time cannot be used.

    As of `HandMapper`, one thread at a time works on a mapper, and others get a `MapperBusyError`.
    Other threads of Python go on meanwhile: the core moves a robot without the interpreter's lock.
    """

    def __init__(
        self,
        sources: Mapping[Side, Source],
        solver: AnySolver,
        dt: float,
        *,
        pinching: Sequence[Array] = (),
        turns_in: float = 2.0,
    ) -> None:
        expect(turns_in > 0.0, "turns_in", "a time > 0 s", value=turns_in)
        self._base = HOME
        self.turns_in = turns_in
        self.work = WorkLock()
        self.pinching = pinching
        self.moving_robot = MovingRobot(solver, dt)
        self.core = None
        self.hands = {
            side: RobotHand(source, self.moving_robot, self.work)
            for side, source in sources.items()
        }
        self.reset()

    @property
    def sources(self) -> dict[Side, Source]:
        """The human's side of each hand, by side."""
        return {side: hand.source for side, hand in self.hands.items()}

    @property
    def human(self) -> Hand:
        """The first hand that leads; joints and points of the others have the same names."""
        return self.hands[self.robot.side].source.human

    @property
    def robot(self) -> Hand:
        """The robot as one hand, with the reference points of all that the methods move."""
        return self.moving_robot.point_ik.hand

    def _was_moved(self) -> None:
        for hand in self.hands.values():
            if hand.is_staying:
                hand.stay()

    @property
    def base_pose(self) -> Array:
        """Where a floating base is in the robot's world, shape (4, 4). Set it before each sample.

        Palms that are led stay in that world; others go with the base, from which a step is seen.

        Raises:
            InvalidOptionsError: If the base is fixed.
            InvalidInputError: If it is no pose.
        """
        return self._base

    @base_pose.setter
    def base_pose(self, pose: PoseLike) -> None:
        if not self.robot.has_floating_base:
            raise InvalidOptionsError(
                f"the base of {self.robot.name} is fixed",
                option="base_pose",
                advice="if it moves, say `base: floating` in robot.yaml",
            )
        self._base = check_pose(pose, "base_pose").copy()

    @exclusively
    def map_landmarks(
        self,
        landmarks: Mapping[Side, ArrayLike],
        wrist_poses: Mapping[Side, PoseLike] | None = None,
        *,
        dt: When | None = None,
        time: float | None = None,
    ) -> RobotStep:
        """Map the landmarks of one or both hands; see `HandMapper.map_landmarks`.

        A hand without landmarks goes on to its last request. The limits of speed and
        acceleration hold in the time since the robot's last command, whichever hand that was for.

        Args:
            landmarks: By side, shape (21, 3) [m].
            wrist_poses: Poses of the wrists by side; fitted where omitted.
            dt: Time since the robot's last command, not since the last sample of a hand [s]; the
                mapper's own if omitted.
            time: Instant of the command in place of `dt`, as of `HandMapper.map_step` [s]: what
                hands in turns, each at a rate of its own, need.

        Raises:
            InvalidInputError: If a sample cannot be used, or there is none; the mapper is then as
                it was before.
            DegeneratePointsError: As of `HandMapper.map_landmarks`.
        """
        return self._mapped(_landmark_reader, landmarks, wrist_poses or {}, dt, time)

    @exclusively
    def map_step(
        self,
        human_q: Mapping[Side, ArrayLike],
        wrist_pose: Mapping[Side, PoseLike],
        *,
        dt: When | None = None,
        time: float | None = None,
    ) -> RobotStep:
        """Map joint angles of one or both hands; see `HandMapper.map_step` and `map_landmarks`."""
        expect_sides(human_q, wrist_pose, "wrist_pose")
        return self._mapped(_joint_reader, human_q, wrist_pose, dt, time)

    def _mapped(
        self,
        reader_of: ReaderOf,
        numbers: Mapping[Side, ArrayLike],
        wrists: Mapping[Side, PoseLike],
        dt: When | None,
        time: float | None,
    ) -> RobotStep:
        """Map samples as they come in, by a reader that each source has."""

        def request_of(side: Side) -> RequestStep:
            hand = self._hand(side)
            since = self.time_since_sample(side, when)
            reader = reader_of(hand.source)
            return hand.read(reader, numbers[side], wrists.get(side), since)

        robot = self.moving_robot
        when = robot.when(dt, time)
        step = self._mapped_in_core(reader_of, numbers, wrists, when)
        step = step or self.step(numbers, request_of, when)
        robot.note_time(time, when)
        return step

    def _mapped_in_core(
        self,
        reader_of: ReaderOf,
        numbers: Mapping[Side, ArrayLike],
        wrists: Mapping[Side, PoseLike],
        when: When,
    ) -> RobotStep | None:
        """Map samples of all hands as `step` does; None for some that Python has to look at."""
        if self.core is None or numbers.keys() != self.hands.keys():
            return None
        started = perf_counter()
        granted = self.point_ik.gate.interval(when).granted
        requests = []
        since = []
        for side, hand in self.hands.items():
            # A hand that has stayed begins in Python.
            state = hand.state
            was_in_core = isinstance(state.step.request, core.HandRequest)
            if hand.core is None or not was_in_core:
                return None
            reader = reader_of(hand.source).core
            waited = state.waited + granted
            timed = hand.core.map(reader, numbers[side], wrists.get(side), waited)
            if timed is None:
                return None
            request, _ = timed
            requests.append(request)
            since.append(state.since + request.dt)
        stages, parts = self.core.move(requests, since, self._worlds(), when)
        duration = perf_counter() - started
        for hand, request, time in zip(
            self.hands.values(), requests, since, strict=True
        ):
            hand.state = structs.replace(
                hand.state,
                step=RequestStep(request, duration=duration),
                since=time,
                waited=0.0,
            )
        steps = [MapStep(part, duration=duration) for part in parts]
        hands = dict(zip(self.hands, steps, strict=True))
        return RobotStep(stages, duration=duration, hands=hands)

    def time_since_sample(self, side: Side, when: When) -> float:
        """Return the time from a hand's last sample to a command that it has one for [s].

        Args:
            side: The hand.
            when: When the command is.
        """
        waited = self._hand(side).state.waited
        return waited + self.point_ik.gate.interval(when).granted

    @exclusively
    def step(
        self,
        sides: Iterable[Side],
        request_of: Callable[[Side], RequestStep],
        when: When | None = None,
    ) -> RobotStep:
        """Move the robot for requests of its hands.

        Args:
            sides: The hands that have a sample. The others go on to their last requests.
            request_of: Returns what a hand asks, such as `mapper.hands[side].map(pose)`. What it
                takes for the time since the hand's last sample does not count for the robot's
                limits.
            when: Time since the robot's last command [s], or the instant of this one on the robot's
                clock; the mapper's own time if omitted.

        Raises:
            InvalidInputError: If there is no hand.
            HandmapError: Any of a hand; the mapper is then as it was before.
        """
        started = perf_counter()
        robot = self.moving_robot
        when = robot.usual_dt if when is None else check_when(when)
        granted = self.point_ik.gate.interval(when).granted
        with self._unchanged_by_errors():
            asking = []
            for side in sides:
                hand = self._hand(side)
                hand.advance(request_of(side), self._base)
                asking.append(hand)
            expect(asking, "hands", "a sample of one at least")
            stages, parts = self._moved(when)
        for hand in self.hands.values():
            # A hand that stays comes back as with a first sample.
            is_behind = hand not in asking and not hand.is_staying
            state = hand.state
            is_renewed = hand.source.bound.renews_reference
            hand.state = structs.replace(
                state,
                waited=state.waited + granted if is_behind else 0.0,
                base=self._base if is_renewed else state.base,
            )
        duration = perf_counter() - started
        steps = {
            side: part_step(hand.state.step, part, duration)
            for (side, hand), part in zip(self.hands.items(), parts, strict=True)
        }
        return whole_step(steps, stages, duration)

    def _moved(self, when: When) -> tuple[AnyStages, Sequence[AnyStages]]:
        """Return the stages of the robot, moved as its hands ask or stopped, and of each hand."""
        hands = self.hands.values()
        robot = self.moving_robot
        if robot.point_ik.is_compiled and not robot.is_released:
            self.core = self.core or self._new_core()
            of_core = [
                hand.request
                for hand in hands
                if isinstance(hand.request, core.HandRequest)
            ]
            if len(of_core) == len(hands):
                since = [hand.state.since for hand in hands]
                return self.core.move(of_core, since, self._worlds(), when)
        to_base = inverse_pose(self._base)
        apart = [
            aimed(
                hand.request,
                to_base @ hand.state.base,
                float(smoothstep(hand.state.since / self.turns_in)),
            )
            for hand in hands
        ]
        weight = self.ik.wrist_position_weight
        together, tasks = brought_together(apart, self.robot, weight)
        targets = [hand.targets for hand in together]
        requests = [hand.request for hand in hands]
        whole = structs.replace(
            targets_as_one(targets, self.robot),
            tasks=(*tasks, *(task for hand in targets for task in hand.tasks)),
            margins=self._margins(targets),
        )
        rest = rest_as_one(requests, self.robot)
        speed = min(request.speed for request in requests)
        result = robot.follow(whole, rest, when, speed)
        rows = self.point_ik.configuration.parts
        return stages_as_one(requests, targets, result, rows)

    def _margins(self, targets: Sequence[Targets]) -> Array | None:
        """Return the margin of each pair: that of the hand whose thumb and finger it is."""
        if not self.pinching:
            return None
        margins = np.full(len(self.point_ik.gate.links) - 1, LINK_MARGIN)
        for hand, (rows, among_its) in zip(targets, self.pinching, strict=True):
            if hand.margins is not None:
                margins[rows] = hand.margins[among_its]
        return margins

    def _new_core(self) -> core.RobotMapper:
        """Return what moves the robot in the core for requests of the core."""
        robot = self.moving_robot
        views = robot.views(_robot_targets, self.robot)
        return core.RobotMapper(robot.point_ik.core, encode(self.model()), views)

    def model(self) -> RobotModel:
        """Return how the core moves the hands of the robot together."""
        robot = self.robot
        none = np.zeros((2, 0), dtype=int)
        pinching = self.pinching or [none] * len(robot.hands)
        return RobotModel(
            hands=tuple(
                RobotHandModel(
                    palm_joint=hand.palm_frame.parentJoint - 1,
                    palm=hand.palm_frame.placement.homogeneous,
                    pinching=rows,
                    among_own=among_its,
                )
                for hand, (rows, among_its) in zip(robot.hands, pinching, strict=True)
            ),
            turns_in=self.turns_in,
            near=NEAR,
            together=TOGETHER,
            together_share=TOGETHER_SHARE,
            margin=LINK_MARGIN,
        )

    def _worlds(self) -> Array | None:
        """Return where the world of each reference is from the base, shape (h, 4, 4).

        None if the base has not moved.
        """
        if self._base is HOME:
            return None
        to_base = inverse_pose(self._base)
        bases = [hand.state.base for hand in self.hands.values()]
        return to_base @ np.array(bases)

    # -- between samples

    @exclusively
    def stay(self, side: Side, verdict: Verdict) -> None:
        """Let a hand of the robot stay where it is until its next sample.

        Args:
            side: The hand.
            verdict: What its steps say meanwhile.
        """
        hand = self._hand(side)
        held = hand.hold(self.moving_robot.usual_dt)
        step = structs.replace(held, verdict=verdict)
        hand.state = structs.replace(hand.state, step=step)

    @exclusively
    def reset(self, robot_q: ArrayLike | None = None) -> None:
        """Start again: the next sample of each hand is its reference.

        Args:
            robot_q: Joint positions of the robot there [rad or m], inside their limits; its rest
                posture if omitted.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        whole = self.robot
        q = whole.rest
        if robot_q is not None:
            q = check_joints(whole, robot_q, "robot_q")[0]
        self.moving_robot.reset(whole.configuration_vector(q))
        self.engage()

    @exclusively
    def engage(self) -> None:
        """Make the next sample of each hand its reference; the robot continues from here."""
        self.moving_robot.is_released = False
        for hand in self.hands.values():
            hand.engage()
            hand.stay()

    @contextmanager
    def _unchanged_by_errors(self) -> Iterator[None]:
        """Let an error leave all hands as they were."""
        before = [(hand, hand.snapshot()) for hand in self.hands.values()]
        try:
            yield
        except BaseException:
            for hand, snapshot in before:
                hand.restore(snapshot)
            raise

    def _hand(self, side: Side) -> RobotHand[Source, AnySolver]:
        if side not in self.hands:
            expect_sides([side], self.hands, "side")
        return self.hands[side]


def expect_sides(
    sides: Iterable[Side], known: Mapping[Side, object], name: str
) -> None:
    """Reject sides that are not among the known ones."""
    for side in sides:
        expect(side in known, name, " and ".join(known) or "at least one", value=side)
