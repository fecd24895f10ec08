"""Which body is the palm and which chains are fingers, from how the robot branches and how far its branches reach.

A branch of a body is *finger-like* if nothing on it gets farther than a hand's breadth or two from
where it begins. The palm is the body that at least two finger-like branches hang from; where bodies
inside such branches qualify too (a metacarpal that carries two fingers), the innermost common one
wins.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.onboarding.robot import Robot
from handmap_qp.transform import transform_points

LONGEST_FINGER = 0.3
"""What is longer than this is a leg or an arm [m]."""
# A link that moves its own end by less than this is a motor's or a sensor's, not a finger's [m].
_LEAST_TRAVEL = 0.004
# Where a finger's last link has an end frame nearer than this to its joint, the frame marks
# something else [m].
_LEAST_TIP = 0.005
# Ends of links that stay this near to a place on another finger are the ends of a linkage [m].
_LINKAGE_SLACK = 0.004


@dataclass(frozen=True, slots=True, eq=False)
class Tip:
    """Where a finger ends.

    Attributes:
        link: Link that carries it.
        xyz: Place in the link's coordinates [m], shape (3,).
        how: How it was found.
        confidence: From 0 to 1.
    """

    link: str
    xyz: np.ndarray
    how: str
    confidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """A finger as a chain.

    Attributes:
        joints: Movable joints from the palm outwards.
        links: The link that each of them moves.
        tip: Where it ends.
    """

    joints: tuple[str, ...]
    links: tuple[str, ...]
    tip: Tip


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """What of a robot is a hand.

    Attributes:
        palm: Link of the palm's body that all fingers hang from.
        chains: The fingers, in the order of the file.
        above: Movable joints between the robot's root and the palm.
        idle: Movable joints outwards from the palm that move no finger.
        how: How the palm was found.
        confidence: From 0 to 1.
        notes: What was left out and why.
    """

    palm: str
    chains: tuple[Chain, ...]
    above: tuple[str, ...]
    idle: tuple[str, ...]
    how: str
    confidence: float
    notes: tuple[str, ...]


def find_structure(robot: Robot) -> Structure:
    """Find the palm and the fingers.

    Args:
        robot: The robot, or the part of it to look at.

    Returns:
        Palm and fingers.

    Raises:
        HandError: If there is no hand or more than one, saying where to begin.
    """
    bodies = [body for body in robot.links if robot.body(body) == body]
    candidates = {body: found for body in bodies if len(found := _fingerlike(robot, body)) >= 2}
    inner = {
        body
        for body in candidates
        for other, joints in candidates.items()
        if _hangs_in(robot, body, other, joints)
    }
    palms = [body for body in candidates if body not in inner]
    if len(palms) > 1:
        raise HandError(
            f"there are {len(palms)} places that could be palms: {', '.join(_gate(robot, body) for body in palms[:8])}; "
            "name the one to take with --root",
            file=robot.file,
            value=palms,
        )
    if not palms:
        return _one_finger(robot)
    palm = palms[0]
    below = [
        leaf
        for joint, child in robot.branches(palm)
        if joint in candidates[palm]
        for leaf in robot.leaves(child)
    ]
    chains = [_chain(robot, leaf, palm) for leaf in below]
    kept, notes = _drop_idle(robot, chains)
    kept = _drop_linkages(robot, _drop_forks(kept, notes), notes)
    if not kept:
        raise HandError("no branch of the palm moves its own end", file=robot.file, value=palm)
    link = _common_link(robot, palm, kept)
    return Structure(
        palm=link,
        chains=tuple(kept),
        above=tuple(joint for joint, _ in robot.chain(palm, robot.root)),
        idle=_idle(robot, palm, kept),
        how=f"{len(kept)} chains of at most {LONGEST_FINGER:g} m branch from it, and from no other place",
        confidence=0.95 if len(kept) > 2 else 0.85,
        notes=tuple(notes),
    )


def _fingerlike(robot: Robot, body: str) -> set[str]:
    """Joints of a body whose branches could be fingers."""
    found = set()
    for joint, child in robot.branches(body):
        chains = [robot.chain(leaf, body) for leaf in robot.leaves(child)]
        is_wheel = joint in robot.endless and all(len(chain) == 1 for chain in chains)
        if not is_wheel and max(_reach(robot, chain) for chain in chains) < LONGEST_FINGER:
            found.add(joint)
    return found


def _reach(robot: Robot, chain: list[tuple[str, str]]) -> float:
    """Length of a chain from its first joint to its last, and to the end of the last body where its links are long [m]."""
    links = [link for _, link in chain]
    steps = [
        np.linalg.norm(robot.pose_in(link, before)[:3, 3])
        for before, link in itertools.pairwise(links)
    ]
    end = find_tip(robot, links[-1], links[-2] if len(links) > 1 else None)
    return float(sum(steps) + np.linalg.norm(robot.pose_in(end.link, links[-1])[:3, 3] + end.xyz))


def _hangs_in(robot: Robot, body: str, other: str, joints: set[str]) -> bool:
    """Whether a body lies on one of another body's finger-like branches."""
    way = robot.chain(body, other)
    return (
        body != other
        and bool(way)
        and robot.body(other) == other
        and way[0][0] in joints
        and _is_above(robot, other, body)
    )


def _is_above(robot: Robot, above: str, link: str) -> bool:
    while link in robot.parent:
        link = robot.parent[link][1]
        if robot.body(link) == above:
            return True
    return False


def _gate(robot: Robot, body: str) -> str:
    """The link to name for a palm: the one that its finger-like branches have in common."""
    chains = [
        _chain(robot, child, body)
        for joint, child in robot.branches(body)
        if joint in _fingerlike(robot, body)
    ]
    return _common_link(robot, body, chains)


def _one_finger(robot: Robot) -> Structure:
    leaves = robot.leaves(robot.root)
    chain = _chain(robot, leaves[0], robot.root)
    reach = _reach(robot, robot.chain(leaves[0], robot.root))
    if len(leaves) > 1 or reach > LONGEST_FINGER:
        what = (
            f"{len(leaves)} chains, none of which branches into fingers"
            if len(leaves) > 1
            else f"one chain of {reach:.2f} m"
        )
        hint = (
            "; are its lengths in millimetres?"
            if reach > 10.0
            else ", or name the palm with --root"
        )
        raise HandError(
            f"no hand found from {robot.root!r} outwards: {what}{hint}",
            file=robot.file,
            value=robot.root,
        )
    return Structure(
        palm=robot.parent[chain.links[0]][1],
        chains=(chain,),
        above=(),
        idle=(),
        how="one chain, and the link that it hangs from",
        confidence=0.5,
        notes=(
            "there is one finger only: which way is out of the back of the hand, and which side it is, is a guess",
        ),
    )


def _chain(robot: Robot, leaf: str, palm: str) -> Chain:
    way = robot.chain(leaf, palm)
    return Chain(
        joints=tuple(joint for joint, _ in way),
        links=tuple(link for _, link in way),
        tip=find_tip(robot, leaf, way[-2][1] if len(way) > 1 else None),
    )


def find_tip(robot: Robot, leaf: str, before: str | None) -> Tip:
    """Where a finger ends.

    A frame at the end of its last body, or else the end of that body's surface.

    Args:
        robot: The robot.
        leaf: First link of the finger's last body.
        before: Link of the joint before; None if there is none.

    Returns:
        The tip.
    """
    cloud = robot.body_surface(leaf)
    size = float(np.linalg.norm(cloud, axis=1).max()) if len(cloud) else 0.0
    last = 0.0 if before is None else float(np.linalg.norm(robot.pose_in(leaf, before)[:3, 3]))
    ends = [link for link in robot.body_links(leaf) if not robot.children[link] and link != leaf]
    if ends:
        far = max(ends, key=lambda link: float(np.linalg.norm(robot.pose_in(link, leaf)[:3, 3])))
        distance = float(np.linalg.norm(robot.pose_in(far, leaf)[:3, 3]))
        if distance > max(_LEAST_TIP, 0.5 * size):
            return Tip(
                far,
                np.zeros(3),
                f"the link {far} ends the chain, {1e3 * distance:.0f} mm beyond the last joint",
                0.95,
            )
    if size > _LEAST_TIP:
        # The middle of the outermost slice, so that it lies on the finger's axis and not on its
        # skin.
        middle = cloud[np.linalg.norm(cloud, axis=1) > 0.95 * size].mean(axis=0)
        for _ in range(2):
            along = cloud @ (middle / np.linalg.norm(middle))
            outermost = cloud[along > 0.85 * along.max()]
            middle = 0.5 * (outermost.min(axis=0) + outermost.max(axis=0))
        return Tip(
            leaf,
            middle,
            f"the far end of the surface of {leaf}, {1e3 * size:.0f} mm from the last joint",
            0.8,
        )
    if last > _LEAST_TIP and before is not None:
        straight = (
            np.linalg.inv(robot.pose_in(leaf, before)[:3, :3]) @ robot.pose_in(leaf, before)[:3, 3]
        )
        return Tip(
            leaf,
            0.8 * straight,
            f"{leaf} has no surface and no end: as long as 0.8 of the link before it",
            0.3,
        )
    return Tip(leaf, np.zeros(3), f"{leaf} has no surface and no end: its own origin", 0.1)


def tip_track(robot: Robot, chain: Chain, frame: str, samples: int = 5) -> np.ndarray:
    """Where a chain's tip goes in a frame when all its joints go through their ranges together [m], shape (samples, 3)."""
    columns = [
        robot.active.index(robot.drivers(joint))
        for joint in chain.joints
        if robot.drivers(joint) in robot.active
    ]
    track = []
    for share in np.linspace(0.0, 1.0, samples):
        q = robot.zero.copy()
        q[columns] = robot.lower[columns] + share * (robot.upper[columns] - robot.lower[columns])
        robot.place(q)
        track.append(transform_points(robot.pose_in(chain.tip.link, frame), chain.tip.xyz))
    robot.place(robot.zero)
    return np.array(track)


def _drop_idle(robot: Robot, chains: list[Chain]) -> tuple[list[Chain], list[str]]:
    """Chains that move their own ends."""
    kept, notes = [], []
    for chain in chains:
        frame = robot.parent[chain.links[0]][1]
        track = tip_track(robot, chain, frame)
        if float(np.ptp(track, axis=0).max()) < _LEAST_TRAVEL:
            notes.append(
                f"{', '.join(chain.joints)}: moves nothing that touches, so it is no finger"
            )
        else:
            kept.append(chain)
    return kept, notes


def _drop_forks(chains: list[Chain], notes: list[str]) -> list[Chain]:
    """Of chains that part beyond their middle, the one with most joints.

    One finger with two ends.
    """
    kept: list[Chain] = []
    for chain in sorted(chains, key=lambda one: -len(one.joints)):
        fork = next(
            (other for other in kept if _shared(chain, other) > 0.5 * len(chain.joints)), None
        )
        if fork is None:
            kept.append(chain)
        else:
            notes.append(
                f"{chain.links[-1]}: a second end of the finger that ends at {fork.links[-1]}"
            )
    return [chain for chain in chains if chain in kept]


def _shared(chain: Chain, other: Chain) -> int:
    return sum(one == two for one, two in zip(chain.joints, other.joints, strict=False))


def _drop_linkages(robot: Robot, chains: list[Chain], notes: list[str]) -> list[Chain]:
    """Chains that are no bars of a linkage.

    Driven by another finger's motor, their end staying at one place of that finger.
    """
    kept = []
    for chain in chains:
        drivers = {robot.drivers(joint) for joint in chain.joints}
        hosts = [
            other
            for other in chains
            if other is not chain
            and len(other.joints) > len(chain.joints)
            and drivers == {robot.drivers(joint) for joint in other.joints}
            and any(
                np.ptp(tip_track(robot, chain, link), axis=0).max() < _LINKAGE_SLACK
                for link in other.links
            )
        ]
        if hosts:
            notes.append(
                f"{', '.join(chain.joints)}: a bar of the linkage of the finger that ends at {hosts[0].links[-1]}"
            )
        else:
            kept.append(chain)
    return kept


def _idle(robot: Robot, palm: str, chains: list[Chain]) -> tuple[str, ...]:
    """Movable joints outwards from the palm that are set and move no finger."""
    used = {robot.drivers(joint) for chain in chains for joint in chain.joints}
    below = {joint for leaf in robot.leaves(palm) for joint, _ in robot.chain(leaf, palm)}
    return tuple(joint for joint in robot.active if joint in below and joint not in used)


def _common_link(robot: Robot, palm: str, chains: list[Chain]) -> str:
    """The outermost link of a body that all chains hang from."""
    ways = []
    for chain in chains:
        way = [robot.parent[chain.links[0]][1]]
        while way[-1] != palm:
            way.append(robot.parent[way[-1]][1])
        ways.append(way[::-1])
    common = palm
    for links in zip(*ways, strict=False):
        if len(set(links)) > 1:
            break
        common = links[0]
    return common
