"""What a hand may be instead: pairs of descriptions, of which a user chooses one by pictures.

First come other readings of the file that have nearly as much evidence: another thumb or side, jaws
instead of fingers, or another palm of the robot. Then come other directions of the palm, by quarter
turns.
"""

from typing import Any, NamedTuple

from handmap_qp.hands import THUMB, HandSpec, finger_tips, load_hand
from .detect import Detection
from .edit import corrected, with_other_palm, with_palm_turned
from .hand_choice import at_root
from .palm_turns import Turn, with_turn

# Turns of the palm by which the descriptions of a pair differ from the given one; the pair before
# them is the given one and the other hand that the thumb's place allows.
_TURNED: tuple[tuple[Turn, Turn], ...] = (
    ("y", "dorsal"),
    ("distal", "dorsal"),
    ("x", "dorsal"),
    ("z", "distal"),
)
PALMS = 1 + len(_TURNED)
"""Pairs of palms, which come after the other readings."""
# Evidence for what a reading answers: the user knows better.
_ANSWERS = ("thumb", "side", "dorsal")


class Question(NamedTuple):
    """Two descriptions to choose from.

    Attributes:
        text: What is asked.
        caption: How they differ, in words; empty if only pictures tell.
        gestures: Names of the gestures whose pictures tell them apart.
        choices: The left and the right one. What is known then is not asked again.
        is_reading: Whether they are readings of the file, and not turns of the palm.
    """

    text: str
    caption: str
    gestures: tuple[str, ...]
    choices: tuple[Detection, Detection]
    is_reading: bool = False


def first_question(found: Detection) -> int | None:
    """Return the number of the question that a page begins with; None if all is certain."""
    certainty = {clue.what: clue.certainty for clue in found.clues}
    is_sure = certainty.get("dorsal", "certain") == "certain"
    return None if is_sure and not _count_readings(found) else 0


def count_questions(found: Detection) -> int:
    """Return how many pairs there are; after the last one, the first one comes again."""
    return _count_readings(found) + PALMS


def question(found: Detection, number: int) -> Question:
    """Return a pair of descriptions; slow where another reading is found again.

    Args:
        found: The description.
        number: Which pair, from 0 on.

    Raises:
        HandError: If the file has no hand in another reading.
    """
    number %= count_questions(found)
    readings = _count_readings(found)
    if number < readings:
        is_root = number >= readings - len(found.other_roots)
        other = found.other_roots[number - readings] if is_root else None
        return _other_root(found, other) if other else _runner_up(found)
    pair = palms(found.spec, number - readings)
    first, second = (_known(found, spec) for spec in pair)
    return Question("Which picture is a fist?", "", ("fist",), (first, second))


def palms(spec: HandSpec, number: int) -> tuple[HandSpec, HandSpec]:
    """Return two descriptions with different palms.

    Args:
        spec: The description.
        number: Which pair, from 0 on: the description and its palm turned over, then quarter turns
            about the direction of the fingers, then the fingers in other directions.
    """
    hand = load_hand(spec)
    if number == 0:
        return spec, with_other_palm(hand)
    first, second = _TURNED[number - 1]
    one = with_turn(hand, first)
    return one, with_turn(load_hand(one), second)


def _count_readings(found: Detection) -> int:
    return (found.runner_up is not None) + len(found.other_roots)


def _known(found: Detection, spec: HandSpec) -> Detection:
    """Return a description whose palm the user has chosen."""
    return corrected(found, spec, "side", "dorsal")


def _runner_up(found: Detection) -> Question:
    """Ask for the thumb, the side, and what the fingers are."""
    spec = found.spec
    following = found.runner_up
    assert following is not None
    other = at_root(found, spec.root, following.side, following.link, following.kind)
    if _words(other.spec) == _words(spec) and other.spec.palm == spec.palm:
        # Options of the detection cannot tell them apart.
        other = corrected(found, with_palm_turned(load_hand(spec)))
    choices = (
        corrected(found, spec, *_ANSWERS)._replace(runner_up=None),
        corrected(other, other.spec, *_ANSWERS)._replace(
            runner_up=None, other_roots=found.other_roots
        ),
    )
    return Question(
        "Which one is right, open above and as a fist below?",
        _differences(spec, other.spec),
        ("open", "fist"),
        choices,
        is_reading=True,
    )


def _other_root(found: Detection, root: str) -> Question:
    """Ask which of the robot's palms is meant."""
    rest = tuple(link for link in found.other_roots if link != root)
    other = at_root(found, root)
    return Question(
        "Which hand of the robot is it, open above and as a fist below?",
        _differences(found.spec, other.spec),
        ("open", "fist"),
        (found._replace(other_roots=rest), other._replace(other_roots=rest)),
        is_reading=True,
    )


def _differences(one: HandSpec, other: HandSpec) -> str:
    """Return how two descriptions differ, in words."""
    pairs = zip(_words(one).items(), _words(other).values(), strict=True)
    different = [(what, a, b) for (what, a), b in pairs if a != b]
    if not different and one.palm.distal != other.palm.distal:
        return "The fingers of the right one are straight in another posture."
    if not different:
        return "The right one has its palm turned over."
    left, right = (
        ", ".join(f"{row[0]} {row[place]}" for row in different) for place in (1, 2)
    )
    return f"Left: {left}. Right: {right}."


def _words(spec: HandSpec) -> dict[str, Any]:
    """Return what a reading of a file says, by what it is about."""
    tips = finger_tips(load_hand(spec))
    thumb = tips[THUMB].link if THUMB in tips else "none"
    return {"palm": spec.palm.link, "thumb": thumb, "side": spec.side}
