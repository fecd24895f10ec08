"""Find the palm and the fingers, from the branches of a robot and their lengths.

A branch of a body is *finger-like* if it is shorter than `LONGEST_FINGER`. The palm is the body
with at least two finger-like branches. Bodies inside such branches that qualify too, such as a
metacarpal with two fingers, are not the palm.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import Finger
from handmap_qp.se3 import transform_points

LONGEST_FINGER = 0.3
"""A longer branch is a leg or an arm [m]."""
# A chain that moves its end by less than this is a motor or a sensor, not a finger [m].
_LEAST_TRAVEL = 0.004
# An end frame closer than this to the last joint is not a fingertip [m].
_LEAST_TIP = 0.005
# An end frame is the fingertip up to this far inside the end of the surface, and up to this far
# beyond it [m].
_INSIDE, _IN_THE_AIR = 0.005, 0.012
# An end frame this near to the centre of a ball is its centre, and the largest such ball [m].
_AT_CENTRE, _LARGEST_BALL = 0.001, 0.015
# A chain whose end stays within this of a point on another finger is part of a linkage [m].
_LINKAGE_SLACK = 0.004
# A bar turns at least this far about its pivot [rad], which is at least this share of the bar's
# length away from the bar's own joint.
_LEAST_PIVOT, _PIVOT_SHARE = 0.1, 0.4
# Fingers of one hand start within this distance of each other [m].
_APART = 0.16


@dataclass(frozen=True, slots=True, eq=False)
class Tip:
    """The end of a finger.

    Attributes:
        link: Link that carries it.
        xyz: Position in the link's frame [m], shape (3,).
        how: How it was found.
        confidence: From 0 to 1.
    """

    link: str
    xyz: np.ndarray
    how: str
    confidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """The kinematic chain of a finger.

    Attributes:
        joints: Movable joints from the palm outwards.
        links: Child link of each joint.
        tip: Its end.
    """

    joints: tuple[str, ...]
    links: tuple[str, ...]
    tip: Tip


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Palm and fingers of a robot.

    Attributes:
        palm: Link of the palm's body from which all fingers branch.
        chains: The fingers, in the order of the file.
        above: Movable joints between the robot's root and the palm.
        idle: Movable joints beyond the palm that move no finger.
        how: How the palm was found.
        confidence: From 0 to 1.
        notes: Chains that were ignored, and why.
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
        robot: The robot, or a part of it.

    Raises:
        HandError: If there is no hand or more than one; the message names candidates for `root`.
    """
    bodies = [body for body in robot.links if robot.body(body) == body]
    candidates = {
        body: found for body in bodies if len(found := _fingerlike(robot, body)) >= 2
    }
    palms = [
        body
        for body in candidates
        if not any(_hangs_in(robot, body, *other) for other in candidates.items())
    ]
    if len(palms) > 1:
        named = ", ".join(
            _common_palm_link(robot, body, candidates[body]) for body in palms[:8]
        )
        raise HandError(
            f"there are {len(palms)} possible palms: {named}; choose one with --root",
            file=robot.file,
            value=palms,
        )
    if not palms:
        return _one_finger(robot)
    palm, notes = palms[0], []
    chains = [
        _chain(robot, leaf, palm)
        for joint, child in robot.branches(palm)
        if joint in candidates[palm]
        for leaf in robot.leaves(child)
    ]
    kept = _drop_linkages(
        robot, _drop_forks(_drop_idle(robot, chains, notes), notes), notes
    )
    if not kept:
        raise HandError(
            "no branch of the palm moves its end", file=robot.file, value=palm
        )
    _check_one_hand(robot, palm, kept)
    used = {robot.drivers(joint) for chain in kept for joint in chain.joints}
    below = {
        joint for leaf in robot.leaves(palm) for joint, _ in robot.chain(leaf, palm)
    }
    return Structure(
        palm=_common_link(robot, palm, kept),
        chains=tuple(kept),
        above=tuple(joint for joint, _ in robot.chain(palm, robot.root)),
        idle=tuple(
            joint for joint in robot.active if joint in below and joint not in used
        ),
        how=f"the only link from which {len(kept)} chains of at most {LONGEST_FINGER:g} m branch",
        confidence=0.95 if len(kept) > 2 else 0.85,
        notes=tuple(notes),
    )


def fingers_of(robot: Robot, structure: Structure) -> list[Finger]:
    """Return the fingers on the robot's model, in the frame of the palm's link."""
    robot.set_palm(structure.palm)
    return [
        Finger(
            robot,
            [robot.model.getJointId(joint) for joint in chain.joints],
            robot.place_of(chain.tip.link, chain.tip.xyz),
        )
        for chain in structure.chains
    ]


def _check_one_hand(robot: Robot, palm: str, chains: list[Chain]) -> None:
    """Reject two hands on one base: two groups of fingers, far apart.

    Raises:
        HandError: If there are two; the message names their links for `root`.
    """
    roots = np.array([robot.pose_in(chain.links[0], palm)[:3, 3] for chain in chains])
    near = np.linalg.norm(roots[:, None] - roots[None], axis=2) < _APART
    group = np.linalg.matrix_power(near.astype(float), len(chains))[0] > 0.0
    if group.sum() < 2 or (~group).sum() < 2:
        return
    parts = (np.flatnonzero(group), np.flatnonzero(~group))
    links = [_common_link(robot, palm, [chains[i] for i in part]) for part in parts]
    advice = "choose one with --root"
    if links[0] == links[1]:
        advice = "keep the links of one hand in the URDF, because both start at the same link"
    raise HandError(
        f"there are two hands on one base: {len(parts[0])} fingers from {links[0]!r} and "
        f"{len(parts[1])} from {links[1]!r}; {advice}",
        file=robot.file,
        value=links,
    )


def _fingerlike(robot: Robot, body: str) -> set[str]:
    """Return the joints of a body whose branches could be fingers."""
    found = set()
    for joint, child in robot.branches(body):
        chains = [robot.chain(leaf, body) for leaf in robot.leaves(child)]
        is_wheel = joint in robot.endless and all(len(chain) == 1 for chain in chains)
        if (
            not is_wheel
            and max(_reach(robot, chain) for chain in chains) < LONGEST_FINGER
        ):
            found.add(joint)
    return found


def _reach(robot: Robot, chain: list[tuple[str, str]]) -> float:
    """Return the length of a chain from its first joint to its tip [m]."""
    links = [link for _, link in chain]
    steps = [
        robot.pose_in(link, before)[:3, 3] for before, link in itertools.pairwise(links)
    ]
    end = find_tip(robot, links[-1], links[-2] if len(links) > 1 else None)
    steps.append(robot.pose_in(end.link, links[-1])[:3, 3] + end.xyz)
    return float(np.linalg.norm(steps, axis=1).sum())


def _hangs_in(robot: Robot, body: str, other: str, joints: set[str]) -> bool:
    """Return whether a body lies on one of another body's finger-like branches."""
    way, first = robot.chain(body, other), body
    while first in robot.parent and first != other:
        first = robot.parent[first][1]
    return body != other and first == other and bool(way) and way[0][0] in joints


def _common_palm_link(robot: Robot, body: str, joints: set[str]) -> str:
    """Return the link of a palm from which all its finger-like branches start."""
    branches = [child for joint, child in robot.branches(body) if joint in joints]
    return _common_link(robot, body, [_chain(robot, child, body) for child in branches])


def _one_finger(robot: Robot) -> Structure:
    leaves = robot.leaves(robot.root)
    chain = _chain(robot, leaves[0], robot.root)
    reach = _reach(robot, robot.chain(leaves[0], robot.root))
    if len(leaves) > 1 or reach > LONGEST_FINGER:
        what = f"one chain of {reach:.2f} m"
        if len(leaves) > 1:
            what = f"{len(leaves)} chains, none of which branches into fingers"
        is_large = reach > 10.0
        hint = (
            "; are its lengths in millimetres?"
            if is_large
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
        how="the link from which the only chain starts",
        confidence=0.5,
        notes=(
            "there is only one finger, so the dorsal direction and the side are guesses",
        ),
    )


def _chain(robot: Robot, leaf: str, palm: str) -> Chain:
    joints, links = zip(*robot.chain(leaf, palm), strict=True)
    return Chain(
        joints, links, find_tip(robot, leaf, links[-2] if len(links) > 1 else None)
    )


def find_tip(robot: Robot, leaf: str, before: str | None) -> Tip:
    """Find the end of a finger: an end frame of its last body, or else the end of its surface.

    Args:
        robot: The robot.
        leaf: First link of the finger's last body.
        before: Link of the previous joint; None if there is none.
    """
    cloud = robot.body_surface(leaf)
    size = float(np.linalg.norm(cloud, axis=1).max()) if len(cloud) else 0.0
    ends = {
        link: robot.pose_in(link, leaf)[:3, 3]
        for link in robot.body_links(leaf)
        if not robot.children[link] and link != leaf
    }
    if ends:
        far = max(ends, key=lambda link: float(np.linalg.norm(ends[link])))
        distance = float(np.linalg.norm(ends[far]))
        if distance > max(_LEAST_TIP, 0.5 * size) and _is_at_end(
            robot, leaf, ends[far], cloud
        ):
            how = f"the link {far} ends the chain, {1e3 * distance:.0f} mm beyond the last joint"
            return Tip(far, np.zeros(3), how, 0.95)
    if size > _LEAST_TIP:
        # The centre of the outermost slice lies on the finger's axis, not on its skin.
        middle = cloud[np.linalg.norm(cloud, axis=1) > 0.95 * size].mean(axis=0)
        for _ in range(2):
            along = cloud @ (middle / np.linalg.norm(middle))
            outermost = cloud[along > 0.85 * along.max()]
            middle = 0.5 * (outermost.min(axis=0) + outermost.max(axis=0))
        way = middle / np.linalg.norm(middle)
        middle = middle + ((cloud @ way).max() - middle @ way) * way
        how = f"the far end of the surface of {leaf}, {1e3 * size:.0f} mm from the last joint"
        return Tip(leaf, middle, how, 0.8)
    how, last = f"{leaf} has no surface and no end frame", np.zeros(3)
    if before is not None:
        pose = robot.pose_in(leaf, before)
        last = pose[:3, :3].T @ pose[:3, 3]
    if np.linalg.norm(last) > _LEAST_TIP:
        return Tip(leaf, 0.8 * last, f"{how}: 0.8 of the previous link's length", 0.3)
    return Tip(leaf, np.zeros(3), f"{how}: its origin", 0.1)


def _is_at_end(robot: Robot, leaf: str, place: np.ndarray, cloud: np.ndarray) -> bool:
    """Return whether an end frame is at the end of its body's surface, or there is none.

    The centre of a ball is the end of a round fingertip.
    """
    if not len(cloud):
        return True
    length = float(np.linalg.norm(place))
    beyond = float((cloud @ (place / length)).max()) - length
    balls = [
        transform_points(robot.pose_in(link, leaf), robot.balls[link])
        for link in robot.body_links(leaf)
    ]
    at_centre = bool(
        (np.linalg.norm(np.concatenate(balls) - place, axis=1) < _AT_CENTRE).any()
    )
    return -_IN_THE_AIR < beyond < _INSIDE or (
        at_centre and 0.0 < beyond < _LARGEST_BALL
    )


def _swept(robot: Robot, chain: Chain, frame: str) -> np.ndarray:
    """Return the poses of a chain's last link in a frame while its joints cross their ranges.

    All joints cross together.

    Returns:
        Poses, shape (samples, 4, 4).
    """
    drivers = {robot.drivers(joint) for joint in chain.joints}
    mine, poses = np.array([joint in drivers for joint in robot.active]), []
    for share in np.linspace(0.0, 1.0, 5):
        across = robot.lower_limits + share * (robot.upper_limits - robot.lower_limits)
        robot.place(np.where(mine, across, robot.zero))
        poses.append(robot.pose_in(chain.links[-1], frame))
    robot.place(robot.zero)
    return np.array(poses)


def _tip_track(robot: Robot, chain: Chain, frame: str) -> np.ndarray:
    """Return a tip's positions in a frame while its joints cross their ranges [m], (samples, 3)."""
    tip = transform_points(
        robot.pose_in(chain.tip.link, chain.links[-1]), chain.tip.xyz
    )
    return np.array(
        [transform_points(pose, tip) for pose in _swept(robot, chain, frame)]
    )


def _drop_idle(robot: Robot, chains: list[Chain], notes: list[str]) -> list[Chain]:
    """Keep the chains that move their own ends."""
    kept = []
    for chain in chains:
        track = _tip_track(robot, chain, robot.parent[chain.links[0]][1])
        if float(np.ptp(track, axis=0).max()) >= _LEAST_TRAVEL:
            kept.append(chain)
        else:
            joints = ", ".join(chain.joints)
            notes.append(
                f"{joints}: does not move the end of its chain, so not a finger"
            )
    return kept


def _drop_forks(chains: list[Chain], notes: list[str]) -> list[Chain]:
    """Keep the longest of chains that share most joints: one finger with two ends."""
    kept: list[Chain] = []
    for chain in sorted(chains, key=lambda one: -len(one.joints)):
        longer = (
            other
            for other in kept
            if sum(map(str.__eq__, chain.joints, other.joints))
            > 0.5 * len(chain.joints)
        )
        if (fork := next(longer, None)) is None:
            kept.append(chain)
        else:
            end = fork.links[-1]
            notes.append(
                f"{chain.links[-1]}: a second end of the finger that ends at {end}"
            )
    return [chain for chain in chains if chain in kept]


def _drop_linkages(robot: Robot, chains: list[Chain], notes: list[str]) -> list[Chain]:
    """Drop bars of linkages: driven by another finger's joint, and hinged to that finger."""
    kept = []
    drivers = [{robot.drivers(joint) for joint in chain.joints} for chain in chains]
    for chain, own in zip(chains, drivers, strict=True):
        hosts = [
            other
            for other, theirs in zip(chains, drivers, strict=True)
            if len(other.joints) > len(chain.joints)
            and own == theirs
            and any(_is_hinged(robot, chain, link) for link in other.links)
        ]
        if hosts:
            what = (
                f"a bar of the linkage of the finger that ends at {hosts[0].links[-1]}"
            )
            notes.append(f"{', '.join(chain.joints)}: {what}")
        else:
            kept.append(chain)
    return kept


def _is_hinged(robot: Robot, bar: Chain, link: str) -> bool:
    """Return whether the last link of a bar stays at rest in a link, or turns about a point of it.

    The pivot p in the bar and c in the link solve `R p + t = c` for the bar's poses (R, t).
    """
    poses = _swept(robot, bar, link)
    rotations, shifts = poses[:, :3, :3], -poses[:, :3, 3].ravel()
    if np.linalg.norm(rotations - rotations[0], axis=(1, 2)).max() < _LEAST_PIVOT:
        return bool(np.ptp(_tip_track(robot, bar, link), axis=0).max() < _LINKAGE_SLACK)
    matrix = np.hstack([rotations.reshape(-1, 3), np.tile(-np.eye(3), (len(poses), 1))])
    # All points on the pivot's axis fit: the shortest solution is the one nearest to both origins.
    solution = np.linalg.lstsq(matrix, shifts, rcond=1e-6)[0]
    residual = np.linalg.norm((matrix @ solution - shifts).reshape(-1, 3), axis=1)
    off_axis = float(np.linalg.norm(np.cross(robot.axes[bar.joints[-1]], solution[:3])))
    tip = transform_points(robot.pose_in(bar.tip.link, bar.links[-1]), bar.tip.xyz)
    length = float(np.linalg.norm(tip))
    return bool(
        residual.max() < _LINKAGE_SLACK
        and _PIVOT_SHARE * length < off_axis < length + _LINKAGE_SLACK
    )


def _common_link(robot: Robot, palm: str, chains: list[Chain]) -> str:
    """Return the outermost link of a body from which all chains branch."""
    ways = []
    for chain in chains:
        way = [robot.parent[chain.links[0]][1]]
        while way[-1] != palm:
            way.append(robot.parent[way[-1]][1])
        ways.append(way[::-1])
    shared = itertools.takewhile(
        lambda links: len(set(links)) == 1, zip(*ways, strict=False)
    )
    return [palm, *(links[0] for links in shared)][-1]
