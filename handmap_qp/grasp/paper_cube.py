"""The paper's pair of grasps (Sec. IV).

The human hand and the three-fingered one round the same 50 mm cube, ready to use.

The figures are the toolbox's that the paper was computed with; each hand's lie beside its URDF, in
`grasp_cube50.json`. Contacts lie on the bones' axes there, because that planner takes fingers for
lines: with the thickness of our collision shapes, human links reach up to 8 mm into the cube and
robot links up to 11 mm. `handmap_qp.grasp.planning` finds grasps without that.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.contacts import Contact, Grasp
from handmap_qp.grasp.objects import Box
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import read_hand_spec
from handmap_qp.hands.urdf.package_data import urdf_directory

REFERENCE_HANDS = ("human", "three_finger")
"""The hands that have a reference grasp."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceGrasp:
    """A grasp of the paper's pair, and what was published with it.

    Attributes:
        grasp: The grasp; its hand's reference points are the contacts.
        published_points: Contacts as published [m], shape (n_c, 3); `grasp.points` are the same.
        published_q: Joint angles as published [rad], shape (n,). The human's are those of the
            grasp. The three-fingered hand's belong to fingers set 50/3 mm farther out, a slip of
            the planner: at these angles our hand's contacts are 16.7 mm off, and no palm pose
            brings them nearer than 16.4 mm (root mean square). The grasp's own angles, up to 18
            degrees away, reach the published contacts from the published palm.
        published_quality: Quality measures by name, in millimetres (`length=1e-3` in
            `grasp_quality`).
        published_counts: How many of the toolbox's grasps of the cube had so many contacts.
        source: Where the figures come from.
    """

    grasp: Grasp
    published_points: np.ndarray
    published_q: np.ndarray
    published_quality: dict[str, float]
    published_counts: dict[int, int]
    source: str


def reference_grasp(hand: str = "human") -> ReferenceGrasp:
    """The reference grasp of a hand.

    Args:
        hand: `human` or `three_finger`.

    Returns:
        The grasp, both hands' in one world: the cube is the same.

    Raises:
        InvalidInputError: If the hand has none.
    """
    if hand not in REFERENCE_HANDS:
        raise InvalidInputError(
            f"hand: expected one of {', '.join(REFERENCE_HANDS)}, got {hand!r}", value=hand
        )
    figures = read_cube_figures(hand)
    model = Hand(
        read_hand_spec(urdf_directory() / hand / "hand.yaml"), points="contacts", mount="floating"
    )
    wrist, q = np.array(figures["wrist_pose"]), np.array(figures["q"])
    rows = figures["contacts"]
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
        grasp=Grasp(model, q, np.array(figures["object"]["pose"]), contacts, wrist, shape),
        published_points=np.array([row["point"] for row in rows]),
        published_q=np.array(figures.get("published", figures)["q"]),
        published_quality=figures["quality"],
        published_counts={
            int(count): number for count, number in figures["contact_counts"].items()
        },
        source=figures["source"],
    )


def read_cube_figures(hand: str) -> dict[str, Any]:
    """A hand's `grasp_cube50.json` as it stands."""
    return json.loads((urdf_directory() / hand / "grasp_cube50.json").read_text(encoding="utf-8"))
