"""`RobotMapper`: both hands of a person move one robot, by one QP and one command.

    mapper = RobotMapper(load_robot("g1"))
    step = mapper.map_landmarks({"left": left, "right": right})
    robot.move_joints(step.command.joint_names, step.command.q)

Each hand is mapped by a `Leader`: a `HandMapper` that leaves the motion to the robot. Soon after
its reference, the robot's palm has the directions of the person's. Where the person's palms are
near each other, the robot's have their offset, too.
"""

import copyreg
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_qp.errors import HandmapError, InvalidOptionsError, expect
from handmap_qp.hands import (
    LINK_MARGIN,
    Hand,
    Side,
    common_pairs,
    joined,
    load_hand,
)
from handmap_qp.human import Verdict, human_name
from handmap_qp.ik import (
    AttachedPoints,
    IkOptions,
    IkResult,
    Motion,
    PointIk,
    PointOffset,
    Task,
    When,
)
from handmap_qp.ik.core import core
from handmap_qp.models import RobotHandModel, RobotModel, encode
from handmap_qp.se3 import (
    Array,
    PoseLike,
    affine,
    check_pose,
    frozen,
    inverse_pose,
    lengths,
    smoothstep,
    transform_points,
)
from .exclusive import WorkLock, exclusively
from .mapper import (
    Asked,
    HandMapper,
    JointReader,
    LandmarkReader,
    Mover,
    check_dt,
    check_joints,
    check_when,
    own_time,
    posture_of,
    stages_of,
)
from .method import (
    AnyStages,
    CoreMap,
    HumanPose,
    MapStep,
    Method,
    TargetMap,
    Targets,
    step_views,
)
from .palm import PalmMap

# Distances of the person's palms at which the robot's begin to go by it, and wholly do [m].
_NEAR = 0.4
_TOGETHER = 0.2
# Weight of that over the weight of a wrist's position.
_TOGETHER_SHARE = 5.0
# Where a base is that nobody has moved; a copy of it is slower, and no different.
_HOME = frozen(np.eye(4))


class Leader(HandMapper):
    """A `HandMapper` that asks a robot to move; the stages of its steps are what it asks.

    Attributes:
        last: The step with which it asked last.
        since: Time since its reference [s].
        waited: Time that the robot has moved since this hand's last sample [s].
        base: Where the robot's base was at its reference, shape (4, 4).
    """

    last: Any = None
    since = 0.0
    waited = 0.0
    base = _HOME

    def join(self, ik: PointIk) -> None:
        """Ask the robot that a solver moves."""
        self.point_ik = ik
        self._awaits_palm = False
        self.core = None

    @property
    def asked(self) -> Any:
        """What it asked last, as `Asked` or as the core has it."""
        return self.last and self.last.stages

    def engage(self) -> None:
        """Make the next sample the reference; see `HandMapper.engage`."""
        super().engage()
        self.since = 0.0
        self.waited = 0.0
        self.last = MapStep(self.asked, (), 0.0)

    def _when(self, dt: When | None, time: float | None) -> float:
        """Return the time since the last sample of this hand; the robot has a clock of its own."""
        expect(time is None, "time", "none: give it to the `RobotMapper`", value=time)
        return self.dt if dt is None else check_dt(own_time(dt))

    def map(
        self, sample: HumanPose, dt: When | None = None, *, speed: float = 1.0
    ) -> MapStep:
        """Ask the robot to move.

        Args:
            sample: As of `HandMapper.map`.
            dt: Time since the last sample of this hand [s].
            speed: As of `HandMapper.map`.
        """
        own = None if dt is None else own_time(dt)
        return super().map(sample, own, speed=speed)

    def _new_core(self, target_map: CoreMap) -> core.TargetSource:
        views = self._views_by(target_map)
        return core.TargetSource(self.point_ik.core, target_map.make_core(), views, target_map)

    def _moved(
        self,
        pose: HumanPose,
        targets: Targets,
        target_map: TargetMap,
        when: When,
        speed: float,
    ) -> Any:
        """Ask the robot to move."""
        dt = own_time(when)
        return Asked(pose, targets, target_map.rest, dt, speed, target_map)

    @property
    def is_staying(self) -> bool:
        """Whether the robot's hand is to stay."""
        return self.asked and self.asked.map is None

    def stay(self) -> None:
        """Ask that the robot's hand stays where it is now."""
        at = posture_of(self.robot, self.motion.q)
        margins = self.asked and self.asked.targets.margins
        targets = Targets(at.points, at.wrist, margins=margins)
        asked = Asked(self._unseen, targets, at.q, self.dt)
        self.last = structs.replace(self.last, stages=asked)

    def hold(self, dt: When, seen: HumanPose | None = None) -> MapStep:
        """Ask that the robot's hand stays where it is.

        Args:
            dt: Time since the last sample of this hand [s].
            seen: As of `HandMapper.hold`.
        """
        if not self.is_staying:
            self.stay()
        asked = self.asked
        own = check_dt(own_time(dt))
        return MapStep(asked._replace(pose=seen or asked.pose, dt=own), (), 0.0)


ReaderOf = Callable[[Leader], LandmarkReader | JointReader]
"""Returns what reads the samples of a hand as they come in."""


def _landmark_reader(leader: Leader) -> LandmarkReader:
    return leader.landmarks


def _joint_reader(leader: Leader) -> JointReader:
    return leader._joints


def _reduced_ask(ask: core.HandRequest) -> tuple[Any, ...]:
    """Make a copy of what a hand asks in the core one of Python, by copy or pickle."""
    return Asked, (ask.pose, ask.targets, ask.rest, ask.dt, ask.speed, ask.map)


copyreg.pickle(core.HandRequest, _reduced_ask)


def _plain_targets(parts: list[Array], is_clamped: bool) -> Targets:
    """Return the targets of a robot, whose points and wrist the core has."""
    flags = ("stretch_clamped",) if is_clamped else ()
    points, wrist = parts
    return Targets(points, wrist, flags=flags)


def _aimed(
    leader: Leader, to_base: Array, turns_in: float
) -> tuple[Targets, Array | None]:
    """Return targets whose palm is turning to the person's, and the person's palm.

    All are seen from the robot's base, where its world now is at (4, 4). There is no palm, (4, 4),
    where the robot's hand stays, and goes with the base, or the method moves none.
    """
    asked = leader.asked
    if leader.is_staying:
        return asked.targets, None
    world = to_base @ leader.base
    targets = _moved_by(world, asked.targets)
    if not isinstance(asked.map, PalmMap):
        return targets, None
    person = world @ asked.map.person_at(asked.pose)
    share = float(smoothstep(leader.since / turns_in))
    return _turned(asked.map, targets, person, share), person


def _turned(
    leading: PalmMap,
    targets: Targets,
    person: Array,
    share: float,
    shift: Array | float = 0.0,
) -> Targets:
    """Return targets whose palm has turned about its anchor to the axes of a palm, and shifted."""
    palm = targets.wrist @ inverse_pose(leading.robot_palm_to_wrist)
    centre = transform_points(palm, leading.robot_anchor)
    turn = pin.exp3(share * pin.log3(person[:3, :3] @ palm[:3, :3].T))
    return _moved_by(affine(turn, centre - turn @ centre + shift), targets)


def _moved_by(motion: Array, targets: Targets) -> Targets:
    """Return the targets of a hand after a motion, shape (4, 4)."""
    points = transform_points(motion, targets.points)
    return structs.replace(targets, points=points, wrist=motion @ targets.wrist)


class RobotStep(MapStep, frozen=True, kw_only=True):
    """One step of a robot: that of one hand with the points of all, one after the other.

    `wrist` and its error are those of the first hand. It is held if all hands are, and has the rule
    of any that breaks one.

    Attributes:
        hands: The step of each hand by side, with its own points and wrist.
    """

    hands: dict[Side, MapStep]

    @property
    def arm_held_by(self) -> str:
        """What keeps the wrist of a hand off its target; see `MapStep.arm_held_by`."""
        causes = (step.arm_held_by for step in self.hands.values())
        return next(filter(None, causes), "")


class RobotMapper(Mover):
    """Turns the motion of a person's hands into the motion of a robot.

    The first sample of each hand is its reference; the robot is at rest there. A copy continues
    from the same state on its own.

    Args:
        robot: The robot, as of `load_robot`.
        humans: The hands that lead, by side; hands of the package's person if omitted.
        method: As of `HandMapper`, for all hands.
        ik: Weights and settings of the QP; those of the preset if omitted.
        turns_in: Time after a reference until the robot's palms have the directions of the person's
            [s]; infinite to keep how they differ at the reference.
        **options: As of `HandMapper`, such as `preset`, but for `tasks`: name them in `IkOptions`.

    Attributes:
        leaders: The mapping of each hand. Its reference and clutch are its own.
        point_ik: The robot's present posture and the QP. Read it only: changing it breaks the
            mapper.
        core: The compiled core's `RobotMapper`; None where Python has to look at the next samples.

    Raises:
        InvalidOptionsError: As of `HandMapper`.
        InvalidInputError: Likewise, or if a hand of the robot has no partner in `humans`.
    """

    def __init__(
        self,
        robot: Hand,
        humans: Mapping[Side, Hand] | None = None,
        method: Method | str | None = None,
        *,
        ik: IkOptions | None = None,
        turns_in: float = 2.0,
        **options: Any,
    ) -> None:
        expect(turns_in > 0.0, "turns_in", "a time > 0 s", value=turns_in)
        expect("tasks" not in options, "tasks", "none: name them in `ik`")
        if humans is None:
            humans = {
                side: load_hand(human_name(side), points="landmarks")
                for side in robot.by_side
            }
        _expect_sides(robot.by_side, humans, "humans")
        self._name = robot.name
        self.work = WorkLock()
        self.leaders = {
            side: Leader(humans[side], hand, method, ik=ik, **options)
            for side, hand in robot.by_side.items()
        }
        for leader in self.leaders.values():
            # Whoever works on a hand works on the robot.
            leader.work = self.work
        self._base = _HOME
        self._turns_in = turns_in
        self._join()
        self.reset()

    @property
    def _usual_dt(self) -> float:
        return self.leaders[self.robot.side].dt

    @property
    def human(self) -> Hand:
        """The first hand that leads; joints and points of the others have the same names."""
        return self.leaders[self.robot.side].human

    @property
    def robot(self) -> Hand:
        """The robot as one hand, with the reference points of all that the methods move."""
        return self.point_ik.hand

    def _was_moved(self) -> None:
        for leader in self.leaders.values():
            if leader.is_staying:
                leader.stay()

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
                f"the base of {self._name} is fixed",
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

        A hand without landmarks goes on to what it asked for last. The limits of speed and
        acceleration hold in the time since the robot's last command, whichever hand led to that.

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
        _expect_sides(human_q, wrist_pose, "wrist_pose")
        return self._mapped(_joint_reader, human_q, wrist_pose, dt, time)

    def _mapped(
        self,
        reader_of: ReaderOf,
        numbers: Mapping[Side, ArrayLike],
        wrists: Mapping[Side, PoseLike],
        dt: When | None,
        time: float | None,
    ) -> RobotStep:
        """Map samples as they come in, by a reader that each leader has."""

        def ask(side: Side) -> MapStep:
            leader = self.leaders[side]
            since = self.time_since_sample(side, when)
            reader = reader_of(leader)
            return leader._mapped(reader, numbers[side], wrists.get(side), since)

        when = self._when(dt, time)
        step = self._mapped_in_core(reader_of, numbers, wrists, when)
        step = step or self.step(numbers, ask, when)
        self._note_time(time, when)
        return step

    def _mapped_in_core(
        self,
        reader_of: ReaderOf,
        numbers: Mapping[Side, ArrayLike],
        wrists: Mapping[Side, PoseLike],
        when: When,
    ) -> RobotStep | None:
        """Map samples of all hands as `step` does; None for some that Python has to look at."""
        if self.core is None or numbers.keys() != self.leaders.keys():
            return None
        started = perf_counter()
        granted = self.point_ik.gate.interval(when).granted
        asking = []
        for side, leader in self.leaders.items():
            # A hand that has stayed asks in Python first.
            if leader.core is None or not isinstance(leader.asked, core.HandRequest):
                return None
            reader = reader_of(leader).core
            own = leader.waited + granted
            timed = leader.core.map(reader, numbers[side], wrists.get(side), own)
            if timed is None:
                return None
            asking.append((leader, timed[0], leader.since + timed[0].dt))
        _, asks, since = map(list, zip(*asking, strict=True))
        stages, parts = self.core.move(asks, since, self._worlds(), when)
        duration = perf_counter() - started
        for leader, asked, time in asking:
            leader.last = MapStep(asked, (), duration)
            leader.since = time
            leader.waited = 0.0
        steps = [MapStep(part, (), duration) for part in parts]
        hands = dict(zip(self.leaders, steps, strict=True))
        return RobotStep(stages, (), duration, hands=hands)

    def time_since_sample(self, side: Side, when: When) -> float:
        """Return the time from a hand's last sample to a command that it has one for [s].

        Args:
            side: The hand.
            when: When the command is.
        """
        return self._leader(side).waited + self.point_ik.gate.interval(when).granted

    @exclusively
    def step(
        self,
        sides: Iterable[Side],
        ask: Callable[[Side], MapStep],
        when: When | None = None,
    ) -> RobotStep:
        """Let leaders ask, and move the robot.

        Args:
            sides: The hands that have a sample.
            ask: Returns a step of the leader of a hand, such as `mapper.leaders[side].map(pose)`.
                What it takes for the time since the hand's last sample does not count for the
                robot's limits.
            when: Time since the robot's last command [s], or the instant of this one on the robot's
                clock; the mapper's own time if omitted.

        Raises:
            InvalidInputError: If there is no hand.
            HandmapError: Any of a leader; the mapper is then as it was before.
        """
        started = perf_counter()
        when = self._usual_dt if when is None else check_when(when)
        granted = self.point_ik.gate.interval(when).granted
        with self._unless_refused():
            asking = []
            for side in sides:
                leader = self._leader(side)
                leader.last = ask(side)
                asking.append(leader)
                if not leader.is_staying:
                    if not leader.since:
                        leader.base = self._base
                    leader.since += leader.asked.dt
            expect(asking, "hands", "a sample of one at least")
            stages, parts = self._moved(when)
        for leader in self.leaders.values():
            # A hand that stays comes back as with a first sample.
            is_behind = leader not in asking and not leader.is_staying
            leader.waited = leader.waited + granted if is_behind else 0.0
        for leader in self.leaders.values():
            if leader.bound.renews_reference:
                leader.base = self._base
        duration = perf_counter() - started
        hands = {
            side: structs.replace(leader.last, stages=part, duration=duration)
            for (side, leader), part in zip(self.leaders.items(), parts, strict=True)
        }
        return self._whole(hands, stages, duration)

    def _whole(
        self, hands: dict[Side, MapStep], stages: AnyStages, duration: float
    ) -> RobotStep:
        """Return the step of all hands."""
        steps = hands.values()
        verdicts = [step.verdict for step in steps if step.verdict]
        # That of a hand with a rule comes first.
        first = max(verdicts, key=attrgetter("rule"), default=None)
        is_held = all(step.is_held for step in steps)
        return RobotStep(
            stages=stages,
            out_of_range=tuple(name for step in steps for name in step.out_of_range),
            duration=duration,
            verdict=first and structs.replace(first, is_held=is_held),
            confidence=min(step.confidence for step in steps),
            is_gliding=any(step.is_gliding for step in steps),
            hands=hands,
        )

    def _moved(self, when: When) -> tuple[AnyStages, Sequence[AnyStages]]:
        """Return the stages of the robot, moved as its hands ask or stopped, and of each hand."""
        leaders = self.leaders.values()
        asked = [leader.asked for leader in leaders]
        if self.ik.is_compiled and not self._is_released:
            self.core = self.core or self._new_core()
            if all(isinstance(each, core.HandRequest) for each in asked):
                since = [leader.since for leader in leaders]
                return self.core.move(asked, since, self._worlds(), when)
        to_base = inverse_pose(self._base)
        aimed = [_aimed(leader, to_base, self._turns_in) for leader in leaders]
        targets, persons = map(list, zip(*aimed, strict=True))
        tasks = self._together([each.map for each in asked], targets, persons)
        return self._stages(asked, targets, self._solved(asked, targets, tasks, when))

    def _new_core(self) -> core.RobotMapper:
        """Return what moves the robot in the core for hands that ask there."""
        links = self.point_ik.gate.links
        views = step_views(_plain_targets, self.robot, links)
        return core.RobotMapper(self.point_ik.core, encode(self.model()), views)

    def model(self) -> RobotModel:
        """Return how the core leads the hands of the robot together."""
        robot = self.robot
        none = np.zeros(0, dtype=int)
        pinching = self._pinching or [(none, none)] * len(robot.hands)
        return RobotModel(
            hands=tuple(
                RobotHandModel(
                    palm_joint=hand.palm_frame.parentJoint - 1,
                    palm=hand.palm_frame.placement.homogeneous,
                    pinching=rows,
                    among_own=own,
                )
                for hand, (rows, own) in zip(robot.hands, pinching, strict=True)
            ),
            turns_in=self._turns_in,
            near=_NEAR,
            together=_TOGETHER,
            together_share=_TOGETHER_SHARE,
            margin=LINK_MARGIN,
        )

    def _worlds(self) -> Array | None:
        """Return where the world of each reference is from the base, shape (h, 4, 4).

        None if the base has not moved.
        """
        if self._base is _HOME:
            return None
        to_base = inverse_pose(self._base)
        return np.array([to_base @ leader.base for leader in self.leaders.values()])

    def _solved(
        self, asked: list[Any], targets: list[Targets], tasks: list[Task], when: When
    ) -> IkResult:
        """Move the robot to targets by one QP, in Python or in the core."""
        if self._is_released:
            return self.point_ik.hold(when)
        rest = self.robot.rest.copy()
        for own, each in zip(self.robot.finger_joints, asked, strict=True):
            rest[own] = each.rest[own]
        regularisation = np.ones(len(rest))
        for own, each in zip(self.robot.finger_joints, targets, strict=True):
            if each.regularisation is not None:
                regularisation[own] = each.regularisation[own]
        return self.point_ik.solve(
            np.concatenate([each.points for each in targets]),
            np.array([each.wrist for each in targets]),
            when,
            rest=rest,
            regularisation=regularisation,
            tasks=sum((each.tasks for each in targets), tuple(tasks)),
            margins=self._margins(targets),
            speed=min(each.speed for each in asked),
        )

    def _stages(
        self, asked: list[Any], targets: list[Targets], result: IkResult
    ) -> tuple[AnyStages, Sequence[AnyStages]]:
        """Return the stages of the robot, and those of each hand."""
        parts: list[AnyStages] = []
        for k, own in enumerate(self.point_ik.configuration.parts):
            part = structs.replace(
                result,
                points=result.points[own],
                targets=result.targets[own],
                wrists=result.wrists[k : k + 1],
                hand=self.robot.hands[k],
            )
            moved = structs.replace(targets[k], points=part.targets)
            parts.append(stages_of(asked[k].pose, moved, part))
        points = np.concatenate([each.pose.points for each in asked])
        flags = dict.fromkeys(flag for each in targets for flag in each.flags)
        whole = Targets(result.targets, targets[0].wrist, flags=tuple(flags))
        pose = HumanPose(points, asked[0].pose.wrist)
        return stages_of(pose, whole, result), parts

    def _together(
        self, maps: list[Any], targets: list[Targets], persons: list[Any]
    ) -> list[Task]:
        """Let targets of near palms be seen from each other as the person's; return the task of it.

        It is for palms that cannot come there.
        """
        if sum(palm is not None for palm in persons) < 2:
            return []
        first, other = maps
        apart = (persons[1] - persons[0])[:3, 3]
        gap = lengths(apart) / (1.0 + first.further)
        share = float(smoothstep((_NEAR - gap) / (_NEAR - _TOGETHER)))
        if share == 0.0 or not np.array_equal(first.alignment, other.alignment):
            return []
        ends, places = [], []
        for leading, each, hand in zip(maps, targets, self.robot.hands, strict=True):
            anchor = leading.robot_anchor
            ends.append(transform_points(each.wrist @ hand.wrist_to_palm, anchor))
            palm = hand.palm_frame
            places.append((palm.parentJoint, palm.placement.act(anchor)))
        own = ends[1] - ends[0]
        aim = own + share * (apart - own)
        for k, person in enumerate(persons):
            shift = (k - 0.5) * (aim - own)
            targets[k] = _turned(maps[k], targets[k], person, share, shift)
        weight = _TOGETHER_SHARE * share * self.ik.wrist_position_weight
        return [PointOffset(AttachedPoints(self.robot, places), aim, weight)]

    def _margins(self, targets: list[Targets]) -> Array | None:
        """Return the margin of each pair: that of the hand whose thumb and finger it is."""
        if not self._pinching:
            return None
        found = np.full(len(self.point_ik.gate.links) - 1, LINK_MARGIN)
        for each, (rows, own) in zip(targets, self._pinching, strict=True):
            if each.margins is not None:
                found[rows] = each.margins[own]
        return found

    def _join(self, motion: Motion | None = None) -> None:
        """Make one solver of what the leaders are bound to, and let them know it."""
        leaders = [*self.leaders.values()]
        whole = joined(self._name, *(leader.robot for leader in leaders))
        contacts = tuple(filter(None, [leader.bound.contacts for leader in leaders]))
        pairs, pinching = common_pairs(contacts) if contacts else (None, [])
        self.point_ik = PointIk(whole, leaders[0].ik, motion, contacts=pairs)
        self._pinching = pinching
        self.core = None
        for leader in leaders:
            leader.join(self.point_ik)

    # -- between samples

    @exclusively
    def stay(self, side: Side, verdict: Verdict) -> None:
        """Let a hand of the robot stay where it is until its next sample.

        Args:
            side: The hand.
            verdict: What its steps say meanwhile.
        """
        leader = self._leader(side)
        leader.last = structs.replace(leader.hold(leader.dt), verdict=verdict)

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
        self.point_ik.place(whole.configuration_vector(q))
        self._was_reset = True
        self.engage()

    @exclusively
    def engage(self) -> None:
        """Make the next sample of each hand its reference; the robot continues from here."""
        self._is_released = False
        for leader in self.leaders.values():
            leader.engage()
            leader.stay()

    @exclusively
    def configure(
        self, method: Method | str | None = None, *, ik: IkOptions | None = None
    ) -> None:
        """Change options between samples, as `HandMapper.configure` of all hands.

        Raises:
            InvalidOptionsError: As there; the mapper is then as it was before.
        """
        with self._unless_refused():
            for leader in self.leaders.values():
                leader.configure(method, ik=ik)
            self._join(self.motion)
            if method is not None:
                # What they asked for last was of the former one.
                for leader in self.leaders.values():
                    leader.stay()

    @contextmanager
    def _unless_refused(self) -> Iterator[None]:
        """Let an error leave all leaders as they were."""
        before = {side: vars(each).copy() for side, each in self.leaders.items()}
        try:
            yield
        except HandmapError:
            for side, state in before.items():
                vars(self.leaders[side]).update(state)
            raise

    def _leader(self, side: Side) -> Leader:
        if side not in self.leaders:
            _expect_sides([side], self.leaders, "side")
        return self.leaders[side]


def _expect_sides(sides: Iterable[Side], known: Mapping[Side, Any], name: str) -> None:
    """Reject sides that are not among the known ones."""
    for side in sides:
        expect(side in known, name, " and ".join(known) or "at least one", value=side)
