"""Checks of a description's reference points."""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import partner_names
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.urdf.files import urdf_path
from handmap_qp.onboarding.report import Report
from handmap_qp.onboarding.robot import Robot
from handmap_qp.transform import transform_points

# Allowed distance of a reference point from its link's shape, for example a sensor's frame [m].
_OFF_THE_LINK = 0.02


def check_points(report: Report, hand: Hand) -> None:
    """Check partners, places and weights of the reference points."""
    points, names = hand.points(hand.rest), {point.name for point in load_hand("human").spec.points}
    partners = partner_names(hand, names)
    for i, point in enumerate(hand.reference_points):
        if (wanted := partners[i]) not in names:
            report.add(
                "advice",
                f"points.{point.name}",
                f"the human hand has no point {wanted!r}",
                "name a partner",
            )
        for j in range(i):
            if np.linalg.norm(points[i] - points[j]) < 1e-3:
                other = hand.reference_points[j].name
                report.add(
                    "warning", f"points.{point.name}", f"lies on {other}", "one of them will do"
                )
    _check_places(report, hand)
    weights = hand.point_weights
    if weights.max() > 100.0 * weights.min():
        report.add(
            "advice",
            "points.weight",
            f"weights are {weights.max() / weights.min():.0f}-fold apart",
            "stay within 100",
        )
    if len(points) < 3:
        report.add(
            "advice",
            "sets",
            f"{len(points)} points leave some of the hand's motion open",
            "add points of the same links",
        )


def _check_places(report: Report, hand: Hand) -> None:
    """Find reference points far outside the shape of their body."""
    try:
        robot = Robot(hand.urdf_text, urdf_path(hand.spec), root=hand.spec.wrist.link)
    except HandError:
        return
    for point in hand.reference_points:
        if point.link not in robot.links:
            continue
        body = robot.body(point.link)
        cloud = robot.body_surface(body)
        if len(cloud):
            place = transform_points(robot.pose_in(point.link, body), np.array(point.xyz))
            outside = np.maximum(
                np.maximum(cloud.min(axis=0) - place, place - cloud.max(axis=0)), 0.0
            )
            if (distance := float(np.linalg.norm(outside))) > _OFF_THE_LINK:
                what = f"lies {1e3 * distance:.0f} mm outside the shape of {point.link}"
                report.add(
                    "warning",
                    f"points.{point.name}",
                    what,
                    "check its xyz, in metres in that link's frame",
                )
