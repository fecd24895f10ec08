"""`follower_model`: what a mapper is made of, as the library in C++ follows by it."""

from __future__ import annotations

import numpy as np

from handmap_core.human import landmarks_at_rest
from handmap_core.ik.options import ik_model
from handmap_core.models import FollowerModel, GuardModel
from handmap_core.trackers.orders import KnownOrders
from handmap_qp.hands.compiled import hand_model
from handmap_qp.mapping import HandMapper
from handmap_qp.mapping.methods.teleoperation import BoundTeleoperation
from handmap_qp.trackers.plausibility import layout_orders


def follower_model(mapper: HandMapper) -> FollowerModel | None:
    """Return what C++ follows by; None for a method that it does not have.

    Args:
        mapper: The mapper, which the compiled core moves; its human hand must be scaled to the
            person.
    """
    source = mapper.source
    bound = source.bound
    if not isinstance(bound, BoundTeleoperation):
        return None
    gate = mapper.point_ik.gate
    limit = gate.collisions
    human, robot = source.human, source.robot
    orders = KnownOrders(layout_orders())
    return FollowerModel(
        name=robot.name,
        joint_names=robot.joint_names,
        human_joint_names=human.joint_names,
        dt=mapper.dt,
        joint_tolerance=source.joint_tolerance,
        human=hand_model(human),
        robot=hand_model(robot),
        limits=gate.limits,
        ik=ik_model(robot, mapper.ik),
        pairs=None if limit is None else limit.bounds.model(),
        collisions=None if limit is None else limit.model,
        guard=GuardModel(side=human.side, landmarks=landmarks_at_rest(human)),
        order_names=orders.names,
        orders=tuple(np.asarray(order, dtype=np.int64) for order in orders.indices),
        landmarks=source.landmarks.model,
        palm=bound.palm_model,
        teleoperation=bound.model,
    )
