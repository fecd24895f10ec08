"""Tasks by name, with the hands and the operators that they have.

To add a task, add an entry. Packages that it needs are imported when it is made.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from handmap_qp.hands import Hand, Names, load_hand
from . import (
    adroit,
    experts,
    handing,
    inserting,
    judge,
    judge_picking,
    judge_table,
    lifting,
    person,
    picking,
    pouring,
    pressing,
    replaying,
    table,
    turning,
    two_hands,
)
from .mapping import OPEN, STRAIGHT, UNMAPPED
from .operator import Operator
from .task import Task


class Entry(NamedTuple):
    """A task.

    Attributes:
        make: Returns the task for a robot hand, by its name or the path of its hand.yaml, with
            some of its objects; with all if there are no names.
        hands: Robot hands by name, of which the first ones are taken without --hands.
        describe: Writes the hand.yaml of a hand of `hands` into a folder and returns its path;
            None if they are hands of `handmap hands list`.
        operators: Makers of operators by name; each takes the robot hand.
        usual: Operators that are taken without --operators.
        recount: Returns the second judge.
        own_hands: Hands that are the operator's own, so that `unmapped` must succeed.
        own_control: Mapping that must fail on these hands; on all others it is `straight`.
        objects: Objects of which some can be chosen.
    """

    make: Callable[[str, Names], Task]
    hands: tuple[str, ...]
    describe: Callable[[str, Path], Path] | None
    operators: Mapping[str, Callable[[Hand], Operator]]
    usual: tuple[str, ...]
    recount: Callable[[], judge.Recount]
    own_hands: Names
    own_control: str = STRAIGHT
    objects: Names = ()

    def controls(self, hand: str) -> Names:
        """Return the mappings that always run on a hand: they show whether the judge is sound.

        Args:
            hand: The hand's name.
        """
        if hand in self.own_hands:
            return (UNMAPPED, self.own_control)
        return (STRAIGHT,)


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
        make=lambda hand, objects: task(hand),
        hands=(adroit.ADROIT,),
        describe=adroit.describe_hand,
        operators={name: partial(_expert, kind, name) for name in experts.STYLES},
        usual=experts.SOUND,
        recount=lambda: partial(recount, scene=adroit.scene_file(kind)),
        own_hands=tuple(adroit.SPEEDS),
    )


def _on_table(
    task: type[table.TableTask],
    operators: Mapping[str, Callable[[Hand], Operator]],
    recount: judge.Recount,
) -> Entry:
    """Return the entry of a task on a table.

    Args:
        task: The task.
        operators: As of `Entry`; the first one is the usual one.
        recount: Judges its records.
    """
    return Entry(
        make=lambda hand, objects: task(_load(hand), objects),
        hands=(person.OWN, *table.HANDS),
        describe=None,
        operators=operators,
        usual=tuple(operators)[:1],
        recount=lambda: recount,
        own_hands=(person.OWN,),
        own_control=OPEN,
        objects=tuple(task.things),
    )


def _load(name: str) -> Hand:
    """Return a robot hand by its name or path; `own` is the person's."""
    return person.own_hand() if name == person.OWN else load_hand(name)


CATALOGUE: dict[str, Entry] = {
    adroit.DOOR: _adroit(adroit.DOOR, adroit.Door, judge.recount_door),
    adroit.RELOCATE: _adroit(adroit.RELOCATE, adroit.Relocate, judge.recount_relocate),
    picking.PICK: _on_table(
        picking.PickTask, person.people(), judge_picking.recount_pick
    ),
    lifting.LIFT: _on_table(
        lifting.LiftTask,
        {**person.people(), **replaying.replayed_people()},
        judge_table.recount_lift,
    ),
    pressing.BUTTON: _on_table(
        pressing.ButtonTask, pressing.OPERATORS, judge_table.recount_button
    ),
    turning.CAP: _on_table(turning.CapTask, turning.OPERATORS, judge_table.recount_cap),
    pouring.POUR: _on_table(
        pouring.PourTask, pouring.OPERATORS, judge_table.recount_pour
    ),
    inserting.PEG: _on_table(
        inserting.PegTask, inserting.OPERATORS, judge_table.recount_peg
    ),
    handing.HAND_OVER: _on_table(
        handing.HandOverTask, two_hands.OPERATORS, judge_table.recount_hand_over
    ),
}
"""All tasks by name."""
