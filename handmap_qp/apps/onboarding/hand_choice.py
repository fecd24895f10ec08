"""Choose which part of a robot is the hand: roots to detect from, and links of its palm."""

from contextlib import suppress
from pathlib import Path

from msgspec.structs import replace

from handmap_core.errors import HandError
from handmap_qp.hands import (
    MOVABLE,
    Hand,
    HandSpec,
    Names,
    Side,
    edges,
    is_named_source,
    load_hand,
    parse_urdf,
    source_file,
    urdf_path,
)
from .detect import Detection, detect
from .edit import described
from .robot import Robot, carriers
from .single_joints import FingerKind
from .structure import find_palms
from .two_hands import PairedSide, paired_sides
from .write import RobotSource, open_source


def possible_roots(urdf: Path) -> Names:
    """Return the links at which a hand can begin, in the order of the file.

    They are the first links of bodies from which joints branch, or that carry the last body of a
    chain, as a fixed jaw does.

    Raises:
        HandError: If the URDF cannot be used.
    """
    robot = Robot(urdf)
    roots = [robot.root]
    for body in range(robot.model.njoints):
        below = robot.below(body)
        carries_end = any(not robot.below(part) for part in below)
        if len(below) > 1 or carries_end:
            roots.append(robot.links[body][0])
    return tuple(dict.fromkeys(roots))


def palm_links(hand: Hand) -> Names:
    """Return the links from which all fingers branch, the root first: each can be the palm's."""
    _, parents, _ = _tree(hand)
    ways = [
        [*carriers(parents, point.link)] for point in hand.spec.points if point.finger
    ]
    shared = [link for link in ways[0] if all(link in way for way in ways)]
    return tuple(dict.fromkeys([*reversed(shared), hand.spec.palm.link]))


def links_of_hand(hand: Hand) -> Names:
    """Return the links of the palm's body, and those that hang from it.

    Others, of an arm or of the rest of a robot, are not moved by the hand.
    """
    robot, parents, fixed = _tree(hand)
    way = [*carriers(parents, hand.spec.palm.link)]
    # The first link of the palm's body: from it on, all joints up to the palm's link are fixed.
    moving = (i for i, link in enumerate(way) if link not in fixed)
    first = way[next(moving, len(way) - 1)]
    return tuple(link for link in robot if first in carriers(parents, link))


def _tree(hand: Hand) -> tuple[list[str], dict[str, str], set[str]]:
    """Return the links, the parent of each, and those that are fixed to theirs."""
    robot = parse_urdf(hand.urdf_text)
    parents = dict[str, str]()
    fixed = set[str]()
    for joint, parent, child in edges(robot):
        parents[child] = parent
        if joint.get("type") not in MOVABLE:
            fixed.add(child)
    return [link.get("name", "") for link in robot.iterfind("link")], parents, fixed


def first_hand(urdf: Path) -> Detection:
    """Find the hand in a URDF, or the first one of several, which a note says; a finger is none.

    Raises:
        HandError: If the URDF cannot be used, or has no hand from any root on.
    """
    try:
        return detect(urdf)
    except HandError as error:
        palms = find_palms(Robot(urdf))
        for root in dict.fromkeys([*palms, *possible_roots(urdf)[1:]]):
            with suppress(HandError):
                found = detect(urdf, root=root, paired=_paired_side(urdf, root))
                # A single finger is part of a hand that was not found.
                if len(found.chains) < 2:
                    continue
                note = f"the hand at {root} was taken: {error.problem}"
                others = tuple(link for link in palms if link != root)
                return found._replace(
                    notes=(note, *found.notes), other_roots=others * (root in palms)
                )
        raise


def at_root(
    found: Detection,
    root: str | None,
    side: Side | None = None,
    thumb: str | None = None,
    kind: FingerKind | None = None,
) -> Detection:
    """Find the hand of a description again from another root on; all else is derived again.

    Args:
        found: The description.
        root: The link at which the hand begins; that of the URDF if None.
        side: The side, if it is given.
        thumb: A link or joint of the thumb, if it is given.
        kind: What fingers with one flexing joint each are, if it is given.

    Raises:
        HandError: If there is no hand.
    """
    spec = found.spec
    urdf = urdf_path(spec)
    paired = _paired_side(urdf, root)
    again = detect(
        urdf,
        root=root,
        side=side,
        thumb=thumb,
        kind=kind,
        name=spec.name,
        paired=paired,
    )
    return described(again, _source(spec, urdf))


def _paired_side(urdf: Path, root: str | None) -> PairedSide | None:
    """Return the side of one of a robot's two hands by the other one; None without another."""
    if root is None:
        return None
    robot = Robot(urdf)
    palms = find_palms(robot)
    if len(palms) != 2 or root not in palms:
        return None
    pair = paired_sides(robot, (palms[0], palms[1]))
    return pair[palms.index(root)] if pair else None


def _source(spec: HandSpec, urdf: Path) -> RobotSource:
    """Return where a hand was found, with the speeds that the file's actuators tell."""
    named = is_named_source(spec.urdf)
    reference = spec.urdf if named else str(source_file(spec))
    return open_source(Path(reference))._replace(urdf=urdf, reference=reference)


def with_thumb(found: Detection, link: str, side: Side | None = None) -> HandSpec:
    """Return a description whose palm, side and rest are derived again for a given thumb.

    A description of a hand that the detection does not find, or with another palm, keeps them.

    Args:
        found: The description.
        link: The link of the thumb's tip.
        side: The side, if it is given.
    """
    spec = found.spec
    hand = load_hand(spec)
    joint = hand.model.names[hand.frames[link].parentJoint]
    with suppress(HandError):
        again = detect(
            urdf_path(spec), root=spec.root, side=side, thumb=joint, kind=found.kind
        ).spec
        is_same = again.palm.link == spec.palm.link and not spec.mirror
        # The thumb's joints come first in a new description.
        if is_same and {*again.joints} == {*spec.joints}:
            rest = {joint: again.rest[joint] for joint in spec.joints}
            return replace(spec, palm=again.palm, side=again.side, rest=rest)
    return spec
