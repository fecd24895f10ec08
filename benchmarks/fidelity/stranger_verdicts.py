"""Judge what `handmap hands init` makes of a file against what is true of it: `judge`.

A description is judged as its user gets it: as the files that `init_hands` wrote, loaded again.
Its palm, fingers and axes are compared in the URDF, and `handmap hands check`, without its motions,
says whether it contradicts what is wrong.
"""

from __future__ import annotations

import math
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from stranger_list import Group, Stranger, TrueHand

from handmap_qp.apps.onboarding.check import check_hand, check_robot
from handmap_qp.apps.onboarding.findings import HandFinding
from handmap_qp.apps.onboarding.init import DescribedHand, InitResult, init_hands
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.vectors import angle_between
from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands import THUMB

Outcome = Literal[
    "right",
    "wrong",
    "refused rightly",
    "refused wrongly",
    "found in vain",
    "traceback",
]
"""`found in vain`: a hand was described where there is none."""
LARGEST_ANGLE = 20.0
"""A direction that is farther from the true one is wrong [deg]."""
# A rest posture may be on the other side of the straight one by this much [rad or m].
_STILL = 0.02
# The clue that says how certain a key is, where its name is another one.
_CLUES = {"chains": "palm"}
# Keys of findings that doubt a key of the description.
_DOUBTS = {
    "palm": ("palm", "root"),
    "chains": ("points", "palm", "sets"),
    "thumb": ("points",),
    "fingers": ("points",),
    "distal": ("palm",),
    "dorsal": ("palm", "side"),
    "side": ("side", "palm.dorsal"),
    "rest": ("rest",),
}


class WrongKey(NamedTuple):
    """What is wrong in a description.

    Attributes:
        key: `hands`, `palm`, `chains`, `thumb`, `fingers`, `distal`, `dorsal`, `side` or `rest`.
        what: What was found in place of the truth.
        certainty: How certain `init` was: `certain`, `likely` or `a guess: check it`.
        is_contradicted: Whether `check` warns of it.
    """

    key: str
    what: str
    certainty: str = ""
    is_contradicted: bool = False

    def __str__(self) -> str:
        """Return such as `dorsal (certain): 90 deg off, check agrees`."""
        certainty = self.certainty.partition(":")[0]
        given = f" ({certainty})" if certainty else ""
        doubt = ", check contradicts" if self.is_contradicted else ""
        return f"{self.key}{given}: {self.what}{doubt}"


@dataclass(frozen=True)
class Verdict:
    """How right the description of a file is.

    Attributes:
        name: The file's name in the list.
        maker: Its maker.
        group: The group in which it counts.
        is_of_hand: Whether the file has a hand.
        outcome: What became of it.
        wrong: What is wrong, of all its hands.
        message: Why there is no description, on one line.
        seconds: Time of `init` [s].
    """

    name: str
    maker: str
    group: Group
    is_of_hand: bool
    outcome: Outcome
    wrong: tuple[WrongKey, ...] = ()
    message: str = ""
    seconds: float = math.nan

    @property
    def is_good(self) -> bool:
        """Whether all is right, or there is rightly no description."""
        return self.outcome in ("right", "refused rightly")

    @property
    def is_misleading(self) -> bool:
        """Whether something wrong was called certain, and `check` does not warn of it."""
        return self.outcome == "found in vain" or any(
            one.certainty in ("certain", "") and not one.is_contradicted
            for one in self.wrong
        )


def judge(one: Stranger, file: Path) -> Verdict:
    """Describe a file with `init_hands`, check the result, and compare it with the truth.

    Args:
        one: The file's entry in the list.
        file: The file.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # What the loader warns of is among the findings of `check`.
        warnings.simplefilter("ignore")
        try:
            result = init_hands(file, out=Path(folder) / "hand.yaml")
        except HandmapError as error:
            seconds = time.perf_counter() - start
            outcome: Outcome = "refused wrongly" if one.hands else "refused rightly"
            # The file, which may be a converted one, says nothing here.
            reason = error.problem if isinstance(error, HandError) else str(error)
            return _verdict(one, seconds, outcome, " ".join(reason.split()))
        except Exception:  # what no user should see is counted, whatever it is
            seconds = time.perf_counter() - start
            return _verdict(one, seconds, "traceback", traceback.format_exc())
        seconds = time.perf_counter() - start
        if not one.hands:
            palms = ", ".join(each.hand.spec.palm.link for each in result.hands)
            return _verdict(one, seconds, "found in vain", f"a hand at {palms}")
        try:
            check = check_robot if result.is_robot else check_hand
            findings = check(str(result.file), has_motion=False).findings
        except Exception:  # neither should they see this
            return _verdict(one, seconds, "traceback", traceback.format_exc())
        wrong = tuple(_wrong_keys(one, result, file, findings))
    found = _verdict(one, seconds, "wrong" if wrong else "right")
    return replace(found, wrong=wrong)


def _verdict(
    one: Stranger, seconds: float, outcome: Outcome, message: str = ""
) -> Verdict:
    """Return the verdict on a file, with the last line of a message."""
    last = message.strip().rpartition("\n")[2]
    return Verdict(
        one.name,
        one.maker,
        one.group,
        bool(one.hands),
        outcome,
        message=last,
        seconds=seconds,
    )


def _wrong_keys(
    one: Stranger, result: InitResult, file: Path, findings: Sequence[HandFinding]
) -> Iterator[WrongKey]:
    """Yield all that is wrong, with its certainty and what `check` says."""
    if len(result.hands) != len(one.hands):
        yield WrongKey("hands", f"{len(result.hands)} of {len(one.hands)}")
        return
    robot = Robot(result.converted or file)
    if held := find_held(one, robot, file):
        doubted = {
            finding.key.rpartition("locked.")[2]
            for finding in findings
            if finding.level in ("error", "warning") and "locked." in finding.key
        }
        is_said = doubted.issuperset(held)
        yield WrongKey("chains", f"held: {', '.join(held)}", is_contradicted=is_said)
        return
    sides = {hand.side: hand for hand in one.hands}
    for found in result.hands:
        truth = sides.get(found.hand.spec.side) or one.hands[0]
        start = f"{found.hand.spec.side}: " if result.is_robot else ""
        clues = {clue.what: clue for clue in found.clues}
        for wrong in compare(found, truth, robot):
            clue = clues.get(_CLUES.get(wrong.key, wrong.key))
            yield wrong._replace(
                certainty=clue.certainty if clue else "",
                is_contradicted=_is_doubted(wrong.key, findings, start),
            )


def find_held(one: Stranger, robot: Robot, file: Path) -> list[str]:
    """Return joints of the truth that the file has, and that were made fixed.

    Raises:
        HandmapError: If the truth names links or joints that the file does not have.
    """
    held = set[str]()
    for truth in one.hands:
        links = {truth.palm, truth.frame or truth.palm} - robot.frames.keys()
        joints = {*_true_joints(truth), *truth.closes, *truth.straight}
        held |= {*filter(None, joints)} - {*robot.model.names}
        text = file.read_text(encoding="utf-8", errors="replace")
        unknown = {joint for joint in held if f'"{joint}"' not in text} | links
        if unknown:
            named = ", ".join(sorted(unknown))
            raise HandmapError(f"{one.name}: the file has no {named}")
    return sorted(held)


def _is_doubted(key: str, findings: Iterable[HandFinding], start: str) -> bool:
    """Return whether a warning of `check` is about a key; `start` names the hand of a robot."""
    return any(
        finding.level in ("error", "warning")
        and finding.key.startswith(tuple(start + each for each in _DOUBTS[key]))
        for finding in findings
    )


def compare(found: DescribedHand, truth: TrueHand, robot: Robot) -> Iterator[WrongKey]:
    """Yield what is wrong in the description of a hand.

    Args:
        found: The description.
        truth: What is true.
        robot: The URDF from which it was made.
    """
    spec = found.hand.spec
    body = robot.frames[spec.palm.link].parentJoint
    if body != robot.frames[truth.palm].parentJoint:
        yield WrongKey("palm", spec.palm.link)
    chains = {
        point.finger: _chain(robot, point.link, body)
        for point in spec.points
        if point.name.endswith("_tip") and point.finger
    }
    names = [*_named(chains, truth)]
    yield from _compare_fingers(chains, names, truth)
    dorsal = truth.dorsal
    if dorsal and truth.jaws and names[0] == THUMB:
        x, y, z = dorsal
        dorsal = (-x, -y, -z)
    turn = robot.pose_in(spec.palm.link, truth.frame or truth.palm)[:3, :3]
    for key, own, true in (
        ("distal", spec.palm.distal, truth.distal),
        ("dorsal", spec.palm.dorsal, dorsal),
    ):
        if (
            true
            and (angle := angle_between(turn @ own, np.array(true))) > LARGEST_ANGLE
        ):
            yield WrongKey(key, f"{angle:.0f} deg off")
    if truth.side and spec.side != truth.side:
        yield WrongKey("side", spec.side)
    opened = [
        joint
        for joint, sense in truth.closes.items()
        if joint in spec.rest
        and float(f"{sense}1") * (spec.rest[joint] - truth.straight.get(joint, 0.0))
        < -_STILL
    ]
    if opened:
        yield WrongKey("rest", f"opens {', '.join(opened)}")


def _chain(robot: Robot, link: str, palm: int) -> set[str]:
    """Return the names of the joints that move a link relative to the palm's body."""
    supports = robot.model.supports
    moving = {*supports[robot.frames[link].parentJoint]} - {*supports[palm]}
    return {robot.model.names[joint] for joint in moving}


def _true_joints(truth: TrueHand) -> list[str]:
    """Return a joint of each finger that no other finger has."""
    return [*truth.fingers.values(), *(truth.jaws or ()), *truth.alike]


def _named(chains: dict[str, set[str]], truth: TrueHand) -> Iterator[str]:
    """Yield what each true finger is called, empty if it is none; a fixed jaw is what is left."""
    joints = _true_joints(truth)
    for joint in joints:
        theirs = [name for name, chain in chains.items() if joint in chain]
        if not joint:
            moving = {*filter(None, joints)}
            theirs = [name for name, chain in chains.items() if not chain & moving]
        yield theirs[0] if len(theirs) == 1 else ""


def _compare_fingers(
    chains: dict[str, set[str]], names: list[str], truth: TrueHand
) -> Iterator[WrongKey]:
    """Yield what is wrong in the chains, the thumb, and the names of the other fingers."""
    if len(chains) != len(names) or len({*filter(None, names)}) != len(names):
        lost = [joint for joint, name in zip(_true_joints(truth), names, strict=True)
                if not name]  # fmt: skip
        without = f" without {', '.join(lost)}" if any(lost) else ""
        yield WrongKey("chains", f"{len(chains)} of {len(names)} fingers{without}")
        return
    if not truth.fingers:
        return
    called = dict(zip(truth.fingers, names, strict=True))
    true, others = (
        [name for name in row if name != THUMB]
        for row in (truth.fingers, called.values())
    )
    orders = [true] if truth.side else [true, true[::-1]]
    if THUMB in called and called[THUMB] != THUMB:
        yield WrongKey("thumb", f"called {called[THUMB]}")
    elif others not in orders:
        yield WrongKey("fingers", f"called {', '.join(others)}")
