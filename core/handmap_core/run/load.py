"""`load` and `load_robot`: followers of what `handmap hands save` has written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from handmap_core.errors import DegeneratePointsError
from handmap_core.ik import Motion, PointDistances
from handmap_core.ik.gate import IkGate
from handmap_core.ik.qp import PointIk
from handmap_core.ik.tasks import AttachedPoints
from handmap_core.mapping import HumanPose
from handmap_core.mapping.estimation import MotionEstimator
from handmap_core.mapping.hand_mapper import HandMapper
from handmap_core.mapping.homogeneous import BoundHomogeneous
from handmap_core.mapping.moving_robot import MovingRobot
from handmap_core.mapping.robot_mapper import RobotMapper
from handmap_core.mapping.target_source import TargetSource
from handmap_core.mapping.teleoperation import BoundTeleoperation, PalmFollowing
from handmap_core.models import TeleoperationModel
from handmap_core.stream.follower import Follower
from handmap_core.stream.guard import StreamGuard
from handmap_core.stream.hand_grip import GripOptions
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.robot_follower import RobotFollower
from handmap_core.stream.smoothing import Smoothing
from handmap_core.trackers.orders import KnownOrders
from .gripping import GrippingFollower
from .records import (
    CollisionsRecord,
    HandFile,
    HomogeneousRecord,
    MethodRecord,
    RobotFile,
    SettingsRecord,
)
from .robot_gripping import GrippingRobotFollower
from .saved_collisions import SavedCollisions
from .saved_file import misfit, read
from .saved_hand import SavedHand

SavedMethod = BoundHomogeneous[SavedHand] | BoundTeleoperation[SavedHand]
SavedSource = TargetSource[SavedHand, SavedMethod]
SavedIk = PointIk[SavedCollisions]
SavedMapper = HandMapper[SavedSource, SavedIk]
SavedRobotMapper = RobotMapper[SavedSource, SavedIk]

_GRIP = GripOptions()
_SMOOTHING = Smoothing()


def load(
    path: Path | str,
    *,
    rejoin: RejoinKind = "glide",
    smoothing: Smoothing | None = _SMOOTHING,
    grip: GripOptions | None = _GRIP,
) -> GrippingFollower[SavedMapper]:
    """Return a follower of a saved hand; its first sample is the reference.

    Args:
        path: The file, of `handmap hands save`.
        rejoin: How the robot comes back to the human after a hold: `glide` there, or stay where it
            is with its palm, as after a `clutch`.
        smoothing: How samples are smoothed before they are mapped; None for not at all.
        grip: How the hand holds what it meets, where samples come with measured joints; None to
            hold nothing.

    Raises:
        HandError: If the file is none, a damaged one, of a robot with two hands, or of another
            version.
        InvalidOptionsError: If `rejoin` is something else.
        InvalidInputError: If `smoothing` or `grip` is.
        OSError: If the file cannot be read.
    """
    content = read(Path(path), HandFile)
    with _refusing(Path(path)):
        human = SavedHand(content.human)
        robot = SavedHand(content.robot)
        settings = content.settings
        source = _source(human, robot, content.method, settings)
        solver = _solver(robot, settings, content.collisions)
        mapper = HandMapper(source, solver, settings.dt)
        guard = StreamGuard(human, KnownOrders(settings.orders))
        _try_out(mapper.moving_robot, [source])
    follower = Follower(mapper, guard, rejoin=rejoin, smoothing=smoothing)
    return GrippingFollower(follower, robot.grasp, grip)


def load_robot(
    path: Path | str,
    *,
    rejoin: RejoinKind = "glide",
    smoothing: Smoothing | None = _SMOOTHING,
    grip: GripOptions | None = _GRIP,
) -> GrippingRobotFollower[SavedRobotMapper]:
    """Return a follower of a saved robot with two hands; arguments and errors as of `load`.

    The first sample of each hand is its reference.
    """
    content = read(Path(path), RobotFile)
    with _refusing(Path(path)):
        settings = content.settings
        orders = KnownOrders(settings.orders)
        sources = {}
        guards = {}
        parts = []
        for each in content.hands:
            human = SavedHand(each.human)
            robot = SavedHand(each.robot)
            sources[robot.side] = _source(human, robot, each.method, settings)
            guards[robot.side] = StreamGuard(human, orders)
            parts.append(robot)
        whole = SavedHand(content.robot, parts)
        mapper = RobotMapper(
            sources,
            _solver(whole, settings, content.collisions),
            settings.dt,
            pinching=[
                np.array([each.of_robot, each.of_hand]) for each in content.pinching
            ],
            turns_in=content.turns_in,
        )
        _try_out(mapper.moving_robot, sources.values())
    follower = RobotFollower(mapper, guards, rejoin=rejoin, smoothing=smoothing)
    fingers = {hand.side: hand.grasp for hand in parts}
    return GrippingRobotFollower(follower, fingers, grip)


def _try_out(robot: MovingRobot[SavedIk], sources: Iterable[SavedSource]) -> None:
    """Make what is otherwise made at a first sample, so that wrong numbers are found here.

    Args:
        robot: The robot.
        sources: The human's side of each of its hands.
    """
    for source in sources:
        human = source.human
        at_rest = HumanPose(human.points(human.rest, np.eye(4)), np.eye(4))
        # A first sample may determine a motion where the hand at rest does not.
        with suppress(DegeneratePointsError):
            source.reference_at(at_rest, robot.q).map.targets(at_rest)
        hand = source.bound.robot
        AttachedPoints(hand, [finger.pad.place for finger in hand.grasp])


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Refuse what a file has where it cannot be used: its numbers are checked by the core."""
    try:
        yield
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        raise misfit(path, error) from error


def _source(
    human: SavedHand, robot: SavedHand, method: MethodRecord, settings: SettingsRecord
) -> SavedSource:
    """Return the human's side of a hand."""
    return TargetSource(
        human,
        robot,
        lambda: _bound(human, robot, method),
        quat_order=settings.quat_order,
        joint_tolerance=settings.joint_tolerance,
    )


def _bound(human: SavedHand, robot: SavedHand, method: MethodRecord) -> SavedMethod:
    """Return a method for two hands."""
    if isinstance(method, HomogeneousRecord):
        return BoundHomogeneous(method.options, human, robot, method.partners)
    return BoundTeleoperation(
        human,
        robot,
        PalmFollowing(
            method.alignment,
            method.scale,
            method.wrist_to_palm,
            method.human_anchor,
            method.robot_anchor,
        ),
        method.model,
        MotionEstimator.of_model(method.model.estimator, method.singular_values),
        _distances(robot, method.model),
        keeps_apart=method.keeps_apart,
    )


def _distances(robot: SavedHand, model: TeleoperationModel) -> PointDistances:
    """Return the robot's distances that teleoperation has rows of; a sample says their targets."""
    own = model.distances
    joints = (own.joints + 1).tolist()
    places = [*zip(joints, own.offsets, strict=True)]
    pairs = [*zip(own.first.tolist(), own.second.tolist(), strict=True)]
    return PointDistances(AttachedPoints(robot, places), pairs, np.zeros(len(pairs)))


def _solver(
    robot: SavedHand, settings: SettingsRecord, collisions: CollisionsRecord | None
) -> SavedIk:
    """Return the QP that moves a robot, which stands still in its rest posture."""
    start = Motion.at_rest(robot.record.model.configuration, len(robot.active_columns))
    kept = None if collisions is None else SavedCollisions(collisions)
    return PointIk(IkGate(robot, start, settings.ik, kept))
