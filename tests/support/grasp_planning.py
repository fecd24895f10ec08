"""Plan grasps: `plan_grasps` closes a hand from random palm poses and ranks the grasps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from checks import one_of, positive_number, whole_number
from grasp_closing import (
    MARGIN,
    STEP,
    HandCloser,
    Preshape,
    palm_centre,
)
from grasp_measures import (
    FRICTION,
    QUALITIES,
    SMALLER_IS_BETTER,
    grasp_quality,
)
from scipy.spatial.transform import Rotation
from section_four.contacts import Grasp

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.se3 import PoseLike, affine, check_pose, inverse_pose

# Step by which a hand that would start inside the object is moved back [m].
_RETREAT = 1e-3


class PlannedGrasp(NamedTuple):
    """One grasp of a plan.

    Attributes:
        trial: Index of the palm pose in the plan, from 0.
        grasp: The grasp.
        quality: Its value by the plan's measure.
    """

    trial: int
    grasp: Grasp
    quality: float


def circumradius(shape: Shape) -> float:
    """Return the radius of the smallest sphere about a shape's centre that holds it [m]."""
    match shape:
        case Box():
            return float(np.linalg.norm(shape.size)) / 2.0
        case Cylinder():
            return float(np.hypot(shape.radius, shape.length / 2.0))
        case Sphere():
            return shape.radius
    return float(np.linalg.norm(shape.points, axis=1).max())


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
    friction = positive_number(friction, "friction", or_zero=True)
    pose = np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
    closer = HandCloser(hand, shape, pose, preshape=preshape, step=step, margin=margin)
    near = circumradius(shape) + closer.preshape.clearance
    centre = palm_centre(hand, closer.preshape)
    palm_to_wrist = inverse_pose(hand.wrist_to_palm)
    generator = np.random.default_rng(seed)
    planned: list[PlannedGrasp] = []
    for trial in range(samples):
        rotation = Rotation.from_euler(
            "XYZ", generator.uniform(0.0, 2.0 * np.pi, 3)
        ).as_matrix()
        distance = near
        while True:
            place = pose[:3, 3] + distance * rotation[:, 2] - rotation @ centre
            wrist = affine(rotation, place) @ palm_to_wrist
            if closer.starts_clear(wrist):
                break
            distance += _RETREAT
        grasp = closer.close(wrist)
        planned.append(
            PlannedGrasp(trial, grasp, grasp_quality(grasp, quality, friction=friction))
        )
        if progress is not None:
            progress(len(planned))
    sign = 1.0 if quality in SMALLER_IS_BETTER else -1.0
    return sorted(planned, key=lambda one: (sign * one.quality, one.trial))


def contact_counts(planned: Iterable[PlannedGrasp]) -> dict[int, int]:
    """Return the number of grasps by number of contacts, fewest contacts first."""
    return dict(sorted(Counter(len(one.grasp.contacts) for one in planned).items()))
