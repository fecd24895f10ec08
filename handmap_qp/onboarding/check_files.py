"""Checks of the files behind a description: meshes, and joints that it leaves out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf.elements import origin_of, parse_urdf
from handmap_qp.hands.urdf.files import read_urdf, urdf_path, urdf_with_mesh_paths
from handmap_qp.hands.urdf.tree import MOVABLE, edges
from handmap_qp.onboarding.report import Report

# Names in one finding.
_MOST_NAMES = 3
# A joint this near to the hand's first link is one of its wrist [m].
_WRIST_REACH = 0.25


def check_files(report: Report, hand: Hand) -> None:
    """Find missing meshes, and actuated wrist joints that the description leaves out."""
    _check_meshes(report, hand)
    _check_wrist(report, hand)


def _check_meshes(report: Report, hand: Hand) -> None:
    robot = parse_urdf(urdf_with_mesh_paths(hand.spec, hand.urdf_text))
    for tag, use in (("collision", "self-collision and pinches"), ("visual", "pictures")):
        names = [
            mesh.get("filename", "") for shape in robot.iter(tag) for mesh in shape.iter("mesh")
        ]
        missing = [name for name in dict.fromkeys(names) if not Path(name).is_file()]
        if missing:
            shown = ", ".join(Path(name).name for name in missing[:_MOST_NAMES])
            more = ", ..." if len(missing) > _MOST_NAMES else ""
            report.add(
                "warning",
                "urdf",
                f"{len(missing)} of {len(set(names))} {tag} meshes are missing: {shown}{more}; "
                f"{use} do without them",
                f"put them where the URDF looks for them: {Path(missing[0]).parent}",
            )


def _check_wrist(report: Report, hand: Hand) -> None:
    spec = hand.spec
    if (
        spec.root is None
        or spec.arm is not None
        or (hand.has_moving_wrist and not hand.is_floating)
    ):
        return
    if urdf_path(spec).suffix != ".urdf":
        return
    robot = parse_urdf(read_urdf(spec))
    above = {child: (joint, parent) for joint, parent, child in edges(robot)}
    link, distance, left_out, base = spec.root, 0.0, [], ""
    while link in above:
        joint, parent = above[link]
        # The link turns about its own origin: count the way from there to the hand.
        if distance > _WRIST_REACH:
            break
        if joint.get("type") in MOVABLE:
            left_out.append(joint.get("name", ""))
            base = parent
        distance += float(np.linalg.norm(origin_of(joint)[:3, 3]))
        link = parent
    if left_out:
        report.add(
            "advice",
            "root",
            f"wrist joints are left out: {', '.join(reversed(left_out))}",
            f"keep them with `hands init --base {base}`",
        )
