"""Planning grasps.

`plan_grasps` closes a hand from many palm poses round an object and ranks what it gets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.closing import MARGIN, STEP, HandCloser
from handmap_qp.grasp.contacts import Grasp
from handmap_qp.grasp.objects import Shape
from handmap_qp.grasp.preshape import Closing, palm_centre
from handmap_qp.grasp.quality import FRICTION, QUALITIES, SMALLER_IS_BETTER, grasp_quality
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import PoseLike, affine, check_pose, inverse_pose

# A hand that would start in the object is moved back in steps of this length [m].
_RETREAT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PlannedGrasp:
    """One grasp of a plan.

    Attributes:
        trial: Which of the plan's palm poses it came from, counted from 0.
        grasp: The grasp.
        quality: Its quality by the plan's measure.
    """

    trial: int
    grasp: Grasp
    quality: float


def plan_grasps(
    hand: Hand,
    shape: Shape,
    *,
    samples: int = 240,
    seed: int = 0,
    quality: str = "ferrari_canny",
    progress: Callable[[int], None] | None = None,
    object_pose: PoseLike | None = None,
    closing: Closing | None = None,
    friction: float = FRICTION,
    step: float = STEP,
    margin: float = MARGIN,
) -> list[PlannedGrasp]:
    """Close a hand on an object from random palm poses, and rank the grasps.

    The poses are drawn as the toolbox of the paper draws them: the palm looks at the object's
    centre, its middle (`palm_centre`) at a distance of the radius of the sphere round the object
    plus `closing.clearance`, and its orientation is `Rx(a) Ry(b) Rz(c)` with a, b, c uniform over
    the circle, +z out of the back of the hand. (This is not uniform over rotations.) There fingers
    are lines and always start clear of the object; ours have thickness, and a hand that would touch
    the object when open is moved back, out along the palm's +z, until it does not.

    Args:
        hand: The hand; its wrist must be free.
        shape: The object.
        samples: Number of grasps.
        seed: Of the random numbers: the same seed gives the same grasps.
        quality: Name of a measure of `grasp_quality`.
        progress: Called with the number of grasps made after each one.
        object_pose: The object in the world; the identity if omitted.
        closing: How the hand closes; `default_closing` if omitted.
        friction: Coefficient of friction, for the quality.
        step: As of `HandCloser`.
        margin: As of `HandCloser`.

    Returns:
        The grasps, best first; equals in the order of their trials.

    Raises:
        InvalidInputError: If the wrist is fixed or an argument is out of range.
        HandError: If the hand has no collision shapes.
    """
    if not hand.is_floating:
        raise InvalidInputError(
            f"{hand.name} has a fixed wrist: its grasps cannot be planned (mount='floating' frees it)"
        )
    if samples < 1:
        raise InvalidInputError(f"samples: expected at least 1, got {samples}", value=samples)
    if quality not in QUALITIES:
        raise InvalidInputError(
            f"quality: expected one of {', '.join(QUALITIES)}, got {quality!r}", value=quality
        )
    pose = np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
    closer = HandCloser(hand, shape, pose, closing=closing, step=step, margin=margin)
    distance = shape.circumradius + closer.closing.clearance
    centre = palm_centre(hand, closer.closing)
    generator = np.random.default_rng(seed)
    planned: list[PlannedGrasp] = []
    for trial in range(samples):
        angles = generator.uniform(0.0, 2.0 * np.pi, 3)
        wrist = wrist_towards(hand, pose[:3, 3], distance, centre, angles)
        retreat = 0.0
        while not closer.starts_clear(wrist):
            retreat += _RETREAT
            wrist = wrist_towards(hand, pose[:3, 3], distance + retreat, centre, angles)
        grasp = closer.close(wrist)
        planned.append(PlannedGrasp(trial, grasp, grasp_quality(grasp, quality, friction=friction)))
        if progress is not None:
            progress(len(planned))
    sign = 1.0 if quality in SMALLER_IS_BETTER else -1.0
    return sorted(planned, key=lambda one: (sign * one.quality, one.trial))


def wrist_towards(
    hand: Hand, target: np.ndarray, distance: float, centre: np.ndarray, angles: np.ndarray
) -> np.ndarray:
    """The wrist pose whose palm looks at a point.

    Args:
        hand: The hand.
        target: Point in the world [m], shape (3,).
        distance: Of the palm's middle from it [m].
        centre: The palm's middle in the palm frame [m], shape (3,).
        angles: a, b, c of the palm's orientation `Rx(a) Ry(b) Rz(c)` [rad], shape (3,).

    Returns:
        Pose of the wrist, shape (4, 4).
    """
    (ca, cb, cc), (sa, sb, sc) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    about_y = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    about_z = np.array([[cc, -sc, 0.0], [sc, cc, 0.0], [0.0, 0.0, 1.0]])
    rotation = about_x @ about_y @ about_z
    palm = affine(rotation, target + distance * rotation[:, 2] - rotation @ centre)
    return palm @ inverse_pose(hand.wrist_to_palm)


def contact_counts(planned: Iterable[PlannedGrasp]) -> dict[int, int]:
    """How many grasps have so many contacts.

    Args:
        planned: Grasps.

    Returns:
        Number of grasps by number of contacts, fewest contacts first.
    """
    return dict(sorted(Counter(len(one.grasp.contacts) for one in planned).items()))
