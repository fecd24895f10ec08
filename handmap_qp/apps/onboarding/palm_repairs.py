"""Open a `hand.yaml` whose palm is fixed to a wrong link, so that its page can correct it."""

from pathlib import Path

from msgspec.structs import replace

from handmap_core.errors import HandError
from handmap_qp.hands import (
    HandSpec,
    PalmSpec,
    load_hand,
    read_hand_spec,
    urdf_path,
)
from .detect import detect
from .palm_turns import palm_on
from .robot import Robot, carriers

_KEY = "palm.link"


def loadable(hand: str | Path) -> tuple[str | Path | HandSpec, str]:
    """Return a description that can be loaded if only its palm's link is wrong.

    The palm of such a description is fixed to the nearest link before its own that moves with the
    wrist, with the same axes at zero; that of a link which does not exist is found again.

    Args:
        hand: Path of a `hand.yaml` or name of a hand.

    Returns:
        What `load_hand` takes; and a sentence about what is wrong and was changed, empty if
        nothing. Descriptions with other errors come back as they are.

    Raises:
        HandError: If the palm is to be found again, and there is no hand.
    """
    try:
        load_hand(hand)
    except HandError as error:
        if error.key == _KEY and Path(hand).is_file():
            spec = read_hand_spec(Path(hand))
            palm = _palm_of(spec)
            change = f"here it is fixed to {palm.link!r}; look at its axes, then save"
            return replace(spec, palm=palm), f"{_KEY}: {error.problem}: {change}"
    return hand, ""


def _palm_of(spec: HandSpec) -> PalmSpec:
    """Return the palm on a link that moves with the wrist."""
    robot = Robot(urdf_path(spec), root=spec.root)
    link = spec.palm.link
    wrist = spec.wrist.link
    if not {link, wrist} <= robot.frames.keys():
        return detect(urdf_path(spec), root=spec.root).spec.palm
    body = robot.frames[wrist].parentJoint
    before = (
        each
        for each in carriers(robot.parents, link)
        if robot.frames[each].parentJoint == body
    )
    other = next(before, wrist)
    return palm_on(spec.palm, other, robot.pose_in(link, other))
