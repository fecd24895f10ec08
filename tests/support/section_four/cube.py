"""The two grasps of Sec. IV: the human and the three-fingered hand on the same 50 mm cube.

The numbers come from the toolbox that the paper used (SynGrasp). They lie beside each hand's URDF,
in `grasp_cube50.json`. The toolbox models fingers as lines, so its contacts lie on the bones' axes:
with our collision shapes, human links penetrate the cube by up to 8 mm and robot links by up to
11 mm. Grasps of `tests/support/grasp_planning.py` do not penetrate.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
from checks import one_of

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import read_hand_spec
from handmap_qp.hands.urdf import get_numbers, parse_urdf, set_numbers
from handmap_qp.mapping.objects import Box
from section_four.contacts import Contact, Grasp

REFERENCE_HANDS = ("human", "three_finger")
"""Names of the hands that have a reference grasp."""
# Azimuth in the palm of the first joint of each finger of the three-fingered hand [rad].
_AZIMUTHS = {
    "f1_proximal": 0.0,
    "f2_spread": 2.0 * np.pi / 3.0,
    "f3_spread": -2.0 * np.pi / 3.0,
}


class ReferenceGrasp(NamedTuple):
    """One of the paper's two grasps, with the published numbers.

    Attributes:
        grasp: The grasp; the reference points of its hand are the contacts.
        published_points: Published contacts [m], shape (n_c, 3); equal to `grasp.points`.
        published_q: Published joint angles [rad], shape (n,). The human's equal `grasp.q`. Those of
            the three-fingered hand belong to fingers mounted 50/3 mm farther out, an error of the
            toolbox's planner: they put our contacts 16.7 mm off, and no palm pose brings them
            nearer than 16.4 mm RMS. `grasp.q`, up to 18 degrees away, reaches the published
            contacts from the published palm pose.
        published_quality: Quality measures by name, in millimetres (`length=1e-3` in
            `grasp_quality`).
        published_counts: Number of the toolbox's grasps of the cube by number of contacts.
    """

    grasp: Grasp
    published_points: np.ndarray
    published_q: np.ndarray
    published_quality: dict[str, float]
    published_counts: dict[int, int]


def reference_grasp(hand: str = "human", *, is_toolbox: bool = False) -> ReferenceGrasp:
    """Return the reference grasp of a hand.

    Args:
        hand: `human` or `three_finger`.
        is_toolbox: Whether the three-fingered hand is that of the toolbox's planner, at the
            published joint angles, to which numbers computed with the toolbox belong.

    Returns:
        The grasp. Both hands hold the same cube in the same world.

    Raises:
        InvalidInputError: If the hand has no reference grasp.
    """
    one_of(hand, REFERENCE_HANDS, "hand")
    figures = read_cube_figures(hand)
    published = figures.get("published", figures)
    spec = read_hand_spec(urdf_directory() / hand / "hand.yaml")
    model = Hand(spec, points="contacts", mount="floating")
    wrist = np.array(figures["wrist_pose"])
    q = np.array(figures["q"])
    rows = figures["contacts"]
    object_pose = np.array(figures["object"]["pose"])
    if is_toolbox:
        model = _toolbox_hand(model)
        q = np.array(published["q"])
    links = model.link_poses([row["link"] for row in rows], q, wrist)
    contacts = tuple(
        Contact(
            row["link"],
            tuple(row["xyz"]),
            tuple(np.array(row["normal"]) @ pose[:3, :3]),
            row["finger"],
        )
        for row, pose in zip(rows, links, strict=True)
    )
    shape = Box(tuple(figures["object"]["box"]))
    return ReferenceGrasp(
        grasp=Grasp(model, q, object_pose, contacts, wrist, shape),
        published_points=np.array([row["point"] for row in rows]),
        published_q=np.array(published["q"]),
        published_quality=figures["quality"],
        published_counts={
            int(count): number for count, number in figures["contact_counts"].items()
        },
    )


def _toolbox_hand(hand: Hand) -> Hand:
    """Return the three-fingered hand with its fingers 50/3 mm farther out."""
    shift = float(read_cube_figures("three_finger")["published"]["finger_shift"])
    robot = parse_urdf(hand.urdf_text)
    for joint in robot.iterfind("joint"):
        azimuth = _AZIMUTHS.get(joint.get("name", ""))
        origin = joint.find("origin")
        if azimuth is not None and origin is not None:
            outwards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            xyz = get_numbers(origin, "xyz", 3) + shift * outwards
            set_numbers(origin, xyz=xyz)
    text = ET.tostring(robot, encoding="unicode")
    return Hand(hand.spec, points="contacts", mount="floating", urdf_text=text)


def read_cube_figures(hand: str) -> dict[str, Any]:
    """Read a hand's `grasp_cube50.json`."""
    return json.loads(
        (urdf_directory() / hand / "grasp_cube50.json").read_text(encoding="utf-8")
    )
