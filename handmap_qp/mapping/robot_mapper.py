"""`RobotMapper`: both hands of a person move one robot, by one QP and one command.

    mapper = RobotMapper(load_robot("g1"))
    step = mapper.map_landmarks({"left": left, "right": right})
    robot.move_joints(step.command.joint_names, step.command.q)

Each hand is mapped by a `Leader`: a `HandMapper` that leaves the motion to the robot. Soon after
its reference, the robot's palm has the directions of the person's. Where the person's palms are
near each other, the robot's have their offset, too.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_qp.errors import HandmapError, InvalidInputError, expect
from handmap_qp.hands import (
    LINK_MARGIN,
    Hand,
    Robot,
    ShapePairs,
    Side,
    common_pairs,
    joined,
    load_hand,
)
from handmap_qp.human.sample import Verdict, human_name
from handmap_qp.ik.limits import Motion
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import IkResult, PointIk
from handmap_qp.ik.tasks import PointOffset, Task
from handmap_qp.se3 import (
    Array,
    PoseLike,
    affine,
    lengths,
    smoothstep,
    transform_points,
)
from .mapper import HandMapper, check_dt, check_joints, posture_of
from .method import (
    HumanPose,
    MapStep,
    Method,
    RobotCommand,
    Stages,
    Targets,
)
from .palm import PalmMap

# Distances of the person's palms at which the robot's begin to go by it, and wholly do [m].
_NEAR = 0.4
_TOGETHER = 0.2
# Weight of that over the weight of a wrist's position.
_TOGETHER_SHARE = 5.0


# The core takes long to take over pairs that are new.
_common_pairs = lru_cache(maxsize=16)(common_pairs)


class Asked(NamedTuple):
    """What one hand of a person asks of the robot.

    Attributes:
        targets: Of the robot's hand.
        rest: Joint positions that the QP's rest term pulls to, shape (n,).
        dt: Time since the last sample [s].
        speed: Share of the speed limits at which the robot may move.
        palm: The map that the palm follows, and the person's palm in the robot's world, shape (4,
            4); None where the robot's hand stays, or the method moves no palm.
    """

    targets: Targets
    rest: Array
    dt: float
    speed: float = 1.0
    palm: tuple[PalmMap, Array] | None = None


class Leader(HandMapper):
    """A hand of a person that asks a robot to move; see `HandMapper`.

    Its steps have no motion before the robot has moved.

    Attributes:
        asked: What it asked last.
        is_staying: Whether that is to stay.
        turns_in: As of `RobotMapper` [s].
        since: Time since its reference [s].
    """

    asked: Asked
    is_staying = False
    turns_in = math.inf
    since = 0.0

    def join(self, ik: PointIk) -> None:
        """Ask the robot that a solver moves."""
        self._plan = self._plan._replace(ik=ik)
        self._start = None

    @property
    def contacts(self) -> ShapePairs | None:
        """Collision shapes that the method keeps apart."""
        return self._plan.bound.contacts

    def clutch(self) -> None:
        """Make the next sample the reference; see `HandMapper.clutch`."""
        super().clutch()
        self.is_staying = False
        self.since = 0.0

    def stay_here(self) -> None:
        """Let a hand that stays do so where something else has moved the robot."""
        if self.is_staying:
            self.is_staying = False
            self.hold(self.dt)

    def _core_at(self, reference: Any) -> Any:
        """Return None: the robot moves, not this hand."""
        del reference

    def _moved(
        self,
        sample: HumanPose,
        asked: Targets,
        rest: Array,
        dt: float,
        speed: float,
    ) -> Stages:
        """Ask for targets."""
        palm = None
        leading = self._reference and self._reference.map
        if isinstance(leading, PalmMap):
            person = leading.person_at(sample)
            palm = leading, person
            self.since += dt
            own = asked.wrist @ self.robot.wrist_to_palm
            share = float(smoothstep(self.since / self.turns_in))
            turn = _turned(own, leading.robot_anchor, person, share)
            asked = structs.replace(
                asked,
                points=transform_points(turn, asked.points),
                wrist=turn @ asked.wrist,
            )
        self.asked = Asked(asked, rest, dt, speed, palm)
        self.is_staying = False
        return _unmoved(sample, asked)

    def hold(self, dt: float, seen: HumanPose | None = None) -> MapStep:
        """Ask that the robot's hand stays where it is; arguments as of `HandMapper.hold`."""
        check_dt(dt)
        before: Any = vars(self).get("asked")
        if not (before and self.is_staying):
            at = posture_of(self.robot, self.motion.q)
            margins = before and before.targets.margins
            before = Asked(Targets(at.points, at.wrist, margins=margins), at.q, dt)
        self.asked = before._replace(dt=dt)
        self.is_staying = True
        if seen is None:
            seen = HumanPose(
                np.full((len(self.human.reference_points), 3), np.nan), None
            )
        return MapStep(_unmoved(seen, self.asked.targets), (), 0.0)


def _turned(palm: Array, anchor: Array, person: Array, share: float) -> Array:
    """Return the motion that turns a palm about its anchor to another one's axes, (4, 4)."""
    centre = transform_points(palm, anchor)
    turn = pin.exp3(share * pin.log3(person[:3, :3] @ palm[:3, :3].T))
    return affine(turn, centre - turn @ centre)


def _unmoved(pose: HumanPose, asked: Targets) -> Stages:
    """Return stages before the robot has moved."""
    nothing: Any = None
    return Stages(pose, asked, nothing, nothing)


class RobotStep(MapStep, frozen=True, eq=False, kw_only=True):
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
        reasons = (step.arm_held_by for step in self.hands.values())
        return next(filter(None, reasons), "")


class RobotMapper:
    """Turns the motion of a person's hands into the motion of a robot.

    The first sample of each hand is its reference; the robot is at rest there. A copy continues
    from the same state on its own.

    Args:
        robot: The robot.
        humans: The hands that lead, by side; hands of the package's person if omitted.
        method: As of `HandMapper`, for all hands.
        ik: Weights and settings of the QP; those of the preset if omitted.
        turns_in: Time after a reference until the robot's palms have the directions of the person's
            [s]; infinite to keep how they differ at the reference.
        **options: As of `HandMapper`.

    Attributes:
        leaders: The mapping of each hand. Its reference and clutch are its own.

    Raises:
        InvalidOptionsError: As of `HandMapper`.
        InvalidInputError: Likewise, or if a hand of the robot has no partner in `humans`.
    """

    def __init__(
        self,
        robot: Robot,
        humans: Mapping[Side, Hand] | None = None,
        method: Method | str | None = None,
        *,
        ik: IkOptions | None = None,
        turns_in: float = 2.0,
        **options: Any,
    ) -> None:
        expect(turns_in > 0.0, "turns_in", "a time > 0 s", value=turns_in)
        if humans is None:
            names = {side: human_name(side) for side in robot.hands}
            humans = {s: load_hand(n, points="landmarks") for s, n in names.items()}
        _expect_sides(robot.hands, humans, "humans")
        self._name = robot.name
        self.leaders = {
            side: Leader(humans[side], hand, method, ik=ik, **options)
            for side, hand in robot.hands.items()
        }
        for leader in self.leaders.values():
            leader.turns_in = turns_in
        self._join(next(iter(self.leaders.values())).ik)
        self.reset()

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def human(self) -> Hand:
        """The first hand that leads; joints and points of the others have the same names."""
        return next(iter(self.leaders.values())).human

    @property
    def robot(self) -> Hand:
        """The robot as one hand, with the reference points of all that the methods move."""
        return self._ik.hand

    @property
    def ik(self) -> IkOptions:
        """Weights and settings of the QP."""
        return self._ik.options

    @property
    def point_ik(self) -> PointIk:
        """The robot's present posture and the QP. Read it only: changing it breaks the mapper."""
        return self._ik

    @property
    def motion(self) -> Motion:
        """How the robot moves. Set it where something else has moved the robot."""
        return self._ik.gate.motion

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self._ik.gate.motion = motion
        for leader in self.leaders.values():
            leader.stay_here()

    def map_landmarks(
        self,
        landmarks: Mapping[Side, ArrayLike],
        wrist_poses: Mapping[Side, PoseLike] | None = None,
        *,
        dt: float | None = None,
    ) -> RobotStep:
        """Map the landmarks of one or both hands; see `HandMapper.map_landmarks`.

        A hand without landmarks goes on to what it asked for last.

        Args:
            landmarks: By side, shape (21, 3) [m].
            wrist_poses: Poses of the wrists by side; fitted where omitted.
            dt: Time since the last sample [s]; the mapper's own if omitted.

        Raises:
            InvalidInputError: If a sample cannot be used, or there is none; the mapper is then as
                it was before.
            DegeneratePointsError: As of `HandMapper.map_landmarks`.
        """
        wrists = wrist_poses or {}
        return self.step(
            {
                side: partial(
                    self._leader(side).map_landmarks, points, wrists.get(side), dt=dt
                )
                for side, points in landmarks.items()
            }
        )

    def map_step(
        self,
        human_q: Mapping[Side, ArrayLike],
        wrist_pose: Mapping[Side, PoseLike],
        *,
        dt: float | None = None,
    ) -> RobotStep:
        """Map joint angles of one or both hands; see `HandMapper.map_step` and `map_landmarks`."""
        _expect_sides(human_q, wrist_pose, "wrist_pose")
        return self.step(
            {
                side: partial(self._leader(side).map_step, q, wrist_pose[side], dt=dt)
                for side, q in human_q.items()
            }
        )

    def step(self, asking: Mapping[Side, Callable[[], MapStep]]) -> RobotStep:
        """Let leaders ask, and move the robot.

        Args:
            asking: A step of the leader of each hand that has a sample, such as
                `partial(mapper.leaders["left"].map, pose)`.

        Raises:
            InvalidInputError: If there is none.
            HandmapError: Any of a leader; the mapper is then as it was before.
        """
        started = perf_counter()
        if not asking:
            raise InvalidInputError(
                argument="hands", problem="a step needs a sample of a hand at least"
            )
        with self._unless_refused():
            steps = self._last | {side: ask() for side, ask in asking.items()}
            result = self._moved(max(self.leaders[side].asked.dt for side in asking))
        self._last = steps
        duration = perf_counter() - started
        hands = {}
        first = 0
        for k, (side, leader) in enumerate(self.leaders.items()):
            own = slice(first, first + len(leader.robot.reference_points))
            first = own.stop
            part = structs.replace(
                result,
                points=result.points[own],
                targets=result.targets[own],
                wrists=result.wrists[k : k + 1],
                hand=leader.robot,
            )
            asked = structs.replace(
                leader.asked.targets, points=part.targets, wrist=self._wrists[k]
            )
            stages = _stages(steps[side].stages.pose, asked, part)
            hands[side] = structs.replace(steps[side], stages=stages, duration=duration)
        return self._whole(hands, result, duration)

    def _whole(
        self, hands: dict[Side, MapStep], result: IkResult, duration: float
    ) -> RobotStep:
        """Return the step of all hands."""
        steps = hands.values()
        poses = [step.stages.pose for step in steps]
        points = np.concatenate([pose.points for pose in poses])
        flags = tuple(flag for step in steps for flag in step.asked.flags)
        asked = Targets(result.targets, self._wrists[0], flags=flags)
        verdicts = [step.verdict for step in steps if step.verdict]
        # That of a hand with a rule comes first.
        verdicts.sort(key=lambda verdict: not verdict.rule)
        is_held = all(step.is_held for step in steps)
        return RobotStep(
            stages=_stages(HumanPose(points, poses[0].wrist), asked, result),
            out_of_range=tuple(name for step in steps for name in step.out_of_range),
            duration=duration,
            verdict=verdicts[0]._replace(is_held=is_held) if verdicts else None,
            confidence=min(step.confidence for step in steps),
            is_gliding=any(step.is_gliding for step in steps),
            hands=hands,
        )

    def _moved(self, dt: float) -> IkResult:
        """Move the robot for what all hands ask, or bring it to a stop."""
        asked = [leader.asked for leader in self.leaders.values()]
        rest = self.robot.rest.copy()
        for own, each in zip(self._own, asked, strict=True):
            rest[own] = each.rest[own]
        points = [each.targets.points for each in asked]
        wrists = np.array([each.targets.wrist for each in asked])
        tasks = self._together(asked, points, wrists)
        self._wrists = wrists
        if self._is_released:
            return self._ik.hold(dt)
        return self._ik.solve(
            np.concatenate(points),
            wrists,
            dt,
            rest=rest,
            tasks=(*tasks, *(task for each in asked for task in each.targets.tasks)),
            margins=self._margins(asked),
            speed=min(each.speed for each in asked),
        )

    def _together(
        self, asked: list[Asked], points: list[Array], wrists: Array
    ) -> list[Task]:
        """Move the targets of near palms to where one is seen from the other as the person's is.

        Returns:
            The task of their offset, for palms that cannot come there.
        """
        palms = [each.palm for each in asked if each.palm]
        if len(palms) < 2:
            return []
        (first, here), (other, there) = palms
        apart = (there - here)[:3, 3]
        gap = lengths(apart) / (1.0 + first.further)
        share = float(smoothstep((_NEAR - gap) / (_NEAR - _TOGETHER)))
        if share == 0.0 or not np.array_equal(first.alignment, other.alignment):
            return []
        hands = [leader.robot for leader in self.leaders.values()]
        anchors = first.robot_anchor, other.robot_anchor
        palms = [w @ hand.wrist_to_palm for w, hand in zip(wrists, hands, strict=True)]
        centres = [*map(transform_points, palms, anchors)]
        own = centres[1] - centres[0]
        aim = own + share * (apart - own)
        for k, person in enumerate((here, there)):
            moved = _turned(palms[k], anchors[k], person, share)
            moved[:3, 3] += (k - 0.5) * (aim - own)
            points[k] = transform_points(moved, points[k])
            wrists[k] = moved @ wrists[k]
        places = [*map(palm_place, hands, anchors)]
        weight = _TOGETHER_SHARE * share * self._ik.options.wrist_position_weight
        return [PointOffset(self.robot, places, aim, weight)]

    def _margins(self, asked: list[Asked]) -> Array | None:
        """Return the margin of each pair: that of the hand whose thumb and finger it is."""
        if not self._pinching:
            return None
        found = LINK_MARGIN * np.ones(len(self._ik.gate.links) - 1)
        for each, (rows, own) in zip(asked, self._pinching, strict=True):
            if (margins := each.targets.margins) is not None:
                found[rows] = margins[own]
        return found

    def _join(self, options: IkOptions, motion: Motion | None = None) -> None:
        """Make one solver of what the leaders are bound to, and let them know it."""
        leaders = self.leaders.values()
        whole = joined(self._name, *(leader.robot for leader in leaders))
        contacts = tuple(leader.contacts for leader in leaders if leader.contacts)
        pairs, self._pinching = _common_pairs(contacts) if contacts else (None, [])
        self._ik = PointIk(whole, options, motion, contacts=pairs)
        moves = [leader.robot.moves_points.any(axis=0) for leader in leaders]
        self._own = [moved & ~whole.moves_wrist for moved in moves]
        for leader in leaders:
            leader.join(self._ik)

    # -- between samples

    def stay(self, side: Side, verdict: Verdict) -> None:
        """Let a hand of the robot stay where it is until its next sample.

        Args:
            side: The hand.
            verdict: What its steps say meanwhile.
        """
        leader = self._leader(side)
        held = leader.hold(leader.dt)
        self._last[side] = structs.replace(held, verdict=verdict)

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
        self._ik.place(whole.configuration_vector(q))
        self.clutch()

    def release(self) -> None:
        """Release the robot: it brakes and holds still until `clutch`, whatever the hands do."""
        self._is_released = True

    def clutch(self) -> None:
        """Make the next sample of each hand its reference; the robot continues from here."""
        self._is_released = False
        self._last: dict[Side, MapStep] = {}
        for side, leader in self.leaders.items():
            leader.clutch()
            leader.is_staying = False
            self._last[side] = leader.hold(leader.dt)

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
            self._join(next(iter(self.leaders.values())).ik, self.motion)

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
        _expect_sides([side], self.leaders, "side")
        return self.leaders[side]


def _stages(pose: HumanPose, asked: Targets, result: IkResult) -> Stages:
    hand = result.hand
    q = result.q[hand.q_indices]
    command = RobotCommand(hand.joint_names, q, result.wrist)
    return Stages(pose, asked, result, command)


def palm_place(hand: Hand, anchor: Array) -> tuple[int, Array]:
    """Return the joint that carries a palm, and where a point of palm axes (3,) is on it."""
    frame = hand.model.frames[hand.palm_frame_id]
    return frame.parentJoint, frame.placement.act(anchor)


def _expect_sides(sides: Iterable[Side], known: Mapping[Side, Any], name: str) -> None:
    """Reject sides that are not among the known ones."""
    for side in sides:
        expected = " and ".join(known) or "at least one"
        expect(side in known, name, expected, value=side)
