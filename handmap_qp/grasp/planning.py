"""Plan grasps: `plan_grasps` closes a hand from random palm poses and ranks the grasps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import non_negative_number, one_of, whole_number
from handmap_qp.grasp.closing import MARGIN, STEP, HandCloser
from handmap_qp.grasp.contacts import Grasp
from handmap_qp.grasp.measures import FRICTION, QUALITIES, SMALLER_IS_BETTER, grasp_quality
from handmap_qp.grasp.objects import Shape
from handmap_qp.grasp.preshape import Preshape, palm_centre
from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import PoseLike, affine, check_pose, inverse_pose

# Step by which a hand that would start inside the object is moved back [m].
_RETREAT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PlannedGrasp:
    """One grasp of a plan.

    Attributes:
        trial: Index of the palm pose in the plan, from 0.
        grasp: The grasp.
        quality: Its value by the plan's measure.
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
    preshape: Preshape | None = None,
    friction: float = FRICTION,
    step: float = STEP,
    margin: float = MARGIN,
) -> list[PlannedGrasp]:
    """Close a hand on an object from random palm poses, and rank the grasps.

    Poses are sampled as in the toolbox of the paper. The palm faces the object's centre. The
    distance from `palm_centre` to the object's centre is the circumradius of the object plus
    `preshape.clearance`. The palm's orientation is `Rx(a) Ry(b) Rz(c)` with a, b, c uniform in
    [0, 2 pi), +z out of the back of the hand (not uniform over SO(3)). The toolbox models fingers
    as lines, which start clear of the object. Ours have thickness, so a hand that would touch the
    object when open is moved back along the palm's +z until it does not.

    Args:
        hand: The hand; its wrist must be floating.
        shape: Shape of the object.
        samples: Number of grasps.
        seed: Seed of the random numbers, >= 0; the same seed gives the same grasps.
        quality: Name of a measure of `grasp_quality`.
        progress: Called after each grasp with the number of grasps done.
        object_pose: Pose of the object in the world; the identity if omitted.
        preshape: Start posture and closing directions; `default_preshape` if omitted.
        friction: Coulomb coefficient of friction, for the quality.
        step: As for `HandCloser`.
        margin: As for `HandCloser`.

    Returns:
        The grasps, best first; ties in the order of their trials.

    Raises:
        InvalidInputError: If the wrist is fixed or an argument is invalid.
        HandError: If the hand has no collision shapes.
    """
    if not hand.is_floating:
        raise InvalidInputError(
            argument="hand",
            expected="a floating wrist",
            got=f"{hand.name} with a fixed wrist",
            advice="load the hand with mount='floating'",
        )
    samples = whole_number(samples, "samples", least=1)
    seed = whole_number(seed, "seed", least=0)
    one_of(quality, QUALITIES, "quality")
    friction = non_negative_number(friction, "friction")
    pose = np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
    closer = HandCloser(hand, shape, pose, preshape=preshape, step=step, margin=margin)
    distance = shape.circumradius + closer.preshape.clearance
    centre = palm_centre(hand, closer.preshape)
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
    """Wrist pose at which the palm faces a point.

    Args:
        hand: The hand.
        target: Point in the world [m], shape (3,).
        distance: Distance from the centre of the palm to that point [m].
        centre: Centre of the palm in the palm frame [m], shape (3,).
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
    """Histogram of the number of contacts.

    Args:
        planned: Grasps.

    Returns:
        Number of grasps by number of contacts, fewest contacts first.
    """
    return dict(sorted(Counter(len(one.grasp.contacts) for one in planned).items()))
