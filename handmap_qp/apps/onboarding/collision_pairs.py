"""Pairs of links: those that overlap, and those that self-collision avoidance keeps apart."""

from collections.abc import Sequence
from itertools import combinations, compress, pairwise

import msgspec
import numpy as np
import pinocchio as pin

from handmap_core.errors import HandmapError
from handmap_core.se3 import Array, lengths
from handmap_qp.hands import (
    THUMB,
    CollisionSpec,
    Hand,
    Links,
    ShapePairs,
    all_pairs,
    find_fingers,
    named_pairs,
    pair_distances,
    random_postures,
    read_collision_shapes,
)
from .detect import Detection

MARGIN = 0.0005
"""Least distance between links [m]: pinches close, and the linearised rows hold."""
# Random postures; a pair that comes nearer than this in one of them may collide [m].
_SAMPLES = 60
_NEAR = 0.01
# Pairs that overlap in more postures than this overlap by design.
_BY_DESIGN = 0.5
# The same of a few postures; shorter links of a compact joint overlap when it bends [m].
_FEW = 8
_IN_FEW = 0.8
_SHORT = 0.025


def with_collision_pairs(found: Detection, hand: Hand) -> Detection:
    """Return a detected hand with its `collision`, or with a note if it has no shapes."""
    spec = found.spec
    try:
        pairs = all_pairs(hand)
        collision = find_collision_pairs(hand, pairs)
        spec = msgspec.structs.replace(spec, collision=collision)
        notes = joined_notes(pairs)
    except HandmapError as error:
        notes = [f"no pairs for self-collision: {error}"]
    return found._replace(spec=spec, notes=(*found.notes, *notes))


def joined_notes(pairs: ShapePairs) -> list[str]:
    """Name the links that are not kept apart because they never part."""
    return [
        f"{' and '.join(links)} are close in every posture: their contacts are left out"
        for links in dict.fromkeys(pairs.joined)
    ]


def find_collision_pairs(hand: Hand, pairs: ShapePairs) -> CollisionSpec | None:
    """Find the pairs of links that may collide: thumb and fingers, thumb and palm, neighbours.

    Bars of linkages, pairs on one finger, pairs that overlap at rest, stretched or in most
    postures, and pairs that never come near each other are left out.

    They are chosen from all `pairs` of shapes that may collide; None if there are none.

    Raises:
        HandError: If a collision shape cannot be read.
    """
    fingers = find_fingers(hand)
    # The palm's joint and those that fingers share are the palm's.
    owners = {hand.palm_frame.parentJoint: "palm"}
    for name, finger in fingers.items():
        owners |= {j: name if j in finger.own else "palm" for j in finger.joints}
    others = [finger for finger in fingers if finger != THUMB]
    beside = [{THUMB, other} for other in ("palm", *others)]
    beside += map(set, pairwise(others))
    postures = np.vstack([hand.rest, random_postures(hand, _SAMPLES)])
    distances = pair_distances(hand, pairs.geometry, postures)
    is_near = np.array(pairs.fingers) != ""
    is_near |= distances.min(axis=0) < _NEAR
    overlaps = (distances <= 0.0).mean(axis=0) > _BY_DESIGN
    named = [(min(links), max(links)) for links in pairs.links]
    by_design = {*compress(named, overlaps)}
    wanted = [
        links
        for links in dict.fromkeys(compress(named, is_near))
        if {owners.get(hand.frames[link].parentJoint) for link in links} in beside
        and links not in by_design
    ]
    # A link has several shapes: its pair is left out if one pair of them touches at rest.
    every = named_pairs(hand, wanted)
    (at_rest,) = pair_distances(hand, every.geometry, hand.rest[None])
    touching = {*compress(every.links, at_rest < 2.0 * MARGIN)}
    found = tuple(pair for pair in wanted if pair not in touching)
    return CollisionSpec(found, MARGIN) if found else None


def colliding_links(hand: Hand, q: Array, wrists: Sequence[int] = ()) -> list[Links]:
    """Return the pairs of links whose collision shapes overlap in one posture.

    Pairs that meet in a joint, or that overlap in most postures, are left out.

    Args:
        hand: The hand.
        q: Joint angles [rad], shape (n,).
        wrists: Joints of a robot's wrists; pairs of links that one of them carries are left out.

    Raises:
        HandError: If a shape cannot be read.
    """
    geometry = read_collision_shapes(hand)
    joints = [shape.parentJoint for shape in geometry.geometryObjects]
    parts = [_neighbours(hand.model, joint, joints) for joint in {*joints}]
    parts += [{*hand.model.subtrees[wrist]} for wrist in wrists]
    for (i, one), (j, other) in combinations(enumerate(joints), 2):
        if not any({one, other} <= part for part in parts):
            geometry.addCollisionPair(pin.CollisionPair(i, j))
    postures = np.vstack([q, random_postures(hand, _FEW)])
    overlaps = pair_distances(hand, geometry, postures) <= 0.0
    found = overlaps[0] & (overlaps[1:].mean(axis=0) < _IN_FEW)
    return [*dict.fromkeys(compress(ShapePairs(geometry, ()).links, found))]


def _neighbours(model: pin.Model, joint: int, with_shape: list[int]) -> set[int]:
    """Return a joint and those above it, whose bodies may overlap up to one that is not short."""
    found = {joint}
    while joint > 0:
        length = lengths(model.jointPlacements[joint].translation)
        joint = model.parents[joint]
        found.add(joint)
        if joint in with_shape and length > _SHORT:
            break
    return found
