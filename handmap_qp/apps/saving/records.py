"""`saved_bytes`: what a mapper is made of, as the file that `handmap_core.run` reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from handmap_core.errors import InvalidOptionsError
from handmap_core.run.records import (
    CollisionsRecord,
    FingerRecord,
    HandFile,
    HandRecord,
    HomogeneousRecord,
    MethodRecord,
    PinchingRecord,
    PointRecord,
    RobotFile,
    SettingsRecord,
    SideRecord,
    TeleoperationRecord,
)
from handmap_core.run.saved_file import written
from handmap_core.stream.hand_grip import has_pinches
from handmap_qp.hands import Hand, PointSpec
from handmap_qp.hands.compiled import hand_model
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.mapping import HandMapper, RobotMapper, TargetSource
from handmap_qp.mapping.methods.homogeneous import BoundHomogeneous, Homogeneous
from handmap_qp.mapping.methods.teleoperation import BoundTeleoperation
from handmap_qp.stream.grasp import grasp_fingers
from handmap_qp.trackers.plausibility import layout_orders
from .follower import follower_model


def saved_bytes(mapper: HandMapper | RobotMapper) -> bytes:
    """Return the file of a mapper's hands, and of how the one follows the other.

    References, the posture and the person's samples are not in it.

    Args:
        mapper: The mapper; its human hands must be scaled to the person.

    Raises:
        InvalidOptionsError: If it moves the robot in Python: by another method than those of the
            core, with tasks, or by another solver.
        HandError: If a human hand has no landmarks.
    """
    if not mapper.point_ik.is_compiled:
        _refuse("formulation", "the compiled core does not move this hand as asked")
    collisions = _collisions(mapper.point_ik.gate.collisions)
    if isinstance(mapper, HandMapper):
        source = mapper.source
        return written(
            HandFile(
                human=_human(source.human),
                robot=_hand(source.robot, grips=has_pinches(source)),
                method=_method(mapper, source),
                collisions=collisions,
                settings=_settings(mapper, source),
            ),
            follower_model(mapper),
        )
    sources = [*mapper.sources.values()]
    return written(
        RobotFile(
            robot=_hand(mapper.robot),
            hands=tuple(
                SideRecord(
                    human=_human(source.human),
                    robot=_hand(source.robot, grips=has_pinches(source)),
                    method=_method(mapper, source),
                )
                for source in sources
            ),
            pinching=tuple(
                PinchingRecord(of_robot=of_robot, of_hand=of_hand)
                for of_robot, of_hand in mapper.pinching
            ),
            collisions=collisions,
            turns_in=mapper.turns_in,
            settings=_settings(mapper, sources[0]),
        )
    )


def _method(mapper: HandMapper | RobotMapper, source: TargetSource) -> MethodRecord:
    """Return how a robot's hand follows the human's."""
    if source.tasks or mapper.ik.tasks:
        _refuse("tasks", "further tasks are in Python alone")
    bound = source.bound
    if isinstance(bound, BoundHomogeneous):
        assert isinstance(source.method, Homogeneous)
        return HomogeneousRecord(options=source.method, partners=tuple(bound.partners))
    if isinstance(bound, BoundTeleoperation):
        return TeleoperationRecord(
            alignment=bound.palm.alignment,
            scale=bound.palm.scale,
            wrist_to_palm=bound.palm.wrist_to_palm,
            human_anchor=bound.palm.human_anchor,
            robot_anchor=bound.palm.robot_anchor,
            model=bound.model,
            singular_values=bound.estimator.singular_values,
            keeps_apart=bound.keeps_apart,
        )
    name = type(bound).__name__.removeprefix("Bound")
    _refuse("method", f"{name} is in Python alone")


def _settings(mapper: HandMapper | RobotMapper, source: TargetSource) -> SettingsRecord:
    """Return how the robot of a mapper follows."""
    return SettingsRecord(
        ik=mapper.ik,
        dt=mapper.moving_robot.usual_dt,
        joint_tolerance=source.joint_tolerance,
        quat_order=source.quat_order,
        orders=layout_orders(),
    )


def _human(hand: Hand) -> HandRecord:
    """Return a person's hand, with its landmarks.

    Raises:
        HandError: If it has none.
    """
    landmarks = hand.with_points("landmarks").reference_points
    return _hand(hand, landmarks)


def _hand(
    hand: Hand, landmarks: Sequence[PointSpec] = (), *, grips: bool = False
) -> HandRecord:
    """Return a hand, or the hands of a robot as one.

    Args:
        hand: The hand.
        landmarks: Of a person's hand.
        grips: Whether the robot's hand may grip.
    """
    return HandRecord(
        name=hand.name,
        side=hand.side,
        upright=hand.upright,
        is_floating=hand.is_floating,
        has_floating_base=hand.has_floating_base,
        joint_names=hand.joint_names,
        followers=tuple(hand.rules),
        velocity_limits=hand.velocity_limits,
        wrist_speeds=hand.wrist_speeds,
        active_columns=hand.active_columns,
        moves_wrist=hand.moves_wrist,
        points=_points(hand.reference_points),
        point_weights=hand.point_weights,
        palm_weights=hand.palm_weights,
        landmarks=_points(landmarks),
        grasp=_grasp(hand) if grips else (),
        model=hand_model(hand),
    )


def _points(points: Sequence[PointSpec]) -> tuple[PointRecord, ...]:
    return tuple(PointRecord(name=p.name, link=p.link, xyz=p.xyz) for p in points)


def _grasp(robot: Hand) -> tuple[FingerRecord, ...]:
    """Return what grips of a robot's hand; nothing if it cannot."""
    return tuple(
        FingerRecord(
            joint=finger.pad.joint,
            offset=finger.pad.offset,
            radius=finger.pad.radius,
            cover=finger.pad.cover,
            columns=finger.columns,
            is_jaw=finger.is_jaw,
        )
        for finger in grasp_fingers(robot)
    )


def _collisions(limit: CollisionLimit | None) -> CollisionsRecord | None:
    """Return the pairs of shapes that a robot keeps apart, and how."""
    if limit is None:
        return None
    bounds = limit.bounds
    return CollisionsRecord(pairs=bounds.model(), model=limit.model, links=bounds.links)


def _refuse(option: str, problem: str) -> NoReturn:
    raise InvalidOptionsError(
        problem,
        option=option,
        advice="a saved hand is moved by the compiled core alone",
    )
