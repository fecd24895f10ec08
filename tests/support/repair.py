"""A user of `handmap hands edit` who knows what is true of a hand, and corrects its description."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, get_args

import numpy as np
from patience import wait_until

from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.apps.onboarding.palm_turns import Turn, palm_axes, turned_axes
from handmap_qp.apps.onboarding.vectors import angle_between
from handmap_qp.hands.spec import HandSpec
from handmap_qp.se3 import quat_wxyz_from_rotation

TURNS: tuple[Turn, ...] = get_args(Turn)
LARGEST_ANGLE = 20.0
"""Axes nearer than this to the true ones are right [deg]."""
_LABELS = {
    "dorsal": "Turn the palm over",
    "distal": "Reverse the fingers' direction",
    "names": "Apply the names",
    "root": "Find the hand from this root",
    "side": "Left / right",
    "rest": "Rest as shown",
    "bend": "Bend the other way",
    "palm": "Fix the palm to this link",
}


@dataclass(frozen=True)
class Truth:
    """What is true of a hand, as far as it is known.

    Attributes:
        distal: Direction of the straight fingers in the coordinates of the palm's link, (3,).
        dorsal: Direction out of the back of the hand, (3,); None if it has none.
        side: Its side; empty if it has none.
        names: Name of the finger by its tip's link; None of what is no finger.
    """

    distal: np.ndarray
    dorsal: np.ndarray | None = None
    side: str = ""
    names: Mapping[str, str | None] = field(default_factory=dict)


class Operator(Protocol):
    """What presses the buttons of the page."""

    def add_clicks(self, count: int) -> None:
        """Count clicks that are made otherwise."""

    def press(self, name: str) -> None:
        """Press a button."""

    def turn(self, axis: str) -> None:
        """Press one of the buttons of a quarter turn."""

    def choose(self, label: str, entry: str) -> None:
        """Choose an entry of the list with a label."""

    def drag_rings(self, axes: np.ndarray) -> None:
        """Turn the palm's axes by the rings to axes of its link, (3, 3)."""


class Requests:
    """Presses the buttons without a browser: the callbacks that record requests.

    Args:
        editor: The page.
    """

    def __init__(self, editor: HandEditor) -> None:
        self.editor = editor
        self.clicks = 0
        self.settle()

    def settle(self) -> None:
        """Wait until all requests are carried out."""
        editor = self.editor
        editor.tick()
        wait_until(lambda: editor.tick() or not editor._search.is_busy)

    def add_clicks(self, count: int) -> None:
        """Count clicks that are made otherwise."""
        self.clicks += count

    def press(self, name: str) -> None:
        """Press a button."""
        known = {"dorsal": "turn"}
        self.editor._press(known.get(name, name), None)
        self.clicks += 1
        self.settle()

    def turn(self, axis: str) -> None:
        """Press one of the buttons of a quarter turn."""
        self.editor._press("quarter", axis)
        self.clicks += 1
        self.settle()

    def choose(self, label: str, entry: str) -> None:
        """Choose an entry of the list with a label: one click opens it, one chooses."""
        editor = self.editor
        lists = {
            **editor.names,
            "root": editor.root,
            "palm": editor.palm,
            "bend": editor.bent,
        }
        assert entry in lists[label].options
        lists[label].value = entry
        self.clicks += 2

    def drag_rings(self, axes: np.ndarray) -> None:
        """Turn the palm's axes by the rings."""
        editor = self.editor
        palm = editor.hand.spec.palm.link
        (pose,) = editor.hand.link_poses([palm], editor._q)
        editor.rings.wxyz = quat_wxyz_from_rotation(pose[:3, :3] @ axes)
        self.press("axes")


def repair(
    operator: Operator, spec: Callable[[], HandSpec], truth: Callable[[], Truth]
) -> None:
    """Correct names, axes and side of a description, in this order.

    Args:
        operator: What presses the buttons.
        spec: Returns the description as it is now.
        truth: Returns what is true, in the coordinates of the palm's link of now.
    """
    fix_names(operator, spec(), truth().names)
    fix_axes(operator, spec(), truth())
    # Names that were derived from wrong axes are as they were given: they were held.
    side = truth().side
    if side and spec().side != side:
        operator.press("side")


def fix_palm_link(operator: Operator, spec: HandSpec, link: str) -> None:
    """Fix the palm to another link."""
    if spec.palm.link != link:
        operator.choose("palm", link)
        operator.press("palm")


def fix_bends(
    operator: Operator, fingers: Collection[str], bent: Collection[str]
) -> None:
    """Bend fingers the other way: all at once, or one after another.

    Args:
        operator: What presses the buttons.
        fingers: All fingers.
        bent: Those that rest bent to the wrong side.
    """
    if bent and {*bent} == {*fingers}:
        operator.press("bend")
        return
    for finger in bent:
        operator.choose("bend", finger)
        operator.press("bend")


def fix_names(
    operator: Operator, spec: HandSpec, names: Mapping[str, str | None]
) -> None:
    """Choose the names of all fingers that are wrong, and apply them at once."""
    now = {
        point.link: point.finger for point in spec.points if point.name.endswith("_tip")
    }
    wrong = {link: name for link, name in names.items() if now.get(link) != name}
    for link, name in wrong.items():
        operator.choose(link, name or "none")
    if wrong:
        operator.press("names")


def fix_axes(operator: Operator, spec: HandSpec, truth: Truth) -> None:
    """Turn the axes by the fewest buttons, or by the rings where no quarter turns are enough."""
    axes = palm_axes(spec)
    if error(axes, truth) < LARGEST_ANGLE:
        return
    for count in range(1, 4):
        rows = [*itertools.product(TURNS, repeat=count)]
        errors = [error(after(axes, turns), truth) for turns in rows]
        if min(errors) < LARGEST_ANGLE:
            for turn in rows[int(np.argmin(errors))]:
                if turn in _LABELS:
                    operator.press(turn)
                else:
                    operator.turn(turn)
            return
    operator.drag_rings(true_axes(axes, truth))


def after(axes: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """Return axes after some turns."""
    for turn in turns:
        axes = turned_axes(axes, turn)
    return axes


def error(axes: np.ndarray, truth: Truth) -> float:
    """Return the largest angle of the axes to the true ones [deg]."""
    pairs = [(axes[:, 1], truth.distal)]
    if truth.dorsal is not None:
        pairs.append((axes[:, 2], truth.dorsal))
    return max(angle_between(own, true) for own, true in pairs)


def true_axes(axes: np.ndarray, truth: Truth) -> np.ndarray:
    """Return the true axes; those that are not known are near to what they were, (3, 3)."""
    distal = truth.distal / np.linalg.norm(truth.distal)
    dorsal = axes[:, 2] if truth.dorsal is None else truth.dorsal
    if abs(dorsal @ distal) > 0.9:
        dorsal = axes[:, 0]
    dorsal = dorsal - (dorsal @ distal) * distal
    dorsal = dorsal / np.linalg.norm(dorsal)
    return np.column_stack([np.cross(distal, dorsal), distal, dorsal])


def label_of(name: str) -> str:
    """Return what a button says."""
    return _LABELS[name]
