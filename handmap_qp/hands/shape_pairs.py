"""Pairs of a hand's collision shapes: those that its description names, or all that may collide."""

from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, compress, product
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_core.hands import THUMB, Names
from handmap_core.hands.contact_yield import ContactYield, common_yield
from handmap_core.se3 import Array, lengths
from .collision_shapes import read_collision_shapes
from .fingers import PARALLEL, Finger, PalmKinematics, find_fingers
from .hand import Hand
from .spec import Links
from .torques import are_prismatic, torque_limits

# Random postures in which pairs are measured.
_POSTURES = 64
# Pairs that are never farther apart than this in them count as joined [m].
_PARTED = 3e-3
# So do pairs that are never farther apart than this [m], and overlap in this share of the postures:
# coarse shapes at a joint.
_COARSE = 5e-3
_OVERLAPPING = 0.4
# Joints that are no farther apart than this have crossing axes [m].
_CROSSING = 1e-3
# Links may overlap by this share of the thinner one's half thickness. Beyond its middle, the
# direction in which shapes part turns round.
_DEEPEST = 0.7


class ShapePairs(NamedTuple):
    """Collision shapes, and the pairs of them that distances are measured between.

    Attributes:
        geometry: The shapes, with one collision pair for each of the pairs.
        fingers: Finger whose distal link the pair brings together with the thumb's; empty for
            pairs that do not pinch.
        joined: Links of pairs that were left out because they never part.
        yielding: How far they may overlap in commands; None for not at all.
    """

    geometry: pin.GeometryModel
    fingers: Names
    joined: tuple[Links, ...] = ()
    yielding: ContactYield | None = None

    @property
    def links(self) -> tuple[Links, ...]:
        """Links of both shapes of each pair."""
        names = _links(self.geometry)
        return tuple((names[i], names[j]) for i, j in pair_ends(self.geometry))


def _links(geometry: pin.GeometryModel) -> list[str]:
    """Return the link of each shape, which Pinocchio names `LINK_0`, `LINK_1`, and so on."""
    return [shape.name.rpartition("_")[0] for shape in geometry.geometryObjects]


def pair_ends(geometry: pin.GeometryModel) -> list[tuple[int, int]]:
    """Return the indices of both shapes of each pair."""
    return [(pair.first, pair.second) for pair in geometry.collisionPairs]


def paired(geometry: pin.GeometryModel, ends: ArrayLike) -> pin.GeometryModel:
    """Return the shapes with k pairs of their indices alone, shape (k, 2)."""
    paired = geometry.copy()
    paired.removeAllCollisionPairs()
    for pair in np.array(ends).tolist():
        paired.addCollisionPair(pin.CollisionPair(*pair))
    return paired


def named_pairs(hand: Hand, pairs: Sequence[Links]) -> ShapePairs:
    """Pair the shapes of links.

    Args:
        hand: The hand.
        pairs: Names of both links of each pair, such as `hand.spec.collision.pairs`.

    Raises:
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """
    geometry = read_collision_shapes(hand)
    shapes = defaultdict[str, list[int]](list)
    for i, link in enumerate(_links(geometry)):
        shapes[link].append(i)
    for i, pair in enumerate(pairs):
        for link in pair:
            if link not in shapes:
                is_link = link in hand.frames
                what = (
                    "has no collision shape" if is_link else "is not a link of the URDF"
                )
                key = f"collision.pairs[{i}]"
                raise hand.spec.error(f"{link!r} {what}", key, link)
    ends = [end for a, b in pairs for end in product(shapes[a], shapes[b])]
    geometry = paired(geometry, ends)
    return ShapePairs(geometry, ("",) * len(geometry.collisionPairs))


def all_pairs(hand: Hand) -> ShapePairs:
    """Pair all shapes that may collide.

    Pairs on one joint, on neighbouring joints (those of a knuckle's crossing axes count as one), on
    one finger, that overlap at rest or with the hand stretched, or that never part are left out.
    Shapes of one finger overlap at its joints as it bends, and its limits keep it from touching
    itself. A pair that never parts would hold its joints for good.

    Raises:
        HandError: If a shape cannot be read.
    """
    shapes = read_collision_shapes(hand)
    chains = find_fingers(hand)
    joints = [shape.parentJoint for shape in shapes.geometryObjects]
    carriers = {joint: _carrier(hand, joint, joints) for joint in {*joints}}
    owner = {joint: name for name, chain in chains.items() for joint in chain.joints}
    ends = np.array(
        [
            (i, j)
            for (i, a), (j, b) in combinations(enumerate(joints), 2)
            if b != carriers[a] and a != carriers[b]
            if owner.get(a, a) != owner.get(b, b)
        ]
    )
    postures = np.array([hand.rest, hand.zero])
    distances = pair_distances(hand, paired(shapes, ends), postures)
    is_apart = np.all(distances > 0.0, axis=0)
    is_near = is_apart & np.all(distances < _COARSE, axis=0)
    near = paired(shapes, ends[is_near])
    distances = pair_distances(hand, near, random_postures(hand, _POSTURES))
    is_often = np.mean(distances <= 0.0, axis=0) > _OVERLAPPING
    never = distances.max(axis=0) < np.where(is_often, _COARSE, _PARTED)
    is_apart[is_near] = ~never
    geometry = paired(shapes, ends[is_apart])
    joined = tuple(compress(ShapePairs(near, ()).links, never))
    return ShapePairs(geometry, _pinching_fingers(geometry, chains), joined)


def _carrier(hand: Hand, joint: int, with_shapes: Sequence[int]) -> int:
    """Return the joint above one, beyond those whose axes cross its own and carry no shape.

    A knuckle of two crossing axes has a link between them that is a mere point: the links that it
    joins are neighbours.
    """
    model = hand.model
    view = PalmKinematics(hand)
    above = model.parents[joint]
    while above and above not in with_shapes:
        turns, _ = view.axes(hand.zero, [joint, above])
        is_apart = lengths(model.jointPlacements[joint].translation) > _CROSSING
        if is_apart or abs(turns[0] @ turns[1]) > PARALLEL:
            break
        joint, above = above, model.parents[above]
    return above


# The core takes long to take over pairs that are new.
@lru_cache(maxsize=16)
def common_pairs(
    of: tuple[ShapePairs, ...],
) -> tuple[ShapePairs, list[Array]]:
    """Return the pairs that all hands of one robot keep apart.

    Args:
        of: The pairs of each hand, of the same shapes.

    Returns:
        The pairs, and of each hand's r pairs that pinch their indices there and among its own, in
        shape (2, r).
    """
    owns = [
        dict(zip(pair_ends(pairs.geometry), pairs.fingers, strict=True)) for pairs in of
    ]
    common = sorted(set.intersection(*map(set, owns)))
    # Each finger is of one hand, so the others' names are empty.
    fingers = tuple(max(own[end] for own in owns) for end in common)
    pinching = []
    yielding = []
    for pairs, own in zip(of, owns, strict=True):
        order = [*own]
        yielding.append(
            (pairs.yielding, np.array([order.index(end) for end in common]))
        )
        found = [(k, order.index(end)) for k, end in enumerate(common) if own[end]]
        pinching.append(np.array(found, dtype=int).reshape(-1, 2).T)
    geometry = paired(of[0].geometry, common)
    return ShapePairs(geometry, fingers, (), common_yield(yielding)), pinching


def yield_to(
    hand: Hand,
    pairs: ShapePairs,
    force: float,
    stiffness: float,
    sliding_stiffness: float,
) -> ShapePairs:
    """Return pairs of a hand's shapes of which thumb, fingers and palm may press on each other.

    Neighbouring fingers may not.

    Args:
        hand: The hand.
        pairs: The pairs.
        force: Largest force between the shapes of a pair [N]; the motors' torques may allow less.
        stiffness: Stiffness of the fingers' position control [N m/rad].
        sliding_stiffness: The same of joints that slide [N/m].
    """
    chains = find_fingers(hand)
    owner = {joint: name for name, chain in chains.items() for joint in chain.joints}
    shapes = pairs.geometry.geometryObjects
    thickness = np.array([_half_thickness(shape) for shape in shapes])
    palm = hand.palm_frame.parentJoint
    ends = pair_ends(pairs.geometry)
    joints = [(shapes[i].parentJoint, shapes[j].parentJoint) for i, j in ends]
    may_press = np.array([_may_press(pair, owner, palm) for pair in joints], dtype=bool)
    thinner = thickness[np.array(ends, dtype=int).reshape(-1, 2)].min(axis=1)
    size = len(hand.active_columns)
    compliances = np.zeros(size)
    torques = np.full(size, np.inf)
    moves = np.any([chain.moves for chain in chains.values()], axis=0)
    columns = hand.joint_columns[moves]
    springs = np.where(are_prismatic(hand), sliding_stiffness, stiffness)
    compliances[columns] = 1.0 / springs[moves]
    torques[columns] = torque_limits(hand).values[moves]
    yielding = ContactYield(
        forces=force * may_press,
        depths=_DEEPEST * thinner * may_press,
        compliances=compliances,
        torques=torques,
    )
    return pairs._replace(yielding=yielding)


def _may_press(joints: tuple[int, int], owner: dict[int, str], palm: int) -> bool:
    """Return whether links on two joints are of thumb and finger, or of finger and palm."""
    fingers = {owner[joint] for joint in joints if joint in owner}
    if len(fingers) == 2:
        return THUMB in fingers
    return len(fingers) == 1 and palm in joints


def _half_thickness(shape: pin.GeometryObject) -> float:
    """Return half the least side of a shape's box along its own axes [m]."""
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    return float(np.min(box.max_ - box.min_)) / 2.0


def _pinching_fingers(geometry: pin.GeometryModel, chains: dict[str, Finger]) -> Names:
    """Return the finger that each pair brings together with the thumb; empty where none."""
    owners = defaultdict[int, str](str)
    for finger, chain in chains.items():
        owners |= dict.fromkeys(distal_shapes(chain, geometry), finger)
    names = [{owners[i], owners[j]} for i, j in pair_ends(geometry)]
    return tuple(max(two - {THUMB}) if THUMB in two else "" for two in names)


def distal_shapes(chain: Finger, geometry: pin.GeometryModel) -> list[int]:
    """Find the shapes on a finger's last joint, or on the nearest one before it that has any.

    Returns:
        Indices into `geometry.geometryObjects`; empty if the finger has no shapes.
    """
    shapes = list(enumerate(geometry.geometryObjects))
    found = (
        [i for i, s in shapes if s.parentJoint == joint]
        for joint in reversed(chain.joints)
    )
    return next(filter(None, found), [])


def random_postures(hand: Hand, count: int) -> Array:
    """Return postures within the joint limits, always the same ones, shape (count, n)."""
    shape = count, len(hand.rest)
    return np.random.default_rng(0).uniform(*hand.limits, shape)


def pair_distances(hand: Hand, geometry: pin.GeometryModel, postures: Array) -> Array:
    """Measure the distance of each of k pairs in postures (p, n) [m], shape (p, k)."""
    data = hand.model.createData()
    geometry_data = geometry.createData()
    found = []
    for q in postures:
        vector = hand.configuration_vector(q)
        pin.updateGeometryPlacements(hand.model, data, geometry, geometry_data, vector)
        pin.computeDistances(geometry, geometry_data)
        found.append([result.min_distance for result in geometry_data.distanceResults])
    return np.array(found, dtype=float).reshape(len(postures), -1)
