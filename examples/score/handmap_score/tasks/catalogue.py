"""Tasks by name, with the hands and the operators that they have.

To add a task, add an entry. Packages that it needs are imported when it is made.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from handmap_qp.hands import Hand
from . import adroit, experts, judge, judge_picking, person, picking
from .operator import Operator
from .task import Task


class Entry(NamedTuple):
    """A task.

    Attributes:
        make: Returns the task for a robot hand, by its name or the path of its hand.yaml.
        hands: Robot hands by name, of which the first ones are taken without --hands.
        describe: Writes the hand.yaml of a hand of `hands` into a folder and returns its path;
            None if they are hands of `handmap hands list`.
        operators: Makers of operators by name; each takes the robot hand.
        usual: Operators that are taken without --operators.
        recount: Returns the second judge.
        own_hand: Whether the operators move their own hand, so that `unmapped` must succeed.
    """

    make: Callable[[str], Task]
    hands: tuple[str, ...]
    describe: Callable[[str, Path], Path] | None
    operators: Mapping[str, Callable[[Hand], Operator]]
    usual: tuple[str, ...]
    recount: Callable[[], judge.Recount]
    own_hand: bool


def _expert(kind: str, name: str, robot: Hand) -> Operator:
    """Return an expert, which has a hand of its own and does not look at the robot's."""
    return experts.Expert(kind, name)


def _adroit(
    kind: str, task: Callable[[str], Task], recount: Callable[..., bool]
) -> Entry:
    """Return the entry of a task with the Adroit hand.

    Args:
        kind: Its name.
        task: Makes it for a hand.
        recount: Judges its records with the scene's file.
    """
    return Entry(
        make=task,
        hands=(adroit.ADROIT,),
        describe=adroit.describe_hand,
        operators={name: partial(_expert, kind, name) for name in experts.STYLES},
        usual=experts.SOUND,
        recount=lambda: partial(recount, scene=adroit.scene_file(kind)),
        own_hand=True,
    )


CATALOGUE: dict[str, Entry] = {
    adroit.DOOR: _adroit(adroit.DOOR, adroit.Door, judge.recount_door),
    adroit.RELOCATE: _adroit(adroit.RELOCATE, adroit.Relocate, judge.recount_relocate),
    picking.PICK: Entry(
        make=picking.make_pick,
        hands=picking.HANDS,
        describe=None,
        operators=person.OPERATORS,
        usual=tuple(person.OPERATORS),
        recount=lambda: judge_picking.recount_pick,
        own_hand=False,
    ),
}
"""All tasks by name."""
